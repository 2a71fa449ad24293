"""Names that files, conditions and reports had before, and the names of today. All are still read.

Older spellings of options (`--jitter`) stand with the options.

Digests and seals are made of the first names, so that a file keeps the ones it has.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: fields of loops and scenarios
_FIELDS = {"box": "ranges", "jitter": "varying_delay"}

#: conditions: in files, options and reports
CONDITIONS = {"closed-loop": "this-environment", "theorem4": "any-environment"}

#: what a certificate in a file is claimed for
GUARANTEES = {"a set": "these ranges"}

#: built-in scenarios
SCENARIOS = {"omega-pair-box": "omega-pair-ranges"}

#: of an audit
AUDITS = CONDITIONS | {"jitter-proof": "switching"}


def with_older(parts: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """A report's parts, which stand there by their older names, too."""
    return {**parts, **{older: parts[today] for older, today in names.items() if today in parts}}


def named_today(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields of a file by their names of today. Raises ValueError where one has both names."""
    for older, today in _FIELDS.items():
        if today in fields and older in fields:
            raise ValueError(f"{today} and {older}, its older name: give one of them")
    return {_FIELDS.get(name, name): value for name, value in fields.items()}


def named_first(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields by their names in the first files."""
    first = {today: older for older, today in _FIELDS.items()}
    return {first.get(name, name): value for name, value in fields.items()}
