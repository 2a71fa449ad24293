"""Every fault that we could think of, in virtual time, with what it ends in and how soon."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FaultOutcome:
    """What a case came to."""

    fault: str
    stage: str
    cause: str
    zero_force_ms: float | None  # from the fault on; None: not asked, or forces go on
    allowed_ms: float | None
    wrong: tuple[str, ...]  # empty where it went as it must

    @property
    def holds(self) -> bool:
        return not self.wrong


def rehearse_faults() -> list[FaultOutcome]:
    """Every case with the default scenario and lively people, in virtual time; some seconds in all."""
    from hw.faults.__main__ import outcomes

    return [
        FaultOutcome(
            outcome.case.name,
            str(outcome.rehearsal.session.stage),
            outcome.rehearsal.session.cause,
            None if outcome.to_zero is None else 1e3 * outcome.to_zero,
            outcome.case.within,
            outcome.wrong,
        )
        for outcome in outcomes()
    ]
