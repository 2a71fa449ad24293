"""Tests of fixed-order couplings (`--coupling ccl`): their realisation, the descent, and the designs' certificates."""

import warnings
from itertools import islice

import msgspec
import numpy as np
import pytest
import scipy.linalg
from evaluate import any_environment, this_environment
from shared import DELTA, T, force_map, pair

from haptic_loop.cli.design import main
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design import fixed_order as ccl
from haptic_loop.design import lmi, spring_damper
from haptic_loop.design.conditions import any_environment_demand
from haptic_loop.design.fixed_order import _START_ROOM, _descend, _FixedOrder
from haptic_loop.design.lmi import RESERVE, Shaping

Z = np.exp(1j * np.array([0.01, 0.3, 1.0, 2.0, 3.1]))


HELD = Network(("tip",), (Spring(("tip", "mass"), 800.0, 1.0), Spring(("mass", GROUND), 100.0, 1.0)), {"mass": 0.5})
LONE = Loop(T, (1,), (0,), (1,), (1.37,), HELD)


@pytest.fixture(scope="module", params=[LONE, pytest.param(pair(), marks=pytest.mark.validate)], ids=["one", "pair"])
def inner(request):
    """Return a loop and its design: one device, and with `make validate` also a pair."""
    return request.param, ccl.design(request.param)


@pytest.mark.parametrize("order", [1, 2])
def test_every_family_contains_the_spring_damper(order):
    gains = SpringDamper([500.0, 900.0], [0.4, 1.0])
    loop = pair(delta=(2.0, 0.8))
    family = _FixedOrder(Shaping(loop), None, order)
    p = family.start(gains)
    assert p.shape == (family.unknowns,)
    np.testing.assert_allclose(family.coupling(p).at(Z), gains.compliance(T).at(Z), rtol=0, atol=1e-15)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("case", [(1, 2), (0, 0)])
def test_the_affine_realisations_are_the_transfer_matrices(order, case):
    loop = pair(case, delta=(2.0, 0.8))
    family = _FixedOrder(Shaping(loop), None, order)
    p = family.start(SpringDamper([500.0, 900.0], [0.4, 1.0]))
    p = p + 0.05 * np.random.default_rng(0).normal(size=p.size)
    left, right, late = Shaping(loop).parts(np.angle(Z))
    expected = (left @ family.coupling(p).at(Z) + late) @ right
    # The realisation rounded the entries by 2e-12 of the largest one.
    np.testing.assert_allclose(family.weighted_loop(p).at(Z), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    V = family.coupling(p)
    demand = any_environment_demand(Lti(V.A, V.B, V.C, V.D, T), loop)  # from V itself, in SI units
    root = np.sqrt((1 - RESERVE) * np.array(loop.delta) / T)
    wanted = demand.gain.at(Z) + demand.free.at(Z) / (1 - RESERVE)
    np.testing.assert_allclose(family.block(p).at(Z), root[:, None] * wanted * root, rtol=0, atol=1e-12)


def test_the_inequalities_are_affine_in_the_unknowns():
    family = _FixedOrder(Shaping(pair((0, 0))), np.array([0.4, 0.3]), 2)
    rng = np.random.default_rng(1)
    one, two = rng.normal(size=(2, family.unknowns))

    def everything(p):
        both = family.weighted_loop(p), family.block(p)
        return np.concatenate([np.ravel(M) for G in both for M in (G.A, G.B, G.C, G.D)])

    middle = (everything(one) + everything(two)) / 2
    np.testing.assert_allclose(everything((one + two) / 2), middle, rtol=0, atol=1e-12 * np.abs(middle).max())


@pytest.mark.slow
def test_fixed_order_designs_beat_spring_dampers(inner):
    """The norms were 4.30 for one device and below 9.8 for the pair; spring-dampers have 5.58 and 11.25."""
    loop, design = inner
    assert design.objective <= (4.31 if loop is LONE else 9.8)
    assert design.objective < spring_damper.design(loop).objective


@pytest.mark.slow
def test_results_are_certified_from_the_coupling_alone(inner):
    loop, design = inner
    V = design.coupling.V
    assert V.order == loop.channels
    assert any_environment(V, loop.theta, loop.delta).ratio <= 1 - RESERVE + 1e-6
    assert Shaping(loop).norm(V)[0] == pytest.approx(design.objective, rel=1e-9)
    F = force_map(loop.E(), design.coupling, loop.theta, loop.psi)
    assert F.is_stable()
    assert this_environment(F, loop.delta).certified


@pytest.mark.slow
def test_every_descent_step_is_feasible_and_better():
    loop = pair((0, 0))
    family = _FixedOrder(Shaping(loop))
    # The descent starts strictly inside the condition: these gains leave 0.01 N s/m unused.
    gains = spring_damper.design(pair((0, 0), delta=(1.36, 1.36))).coupling
    p = family.start(gains)
    norm = Shaping(loop).norm(gains.compliance(T))[0]
    steps = list(islice(_descend(family, p, norm), 3))
    assert len(steps) == 3
    for step in steps:
        V = family.coupling(step)
        before, norm = norm, Shaping(loop).norm(V)[0]
        assert any_environment(V, loop.theta, DELTA).certified
        assert norm < before


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")  # the optimum is compared to 1e-3 only
def test_the_zeros_are_optimal_for_the_poles(inner):
    """With the poles fixed, condition and norm are convex at each frequency. The design equals the optimum of cvxpy."""
    import cvxpy as cp  # the import takes over a second in every worker that collects this file

    loop, design = inner
    shaping, poles = Shaping(loop), np.diag(design.coupling.V.A)
    highest = shaping.norm(design.coupling.V)[1]
    w = np.unique([*np.geomspace(1e-2, np.pi, 40), *highest * np.linspace(0.9, 1.1, 21)])
    z = np.exp(1j * w)
    x, t = cp.Variable(2 * poles.size), cp.Variable()  # V_i = x_2i + x_(2i+1) (1 - z)/(z - pole_i) [mm/N]
    left, right, late = shaping.parts(w)
    terms = []
    feasible = []
    for i, (pole, delta, theta) in enumerate(zip(poles, loop.delta, loop.theta, strict=True)):
        window = abs(sum(z**-k for k in range(theta + 1)))
        least = 1e3 * T * window**2 / (4 * delta * (1 - RESERVE))  # Theorem 4, psi = 0
        feasible.append(x[2 * i] / 2 + (1 / (z - pole)).real * x[2 * i + 1] >= least)
        for part in (1 + 0 * z, (1 - z) / (z - pole)):
            terms.append(1e-3 * part[:, None, None] * left[:, :, i : i + 1] @ right[:, i : i + 1])

    def real(M):
        return np.block([[M.real, -M.imag], [M.imag, M.real]]) / design.objective

    felt = [
        real(fixed) + sum(x[n] * real(terms[n][k]) for n in range(len(terms))) for k, fixed in enumerate(late @ right)
    ]
    cp.Problem(cp.Minimize(t), [*feasible, *(cp.sigma_max(M) <= t for M in felt)]).solve(solver=cp.CLARABEL)
    assert t.value == pytest.approx(1, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop", "order"), [pytest.param(pair(), 1, marks=pytest.mark.validate), (LONE, 3)], ids=["pair", "one"]
)
def test_three_steps_beat_the_structured_design(loop, order):
    """The start leaves a share `_START_ROOM` of the damping unused. Three steps lower the norm by ten such shares."""
    structured, design = spring_damper.design(loop), ccl.design(loop, order, most_sdps=3)
    assert design.sdps == structured.sdps + 3  # no step ended in the solver's rounding
    assert design.objective < structured.objective * (1 - 10 * _START_ROOM)
    assert design.requirement.certified


@pytest.mark.slow
def test_environment_delay_designs_never_worsen_their_start():
    soft = Network(
        ("tip",), (Spring(("tip", "mass"), 200.0, 0.25), Spring(("mass", GROUND), 25.0, 0.25)), {"mass": 0.5}
    )
    loop = Loop(T, (1,), (1,), (0,), (1.37,), soft)
    design = ccl.design(loop, most_sdps=3)
    assert design.requirement.certified
    assert design.phi is not None
    # The design is never worse than its starting gains, which leave `_START_ROOM` of the damping unused.
    room = msgspec.structs.replace(loop, delta=tuple((1 - _START_ROOM) * d for d in loop.delta))
    assert design.objective <= spring_damper.design(room).objective * (1 + 1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": 0}, "order is 0.*1 to 10"),
    ],
)
def test_an_order_of_zero_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ccl.design(pair(), **options)


def test_a_free_mass_is_called_useless(tmp_path, capsys):
    """A free mass has no static stiffness. Its design emits no warning, though SciPy's Lyapunov solver would."""
    scenario = tmp_path / "free.toml"
    text = 'name = "free"\nT = 1e-3\nduration = 1.0\ntheta = [1]\npsi = [0]\n[[device]]\nkind = "compliant"\n'
    scenario.write_text(text + 'damping = 1.37\n[environment]\ncontacts = ["tip"]\nmasses = { tip = 0.3 }\n')
    words = ["--scenario", str(scenario), "--coupling", "ccl", "--out", str(tmp_path / "c.json")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(words) == 0
    shown = capsys.readouterr()
    assert "Useless: its force is about as wrong as no force" in " ".join(shown.out.split())
    assert "error" not in shown.err
    assert "nan" not in shown.out


@pytest.mark.parametrize(("condition", "searched"), [("this-environment", True), ("any-environment", False)])
def test_only_searched_springs_are_called_the_softest(condition, searched, tmp_path, capsys):
    scenario = tmp_path / "free.toml"
    text = 'name = "free"\nT = 1e-3\ntheta = [1]\n[[device]]\nkind = "compliant"\ndamping = 1.37\n'
    scenario.write_text(text + '[environment]\ncontacts = ["tip"]\nmasses = { tip = 0.3 }\n')
    assert main(["--scenario", str(scenario), "--condition", condition, "--out", str(tmp_path / "c.json")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Useless on all contacts" in shown
    assert ("softest spring that the search tries" in shown) == searched


def test_doubling_gives_scipys_reachability_gramian(monkeypatch):
    """If SciPy's solver warns, doubling sums the Gramian. Here both are accurate, so their Cholesky factors agree."""
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    G = Lti(0.99 * A / np.abs(np.linalg.eigvals(A)).max(), B, np.eye(4), np.zeros((4, 2)), 1.0)
    S = lmi.reachability_scaled(G)

    def refused(A, Q):
        raise scipy.linalg.LinAlgWarning

    monkeypatch.setattr(scipy.linalg, "solve_discrete_lyapunov", refused)
    assert lmi.reachability_scaled(G) == pytest.approx(S, rel=1e-8, abs=1e-8)
