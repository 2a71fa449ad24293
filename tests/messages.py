"""Compare error messages by field, value and allowed values, and not by the words between them."""

import re


def says(error: object, parts: str) -> bool:
    """Return whether the text of `error` has all parts, which " .. " separates, in this order."""
    return re.search(".*".join(map(re.escape, parts.split(" .. "))), str(error), re.DOTALL) is not None
