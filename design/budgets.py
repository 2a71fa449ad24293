"""Budgets of the searches, in one table: how much each may try, and the measurement that set it.

No clock ends a search, so that a busy machine designs what an idle one does. A search ends because it has converged,
because a proof or a bound says so, or because one of these budgets is spent. Work is counted from the sizes of
matrices and numbers (`haptic_loop.controller.arithmetic.spend`); one unit takes about a second on one core.
Measured on the 23 loops of tests/loops, on one core of an AMD EPYC at 2.4 GHz.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

# Work that is counted [units] -----------------------------------------------------------------------------------------

#: Exact arithmetic for one coupling. A proof over 100 states takes 0.3, over 800 states 30.
EXACT = 60.0
#: A sweep, or a search by many of them. A sweep of two devices takes 0.006, of eight devices with 200 states 0.1.
SWEEPS = 60.0
#: Growing the basis of an optimal coupling. The largest loops take 15 (n6, n7) and 13 (n8), so none of them reaches it.
CLIMB = 60.0
#: The search between the vertices of ranges, for one coupling. Seven parameters of three devices take 8.
RANGES = 60.0
#: The price of 10 %, by the most devices: 0.4 to 2.0 (two devices), 2.4 to 5.6 (three, four), 14 and 16 (eight).
PRICE = {2: 6.0, 4: 12.0, 10**3: 40.0}


_Value = TypeVar("_Value")


def of_channels(table: Mapping[int, _Value], channels: int) -> _Value:
    """Return the entry of a table that is made by the most channels."""
    return next(value for most, value in table.items() if channels <= most)
