"""What a design, its proof and a margin cost, beside what they reach.

make bench
"""

import pytest

from design import ccl, spring_damper
from design.assess import assess, specification
from design.audit_report import report
from design.certificate import prove, verify
from design.published import CASE_I
from design.store import Stored, data_of
from design.subject import Subject
from sim.scenario import load

pytestmark = pytest.mark.benchmark(group="design")
LOOP = load().loop("I")


def test_spring_damper(benchmark):
    design = benchmark.pedantic(lambda: spring_damper.design(specification(LOOP)), rounds=5, warmup_rounds=1)
    need = design.requirement.ratio
    print(f"\nspring-damper, theorem4: norm {design.objective:.4f} in {design.sdps} SDPs, requires {need:.6f} delta")
    assert design.objective < 11.2495


def test_inner_convex_approximation(benchmark):
    design = benchmark.pedantic(lambda: ccl.design(specification(LOOP)), rounds=1)
    print(f"\nccl, order one per channel: norm {design.objective:.4f} in {design.sdps} SDPs")
    assert design.objective < 9.8


def test_both_margins_and_their_proofs(benchmark):
    coupling = spring_damper.design(specification(LOOP)).coupling
    requirements = benchmark.pedantic(lambda: assess(LOOP, coupling), rounds=5, warmup_rounds=1)
    print(f"\nboth conditions, swept and proved: {[r.proof for r in requirements.values()]}")
    assert all(r.proof == "rational" for r in requirements.values())


def test_a_stored_proof_is_checked_again(benchmark):
    data = data_of(spring_damper.design(specification(LOOP)).coupling)
    stored = Stored(LOOP, data, prove(LOOP, data, "theorem4"))
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
