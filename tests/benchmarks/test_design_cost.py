"""What a design, its proof and a margin cost, beside what they reach.

make bench
"""

from time import perf_counter

import pytest

from controller.environment import environment
from controller.loop import force_map
from design import fixed_order as ccl
from design import optimal, spring_damper
from design.audit import Subject, report
from design.certificate import Stored, assess, prove, verify
from design.lmi import Specification
from design.optimal import Wish
from design.result import CASE_I
from design.transparency import decibels, transparency
from sim.scenario import load

pytestmark = pytest.mark.benchmark(group="design")
LOOP = load().loop("I")
WISHES = {
    "8 taps": Wish(),
    "8 taps, no HF limit": Wish(high_gain=None),
    "full 37, no HF limit": Wish(functions=37, diagonal=False, filter="mixed", high_gain=None),
}


def test_spring_damper(benchmark):
    design = benchmark.pedantic(lambda: spring_damper.design(Specification.of(LOOP)), rounds=5, warmup_rounds=1)
    need, seconds = design.requirement.ratio, benchmark.stats.stats.median
    work = f"{design.sdps} convex problems, {seconds:.2f} s"
    print(f"\ncase I, spring-damper, theorem4: norm {design.objective:.4f} in {work}; needs {need:.6f} delta")
    assert design.objective < 11.2495


def test_inner_convex_approximation(benchmark):
    design = benchmark.pedantic(lambda: ccl.design(Specification.of(LOOP)), rounds=1)
    print(f"\nccl, order one per channel: norm {design.objective:.4f} in {design.sdps} SDPs")
    assert design.objective < 9.8


@pytest.mark.parametrize("case", ["I", "II"])
@pytest.mark.parametrize("name", WISHES)
def test_optimal(benchmark, case, name):
    """The proof is timed beside it, once."""
    loop = load().loop(case)
    design = benchmark.pedantic(lambda: optimal.design(Specification.of(loop), WISHES[name]), rounds=3, warmup_rounds=1)
    begin = perf_counter()
    proof = prove(loop, design.coupling, "closed-loop").proof
    proving = perf_counter() - begin
    E = environment(loop.environment, loop.T)
    found = transparency(force_map(E, design.coupling, loop.theta, loop.psi), E, loop.lam)
    seconds = benchmark.stats.stats.median
    figures = f"{decibels(found.relative_mismatch):.2f} / {decibels(found.rms_mismatch):.2f} dB"
    print(f"\ncase {case}, {name}: {figures} in {seconds:.2f} s, swept; proof {proof} in {proving:.2f} s")
    assert proof == "rational"


def test_both_margins_and_their_proofs(benchmark):
    coupling = spring_damper.design(Specification.of(LOOP)).coupling
    requirements = benchmark.pedantic(lambda: assess(LOOP, coupling), rounds=5, warmup_rounds=1)
    print(f"\nboth conditions, swept and proved: {[r.proof for r in requirements.values()]}")
    assert all(r.proof == "rational" for r in requirements.values())


def test_a_stored_proof_is_checked_again(benchmark):
    coupling = spring_damper.design(Specification.of(LOOP)).coupling
    stored = Stored.of(LOOP, coupling, prove(LOOP, coupling, "theorem4"))
    verdict = benchmark.pedantic(lambda: verify(stored), rounds=5, warmup_rounds=1)
    assert verdict.proved


def test_a_refusal(benchmark):
    requirements = benchmark.pedantic(lambda: assess(LOOP, CASE_I), rounds=5, warmup_rounds=1)
    print(f"\npublished gains refused: theorem4 needs {requirements['theorem4'].required}")
    assert not any(r.certified for r in requirements.values())


def test_audit(benchmark):
    scenario = load()
    subject = Subject(CASE_I, scenario.environment, scenario.T, scenario.theta, scenario.psi, scenario.delta)
    outcome = benchmark.pedantic(lambda: report(subject), rounds=5, warmup_rounds=1)
    print(f"\naudit of (27): closed-loop needs {outcome['closed-loop']['required_damping'][0]:.6f} N s/m")
    assert abs(outcome["closed-loop"]["required_damping"][0] - 1.39871) < 1e-5
