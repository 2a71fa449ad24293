"""A terminal for reports: it never cuts numbers in tables, and it prints names literally."""

from __future__ import annotations

import re
from typing import Any

from rich.console import Console
from rich.errors import MarkupError
from rich.table import Table
from rich.text import Text

from haptic_loop.controller.units import in_unit
from haptic_loop.design.files import discard_output, lost_output, printable

_CUT = "…"  # rich's mark for a cut word
_WIDEST = 400  # [characters] largest width of a table
_STEP = 2  # characters by which the width grows
_OTHER_BRACKET = re.compile(r"\[(?!(?:red|green|yellow|dim|/)\])")  # "[" that does not begin one of our reports' tags


def _in_unit(shown: Any) -> Any:
    """Return a text or table in the unit of this command, metres or radians."""
    if isinstance(shown, Table):
        shown.title = shown.title and in_unit(str(shown.title))
        for column in shown.columns:
            column.header = in_unit(str(column.header))
            column._cells = [in_unit(cell) if isinstance(cell, str) else cell for cell in column._cells]
    return in_unit(shown) if isinstance(shown, str) else shown


class Screen(Console):
    """A console that makes tables wider than the terminal (up to _WIDEST) instead of cutting a cell."""

    def print(self, *objects: Any, **how: Any) -> None:
        """Print as rich does, but widen the console up to _WIDEST, so that no table loses a character.

        If standard output cannot be written, the command goes on without it, to store its files.
        """
        own, objects = self._width, tuple(map(_in_unit, objects))
        self._width = max([self.width, *(self._needed(one) for one in objects if isinstance(one, Table))])
        try:
            super().print(*objects, **how)
        except OSError as error:
            if self.stderr:
                raise
            lost_output.append(error)
            discard_output()
        finally:
            self._width = own

    def render_str(self, text: str, **how: Any) -> Text:
        """Render as rich does, but print names such as `[/b].npz` or `:x:` literally."""
        how, text = how | {"emoji": False}, printable(text)
        if how.get("markup") is not False:
            try:
                return super().render_str(_OTHER_BRACKET.sub(r"\\[", text), **how)
            except MarkupError:  # an unbalanced closing tag
                how |= {"markup": False}
        return super().render_str(text, **how)

    def on_broken_pipe(self) -> None:
        """Continue without output after its reader has left (`| head -1`). rich would change the exit code to 1."""
        self.quiet = True
        discard_output()

    def _needed(self, table: Table) -> int:
        least = 4 * len(table.columns) + 1  # frames, padding and one character for each column
        for width in range(max(self.width, least), _WIDEST, _STEP):
            lines = self.render_lines(table, self.options.update(width=width), pad=False)
            if not any(_CUT in part.text for line in lines for part in line):
                return width
        return _WIDEST
