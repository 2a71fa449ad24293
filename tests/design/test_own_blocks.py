"""Tests of user-written conditions with wrong code or an empty multiplier, and of files with wrong multipliers."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from shared import PAIR, SOFT, STIFF

from haptic_loop.cli import check
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import constant_like
from haptic_loop.design.certificate import prove, required_damping, requirements_of, verify
from haptic_loop.design.conditions import Condition, this_environment_demand
from haptic_loop.design.coupling_file import Stored, save, sealed
from haptic_loop.design.environments import LimitedForces, Multiplied
from haptic_loop.design.facts import Unknowns
from haptic_loop.design.result import MAKING

change = msgspec.structs.replace


class PerWall(Multiplied):
    """this-environment, with a multiplier that has one entry per wall."""

    name, covers = "per-wall", ("walls",)

    def unknowns(self, loop):
        return (Unknowns("g", (1.0,) * len(loop.environment.walls), "a number > 0 for each wall", 1e-3, 1e3),)

    def map(self, loop, coupling, exact=False):
        return loop.F(coupling, exact)

    def block(self, G, loop, multiplier=None, scaled=False):
        return this_environment_demand(G, loop)


class Scaled(Condition):
    """this-environment for forces multiplied by `times`, which require `times` the damping."""

    name, times = "scaled", 2

    def demand(self, loop, coupling, exact=False):
        linear = this_environment_demand(loop.F(coupling, exact), loop)
        return replace(linear, free=linear.free * self.times)


class Contradicting(Scaled):
    """Exact arithmetic sees ten times the forces that a sweep sees."""

    name = "contradicting"

    def demand(self, loop, coupling, exact=False):
        linear = this_environment_demand(loop.F(coupling, exact), loop)
        return replace(linear, free=linear.free * (10 if exact else 1))


@pytest.mark.parametrize("coupling", [SOFT, SpringDamper([20000.0] * 2, [0.0] * 2)])
def test_a_multiplier_without_entries_is_swept(coupling):
    own, here = (required_damping(PAIR, coupling, each) for each in (PerWall(), "this-environment"))
    assert own.ratio == pytest.approx(here.ratio, rel=1e-9)
    assert required_damping(PAIR, coupling, LimitedForces(0.01, 0)).ratio >= here.ratio - 1e-9


def test_proofs_with_empty_multipliers_are_verified():
    proved = Stored.of(PAIR, SOFT, prove(PAIR, SOFT, PerWall()))
    assert verify(proved, PerWall()).proved


def test_conditions_that_exact_arithmetic_contradicts_are_not_certified():
    assert required_damping(PAIR, STIFF, Contradicting()).certified
    requirement = requirements_of(PAIR, STIFF, own=Contradicting())["contradicting"]
    assert not requirement.certified
    assert "violated at" in (requirement.reason or "")
    assert requirement.required == (np.inf, np.inf)


def test_check_does_not_replace_the_proof_on_file(tmp_path, capsys):
    stored = Stored.of(PAIR, SOFT, prove(PAIR, SOFT, PerWall()))
    assert stored.certificate
    edited = change(stored, loop=change(PAIR, delta=(5.0, 5.0)), certificate=change(stored.certificate, seal="0" * 64))
    words = ["--condition", f"{__file__}:PerWall"]
    for name, file in (("right", stored), ("edited", edited)):
        save(file, tmp_path / f"{name}.json")
    assert check.main([str(tmp_path / "right.json"), *words]) == 0
    assert "anew" not in capsys.readouterr().out
    assert check.main([str(tmp_path / "edited.json"), *words]) == 1
    assert "digest differs" in " ".join(capsys.readouterr().out.split())
    assert check.main([str(tmp_path / "right.json"), "--condition", "any-environment"]) == 0
    assert "proved anew, not from the file" in " ".join(capsys.readouterr().out.split())


class Seven(Scaled):
    name = "seven"

    def demand(self, loop, coupling, exact=False):
        return 7


class Tuple(Scaled):
    name = "tuple"

    def demand(self, loop, coupling, exact=False):
        linear = super().demand(loop, coupling, exact)
        return linear.free, linear.gain


class Wide(Scaled):
    name = "wide"

    def demand(self, loop, coupling, exact=False):
        linear = super().demand(loop, coupling, exact)
        return replace(linear, gain=constant_like(linear.free, np.eye(3)))


class Empty(PerWall):
    name = "empty"

    def block(self, G, loop, multiplier=None, scaled=False):
        return None


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (Seven(), r"the demand of condition seven is 7 \(int\), expected a Demand"),
        (Tuple(), "the demand of condition tuple is a tuple, expected a Demand"),
        (Wide(), "free is 2 x 2, gain is 3 x 3 in a demand, expected square blocks of one size"),
        (Empty(), "the demand of condition empty is None, expected a Demand"),
    ],
)
def test_an_invalid_demand_is_refused_by_name(own, message):
    for ask in (required_damping, prove):
        with pytest.raises(ValueError, match=message):
            ask(PAIR, SOFT, own)


def test_files_hold_exactly_the_right_multiplier(tmp_path, capsys):
    wall = Wall(("tip", GROUND), 3000.0, gap=0.0)
    network = Network(("tip",), (Spring(("tip", GROUND), 20.0, 0.3),), {"tip": 0.05}, (wall,))
    loop, coupling = Loop(1e-3, (1,), (0,), (1,), (1.3,), network), SpringDamper([1000.0], [0.5])
    stored = Stored.of(loop, coupling, prove(loop, coupling, "this-environment"))
    held = stored.certificate
    assert held
    save(stored, path := tmp_path / "wall.json")
    assert check.main([str(path), "--condition", "this-environment"]) == 0
    assert MAKING in " ".join(capsys.readouterr().out.replace("│", " ").split())
    for wrong in ({}, {"a": (1.0,)}, held.multipliers | {"d": (1.0, 1.0)}, held.multipliers | {"g": (1.0,)}):
        forged = change(stored, certificate=sealed(change(held, multipliers=wrong)))
        assert "multipliers are" in (verify(forged).reason or "")
