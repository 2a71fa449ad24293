"""The terminal that reports are printed on: no number of a table is ever cut, no name is taken for a colour."""

from __future__ import annotations

import re
from typing import Any

from rich.console import Console
from rich.errors import MarkupError
from rich.table import Table
from rich.text import Text

from haptic_loop.design.files import nobody_reads, printable

_CUT = "…"  # what stands in a table for the end of a word that did not fit
_WIDEST = 400  # characters
_STEP = 2
_OTHER_BRACKET = re.compile(r"\[(?!(?:red|green|yellow|dim|/)\])")  # what opens no tag of our reports: a unit, a name


class Screen(Console):
    """A console that cuts nothing off: words may be broken, numbers are not; a table may be wider than the terminal."""

    def print(self, *objects: Any, **how: Any) -> None:
        """Print as rich does, but widen until no table loses a character."""
        own = self._width
        self._width = max([self.width, *(self._needed(one) for one in objects if isinstance(one, Table))])
        try:
            super().print(*objects, **how)
        finally:
            self._width = own

    def render_str(self, text: str, **how: Any) -> Text:
        """As rich's, but a file `[/b].npz` or a device that calls itself `:x:` is printed as it is."""
        how, text = how | {"emoji": False}, printable(text)
        if how.get("markup") is not False:
            try:
                return super().render_str(_OTHER_BRACKET.sub(r"\\[", text), **how)
            except MarkupError:  # one of our own tags, closed too often
                how |= {"markup": False}
        return super().render_str(text, **how)

    def on_broken_pipe(self) -> None:  # rich itself would leave with 1, our "it does not hold"
        """Go on without output where its reader has gone (`| head -1`); the exit code stays the same."""
        self.quiet = True
        nobody_reads()

    def _needed(self, table: Table) -> int:
        least = 4 * len(table.columns) + 1  # frames and padding, and one character for each column
        for width in range(max(self.width, least), _WIDEST, _STEP):
            lines = self.render_lines(table, self.options.update(width=width), pad=False)
            if not any(_CUT in part.text for line in lines for part in line):
                return width
        return _WIDEST
