"""What a device is asked before it streams: who it is (HELLO), and to run like this (CONFIG).

A question is asked again until it is answered, and given up after a while. Knows no stages: hw/session.py does.
"""

from __future__ import annotations

from hw.frame import Ack, Config, Hello, Info, config_crc, encode
from hw.handshake import Units, configuration, objections
from hw.message import Refused
from hw.safety import Fault, Limits
from sim.scenario import Scenario

RESEND_US, PATIENCE_US = 100_000, 2_000_000


class Unanswered(Exception):
    """A question that was asked for long enough, in the words of the log."""


class Dialogue:
    """The host's questions, and what it learnt from the answers."""

    def __init__(self, scenario: Scenario, limits: Limits, baud: int | None) -> None:
        self._scenario, self._limits, self._baud = scenario, limits, baud
        self.info: Info | None = None
        self.units: Units | None = None
        self.config: Config | None = None
        self._question: Hello | Config = Hello()
        self._begun = self._asked_at = 0  # [us]

    def hello(self, now: int) -> bytes:
        """Who are you?"""
        return self._ask(Hello(), now)

    def configure(self, theta: int, now: int) -> bytes:
        """Run with a delay of `theta` ticks, within the limits of both."""
        assert self.info
        self.config = configuration(self.info, self._limits, theta)
        return self._ask(self.config, now)

    def again(self, now: int) -> bytes:
        """The question once more, where it is time for it. Raises Unanswered where there was time enough."""
        waited = now - self._begun
        if waited > PATIENCE_US:
            raise Unanswered(f"no answer to {type(self._question).__name__.upper()} within {waited / 1e6:.1f} s")
        if now - self._asked_at < RESEND_US:
            return b""
        self._asked_at = now
        return encode(self._question)

    def meet(self, info: Info) -> None:
        """Take in who the device is. Raises Fault where it may not run this scenario."""
        reasons = objections(info, self._scenario, self._limits, self._baud)
        if reasons:
            raise Fault("; ".join(reasons))
        self.info, self.units = info, Units.of(info)

    def concerns(self, ack: Ack) -> bool:
        """Whether it answers the last CONFIG."""
        return self.config is not None and ack.crc == config_crc(self.config)

    def agreed(self, ack: Ack) -> bool:
        """Whether the device runs by the last CONFIG from now on. Raises Fault where it refuses to.

        False while it is still on its way to zero force: then it will be asked again.
        """
        if ack.refused in (Refused.ACCEPTED, Refused.RUNNING):
            return ack.refused == Refused.ACCEPTED
        known = [r.name.lower() for r in Refused if r == ack.refused]
        raise Fault(f"the device refuses the configuration: {(known or [ack.refused])[0]}")

    def _ask(self, question: Hello | Config, now: int) -> bytes:
        self._question, self._begun, self._asked_at = question, now, now
        return encode(question)
