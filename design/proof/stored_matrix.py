"""The matrix of a proof as a file holds it: rows of rationals "p/q"."""

from __future__ import annotations

from collections.abc import Sequence

from design.proof.exact import Exact
from design.proof.positive_real import prove_positive_real
from design.proof.rational import Matrix

Rows = tuple[tuple[str, ...], ...]


def rows_of(M: Matrix) -> Rows:
    """Every entry in lowest terms."""
    return tuple(tuple(str(value) for value in row) for row in M.fractions())


def refuted_rows(name: str, block: Exact, rows: Sequence[Sequence[str]]) -> str | None:
    """Why the matrix of this name does not prove that the block is strictly positive real, or None if it does."""
    n = block.order
    if len(rows) != n or any(len(row) != n for row in rows):
        return f"{name} has {len(rows)} rows, the model has {n} states"
    try:
        P = Matrix.of(rows, (n, n))
    except (ValueError, ZeroDivisionError) as error:
        return f"{name} has an entry that is not a rational number: {error}"
    try:
        return prove_positive_real(block, P)
    except OverflowError:
        return f"{name} has an entry beyond the range of floating point"
