"""The terminal that reports are printed on: no number of a table is ever cut, no name is taken for a colour."""

from __future__ import annotations

import re
from typing import Any

from rich.console import Console
from rich.errors import MarkupError
from rich.table import Table
from rich.text import Text

from sim.files import nobody_reads

CUT = "…"  # what stands in a table for the end of a word that did not fit
WIDEST = 400  # characters
STEP = 2
OTHER_BRACKET = re.compile(r"\[(?!(?:red|green|yellow|dim|/)\])")  # what opens no tag of our reports: a unit, a name


class Screen(Console):
    """A console whose tables lose nothing: words may break, numbers do not; what is too wide runs over the edge."""

    def print(self, *objects: Any, **how: Any) -> None:
        """As rich's, at the least width from the terminal's at which no table loses a character."""
        own = self._width
        self._width = max([self.width, *(self._needed(one) for one in objects if isinstance(one, Table))])
        try:
            super().print(*objects, **how)
        finally:
            self._width = own

    def render_str(self, text: str, **how: Any) -> Text:
        """As rich's, but a file `[/b].npz` or a device that calls itself `:x:` is printed as it is."""
        how |= {"emoji": False}
        if how.get("markup") is not False:
            try:
                return super().render_str(OTHER_BRACKET.sub(r"\\[", text), **how)
            except MarkupError:  # one of our own tags, closed too often
                how |= {"markup": False}
        return super().render_str(text, **how)

    def on_broken_pipe(self) -> None:  # rich itself would leave with 1, our "it does not hold"
        """A reader that has seen enough (`| head -1`) changes neither the work nor its exit code."""
        self.quiet = True
        nobody_reads()

    def _needed(self, table: Table) -> int:
        least = 4 * len(table.columns) + 1  # frames and padding, and one character for each column
        for width in range(max(self.width, least), WIDEST, STEP):
            lines = self.render_lines(table, self.options.update(width=width), pad=False)
            if not any(CUT in part.text for line in lines for part in line):
                return width
        return WIDEST
