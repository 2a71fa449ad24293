"""Physical quantities with their units and the range in which a value makes sense."""


def require(field: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise ValueError unless low <= value <= high; not-a-number never passes."""
    if not low <= value <= high:
        raise ValueError(f"{field} is {value:g}, allowed are {low:g} to {high:g} {unit}")
