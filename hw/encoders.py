"""Check encoders and motors: noise at rest, the answer to a test force, and motion while a session's forces act."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from haptic_loop.controller.lti import Array
from haptic_loop.hw.limits import SafetyLimits, Units
from haptic_loop.hw.protocol import SafetyStop, State
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import build
from haptic_loop.sim.scenario import Scenario

_IMPULSE = 0.1  # [s] longest time without a motion for which a force change of 1 N (EncoderMonitor: _newton) may act
_HEAVIEST = 2.5  # [kg] largest mass of hand and handle
_TEST_FORCE, _TEST_HALF, _BLOCKS = 1.3, 0.03, 4  # force in the last block [N], half a period [s], number of blocks
_PULSE = 2 / 3  # share of half a period in which the test force acts; pauses separate the motions of both directions
_TEST_SPEED = 0.1  # [m/s] speed in the last test, whose force may exceed _TEST_FORCE; a one-way motor reaches 0.4 m/s
_TEST_BEFORE = 0.012  # [s] time at zero force before the test of an axis
_TEST_RATIO = 2.0  # largest ratio of a motion to the expected motion, or of the expected motion to it
_DEGREE = 5  # degree of the polynomials that remove a hand's own motion; they leave 2e-5 of a motion at 2 Hz
_ROUGH = 12  # largest degree of polynomials that contain a motion at the force's 17 Hz, but none above 45 Hz
#: A motion has the expected shape if a multiple of that shape makes up this share of its sum of squares. The share is
#: 0.93 for loosely held handles, and at most 0.5 for compliant devices whose handle is held firmly.
_FIT = 0.8
_LATE = 0.75  # [ticks] largest hidden delay: amplifiers have a short delay, but no certificate covers a whole tick
#: ratios friction / force: above the first, the fit finds too little friction in weaker motions; above the second, a
#: weight beside the friction looks like a delay
_HIDES, _HIDES_ALL = 0.2, 0.35
#: most seconds by which friction makes a motion earlier, per ratio friction / force, in rehearsals at 0.5 to 2 ms: with
#: rigid devices in fits without and with friction, and with compliant devices
_EARLY_PLAIN, _EARLY_RUBBED, _EARLY_COMPLIANT = 11e-3, 4e-3, 20e-3
#: least ticks by which friction makes the strongest motion of a compliant device later, per ratio friction / force
_LATER_COMPLIANT = 0.5
_CROSS = 0.25  # largest motion of another axis, as a share of the expected motion; a common table transmits less
#: least share of the expected swing: firm hands (0.5 kg, 20 N s/m, 1500 N/m) leave 0.09 with a rigid device of
#: 40 g, 0.22 with those of omega-pair and 0.38 with a rigid device of 0.25 kg; dead motors leave 0.03
_ALIVE = 0.06
_UNEVEN = 0.2  # largest difference of the two directions of motor or encoder, as a share of their sum: a factor of 1.5
_ZONE = 0.72  # least ratio of motion / expected motion to its value under twice the force; 1 without a dead zone
_CLEAN, _RUBBED = 0.15, 0.25  # a dead zone is judged up to this one-sided share, and up to this ratio friction / force
#: largest ratio of friction at rest to friction in motion; least motion in one pulse, as a share of the motion in a
#: block (1/3 for a free mass)
_STICKS, _SLID = 2.0, 0.3
#: a one-sided fault must explain this multiple of the squares that remain unexplained; friction and weight reach 6
_BETTER = 8.0
#: largest span of the positions in a block of an identification, as a multiple of the expected span; at most 1.4 for
#: devices as declared, and 2.8 for half the mass
_DRIFT = 3.0
_WEAKENED = 0.7  # least motion at the end of a session, as a share of the motion at arming
_LETTING_GO = 5.0  # [s] time at the end of a session in which a person can let go of a handle
ELSEWHERE = 5e-3  # [m] least motion by a person after which a handle counts as moved to another place
_SETTLED, _CALM = 0.5, 5e-4  # [s] rest before and after a person moves an axis; [m] largest motion in a rest
_REST = 0.1  # [s] window in which the noise of an encoder at rest is measured
_PRESSING, _PRESSED = 0.3, 0.5  # least force in units of `_newton`; longest time [s] of rest under such a force
#: [m] least motion of a calm hand within _PRESSED; the hand drifts like a random walk, so n times the motion takes n^2
#: times as long
_TREMOR = 3e-5


class EncoderNoise:
    """The noise of every encoder at rest, while no force acts.

    It is the least range of counts over windows of 100 ms, so a person may move the handle before or after a window.
    """

    def __init__(self, axes: int, T: float) -> None:
        self._recent = [deque[int](maxlen=max(8, round(_REST / T))) for _ in range(axes)]
        self.range: list[int | None] = [None] * axes  # [counts] least range of a full window; None before the first

    def note(self, counts: Sequence[int]) -> None:
        """Process the counts (m,) of a tick."""
        for i, (recent, n) in enumerate(zip(self._recent, counts, strict=True)):
            recent.append(n)
            if len(recent) == recent.maxlen:
                own, least = max(recent) - min(recent), self.range[i]
                self.range[i] = own if least is None else min(own, least)

    def above(self, widest: float, units: Units) -> str | None:
        """Return a message about an encoder whose noise exceeds one count and `widest` [m], or None."""
        for i, (least, q) in enumerate(zip(self.range, units.encoder_step, strict=True), start=1):
            if least and least > 1 and least * q > widest:
                noise = f"its positions vary by {1e3 * least * q:.3g} mm within {_REST:g} s"
                return f"encoder {i} is noisy at rest: {noise}, at most {1e3 * widest:g} mm is allowed"
        return None

    @property
    def still(self) -> tuple[int, ...]:
        """Return the range (m,) [counts] in which an encoder rests: twice its noise, but 1 for a noise of up to 1.

        Broken channels toggle by 1. Over a longer time, noise exceeds this range with a probability below 1e-6.
        """
        return tuple(2 * least if least and least > 1 else 1 for least in self.range)


class AxisCheck:
    """Let a person move one axis after the other in its + direction while no force acts.

    This finds axes that are reversed or exchanged with motors and encoders together, which no force can show. Motions
    are judged between places where all handles rest, so that a handle that sags slowly passes no axis. People move
    wrong handles, so after a wrong motion the person tries again from the same place. The same wrong motion twice is
    an error.
    """

    def __init__(self, units: Units, T: float, lever: float) -> None:
        self._step, self._far, self._rest = units.encoder_step, ELSEWHERE / lever, round(_SETTLED / T)
        self._calm = [max(_CALM / lever, 1.5 * q) for q in self._step]
        self._axis, self._still = 0, 0  # the axis that is asked for, ticks of rest
        self._moving: int | None = None  # the last axis to move
        self._anchor: tuple[int, ...] = ()  # [counts] place at which the present rest began
        self._origin: tuple[int, ...] = ()  # [counts] place of rest from which the next motion is counted
        self._wrong: tuple[int, bool] | None = None  # axis and sign of the last wrong motion
        self._finding = ""  # words for the last wrong motion

    @property
    def request(self) -> str | None:
        """What the person must do now; None once all axes were moved."""
        if self._axis == len(self._step):
            return None
        if not self._origin:
            return "let every handle rest" + ("" if self._moving is None else f": axis {self._moving + 1} moves")
        ask = f"move axis {self._axis + 1} by +{1e3 * self._far:.3g} mm or more and hold it"
        return f"{self._finding}. Go back, then {ask}" if self._wrong else ask

    def note(self, counts: tuple[int, ...]) -> str | None:
        """Process the counts (m,) of a tick. Return a message once a wrong motion is repeated."""
        places = zip(counts, self._anchor or counts, self._step, self._calm, strict=True)
        strayed = [abs(n - then) * q - calm for n, then, q, calm in places]
        if not self._anchor or max(strayed) > 0:
            self._moving = strayed.index(max(strayed)) if self._anchor else None
            self._anchor, self._still = counts, 0
            return None
        self._still += 1
        if self._still != self._rest or self._axis == len(self._step):
            return None
        origin, self._origin = self._origin, counts
        moved = [(n - then) * q for n, then, q in zip(counts, origin or counts, self._step, strict=True)]
        return self._judged(origin, moved) if max(map(abs, moved)) >= self._far else None

    def _judged(self, origin: tuple[int, ...], moved: list[float]) -> str | None:
        """Judge a motion (m,) [m] from `origin` to the next rest. Return a message if it repeats a wrong one."""
        far, asked = [abs(x) for x in moved], self._axis
        farthest, others = far.index(max(far)), max([x for i, x in enumerate(far) if i != asked], default=0.0)
        if moved[asked] >= self._far and others <= moved[asked] / 2:
            self._axis, self._wrong = asked + 1, None
            return None
        if farthest < asked:  # An axis that has passed moves back.
            return None
        self._finding = f"axis {farthest + 1} moved by {1e3 * moved[farthest]:+.3g} mm"
        if farthest != asked:
            self._finding += f" instead of axis {asked + 1}"
            why = "the axes are exchanged, with motors and encoders, or the person moved another axis"
        elif moved[asked] < 0:
            self._finding += ", not in + direction"
            why = "reverse both its motor and its encoder, unless the person moved it the other way"
        else:
            self._finding += f", and another axis by {1e3 * others:.3g} mm"
            why = "move one axis alone"
        again, self._wrong, self._origin = self._wrong, (farthest, moved[farthest] > 0), origin
        return f"{self._finding}, twice: {why}" if again == self._wrong else None


class Expected:
    """Predict how the encoders move under a force while the handles are free, or held by the scenario's hands.

    For free handles, also predict their motion in hands that weigh as much as the devices.
    """

    def __init__(self, scenario: Scenario, held: bool, rough: bool = False) -> None:
        """Build the plants. If `held`, the hands of the scenario hold the handles; otherwise nobody does.

        In an identification the scenario's masses and transmissions are `rough` values.
        """
        import scipy

        self.held, self.rough, devices = held, rough, scenario.device
        bodies = [device.bodies.values() for device in scenario.axis_devices]
        self.mass = [sum(own) for own in bodies]  # (m,) [kg]
        stiffness = [(device.transmission or (0.0, math.inf))[1] for device in scenario.axis_devices]
        #: (m,) [rad/s] at which a motor swings against its handle; infinite for rigid devices
        self.mode = [math.sqrt(k * sum(1 / m for m in own)) for k, own in zip(stiffness, bodies, strict=True)]
        if held:
            scenes = [build(devices, scenario.human, scenario.person)] * 2
        else:
            weights = [sum(device.bodies.values()) for device in devices]
            scenes = [build(devices, [Human((Link(i * w, 0.0, 0.0),)) for w in weights]) for i in (0, 1)]
        plants = [hold(scene.plant, scenario.T) for scene in scenes]
        (own, heavy), n = ([-p.B[:, s.outside :] for p, s in zip(plants, scenes, strict=True)]), len(plants[0].A)
        # The state has three plants: free or held; in heavy hands if free; the first again, under absolute forces.
        self._A = scipy.linalg.block_diag(plants[0].A, plants[1].A, plants[0].A)
        self._B = np.vstack([own, heavy, 0 * own]), np.vstack([0 * own, 0 * heavy, own])
        self._places = np.array([0, n, n + len(heavy)])
        self.rest()

    def rest(self) -> None:
        """Set all plants to rest."""
        self._state = np.zeros(len(self._A))

    def advance(self, axis: int, force: float) -> Array:
        """Apply the force [N] of the motor of `axis` for a tick, and return three positions [m] of this axis.

        The first is the expected position. The second is expected in a hand as heavy as the device, if the handles are
        free. The third is expected under the absolute values of all forces so far.
        """
        signed, absolute = self._B
        self._state = self._A @ self._state + signed[:, axis] * force + absolute[:, axis] * abs(force)
        return self._state[self._places + axis]


class _Fit(NamedTuple):
    """The least squares fit of some shapes to a motion."""

    shares: Array  # (k,) coefficients of the shapes
    doubts: Array  # (k,) error bounds of the coefficients: sqrt(12) standard errors, with 0.05 % of normal errors above
    explains: bool  # whether the last shape explains over _BETTER times the squares in `rest` that are not noise
    rest: float  # [m^2] sum of squares that remains
    fitted: Array  # (n,) [m]

    @classmethod
    def of(cls, motion: Array, noise: float, *shapes: Array) -> _Fit:
        """Fit shapes (n,) to a `motion` (n,) [m] with a standard deviation of `noise` [m]."""
        columns = np.stack(shapes, axis=1)
        inverse = np.linalg.pinv(columns)
        shares, lengths = inverse @ motion, np.linalg.norm(inverse, axis=1)
        fitted = columns @ shares
        rest = float(((motion - fitted) ** 2).sum())
        most = _BETTER * max(0.0, rest - len(motion) * noise**2) * lengths[-1] ** 2
        return cls(shares, 12**0.5 * noise * lengths, bool(shares[-1] ** 2 > most), rest, fitted)


class _Answer(NamedTuple):
    """The motion with which an axis has passed its test."""

    size: float  # as a multiple of the expected motion
    sided: float  # difference of the motions in the two directions, as a share of their sum
    rounding: float  # largest error of `size` that rounding causes


class CheckedAxes(NamedTuple):
    """The axes whose encoders and motors are checked."""

    limits: SafetyLimits
    units: Units
    T: float  # [s]
    still: tuple[int, ...]  # (m,) [counts] ranges in which the encoders rest; a motion within its range is noise


class _Block:
    """The motions (m,) in one block of a test, compared with the expected motion of the tested axis."""

    def __init__(self, rows: Array, axis: int, axes: CheckedAxes, mass: float, rough: bool = False) -> None:
        """Take the rows of EncoderTest, and the `mass` [kg] of the tested axis.

        If its transmission is a `rough` value, only motions near the frequency of the force count, because a mode at
        45 Hz or more changes them little. Then no fit shows a delay, friction or a fault of the axis.
        """
        t, expected, loaded, even, *counts = rows.T
        q, ranges = np.array(axes.units.encoder_step), np.array(axes.still)
        self.span, self.reach = np.ptp(counts, axis=1), np.ptp(expected)  # [counts], [m]
        whole = np.linalg.qr(np.vander((t - t.mean()) / len(t), _ROUGH + 1, increasing=True))[0]
        smooth, band = whole[:, : _DEGREE + 1], whole[:, _DEGREE + 1 :]
        self._fast = lambda signal: band @ (band.T @ signal) if rough else signal - smooth @ (smooth.T @ signal)
        count, self._rough = band.shape[1] if rough else len(t), rough
        speed, position = np.gradient(expected, t), np.array(counts).T * q
        parts = expected, np.cumsum(expected), loaded, speed, even
        wanted, late, heavy, rate, even = map(self._fast, parts)
        moved, power = self._fast(position), float(wanted @ wanted) or 1.0
        self.size = wanted @ moved / power  # as a multiple of the expected motion
        #: bound of the error of the size that rounding causes; the errors of two motions add up to at most sqrt(2)
        #: times as much (the largest difference of 99.97 % of simulated motions of two counts)
        self.rounding = 0.9 * float(q[axis] / (self.reach or 1.0))
        # standard deviation [m] of rounding, or of noise if that is larger: the range `still` / 2 spans four of them
        noise = q * np.maximum(12**-0.5, ranges / 8)
        own = np.maximum((moved**2).sum(axis=0) - count * noise**2, count * noise**2)
        fit, tested = self.size**2 * power / own, moved[:, axis]
        both = np.linalg.qr(np.stack([wanted, late], axis=1))[0]
        self.moves = self.span > ranges
        # `late` is the integral of `wanted`, so that a swing at the frequency of the force counts at any phase.
        self.swings = bool(np.linalg.norm(both.T @ tested) > _ALIVE * math.sqrt(power))
        # A block lasts about as long as the window in which the noise was measured: a motion exceeds it by 2.
        self.follows = (self.span > np.maximum(1, ranges // 2 + 1)) & (fit > _FIT)
        #: whether the tested axis moves like a free handle, and not like one in a hand as heavy as the device
        self.free = bool(fit[axis] > _FIT > (heavy @ tested) ** 2 / ((heavy @ heavy or 1.0) * own[axis]))
        self._t, self._slow, self._inertia = t, (position - moved)[:, axis], mass / axes.T**2  # [N/m]
        self._slip = 0.1 * np.abs(speed).max() or 1.0  # [m/s]
        self._motion, self._shapes, self._even = (tested, float(noise[axis])), (wanted, rate), even

    def fits(self) -> list[_Fit]:
        """Fit three sets of shapes to the motion of the tested axis.

        The first set has the expected motion, its rate and the motion under absolute forces; it gives the delay. With
        a shape for dry friction the delay would be 6 times less certain, because both shift the phase.
        Each other set has the expected motion, its rate, the motion under a friction of 1 N, and a one-sided fault: of
        a motor (the motion under absolute forces), or of an encoder that loses counts (the length of the path).
        """
        if self._rough:
            return [_Fit(np.eye(4)[0], np.array([0, 0, np.inf, 0]), False, 0.0, self._motion[0])] * 3
        delay = _Fit.of(*self._motion, *self._shapes, self._even)
        fits = [delay]
        for _ in range(2):  # Friction and path of the second round follow the motion that the first round has fitted.
            speed = np.gradient(min(fits, key=lambda one: one.rest).fitted + self._slow, self._t)
            rub = self._fast(np.tanh(speed / self._slip).cumsum().cumsum() / -self._inertia)
            extras = self._even, self._fast(np.abs(speed).cumsum())
            fits = [_Fit.of(*self._motion, *self._shapes, rub, extra) for extra in extras]
        return [delay, *fits]


class EncoderTest:
    """Test whether encoders answer a small force that acts on one axis after the other.

    In a block of 120 ms, pulses of 20 ms act every 30 ms in alternating directions; the next block is twice as strong.
    After a block, a polynomial of degree 5 is subtracted from every position. It contains the intended motion of a hand
    in this time, such as 50 mm at 2 Hz, and little of the answer. The remainder must match the expected motion in shape
    (`_FIT` of its sum of squares), in sign, and in size within a factor of 2. A reversed motor or encoder gives the
    wrong sign, a wrong scale the wrong size. A dead encoder and a held or moved handle give another shape. A late
    motion shows a hidden delay, because friction and hands advance the phase of a motion. Dry friction makes weak
    motions small, so only with the strongest force is a small motion wrong. Coarse counts leave the delay uncertain:
    stronger forces follow until the error of the delay is small enough, or the delay is not tested (`remarks`). A fit
    of dry friction finds a motor that is weak, or an encoder that loses counts, in one direction, because friction
    under a weight gives other shapes. Under twice the force, a motor with a dead zone makes much more than twice the
    motion; with low friction alone the motion is about twice as large. A motor is also dead at small forces if a block
    does not move the axis, but twice the friction that the last block shows could not have held it.

    The test at the end of a session has the largest force that the session allows, and finds a motor that saturates: a
    motion may be 30 % smaller than at arming (`before`), whatever the mass. Unknown hands may hold the handles, except
    in rehearsals (`held`). With unknown hands, two blocks in a row must agree, and blocks are repeated until the person
    lets go, at most for 5 s. A small or late motion then counts as wrong only if its shape fits a free handle, but not
    a handle in a hand as heavy as the device. The two shapes differ for a device with a transmission; for a rigid
    device they are equal. If an axis never moves as a free handle does, the session does not finish. If it swings
    at the frequency of the force, at any phase, the message asks to let go: a dead motor would not swing it.
    """

    def __init__(
        self,
        axes: CheckedAxes,
        expected: Expected,
        at_once: bool = False,
        before: Sequence[_Answer] | None = None,
    ) -> None:
        """Test the axes one after the other against the `expected` motion.

        A STATE reports the force that acts after it, or with `at_once` (theta = 0) the force that acted before it.
        `before` has the answers at arming, which the test at arming stores in `sizes`.
        """
        self._at_once, self._closing, self._before = at_once, before is not None, before
        self.sizes: list[_Answer] = []
        self._axes, self._units, self._expected = axes, axes.units, expected
        lever, T = axes.limits.lever, axes.T
        push = 2 * _TEST_SPEED / (lever * _PULSE * _TEST_HALF) * self._closing
        self._most = [max(_TEST_FORCE * lever, push * mass) for mass in expected.mass]  # (m,) [N] without a cap
        self._strongest = list(map(min, axes.limits.cap, self._most))
        self._lead, self._half = max(1, round(_TEST_BEFORE / T)), max(2, round(_TEST_HALF / T))  # [ticks]
        self._axis, self._last = -1, None
        self.remarks: list[str] = []  # what the test could not judge
        self._unknown_hands = self._closing and not expected.held
        self._blocks = _BLOCKS + self._closing + round(_LETTING_GO / (4 * _TEST_HALF)) * self._unknown_hands
        self._next_axis()

    def _next_axis(self) -> None:
        self._axis, self._ticks, self._block = self._axis + 1, 0, _BLOCKS - 1 if self._closing else 0
        self._expected.rest()
        self._rows: list[tuple[float, ...]] = []  # tick, three expected positions [m] and counts (m,) in this block
        self._pushed = 0.0  # [N] largest force on the axis in this block
        self._finding: str | None = None  # the verdict of the last block
        self._swings = False  # whether the axis swung at the frequency of the force in a block
        self._stuck = 0.0, 0.0  # strongest force [N] that did not move the axis, and the motion [m] expected of it
        self._weaker = math.nan  # upper bound of the last block's relative size without friction; nan if uncertain

    def force(self, state: State, ticks: int) -> tuple[float, ...] | None:
        """Return the forces fed back (m,) [N], `ticks` ticks after the last call; None once all encoders have answered.

        Raises SafetyStop, naming the axis, where an encoder answers wrongly, or not even to the strongest test force.
        """
        acted: State | None = state if self._at_once else self._last
        pushed = acted.applied[self._axis] * self._units.force_step[self._axis] if acted else 0.0
        position = [self._expected.advance(self._axis, pushed) for _ in range(ticks)][-1]
        self._last, self._ticks, self._pushed = state, self._ticks + ticks, max(self._pushed, abs(pushed))
        self._rows.append((self._ticks, *position, *state.counts))
        if self._ticks > self._lead + 4 * self._half:
            if self._passed():
                self._next_axis()
                if self._axis == len(self._strongest):
                    return None
            elif self._block == self._blocks - 1:
                raise SafetyStop(self._unanswered())
            else:
                self._ticks, self._block, self._pushed = self._lead, self._block + 1, 0.0
                self._rows = [(self._ticks, *position, *state.counts)]
        since, half = self._ticks - self._lead, self._half
        number, place = divmod(since - 0.5 + half / 2, half)
        sign = (1 - 2 * (number % 2)) * (since > 0 and abs(place - half / 2) < half * _PULSE / 2)
        size = self._strongest[self._axis] * 2.0 ** min(0, self._block + 1 - _BLOCKS)
        return tuple(sign * size if i == self._axis else 0.0 for i in range(len(self._strongest)))

    @property
    def request(self) -> str | None:
        """Return what the person must do so that the axis can pass its test, or None."""
        return f"let go of the handle of axis {self._axis + 1}" if self._block > _BLOCKS else None

    @property
    def _or_undeclared(self) -> str:
        """Return a further reason for a late or wrong motion of a compliant device, or ""."""
        compliant = math.isfinite(self._expected.mode[self._axis])
        return " (or its transmission or mass is not as declared)" * compliant

    def _passed(self) -> bool:
        """Return whether the axis has passed its test. Raises SafetyStop where it answered wrongly.

        An unknown hand may look like a right or wrong answer in one block, so two blocks in a row must agree.
        """
        before, self._finding = self._finding, self._verdict()
        if self._finding is None or (self._unknown_hands and (before is None or bool(before) != bool(self._finding))):
            return False
        if self._finding:
            raise SafetyStop(self._finding)
        return True

    def _verdict(self) -> str | None:
        """Return the fault that this block shows, "" if the axis has answered well, or None if it has not answered."""
        axis, name, mass = self._axis, f"axis {self._axis + 1}", self._expected.mass[self._axis]
        rows, rough = np.array(self._rows), self._expected.rough and math.isfinite(self._expected.mode[axis])
        block = _Block(rows, axis, self._axes, mass)
        if rough and not block.follows[axis]:
            block = _Block(rows, axis, self._axes, mass, rough)
        self._answer = block
        size, moves, weaker, self._weaker = float(block.size[axis]), block.moves[axis], self._weaker, math.nan
        others = [i + 1 for i in np.flatnonzero(block.follows & (abs(block.size) > _CROSS)).tolist() if i != axis]
        self._swings |= bool(moves and block.swings)
        faint = 2 * self._axes.still[axis] * self._units.encoder_step[axis]  # [m] motion that counts may hide
        if not moves:
            self._stuck = self._pushed, float(block.reach)
        if not (block.follows[axis] and block.swings):
            swapped = others and not moves and block.reach > faint  # a weak force may move it by less than a count
            return f"a force on {name} moves encoder {others[0]}: axes are swapped" if swapped else None
        delay, *fits = block.fits()
        # differences of the motions in the two directions, and the errors of these differences
        wholes = abs(float(fits[0].shares[0])) or 1.0, 1.0
        uneven = [(abs(one.shares[3]) / whole, one.doubts[3] / whole) for one, whole in zip(fits, wholes, strict=True)]
        blamed = int(fits[1].explains and 2 * fits[1].rest < fits[0].rest)
        best, (sided, unsure) = fits[blamed], uneven[blamed]
        (own, _, friction, fault), doubts = best.shares, best.doubts
        if max(abs(fault), doubts[0]) < _CLEAN:
            self._weaker = float(own + doubts[0])
        farthest, sided_before, rounded = self._before[axis] if self._before else _Answer(0.0, 0.0, 0.0)
        weak = self._block < _BLOCKS - 1 + (self._closing and not self._unknown_hands)
        least = min(_WEAKENED * farthest, farthest - math.hypot(rounded, block.rounding))
        most_uneven, most_late = _UNEVEN + sided_before, _LATE + self._at_once
        small, lopsided = size < 1 / _TEST_RATIO, sided - unsure > most_uneven
        if rough:
            late = latest = 0.0  # A transmission that is not as declared looks like a delay.
        else:
            late, latest = self._delay(delay, best, weak)
        late_for_sure = late > most_late
        if not weak and best.explains and lopsided:
            what = "its encoder loses counts in one direction" if blamed else "its motor is weak in one direction"
            return f"{name} moves much farther in one direction than in the other: {what}"
        drifts = self._expected.rough and block.span[axis] * self._units.encoder_step[axis] > _DRIFT * block.reach
        if drifts and not weak:
            why = "motor or encoder differs between the directions, or something pulls the handle"
            return f"{name} drifts in one direction under a test force in both directions: its {why}"
        hidden = abs(size) < max(least, 1 / _TEST_RATIO) or late_for_sure
        if hidden and self._unknown_hands and not block.free:
            return None  # A hand that holds the handle can make its motion small or late.
        if size < 0:
            wrong = "a positive force moves it to negative counts"
            return f"{name} has the wrong sign: {wrong}. Reverse its motor or encoder"
        unclear = max(map(sum, uneven)) > most_uneven or (self._block and math.isnan(weaker))
        if weak and (small or lopsided or drifts or (unclear and not self._closing)):
            return None  # dry friction hides much of a weak motion; a stronger force overcomes it
        if not 1 / _TEST_RATIO <= size <= _TEST_RATIO:
            brake = f", or dry friction brakes it{self._axes.limits.raise_cap(axis, '')}" * small
            than = f"{size:.2g} times as far as expected of {mass:.3g} kg"
            return f"{name} moves {than}: its encoder step, force step or mass is wrong{brake}"
        if size < least:
            share = f"{size / farthest:.2g} times as far as at arming"
            return f"{name} moves {share}: its motor has become weak, or saturates at this force"
        if others:
            return f"a force on {name} moves encoder {others[0]}, too: two axes are connected to each other"
        if weak and latest > most_late and not late_for_sure:
            return None  # a larger motion shows the delay better
        if late_for_sure:
            what = "an encoder or motor has a hidden delay"
            return f"{name} answers {late:.1f} ticks later than agreed: {what}{self._or_undeclared}"
        if latest > most_late:
            coarse = f"counts of {1e3 * self._units.encoder_step[axis]:.3g} mm, or dry friction, may hide it"
            self.remarks.append(f"{name} may be up to {latest:.1f} ticks later than agreed: {coarse}")
        stuck, reach = self._stuck
        slip = stuck - _STICKS * (abs(friction) + doubts[2])  # [N] force that friction at rest leaves to the axis
        dead = slip > 0 and _SLID * reach * slip / stuck > faint
        zone = weaker < _ZONE * own and abs(friction) + doubts[2] < _RUBBED * self._pushed
        if (dead or zone) and not self._closing:
            than = f"{weaker / own if zone else 0.0:.2g} times as far as expected of its motion under twice the force"
            return f"{name} moves {than}, and not because of dry friction: its motor has a dead zone"
        self.sizes.append(_Answer(size, sided, block.rounding))
        return ""

    def _delay(self, plain: _Fit, rubbed: _Fit, weak: bool) -> tuple[float, float]:
        """Return the hidden delay [ticks] that the motion shows for sure (0: none), and an upper bound of the delay.

        `plain` is fitted without friction, `rubbed` with it. Friction makes motions earlier, in both fits and more in
        `weak` motions; of rigid devices, the plain fit gives a lower bound, and the other one is less certain.
        """
        (late, doubt), (later, unsure) = [
            (-float(fit.shares[1] / (fit.shares[0] or 1.0)), float(fit.doubts[1] / abs(fit.shares[0] or 1.0)))
            for fit in (plain, rubbed)
        ]
        shown, T = late if doubt < _LATE else 0.0, self._axes.T
        friction, error = (x / (self._pushed or 1.0) for x in (abs(rubbed.shares[2]), rubbed.doubts[2]))
        if weak and friction > _HIDES:
            return 0.0, math.inf
        if math.isfinite(self._expected.mode[self._axis]):
            return shown - _LATER_COMPLIANT * friction, late + doubt + _EARLY_COMPLIANT / T * friction
        latest = later + unsure + _EARLY_RUBBED / T * friction
        if not weak:
            latest = min(latest, late + doubt + _EARLY_PLAIN / T * (friction + error))
        clear = unsure < _LATE and friction < _HIDES_ALL
        return max(shown, later if clear else 0.0), latest

    def _advice(self, needed: float) -> str:
        """Return what helps where an axis needs the force `needed` [N] to move by two counts."""
        limits, most = self._axes.limits, self._most[self._axis]
        if self._strongest[self._axis] >= most or 0.75 * needed > most:  # motions of 1.5 counts often pass
            return "It is too coarse for this mass"
        if self._strongest[self._axis] < max(limits.motors[self._axis : self._axis + 1], default=0.0):
            cap = "--force" if self._expected.rough else "--force-cap"  # the options of hw.identify and hw.bridge
            return f"Raise {cap} to {math.ceil(100 * min(needed, most) / limits.lever) / 100:g} or more"
        return f"The scenario's force_limit must allow {min(needed, most):.3g} N"

    def _unanswered(self) -> str:
        """Return a message about an axis whose encoder has not answered."""
        axis, most = self._axis + 1, self._strongest[self._axis]
        at = f"a test force of up to {most:g} N"
        if self._pushed < most / _TEST_RATIO:
            tested = f"motor and encoder of axis {axis} are not tested"
            return f"the energy left allows {self._pushed:.2g} of {most:g} N: {tested}. Raise --energy-budget"
        count, expected = self._units.encoder_step[self._axis], self._answer.reach
        if expected < 2 * count:  # rounding alone can hide such a motion
            faint = f"{at} moves axis {axis} by {1e3 * expected:.2g} mm, less than 2 counts of {1e3 * count:.3g} mm"
            needed = most * 2 * count / expected if expected else math.inf
            return f"{faint}: its encoder is not tested. {self._advice(needed)}"
        if self._unknown_hands and self._swings:
            free = f"axis {axis} did not move as a free handle at the end: let go of all handles before a session ends"
            return f"{free}. If nobody held it, motor or encoder is wrong"
        if self._closing:
            return f"motor or encoder of axis {axis} did not answer {at} at the end of the session"
        if (moved := self._answer.span[self._axis]) > self._axes.still[self._axis]:
            slips = self._axes.limits.raise_cap(self._axis, ". If nobody holds it, dry friction may brake it")
            holds = f"let go of it while arming{self._or_undeclared}{slips}"
            return f"axis {axis} does not follow {at} as a free handle: {holds}"
        sticks = self._axes.limits.raise_cap(self._axis, " If so, dry friction may hold it")
        motor = f"Is its motor on?{sticks}"
        return f"encoder of axis {axis} does not follow: it moved by {moved:.0f} counts at {at}. {motor}"


class EncoderMonitor:
    """Check that encoders follow the force while it acts.

    No living hand holds a handle within one count under a changing force; an encoder with one broken channel still
    toggles between two counts. The force that the device reports is compared with the force at the last motion. Changes
    of more than 1 N, or of half of a cap below 2 N, are integrated over time. A mass M whose motion a force change F
    reverses stays within two counts of q for 4 sqrt(q M / F), so a coarse encoder gets twice this time. Under a force
    of more than 0.3 N, or 0.15 of a cap below 2 N, no hand holds still for half a second, because it has a tremor.
    Where noise and counts hide more than 30 um of it, this time is longer by the square of the ratio. Handles with dry
    friction F_c may look dead, because friction holds them while the force changes by 2 F_c (so 1 N allows F_c =
    0.5 N), and hides a tremor below F_c.
    """

    def __init__(self, axes: CheckedAxes) -> None:
        limits, self._units, self._T, self._still = axes
        self._lever, m = limits.lever, len(axes.still)
        #: (m,) [N] unit of force changes: 1 N, or half of a cap below 2 N
        self._newton = [min(limits.lever, cap / 2) for cap in limits.cap]
        self._band: list[list[int]] | None = None
        hidden = [(n + 1) * q * limits.lever for n, q in zip(axes.still, axes.units.encoder_step, strict=True)]
        self._longest = [_PRESSED * max(1.0, (x / _TREMOR) ** 2) for x in hidden]  # (m,) [s] longest rest under a force
        self._quiet = [0.0] * m  # [s] time under a force without a motion that shows a tremor
        self._reference = [0.0] * m  # [N] force at the last motion
        self._impulse = [0.0] * m  # [N s] changes of force over time since the last motion

    def check(self, counts: Sequence[int], applied: Sequence[int], ticks: int) -> None:
        """Raise SafetyStop where an encoder is dead. `applied` (m,) [steps] acts from these `counts` (m,) on."""
        if self._band is None:
            self._band = [[n, n] for n in counts]
        for i, (n, steps) in enumerate(zip(counts, applied, strict=True)):
            force, band, still = steps * self._units.force_step[i], self._band[i], self._still[i]
            if n > band[0] + still or n < band[1] - still:
                band[:] = n, n
                self._reference[i], self._impulse[i], self._quiet[i] = force, 0.0, 0.0
                continue
            if n > band[1]:
                band[1] = n
            elif n < band[0]:
                band[0] = n
            change = abs(force - self._reference[i])
            newton = self._newton[i]
            if change > newton:  # a smaller change neither adds to the impulse nor tightens its limit
                self._impulse[i] += change * ticks * self._T
                q = self._units.encoder_step[i] * still
                if self._impulse[i] > max(_IMPULSE * newton, 8.0 * (q * _HEAVIEST * self._lever**2 * change) ** 0.5):
                    doing = f"it stands still while the force changes by {change:.3g} N"
                    raise SafetyStop(f"encoder of axis {i + 1} does not follow: {doing}")
            pressed = abs(force) > _PRESSING * newton
            self._quiet[i] = self._quiet[i] + ticks * self._T if pressed else 0.0

    @property
    def dead(self) -> str | None:
        """Return a message about an encoder that stands still under a long force, or None."""
        for i, (seconds, longest) in enumerate(zip(self._quiet, self._longest, strict=True)):
            if seconds > longest:
                return f"encoder or motor of axis {i + 1} is dead: nothing moves for {longest:.2g} s under a force"
        return None
