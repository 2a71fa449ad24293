"""The unknown Q and the environments that it is to be safe in, of a specification."""

from __future__ import annotations

from controller.lti import Lti
from design.parameter.free_parameter import FreeParameter
from design.parameter.inequalities import World
from design.parameter.wish import Wish
from design.specification import Specification


def parameter(spec: Specification, wish: Wish) -> FreeParameter:
    """The unknown Q."""
    return FreeParameter(wish.poles(spec), spec.channels, wish.diagonal)


def environments(spec: Specification) -> list[Lti]:
    """The environment, and what else it may be."""
    return [spec.environment, *spec.others.values()]


def worlds(spec: Specification) -> list[World]:
    """The environments with the delays around them; one that no device feels asks nothing and is left out."""
    return [world(spec, E) for E in environments(spec) if E.D.any()]


def world(spec: Specification, E: Lti | None = None) -> World:
    """An environment, by default the specified one, with the delays around it."""
    return World(E or spec.environment, spec.theta, spec.psi, spec.lam)
