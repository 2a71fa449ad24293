"""Tests of couplings designed for varying delays: sweeps, proofs, and lossless hands under adversarial switching."""

import json

import msgspec
import numpy as np
import pytest
from evaluate import switching_sweep

from haptic_loop.cli.design import main
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import VaryingDelay
from haptic_loop.controller.environment import Spring
from haptic_loop.controller.loop import DelayRange
from haptic_loop.design import spring_damper
from haptic_loop.design.assessment import assess
from haptic_loop.design.coupling_file import load as load_stored
from haptic_loop.design.optimal import design_with
from haptic_loop.design.result import DesignFailed
from haptic_loop.design.spring_damper import design
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import InputError, load
from haptic_loop.sim.switching import switched_crowd

RANGE = ((1, 1), (2, 2))
HANDS, SECONDS = 20, 0.7


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """Return (report, coupling) of one run of the design command."""
    out = tmp_path_factory.mktemp("design")
    options = ["--condition", "this-environment", "--varying-delay", "1,2", "--out", str(out / "c.json")]
    assert main([*options, "--json", str(out / "r.json")]) == 0
    return json.loads((out / "r.json").read_text()), load_stored(out / "c.json").coupling.build(load().T)


def growing(loop, hands=HANDS, seconds=SECONDS):
    """Return for how many lossless hands the loop's motion grows under adversarial switching."""
    rng = np.random.default_rng(0)
    low, high = np.log([0.01, 1.0, 10.0]), np.log([1.0, 1.001, 3000.0])
    links = np.exp(rng.uniform(low, high, size=(hands, loop.scenario.channels, 1, 3)))
    links[..., 1] = 0.0
    held_by = variants(loop.scenario.device, Crowd(links))
    return int((switched_crowd(loop, held_by, np.arange(hands), 0, seconds, None).exact > 0).sum())


@pytest.mark.slow
def test_the_designed_gains_are_proved_for_any_switching(designed):
    report, coupling = designed
    loop = load().loop("I")
    swept = switching_sweep(loop.sent(coupling), *RANGE, loop.delta)
    assert swept.certified
    assert swept.ratio > 0.999  # the design uses all available damping
    assert report["switching"]["proof"] == "rational"
    assert report["switching"]["required_damping"] == pytest.approx(swept.required, rel=1e-9)
    # -3.37 dB was measured at a local optimum. For constant delays the design gives -11.2 dB; zero force gives 0 dB.
    assert report["assessment"]["transparency"]["rms_mismatch_db"] == pytest.approx(-3.37, abs=0.05)


@pytest.mark.slow
def test_the_worst_switching_excites_no_lossless_hand(designed):
    """Under greedy adversarial switching no lossless hand's motion grows; with 20 % less damping it can."""
    _, coupling = designed
    scenario = load().replace(varying_delay=VaryingDelay(*RANGE, "adversarial"))
    placed = [scenario.replace(delta=tuple(share * d for d in scenario.delta)) for share in (1.0, 0.8)]
    assert growing(assemble(placed[0], coupling)) == 0
    assert growing(assemble(placed[1], coupling)) > 0


def test_designs_refuse_too_wide_ranges_of_delays(monkeypatch):
    monkeypatch.setattr(spring_damper, "_starts", lambda loop: [SpringDamper([2e4, 2e4], [0.5, 0.5])])
    loop = load().replace(theta=(3, 3), delta=(0.02, 0.02)).loop("I")
    with pytest.raises(DesignFailed, match=r"under any switching from \(0, 0\) to \(9, 9\) samples"):
        design(loop.switching(DelayRange((0, 0), (9, 9))), "this-environment")


@pytest.mark.parametrize(
    "options",
    [
        ["--coupling", "moving-average", "--varying-delay", "1,2"],  # refuses varying delays
        ["--condition", "this-environment", "--varying-delay", "2,1"],
        ["--condition", "this-environment", "--varying-delay", "1"],
    ],
)
def test_invalid_varying_delays_are_refused(options, tmp_path):
    with pytest.raises(InputError, match="--varying-delay"):
        main([*options, "--out", str(tmp_path / "c.json")])


@pytest.mark.slow
def test_any_environment_designs_take_varying_delays(tmp_path):
    """The search assumes constant delays. It is repeated with less damping until switching delays are certified."""
    main(["--condition", "any-environment", "--varying-delay", "1,2", "--out", str(tmp_path / "c.json")])
    loop, coupling = load().loop("I"), load_stored(tmp_path / "c.json").coupling.build(load().T)
    assert switching_sweep(loop.sent(coupling), *RANGE, loop.delta).certified


@pytest.mark.slow
@pytest.mark.parametrize(
    ("basis", "most_db"),
    # measured: -12.85 dB and -13.37 dB; the designed spring-damper has -3.4 dB
    [((4, 3), -12.8), pytest.param((14, 10), -13.3, marks=pytest.mark.validate)],
)
def test_optimal_couplings_for_switching_delays_are_proved(basis, most_db):
    """A sweep confirms the proof of the design. With the larger basis no lossless hand's motion grows at worst ages."""
    constant = load().loop("I")
    optimum = design_with(constant.switching(DelayRange(*RANGE)), bases=(basis,))
    assert optimum.proved
    swept = switching_sweep(constant.sent(optimum.coupling), *RANGE, constant.delta)
    assert swept.ratio == pytest.approx(0.998, abs=1e-3)  # a margin of 0.2 %; all other damping is used
    assert 20 * np.log10(optimum.objective) < most_db
    if basis == (14, 10):
        loop = assemble(load().replace(varying_delay=VaryingDelay(*RANGE, "adversarial")), optimum.coupling)
        assert growing(loop) == 0


def one_known_device():
    """Return one-wall with one Omega of known bounds and a spring instead of the wall."""
    spring = Spring(between=("tip", "ground"), stiffness=500.0, damping=1.0)
    object_ = msgspec.structs.replace(load("one-wall").environment, walls=(), springs=(spring,))
    return load("one-wall").replace(device=load("omega-pair-known").device[:1], environment=object_)


@pytest.mark.validate
@pytest.mark.parametrize(
    ("scenario", "basis", "most_db"),
    [
        (one_known_device(), (3, 2), -70.0),
        (load("omega-pair-known"), (4, 3), -29.0),  # measured with this basis: -29.3 dB
    ],
)
def test_optimal_couplings_of_known_devices_take_switching(scenario, basis, most_db):
    """The guarantee is proved for known motors, and no lossless hand's motion grows under adversarial switching."""
    m = scenario.channels
    lo, hi = (tuple(each[:m]) for each in RANGE)
    loop = scenario.loop("I").switching(DelayRange(lo, hi))
    optimum = design_with(loop, "known-device", bases=(basis,))
    guarantee = assess(loop, optimum.coupling, limiter=False, certificate=optimum.certificate).guarantee
    assert (guarantee.condition, guarantee.proof) == ("known-device", "rational")
    assert guarantee.delays == loop.varying_delay
    assert 20 * np.log10(optimum.objective) < most_db
    assert growing(assemble(scenario.replace(varying_delay=VaryingDelay(lo, hi, "adversarial")), optimum.coupling)) == 0
