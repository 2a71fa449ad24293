"""Designs kept on disk: what is read is proved, and what is not proved is designed again."""

import json
from functools import partial

import numpy as np
import pytest
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.certificate import assess
from haptic_loop.design.result import Chosen
from haptic_loop.sim import couplings, design_cache
from haptic_loop.sim.couplings import choose
from haptic_loop.sim.scenario import load


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


SPRING_DAMPERS = [("spring-damper", "any-environment"), ("spring-damper", "this-environment")]
OWN = load().replace((1.36, 1.36))  # no design of it comes with the package


def soft() -> Chosen:
    return choose(OWN, "I", "spring-damper", "any-environment")


def stiffness(chosen: Chosen) -> np.ndarray:
    assert isinstance(chosen.coupling, SpringDamper)
    return chosen.coupling.K


def test_a_design_is_made_once(asked, tmp_path):
    first, again = soft(), soft()
    assert len(asked) == 1
    assert again.coupling.form() == first.coupling.form()
    assert (again.kind, again.condition) == (first.kind, first.condition)
    choose(OWN, "II", "spring-damper", "any-environment")  # another loop
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
        choose(OWN, "I", "optimal")
    assert len(asked) == 2


@pytest.mark.parametrize(
    ("case", "kind", "condition"),
    [
        ("I", "spring-damper", "any-environment"),
        ("I", "spring-damper", "this-environment"),
        ("II", "spring-damper", "this-environment"),
    ],
)
def test_the_papers_cases_need_no_design_and_are_proved_when_read(asked, case, kind, condition):
    loop, chosen = load().loop(case), choose(load(), case, kind, condition)
    assert not asked
    needs = assess(loop, chosen.coupling)  # which knows nothing of the file
    assert needs[condition].proof == "rational"
    assert chosen.certificate is not None
    assert chosen.certificate.required == pytest.approx(needs[condition].required)
    assert bool(chosen.limiter) == ((kind, condition) == ("spring-damper", "this-environment"))


@pytest.mark.parametrize("kind", ["spring-damper", "optimal"])
def test_a_shipped_file_is_believed_no_more_than_another(asked, tmp_path, monkeypatch, kind):
    loop = load().loop("I")
    there = design_cache.shipped(loop, kind, "this-environment")
    monkeypatch.setattr(design_cache, "_SHIPPED", tmp_path)
    text, path = there.read_text(), design_cache.shipped(loop, kind, "this-environment")
    assert path.parent == tmp_path
    stored = json.loads(text)
    if kind == "optimal":  # no certificate: nothing but the sweep and a storage function can refuse it
        stored["coupling"]["R"] = (1.01 * np.array(stored["coupling"]["R"])).tolist()
    else:
        stored["coupling"]["K"][0] *= 1.01
    path.write_text(json.dumps(stored))
    assert design_cache.find(loop, kind, "this-environment") is None
    path.write_text(text)
    assert design_cache.find(loop, kind, "this-environment")


def test_every_shipped_file_is_a_design_that_is_asked_for():
    named = {
        design_cache.shipped(load().loop(case), kind, condition).name
        for case in ("I", "II")
        for kind, condition in (*SPRING_DAMPERS, ("optimal", "this-environment"))
    }
    assert {file.name for file in design_cache._SHIPPED.iterdir()} == named
