"""What a design raises when it has nothing to return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Attempt:
    """What one rung of the ladder gave."""

    settings: str
    status: str
    value: float | None  # the objective, None where the attempt was refused
    wall_s: float
    reason: str | None = None  # why it was refused


class DesignFailed(ValueError):
    """No result could be verified. `problem` is the convex problem, if there is one, `results` what was tried."""

    def __init__(self, problem: Any, results: Sequence[Any], advice: str) -> None:
        self.problem, self.results, self.advice = problem, tuple(results), advice
        super().__init__(advice)


class Infeasible(DesignFailed):
    """What was asked for does not exist."""
