"""The assessment of a coupling in a loop: requirements of the conditions, proofs, and the guarantee.

    assessment = assess(scenario.loop("I"), coupling)
    assessment.guarantee  # a Guarantee, or None: assessment.reason then says why there is none

Every command takes its guarantee from an Assessment of exactly the loop, coupling, environment and limiter that
run. If one of them changes, `assess` must be called again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from haptic_loop.controller.arguments import number, of_kind, whole
from haptic_loop.controller.arithmetic import SingularLoop, one_blas_thread
from haptic_loop.controller.budget import START_J, check_start
from haptic_loop.controller.coupling import Coupling, require_channels
from haptic_loop.controller.environment import Environment
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Array
from haptic_loop.controller.ranges import Member, inside, number_of_vertices, where_proved
from haptic_loop.design import budgets
from haptic_loop.design.certificate import (
    condition_of,
    is_ours,
    judged,
    limiter_rho,
    named,
    on_file,
    prove,
    proves,
    recheck,
    required_damping,
    requirements_of,
)
from haptic_loop.design.conditions import Condition, encoder_friction
from haptic_loop.design.coupling_file import Certificate
from haptic_loop.design.environments import (
    ANY_ENVIRONMENT,
    LIMITER,
    SWITCHING,
    THIS_ENVIRONMENT,
    LimitedForces,
    beta_of,
    in_each,
    worst,
)
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, KnownDevice, LimitedKnownDevice, described
from haptic_loop.design.result import (
    ANY,
    HERE,
    KNOWN_CONDITIONS,
    RANGES,
    Chosen,
    NotProved,
    Requirement,
    held_torques,
    listed,
)
from haptic_loop.design.transparency import BAND_HZ, Transparency, in_band, silent, transparency
from haptic_loop.design.worst_member import Progress, Searched, search_ranges

#: A user's function from displacements (m,) [m] of the environment to forces (m,) [N] at a tick. The displacements are
#: those that the environment would have at this tick if its forces were zero.
PluggedEnvironment = Callable[[Array], Array]


_SAMPLES = 64  # default number of environments that are drawn at random from inside the ranges


@dataclass(frozen=True, eq=False)
class RangesResult:
    """The results of a condition at members of ranges, at the worst point of a search, and at random samples.

    Attributes:
        members: The nominal environment and the vertices.
        at_members: The requirement of each member.
        samples: Environments that are drawn at random from inside the ranges.
        at_samples: The requirement of each sample.
        vertices: The number of vertices of the ranges; at most 128 of them are members.
        where: Words for the vertices that are members: "every vertex", or "128 of 625 vertices".
        searched: The search between the vertices.
        at_found: The requirement at the worst environment of the search.
        seed: The seed of the samples.
        certificate: The Certificate for all members, with the guarantee "these ranges", or None.
        reason: Why the ranges are not guaranteed, or None.
    """

    members: tuple[Member, ...]
    at_members: tuple[Requirement, ...]
    samples: tuple[Member, ...]
    at_samples: tuple[Requirement, ...]
    vertices: int
    where: str
    searched: Searched
    at_found: Requirement
    seed: int
    certificate: Certificate | None
    reason: str | None

    @property
    def proved(self) -> bool:
        """Whether every member is proved in exact arithmetic, and neither search nor samples violate the condition."""
        return self.certificate is not None and self.worst_found[1].certified

    @property
    def worst(self) -> tuple[Member, Requirement]:
        """The member that requires the most damping, and its requirement."""
        i = worst(self.at_members)
        return self.members[i], self.at_members[i]

    @property
    def worst_found(self) -> tuple[Member, Requirement]:
        """The environment that requires the most damping among members, search and samples, and its requirement."""
        places = (*self.members, self.searched.worst[0].member, *self.samples)
        requirements = (*self.at_members, self.at_found, *self.at_samples)
        i = worst(requirements)
        return places[i], requirements[i]

    def part(self) -> dict[str, Any]:
        """Return the record as fields for JSON."""
        member, requirement = self.worst
        i = worst(self.at_samples) if self.samples else None
        inside = {
            "samples": len(self.samples),
            "certified": sum(r.certified for r in self.at_samples),
            "seed": self.seed,
            "worst_ratio": None if i is None else self.at_samples[i].ratio,
            "worst": None if i is None else self.samples[i].name,
        }
        part = {
            "vertices": len(self.members) - 1,
            "all_vertices": self.vertices,
            "vertices_certified": sum(r.certified for r in self.at_members[1:]),
            "required_damping": requirement.required,
            "available_damping": requirement.available,
            "worst": member.name,
            "proof": "rational" if self.certificate else "sampled",
            "certified": self.proved,
            "search": self.searched,
            "inside": inside,
        }
        return part | ({"reason": self.reason} if self.reason else {})


def check_ranges(
    loop: Loop,
    coupling: Coupling,
    seed: int = 0,
    samples: int = _SAMPLES,
    progress: Progress = lambda done, total: None,
    searched: Searched | None = None,
    certificate: Certificate | None = None,
    condition: Condition = THIS_ENVIRONMENT,
) -> RangesResult | None:
    """Check a coupling by a condition over the ranges of its loop; return None for a loop without ranges.

    The search between the vertices is deterministic. In addition, `samples` environments are drawn at random, with
    `seed`. A caller that has the search or the proof passes it as `searched` or `certificate`, and it is not repeated.
    One set of multipliers serves all environments, including those between the vertices.
    """
    if loop.ranges is None:
        return None
    certificate, reason, multiplier = _proved_ranges(loop, coupling, condition, certificate)
    simple = condition.extensible and not multiplier  # `in_each` covers only this-environment without multipliers.

    def need(there: Loop) -> Requirement:
        return required_damping(there, coupling, condition, multiplier)

    def needs(there: Sequence[Member]) -> list[Requirement]:
        return in_each(loop, coupling, there) if simple else [need(loop.at(one.network)) for one in there]

    ratio = None if simple else (lambda there: need(there).ratio)
    searched = searched or search_ranges(loop, coupling, progress, ratio=ratio)
    members, drawn = loop.members(), inside(loop.network, loop.ranges, samples, seed)
    at_members, at_samples = needs(members), needs(drawn)
    (at_found,) = needs([searched.worst[0].member])
    result = RangesResult(
        members,
        tuple(at_members),
        drawn,
        tuple(at_samples),
        number_of_vertices(loop.network, loop.ranges),
        where_proved(loop.network, loop.ranges),
        searched,
        at_found,
        seed,
        certificate,
        reason,
    )
    if certificate and not result.proved:
        place, requirement = result.worst_found
        result = replace(result, reason=violated_between(result.where, place, requirement.ratio))
    return result


def _proved_ranges(
    loop: Loop, coupling: Coupling, condition: Condition, certificate: Certificate | None
) -> tuple[Certificate | None, str | None, Sequence[Any] | None]:
    """Return (certificate for all members, reason why there is none, multipliers); each may be None."""
    if certificate and certificate.guarantee == RANGES and certificate.condition == condition.name:
        values = on_file(condition_of(certificate, condition), loop, certificate.multipliers)
        return certificate, None, values[: sum(condition.multiplier_sizes(loop).values())] if values else None
    swept = required_damping(loop, coupling, condition) if condition.multiplier_sizes(loop) else None
    multiplier = swept.multiplier if swept else None
    try:
        return prove(loop, coupling, condition, multiplier, swept), None, multiplier
    except NotProved as error:
        return None, str(error), multiplier


def violated_between(where: str, place: Member, ratio: float) -> str:
    """Return the reason why ranges are not guaranteed although all members are proved; `where` names the members."""
    needs = f"{ratio:.4f} times the damping is needed" if np.isfinite(ratio) else "no damping is enough"
    return f"proved at {where}, but violated between them: {needs} at {place.name}"


_OWN_PROOF = "by a separate proof for this environment"  # the `reason` of a limiter from `_by_its_own_block`


@dataclass(frozen=True)
class ForceLimits:
    """How forces are limited: by a limiter that a condition covers, or by clipping without a proof.

    Attributes:
        rho: (m,) stiffnesses of the limiter [N/m]; None if forces are clipped.
        reason: What covers limited forces, or why nothing covers them.
        requirement: The requirement of the condition `limiter`, if it was evaluated.
        c: The multiplier of the condition `limiter`, one row per device, no unit.
        certificate: The proof of the condition `limiter`, or None.
        force_limit: (m,) largest forces [N] for reports, or (); `Assessment.within` sets them.
        less: Whether the limiter is covered in one environment only, while the guarantee covers more environments.
        bounded: Whether the limiter is covered only for devices within the bounds of the condition known-device.
        energy_budget: The initial energy W0 [J] in an energy account of the forces; None without an account.
        void: Whether the loop that runs has no guarantee; a proof of the limiter then does not apply.
        proof: "rational" if exact arithmetic proves the condition that covers the limiter in this loop, else "sampled".
    """

    rho: tuple[float, ...] | None
    reason: str
    requirement: Requirement | None = None
    c: tuple[tuple[float, ...], ...] = ()
    certificate: Certificate | None = None
    force_limit: tuple[float, ...] = ()
    less: bool = False
    bounded: bool = False
    energy_budget: float | None = None
    void: bool = False
    proof: str = "sampled"

    @property
    def words(self) -> str:
        """The force limits, and whether a guarantee covers limited forces, in one line for a report."""
        amounts = [f"{f:.4g}" for f in self.force_limit]
        figures = f" to {', '.join(amounts if len(set(amounts)) > 1 else amounts[:1])} N" if amounts else ""
        how = f"{'clipped' if self.rho is None else 'limited'}{figures}"
        if self.void:
            scaled = "" if self.energy_budget is None else " and scaled by an energy account"
            return f"{how}{scaled}, without a guarantee"
        if self.energy_budget is not None:
            return f"{how}, and scaled by an energy account of {self.energy_budget:g} J"
        if self.rho is None:
            why = self.reason.removeprefix("limiter: ")
            return f"{how}: a guarantee holds while forces stay below their limits ({why})"
        if not self.proved:
            return f"certified, also while forces are {how} ({self.reason})"
        return f"proved, also while forces are {how}{', in this environment' if self.less else ''}"

    @property
    def proved(self) -> bool:
        """Whether exact arithmetic proves the condition that covers the limiter in this loop."""
        return self.rho is not None and self.proof == "rational"

    def part(self) -> dict[str, Any]:
        """Return the record as fields for JSON."""
        shown = {"rho": self.rho, "force_limit": self.force_limit, "reason": self.reason, "words": self.words}
        return shown | {"certificate": self.requirement, "c": self.c, "energy_budget": self.energy_budget}


def _covered_limits(
    loop: Loop,
    coupling: Coupling,
    requirements: Mapping[str, Requirement],
    proof: Certificate | None = None,
    known: Certificate | None = None,
    c: Sequence[Sequence[float]] | None = None,
) -> ForceLimits:
    """Return the limiter that a certified condition covers, or clipping and the reason why no limiter is covered.

    A condition that covers a limiter without a further proof is preferred. Otherwise this-environment or known-device
    is extended to limited forces. If `proof` holds in this loop, its limiter is used. If `proof` does not hold,
    multipliers are searched for a limiter of the same beta (LimitedForces). Without a `proof`, the multipliers `c` are
    tried for this-environment before others are searched. `known` is a certificate that has been verified.
    """
    covering = [each for each in requirements.values() if each.certified and each.limiter_rho is not None]
    if covering:
        each = min(covering, key=lambda requirement: requirement.proof != "rational")
        swept = "" if each.proof == "rational" else "by a refined sweep, without an exact proof: "
        return ForceLimits(each.limiter_rho, f"{swept}{each.condition} covers limited forces", proof=each.proof)
    extended = [name for name in _EXTENDED if name in requirements and requirements[name].certified]
    if not extended:
        return ForceLimits(None, "no condition that extends to limited forces is certified")
    less = any(each.certified and each.guarantee == ANY for each in requirements.values())
    covered = _by_its_own_block(loop, coupling, proof, known, extended[0], c)
    if covered.rho is None and len(extended) > 1:
        second = _by_its_own_block(loop, coupling, None, known, extended[1])
        covered = second if second.rho is not None else covered
    return replace(covered, less=less)


_EXTENDED = THIS_ENVIRONMENT.name, KNOWN_DEVICE.name  # conditions that have a block for limited forces


def _by_its_own_block(
    loop: Loop,
    coupling: Coupling,
    proof: Certificate | None,
    known: Certificate | None,
    base: str,
    c: Sequence[Sequence[float]] | None = None,
) -> ForceLimits:
    """Return the limiter that the condition `base` covers after its extension to limited forces, or clipping."""
    if proof:
        try:
            requirement, condition = recheck(loop, coupling, proof, known), condition_of(proof)
            assert isinstance(condition, LimitedForces | LimitedKnownDevice)
            rho, rows = limiter_rho(loop, proof), _rows(condition, loop, requirement)
            bounded = isinstance(condition, LimitedKnownDevice)
            return ForceLimits(rho, _OWN_PROOF, requirement, rows, proof, bounded=bounded, proof=requirement.proof)
        except NotProved:  # The proof does not hold in this loop, or would take long.
            pass
    plain = LimitedForces(beta_of(loop, proof)) if proof else LIMITER
    limiter = LimitedKnownDevice(plain) if base == KNOWN_DEVICE.name else plain
    found = [v for row in c for v in row] if c and limiter is LIMITER else None
    requirement = required_damping(loop, coupling, limiter, found)
    if found and not requirement.certified:
        requirement = required_damping(loop, coupling, limiter)
    rows = _rows(limiter, loop, requirement)
    if not requirement.certified:
        needs = f"limiter: a proof for limited forces needs {listed(requirement.required, 5)} N s/m of damping"
        return ForceLimits(None, requirement.reason or needs, requirement, rows)
    rho = loop.per_channel(plain.rho(loop))
    covered = ForceLimits(rho, _OWN_PROOF, requirement, rows, bounded=limiter is not plain)
    try:
        proved = prove(loop, coupling, limiter, swept=requirement)
    except NotProved as refused:
        return replace(covered, reason=f"swept, not proved: {refused}")
    requirement = replace(requirement, proof="rational")
    return replace(covered, requirement=requirement, certificate=proved, proof="rational")


def _rows(
    condition: LimitedForces | LimitedKnownDevice, loop: Loop, requirement: Requirement
) -> tuple[tuple[Any, ...], ...]:
    plain = condition.limiter if isinstance(condition, LimitedKnownDevice) else condition
    return plain.rows(loop, requirement.multiplier or ())


@dataclass(frozen=True)
class EncoderSteps:
    """Whether the declared Coulomb friction dissipates the work that encoder steps can do."""

    encoder_step: tuple[float, ...]  # (m,) [m]
    friction: tuple[float, ...]  # (m,) [N] lower bound per axis, from the declared friction
    friction_max: tuple[float | None, ...]  # (m,) [N] published upper bounds, for the report only
    friction_needed: tuple[float, ...] | None  # (m,) [N]; None if no friction is proved to suffice
    covered: bool
    words: str

    @property
    def sentence(self) -> str:
        """The sentence of a verdict that says how encoder steps restrict the guarantee."""
        if not self.covered:
            return "Not covered: the encoder steps of the devices."
        return "Encoder steps are covered with this object only, while forces stay below their limits."

    @property
    def suffix(self) -> str:
        """The restriction by encoder steps, in words that end a guarantee in a table or a title."""
        return ", encoder steps with this object only" if self.covered else ", for exact positions only"

    @classmethod
    def of(
        cls,
        loop: Loop,
        coupling: Coupling,
        steps: Sequence[float],
        friction: Sequence[float],
        friction_max: Sequence[float | None] | None = None,
        beyond: str | None = None,
    ) -> EncoderSteps | None:
        """Compare the declared friction (m,) [N] with what encoder steps (m,) [m] require; return None without steps.

        `beyond` is the name of the condition that certifies the loop if this condition covers no encoder steps.
        """
        if not any(steps):
            return None
        widths = ", ".join(f"{1e6 * q:.4g}" for q in steps)
        published = tuple(friction_max or [None] * len(steps))
        values = tuple(steps), tuple(friction), published
        if loop.environment.walls or loop.environment.world or beyond:
            obstacle = "walls" if loop.environment.walls else "a world" if loop.environment.world else beyond
            return cls(
                *values, None, False, f"encoder steps of {widths} um: with {obstacle} no friction is proved to suffice"
            )
        needed = encoder_friction(loop.F(coupling), steps, loop.axes or ())
        covered = bool((needed <= np.asarray(friction)).all())
        amounts, has = (", ".join(f"{f:.4g}" for f in some) for some in (needed, friction))
        verdict = "are covered with this object while forces stay below the limits" if covered else "are not covered"
        if any(most is not None for most in published):
            bounds = ", ".join("-" if most is None else f"{most:.4g}" for most in published)
            has = f"at least {has} N (published: at most {bounds} N)"
        else:
            has += " N"
        enough = f"friction of {amounts} N is enough for {widths} um, the axes have {has}"
        return cls(*values, tuple(needed.tolist()), covered, f"encoder steps {verdict}: {enough}")


@dataclass(frozen=True)
class Guarantee:
    """The hands, environments and forces for which a coupling keeps its loop safe.

    Attributes:
        condition: The condition that gives the guarantee, without its facts, or "energy-budget".
        proof: "rational": exact arithmetic, also for limited forces if `forces` names them; "sampled": a refined sweep;
            "account": an energy account at every tick.
        facts: Properties of the loop that the condition covers (Assessment.facts).
        hands: The hands that the guarantee covers. For an energy account it is "no passive hand", which begins `words`.
        environments: "any passive environment", "these ranges", "this environment", ..
        forces: Words that follow "forces": whether limited forces are covered, or what scales the forces.
        delays: The range of the forces' delays [samples], lo and hi (m,); delays may change within it at every tick.
        periods: The longest period [s].
        energy_J: Bound of the energy [J] that a hand receives, after subtraction of what the devices dissipate and what
            a MuJoCo scene releases; None for a guarantee that the loop comes to rest.
        vertices: Words for the proved vertices of "these ranges": "every vertex", or "128 of 625 vertices".
        own: Name and file of the user's own condition that gives the guarantee, in words, or None.
        positions: The restriction by encoder steps in words that follow the environments (EncoderSteps.suffix), or "".
    """

    condition: str
    proof: str
    facts: tuple[str, ...]
    hands: str
    environments: str
    forces: str
    delays: DelayRange
    periods: float
    energy_J: float | None = None
    vertices: str = "every vertex"
    own: str | None = None
    positions: str = ""

    def __repr__(self) -> str:
        return f"Guarantee({self.condition}, {self.proof}: {self.hands}, {self.environments}, forces: {self.forces})"

    @property
    def any_environment(self) -> bool:
        """Whether the guarantee holds in any passive environment."""
        return self.environments == ANY

    @property
    def words(self) -> str:
        """The guarantee in one line: environments, bound of the energy, own condition, restriction by encoder steps."""
        by = f", by the condition {self.own}, which is your own" if self.own else ""
        return f"{self._covered}{by}{self.positions}"

    @property
    def _covered(self) -> str:
        if self.energy_J is not None:
            join = "" if self.environments.startswith("and ") else ","
            amount = f"more than {self.energy_J:g} J" if self.energy_J else "any energy"
            return f"{self.hands} is given {amount} beyond what the devices dissipate{join} {self.environments}"
        if self.environments == RANGES:
            return f"{RANGES}: proved at {self.vertices}, searched between them"
        return self.environments

    def part(self) -> dict[str, Any]:
        """Return the record as fields for JSON."""
        delays = {"lo": self.delays.lo, "hi": self.delays.hi}
        part: dict[str, Any] = {"condition": self.condition, "proof": self.proof, "facts": self.facts}
        part |= {"hands": self.hands, "environments": self.environments, "forces": self.forces}
        part |= {"delays_samples": delays, "longest_period_s": self.periods, "words": self.words}
        part |= {"own_condition": self.own} if self.own else {}
        return part | ({} if self.energy_J is None else {"energy_J": self.energy_J})


@dataclass(frozen=True, eq=False)
class Assessment:
    """The assessment of a coupling in a loop, the record behind every report and every run.

    Attributes:
        loop: The loop for which the conditions were evaluated.
        coupling: The coupling as it runs.
        requirements: Required and available damping (m,) [N s/m] and binding frequency [Hz] of each condition. With
            delays that switch, "this-environment" is for constant delays, and "switching" for any switching in range.
        environment: The environment that runs: a network, or a plugged-in function.
        ranges: The results at the vertices of the ranges and between them; None without ranges.
        force_limits: The limiter (rho (m,) [N/m], with its proof) or clipping, and the energy budget [J].
        transparency: The mismatch; None if it cannot be computed, for example because the environment has no E(z).
        certificate: The exact proof that the caller supplied and that holds, or the proof for the ranges, or None.
        guarantee: The guarantee, or None.
        reason: Why there is no guarantee.
        condition: The name of the condition that `holds` requires. Another condition of the package may give the
            guarantee, unless the required condition is the user's own.
        own: The user's own condition, or None.
        encoder: Whether friction covers the devices' encoder steps; None without steps, with a shell, or in the
            result of `assess`, because a loop has no encoder steps.
    """

    loop: Loop
    coupling: Coupling
    requirements: Mapping[str, Requirement]
    environment: Environment | PluggedEnvironment
    ranges: RangesResult | None
    force_limits: ForceLimits
    transparency: Transparency | None
    certificate: Certificate | None
    guarantee: Guarantee | None
    reason: str | None
    condition: str
    own: Condition | None = None
    encoder: EncoderSteps | None = None

    def __repr__(self) -> str:
        return f"Assessment({self.coupling!r}: {self.guarantee or f'no guarantee, {self.reason}'})"

    @property
    def guarantee_words(self) -> str | None:
        """The guarantee in one line; None without a guarantee."""
        return self.guarantee and self.guarantee.words

    def with_encoder(self, encoder: EncoderSteps | None) -> Assessment:
        """Return the assessment for devices with these encoder steps, which restrict its guarantee."""
        guarantee = self.guarantee
        if guarantee:
            # The guarantee of an energy budget at the devices does not depend on exact positions.
            limits = encoder.suffix if encoder and guarantee.proof != "account" else ""
            guarantee = replace(guarantee, positions=limits)
        return replace(self, encoder=encoder, guarantee=guarantee)

    @property
    def facts(self) -> tuple[str, ...]:
        """The names of the loop's properties beyond constant delays, equal periods and one linear environment."""
        loop, plugged = self.loop, shelled(self.environment)
        there = {
            KNOWN_DEVICE.name: loop.known_devices,
            "periods": loop.T_max not in (None, loop.T),
            "latency": loop.latency,
            "switching": loop.varying_delay,
            "walls": not plugged and getattr(self.environment, "walls", ()),
            "ranges": not plugged and loop.ranges,
            "shell": plugged,
            "limiter": self.force_limits.rho is not None,
        }
        return tuple(name for name, present in there.items() if present)

    @property
    def decisive(self) -> Requirement:
        """The requirement of the condition that `holds` requires."""
        return self.requirements[self.condition]

    @property
    def holds(self) -> bool:
        """Whether the required condition is certified, with a guarantee that covers the loop's ranges, if any."""
        if self.guarantee is None or not self.decisive.certified:
            return False
        return self.loop.ranges is None or self.guarantee.environments in (ANY, RANGES)

    @property
    def gains(self) -> dict[str, Any]:
        """Order and gains of the coupling (Coupling.figures)."""
        return self.coupling.figures(self.loop.T)

    @property
    def held_torques(self) -> str | None:
        """The remark that proofs neglect the change of pose while motors hold torques; None for devices of one axis."""
        return held_torques(self.loop)

    def within(self, force_limit: Sequence[float]) -> Assessment:
        """Return the assessment with force limits (m,) [N] for its words; no proof depends on them."""
        return replace(self, force_limits=replace(self.force_limits, force_limit=tuple(force_limit)))

    def without_guarantee(self, reason: str) -> Assessment:
        """Return the assessment without its guarantee, for this reason, and with its limiter marked as void."""
        return replace(self, guarantee=None, reason=reason, force_limits=replace(self.force_limits, void=True))

    def part(self) -> dict[str, Any]:
        """Return the record as fields for JSON, the same in every command."""
        loop, gains = self.loop, self.gains
        about = {"T_s": loop.T, "T_max_s": loop.T_max, "latency_s": loop.latency}
        about |= {name: getattr(loop, name) for name in ("theta", "psi", "lam", "delta")}
        return {
            "coupling": {"kind": self.coupling.kind, "K": gains.get("K"), "B": gains.get("B")} | gains,
            "loop": about,
            "condition": self.condition,
            "requirements": dict(self.requirements),
            "facts": self.facts,
            "guarantee": self.guarantee,
            "reason": self.reason,
            "holds": self.holds,
            "ranges": self.ranges,
            "force_limits": self.force_limits,
            "transparency": self.transparency,
            "encoder": self.encoder,
        }


@one_blas_thread
def assess(
    loop: Loop,
    coupling: Coupling | Chosen,
    *,
    environment: Environment | PluggedEnvironment | None = None,
    energy_budget: float | None = None,
    certificate: Certificate | None = None,
    condition: str | Condition | None = None,
    ranges_seed: int = 0,
    ranges_samples: int = _SAMPLES,
    limiter: bool | None = None,
    band_hz: tuple[float, float] = BAND_HZ,
    progress: Progress = lambda done, total: None,
) -> Assessment:
    """Assess a coupling in its loop, for the environment, limits and delays that run.

    Args:
        loop: The loop, with its ranges, switching delays, latency and longest period.
        coupling: The coupling as it runs. A Chosen or a Design also supplies its condition, its certificates, its
            search between the vertices of ranges, and the multipliers `c` of its limiter. If the limiter is not covered
            in this loop, other multipliers are searched.
        environment: The environment that runs, if it is not the loop's: a network, or a function. A function
            or a MuJoCo world acts on the coupling through a shell that makes it passive.
        energy_budget: Initial energy W0 [J] of the shell's account; the default is 0 for a function and 2 mJ for a
            MuJoCo world. Without a shell, W0 of an energy budget at the devices (controller.budget); the default is no
            budget.
        certificate: A stored proof, which is ignored unless it is for exactly this loop and coupling and holds. The
            proof is verified unless this process has made or verified it.
        condition: The name of the condition that must hold, or a user's own condition. The default is this-environment,
            or known-device if the loop has bounds of its devices. With a user's own condition, no other
            condition gives the guarantee.
        ranges_seed: Seed of the environments that are drawn from inside the ranges.
        ranges_samples: Number of environments that are drawn.
        limiter: False to clip forces even if a condition covers a limiter.
        band_hz: Frequency band [Hz] of the mismatch.
        progress: Called with (done, total) of the conditions, and then of the points of a search over ranges.

    Returns:
        The assessment. Its guarantee is for the environment that runs. `holds` also requires `condition` and, with
        ranges, a guarantee that covers the ranges. A loop has exact positions and loses no packets; `simulate` and the
        commands add the encoder steps, lost packets and force limits of a scenario.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: The numbers of channels of coupling and loop differ, the condition is unknown, or a number is out of
            range.
    """
    of_kind("loop", loop, Loop, 'a Loop, as scenario.loop("I") gives it')
    if environment is not None and not callable(environment):
        of_kind("environment", environment, Environment, "a Network, your own Environment or a function")
    if energy_budget is not None:
        energy_budget = check_start("energy_budget", number("energy_budget", energy_budget, "an energy in J"))
    if certificate is not None:
        of_kind("certificate", certificate, Certificate, "a Certificate, as prove(loop, coupling, condition) gives it")
    ranges_seed, ranges_samples = whole("ranges_seed", ranges_seed, 0), whole("ranges_samples", ranges_samples, 0)
    in_band(band_hz, loop.T)
    searched = limiter_proof = limiter_c = None
    if isinstance(coupling, Chosen):
        proof, limiter_c = coupling.certificate, coupling.c
        limiter_proof = coupling.limiter or (proof and proof.limiter)
        certificate, condition = certificate or proof, condition or coupling.required_condition
        if proof and proof.is_for(loop, coupling.coupling):
            searched = coupling.searched  # The search is for this loop only if the proof is.
        coupling = coupling.coupling
    of_kind("coupling", coupling, Coupling, "a coupling (controller.coupling; NoCoupling() for none), or a Design")
    require_channels(coupling.form(), loop.channels)
    wanted_condition = named(condition or (KNOWN_DEVICE if loop.known_devices else THIS_ENVIRONMENT))
    network = loop.environment if environment is None or callable(environment) else environment
    here = loop.at(network).switching(None)
    own = None if is_ours(wanted_condition) else wanted_condition
    by = own if own and certificate and own.name == certificate.condition else None
    known = certificate if certificate and proves(loop, coupling, certificate, by) else None
    requirements = _requirements(loop, network, coupling, known, own, wanted_condition, progress)
    over = KNOWN_DEVICE if loop.known_devices and not KNOWN_DEVICE.beyond(loop) else THIS_ENVIRONMENT
    over = own if own and not own.beyond(loop) else over
    if known and known.condition != over.name:
        searched = None  # The search was made with the condition of the certificate.
    ranges = check_ranges(loop, coupling, ranges_seed, ranges_samples, progress, searched, known, over)
    if ranges and own and over is not own:
        ranges = replace(ranges, certificate=None, reason=own.beyond(loop))
    if limiter_proof is None and known and known.limiter:
        limiter_proof = known.limiter
    running = network if environment is None else environment
    plugged = shelled(running)
    if plugged:
        limits = ForceLimits(None, "the forces of the environment are clipped before the shell")
    elif limiter is False:
        limits = ForceLimits(None, "the limiter is switched off")
    else:
        where = loop if environment is None else loop.at(network)
        covering = {own.name: requirements[own.name]} if own else requirements
        limits = _covered_limits(where, coupling, covering, limiter_proof, known, limiter_c)
    if plugged and energy_budget is None:
        energy_budget = 0.0 if callable(environment) else START_J
    if energy_budget is not None:
        limits = replace(limits, energy_budget=energy_budget)
    assessment = Assessment(
        loop,
        coupling,
        requirements,
        running,
        ranges,
        limits,
        _transparency(here, coupling, band_hz),
        known or (ranges and ranges.certificate),
        None,
        None,
        wanted_condition.name,
        own,
    )
    return _guaranteed(assessment)


def _requirements(
    loop: Loop,
    network: Environment,
    coupling: Coupling,
    known: Certificate | None,
    own: Condition | None,
    wanted: Condition,
    progress: Progress,
) -> dict[str, Requirement]:
    """Return the requirements for constant delays and, if delays switch, those of the conditions for switching."""
    here = loop.at(network).switching(None)
    requirements = requirements_of(here, coupling, known, own, progress)
    if wanted.name not in requirements:
        requirements[wanted.name] = judged(here, coupling, wanted)
    if loop.varying_delay:
        switched = (SWITCHING, *(() if any(loop.psi) else (ANY_ENVIRONMENT,)))
        switched += (KNOWN_DEVICE, KNOWN_DEVICE_ANY) if loop.known_devices else ()
        switched += (own,) if own else ()
        requirements |= {each.name: judged(loop.at(network), coupling, each) for each in switched}
    return requirements


def _guaranteed(assessment: Assessment) -> Assessment:
    """Return the assessment with its guarantee, or with the reason why it has none."""
    guarantee, reason = _guarantee(assessment)
    limits = assessment.force_limits
    # The search between the vertices does not evaluate the limiter's block, so the limiter is not proved for ranges.
    by_itself = limits.requirement is not None and limits.rho is not None
    if guarantee and guarantee.environments == RANGES and by_itself:
        assessment = replace(assessment, force_limits=replace(limits, less=True))
        guarantee, reason = _guarantee(assessment)
    if guarantee is None:
        return assessment.without_guarantee(str(reason))
    return replace(assessment, guarantee=guarantee)


def _transparency(loop: Loop, coupling: Coupling, band_hz: tuple[float, float]) -> Transparency | None:
    """Return the mismatch of F and E with all walls touching, or None if it cannot be computed."""
    try:
        F, E = loop.F(coupling), loop.E()
    except ValueError:  # A rigid wall or a world has no E(z), and a singular loop has no F.
        return None
    if budgets.too_long(F) or silent(E):
        return None
    try:
        return transparency(F, E, loop.lam, band_hz)
    except (SingularLoop, ArithmeticError, np.linalg.LinAlgError):
        return None


def shelled(environment: Environment | PluggedEnvironment) -> bool:
    """Return whether an environment runs behind the energy shell: a plugged-in function or a MuJoCo scene."""
    return callable(environment) or getattr(environment, "world", None) is not None


_EVERYONE = "every passive hand"
_LIMITED = "also while they are limited"
_LIMITED_HERE = "also while they are limited, in this environment"
BELOW_LIMITS = "while they stay below their limits"


def _guarantee(assessment: Assessment) -> tuple[Guarantee | None, str | None]:
    """Return (the guarantee for the loop that runs, None) or (None, the reason why there is none)."""
    loop, requirements, limits = assessment.loop, assessment.requirements, assessment.force_limits
    decisive, own = requirements[assessment.condition], assessment.own
    plugged = shelled(assessment.environment)
    if loop.latency and (plugged or limits.energy_budget is not None):
        return None, "latency: an energy account assumes forces that latch at ticks; add a sample to theta instead"
    if plugged:
        return _shell(assessment)
    if limits.energy_budget is not None:
        if own:
            return None, f"your own condition {own.name} does not cover forces that an energy account scales"
        return _account(assessment, "whatever computes the forces"), None
    if own and decisive.certified:
        ranges = None if decisive.guarantee == ANY else _over_ranges(assessment)
        return ranges or _stated(assessment, decisive, str(decisive.guarantee)), None
    if own:
        return None, f"{decisive.shortfall} ({own.name})"
    if loop.varying_delay:
        anywhere = () if any(loop.psi) else (ANY_ENVIRONMENT.name, KNOWN_DEVICE_ANY.name)
        here = [name for name in (SWITCHING.name, KNOWN_DEVICE.name) if name in requirements]
        for name in (*anywhere, *here):
            if name in requirements and requirements[name].certified:
                if name in anywhere:
                    return _stated(assessment, requirements[name], ANY), None
                if ranges := _over_ranges(assessment):
                    return ranges, None
                return _stated(assessment, requirements[name], getattr(assessment.environment, "here", HERE)), None
        shortfall = requirements[here[-1]].shortfall
        return None, f"delays that switch within {loop.varying_delay} are not covered: {shortfall}"
    held = [need for need in requirements.values() if need.certified and need.guarantee]
    if anywhere := [need for need in held if need.guarantee == ANY]:
        return _stated(assessment, anywhere[0], ANY), None
    if ranges := _over_ranges(assessment):
        return ranges, None
    if held:
        return _stated(assessment, held[0], str(held[0].guarantee)), None
    return None, f"{decisive.shortfall} ({decisive.condition})"


def _over_ranges(assessment: Assessment) -> Guarantee | None:
    """Return the guarantee for the ranges, or None if they are not proved or the environment that runs is no member."""
    ranges = assessment.ranges
    if not (ranges and ranges.proved) or all(assessment.environment != each.network for each in ranges.members):
        return None
    name = str(ranges.worst[1].condition)
    if assessment.loop.varying_delay:
        name = {THIS_ENVIRONMENT.name: SWITCHING.name}.get(name, name)
    stated = _stated(assessment, replace(assessment.requirements[name], proof="rational"), RANGES)
    return replace(stated, vertices=ranges.where)


def _stated(assessment: Assessment, by: Requirement, environments: str) -> Guarantee:
    """Return the guarantee that the certified requirement `by` gives in these environments."""
    loop, limits = assessment.loop, assessment.force_limits
    forces = BELOW_LIMITS if limits.rho is None else _LIMITED_HERE if limits.less else _LIMITED
    proof = by.proof if limits.rho is None or limits.proved else "sampled"
    longest = loop.T_max or loop.T
    unused = {"walls" if environments == ANY else "", "" if environments == RANGES else "ranges"}
    facts = tuple(fact for fact in assessment.facts if fact not in unused)
    own = assessment.own
    known = by.condition in KNOWN_CONDITIONS or isinstance(own, KnownDevice)
    bounded = known or (limits.rho is not None and limits.bounded)
    hands = f"{_EVERYONE}, on {described(loop)}" if bounded else _EVERYONE
    facts = tuple(fact for fact in facts if bounded or fact != KNOWN_DEVICE.name)
    origin = own.origin if own else None
    name = SWITCHING.base if by.condition == SWITCHING.name else by.condition  # switching is among the facts
    return Guarantee(name, proof, facts, hands, environments, forces, loop.delays, longest, own=origin)


def _shell(assessment: Assessment) -> tuple[Guarantee | None, str | None]:
    """Return (the guarantee of the shell, None) or (None, the reason).

    A shell needs psi = 0, constant delays and a coupling that is certified for any environment.
    """
    loop, needs = assessment.loop, assessment.requirements[(assessment.own or ANY_ENVIRONMENT).name]
    if any(loop.psi):
        return None, f"psi is {', '.join(map(str, loop.psi))}: a shell needs an environment without delay"
    if loop.varying_delay:
        return None, "the shell needs constant delays: its account is not proved for delays that switch"
    if not needs.certified or needs.guarantee != ANY:
        why = f"{needs.condition} holds in {needs.guarantee}" if needs.certified else needs.shortfall
        return None, f"the coupling is not certified for every environment: {why}"
    world = not callable(assessment.environment)
    where = "and what gravity and springs of the scene release, whatever the scene does" if world else None
    return _account(assessment, where or "whatever computes the force"), None


def _account(assessment: Assessment, whatever: str) -> Guarantee:
    """Return the guarantee of an energy account, behind a certified coupling (shell) or at the devices (budget).

    `whatever` are the words for the environments that the account covers.
    """
    loop, plugged, own = assessment.loop, shelled(assessment.environment), assessment.own
    behind = (own or ANY_ENVIRONMENT).name
    condition = behind if plugged else "energy-budget"
    proof = assessment.requirements[behind].proof if plugged else "account"
    how = "scaled by the shell" if plugged else "scaled by the energy budget"
    longest, W0 = loop.T_max or loop.T, assessment.force_limits.energy_budget
    fixed = condition, proof, assessment.facts, "no passive hand", whatever, how, loop.delays, longest
    return Guarantee(*fixed, energy_J=W0, own=own.origin if own else None)
