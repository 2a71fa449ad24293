"""Physical quantities with their units and the range in which a value makes sense."""

from numbers import Real


def require(field: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise ValueError unless low <= value <= high; not-a-number never passes. TypeError for what is no number."""
    if not isinstance(value, Real):
        raise TypeError(f"{field} is {value!r}, expected a number")
    if not low <= value <= high:
        raise ValueError(f"{field} is {value:g}, allowed are {low:g} to {high:g} {unit}")
