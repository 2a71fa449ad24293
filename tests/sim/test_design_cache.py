"""Designs kept on disk: what is read is proved, and what is not proved is designed again."""

from functools import partial

import numpy as np
import pytest

from controller.coupling import SpringDamper
from sim import couplings
from sim.couplings import Chosen, choose
from sim.scenario import load


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """How often something was designed; designs are kept in tmp_path."""
    monkeypatch.setenv("HAPTIC_LOOP_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made, design = [], couplings.design_by_kind

    def counted(*question, **options):
        made.append(question)
        return design(*question, **options)

    monkeypatch.setattr(couplings, "design_by_kind", counted)
    return made


def soft() -> Chosen:
    return choose(load(), "I", "spring-damper", "any-environment")


def stiffness(chosen: Chosen) -> np.ndarray:
    assert isinstance(chosen.coupling, SpringDamper)
    return chosen.coupling.K


def test_a_design_is_made_once(asked, tmp_path):
    first, again = soft(), soft()
    assert len(asked) == 1
    assert again.coupling.form() == first.coupling.form()
    assert (again.kind, again.condition) == (first.kind, first.condition)
    choose(load(), "II", "spring-damper", "any-environment")  # another loop
    assert len(asked) == 2
    assert len(list(tmp_path.glob("haptic-loop/*.json"))) == 2


@pytest.mark.parametrize("spoilt", ["cut", "stiffer", "folder"])
def test_an_entry_that_is_no_proof_is_designed_again(asked, tmp_path, spoilt):
    K = stiffness(soft())
    (entry,) = tmp_path.glob("haptic-loop/*.json")
    text = entry.read_text()
    if spoilt == "cut":
        entry.write_text(text[: len(text) // 2])
    elif spoilt == "stiffer":
        entry.write_text(text.replace(repr(float(K[0])), repr(float(K[0]) * 1.01)))
        assert entry.read_text() != text
    else:
        entry.unlink()
        entry.mkdir()
    np.testing.assert_array_equal(stiffness(soft()), K)
    assert len(asked) == 2
    assert spoilt == "folder" or entry.read_text() == text


def test_nothing_is_kept_where_that_is_not_wanted_or_not_possible(asked, tmp_path, monkeypatch):
    (tmp_path / "haptic-loop").touch()  # no folder
    soft()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    monkeypatch.setenv("HAPTIC_LOOP_CACHE", "off")
    soft()
    assert len(asked) == 2
    assert not (tmp_path / "other").exists()


def test_a_user_without_a_home_keeps_nothing(asked, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as it is where nobody knows the user
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which means nothing, says the standard
    soft(), soft()
    assert len(asked) == 2
    assert not list(tmp_path.iterdir())


def test_what_the_clock_ended_is_not_kept(asked, monkeypatch):
    hurried = partial(couplings.design_by_kind, seconds=0.0)
    monkeypatch.setattr(couplings, "design_by_kind", hurried)
    for _ in range(2):
        choose(load(), "I", "optimal")
    assert len(asked) == 2
