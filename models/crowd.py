"""Many humans for the same devices: one compiled scene, and a row of its parameters for each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.device import Device
from models.human import Cross, Human, Link, Person
from models.scene import Plant, Scene, actuation, build, plant, tendon_jacobian

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Crowd:
    """Sets of humans, one per device, all with the same number of links. They have no voluntary motion.

    `holds` says which channels' humans are arms of one person, whose body and cross spring are in `bodies`.
    """

    links: Array  # (nsim, m, links, 3): mass [kg], damping [N s/m], stiffness [N/m]
    holds: tuple[tuple[int, ...], ...] = ()  # (persons,) channels, counted from 1
    bodies: Array = field(default_factory=lambda: np.zeros((0, 0, 5)))
    # (nsim, persons, 5): mass, damping, stiffness as above, damping and stiffness from hand to hand

    def __post_init__(self) -> None:
        links = np.array(self.links, dtype=float)
        if links.ndim != 4 or links.shape[-1] != 3 or 0 in links.shape[1:]:
            raise ValueError(f"links has the shape {links.shape}, expected (sets, devices, links, 3)")
        if not ((links >= 0) & (links < np.inf)).all():
            raise ValueError("links has a negative or infinite entry: such a human is not passive")
        bodies = np.array(self.bodies, dtype=float) if self.holds else np.zeros((len(links), 0, 5))
        if bodies.shape != (len(links), len(self.holds), 5):
            raise ValueError(f"bodies has the shape {bodies.shape}, expected {(len(links), len(self.holds), 5)}")
        if not ((bodies >= 0) & (bodies < np.inf)).all() or not (bodies[..., 0] > 0).all():
            raise ValueError("bodies has a negative, infinite or massless entry: such a person is not passive")
        for name, values in (("links", links), ("bodies", bodies)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return self.links.shape[0]

    def humans(self, i: int) -> tuple[Human, ...]:
        """Set i, one human per device."""
        return tuple(Human(tuple(Link(*link) for link in human)) for human in self.links[i].tolist())

    def persons(self, i: int) -> tuple[Person, ...]:
        """Set i, those who hold several devices."""
        pairs = zip(self.holds, self.bodies[i].tolist(), strict=True)
        return tuple(Person(holds, m, b, k, Cross(*cross)) for holds, (m, b, k, *cross) in pairs)


@dataclass(frozen=True, eq=False)
class Variants:
    """The fields in which the models of a crowd differ, by MuJoCo's names, with one row per set of humans."""

    scene: Scene
    fields: dict[str, Array]  # (nsim, bodies | joints | tendons)

    def __len__(self) -> int:
        return self.fields["body_mass"].shape[0]

    def repeated(self, times: int) -> dict[str, Array]:
        """The fields with every row `times` times in succession."""
        return {name: np.repeat(rows, times, axis=0) for name, rows in self.fields.items()}

    def plants(self) -> Plant:
        """All plants at once, A (nsim, 2n, 2n) and B (nsim, 2n, inputs): the same matrices as of each one's model."""
        model = self.scene.model
        n, across, forces = model.nv, tendon_jacobian(model), actuation(model)
        mass = self.fields["body_mass"][:, model.jnt_bodyid, None]
        A = np.zeros((len(self), 2 * n, 2 * n))
        A[:, :n, n:] = np.eye(n)
        for column, joint, tendon in ((0, "jnt_stiffness", "tendon_stiffness"), (n, "dof_damping", "tendon_damping")):
            between = across.T * self.fields[tendon][:, None, :] @ across
            A[:, n:, column : column + n] = -(between + self.fields[joint][:, :, None] * np.eye(n)) / mass
        B = np.zeros((len(self), 2 * n, forces.shape[1]))
        B[:, n:] = forces / mass
        return Plant(A, B, plant(model).C)


def variants(devices: Sequence[Device], crowd: Crowd) -> Variants:
    """The devices in the hands of every set of humans. Raises ValueError where their numbers differ."""
    nsim, m, links, _ = crowd.links.shape
    # a hand without mass, damping or stiffness leaves the devices' own parameters; further masses cannot be zero
    nobody = Human((Link(0, 0, 0), *(Link(1, 0, 0) for _ in range(links - 1))))
    scene = build(devices, [nobody] * m, [Person(holds, 1, 0, 0) for holds in crowd.holds])
    model = scene.model
    names = ("body_mass", "jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
    fields = {name: np.tile(getattr(model, name).astype(float), (nsim, 1)) for name in names}
    for i, (joints, tendons) in enumerate(zip(scene.masses, scene.springs, strict=True)):
        mass, damping, stiffness = np.moveaxis(crowd.links[:, i], -1, 0)  # (nsim, links) each
        bodies = model.jnt_bodyid[list(joints)]
        fields["body_mass"][:, bodies[0]] += mass[:, 0]
        fields["body_mass"][:, bodies[1:]] = mass[:, 1:]
        if len(tendons) < links:  # the last link ends on ground
            fields["dof_damping"][:, joints[-1]] += damping[:, -1]
            fields["jnt_stiffness"][:, joints[-1]] = stiffness[:, -1]
        fields["tendon_damping"][:, list(tendons)] = damping[:, : len(tendons)]
        fields["tendon_stiffness"][:, list(tendons)] = stiffness[:, : len(tendons)]
    for p, (joint, crossings) in enumerate(zip(scene.bodies, scene.crossings, strict=True)):
        mass, damping, stiffness, cross_damping, cross_stiffness = crowd.bodies[:, p].T
        fields["body_mass"][:, model.jnt_bodyid[joint]] = mass
        fields["dof_damping"][:, joint], fields["jnt_stiffness"][:, joint] = damping, stiffness
        fields["tendon_damping"][:, list(crossings)] = cross_damping[:, None]
        fields["tendon_stiffness"][:, list(crossings)] = cross_stiffness[:, None]
    return Variants(scene, fields)
