"""Contacts between bodies in MuJoCo, with their forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.lie import Array

from .world import Contact


class MujocoContacts:
    """Contacts of one ``MjModel``."""

    def __init__(
        self, compiled: Any, robot: Callable[[str], bool], fingers: Sequence[Sequence[str]] = ()
    ) -> None:
        self._compiled = compiled
        self._names = [compiled.body(k).name for k in range(compiled.nbody)]
        self._is_robot = np.array([robot(name) for name in self._names])
        self._side = np.zeros(compiled.nbody, dtype=int)
        for side, names in enumerate(fingers, 1):
            for name in names:
                self._side[compiled.body(name).id] = side

    def contacts(self, data: Any) -> tuple[Contact, ...]:
        """Return one contact for each pair of bodies that touch, but those of the robot with itself.

        The force is the size of the sum over all points of contact. Point, normal and distance are those of
        the deepest one.
        """
        engine, found = mujoco(), dict[tuple[int, int], list[Any]]()
        wrench = np.zeros(6)
        for k in range(data.ncon):
            contact = data.contact[k]
            a, b = self._compiled.geom_bodyid[contact.geom].tolist()
            if self._is_robot[a] and self._is_robot[b]:
                continue
            frame = contact.frame.reshape(3, 3)
            engine.mj_contactForce(self._compiled, data, k, wrench)
            force, normal = frame.T @ wrench[:3], frame[0]
            if self._is_robot[b] or (b < a and not self._is_robot[a]):
                a, b, force, normal = b, a, -force, -normal
            known = found.get((a, b))
            if known is None:
                found[a, b] = [contact.pos.copy(), normal.copy(), contact.dist, force]
                continue
            known[3] = known[3] + force
            if contact.dist < known[2]:
                known[:3] = contact.pos.copy(), normal.copy(), contact.dist
        return tuple(
            Contact(
                self._names[a], self._names[b], point, normal, float(distance), float(np.linalg.norm(force))
            )
            for (a, b), (point, normal, distance, force) in found.items()
        )

    def largest_force(self, data: Any) -> float:
        """Return the largest normal force between a body of the robot and another body [N]."""
        if not data.ncon:
            return 0.0
        contact = data.contact
        bodies: Array = self._compiled.geom_bodyid[contact.geom]
        wanted = (self._is_robot[bodies].sum(axis=1) == 1) & (contact.efc_address >= 0)
        if not wanted.any():
            return 0.0
        # Contacts are few, and this runs in each time step: plain Python is faster than arrays here.
        sums: dict[tuple[int, int], float] = {}
        forces = data.efc_force[contact.efc_address[wanted]]
        for (one, other), force in zip(bodies[wanted].tolist(), forces.tolist(), strict=True):
            pair = (one, other) if one < other else (other, one)
            sums[pair] = sums.get(pair, 0.0) + force
        return max(sums.values())

    def grip(self, data: Any) -> dict[str, tuple[float, float]]:
        """Return the normal forces of both fingers by what they touch [N].

        Bodies that are rigidly connected and move count as one; its name is that of the one pressed most.
        """
        if not data.ncon:
            return {}
        contact = data.contact
        bodies: Array = self._compiled.geom_bodyid[contact.geom]
        sides = self._side[bodies]
        # Fingers with something that is not the robot's, in contacts that the solver has rows for.
        wanted = (sides.max(axis=1) > 0) & ~self._is_robot[bodies].all(axis=1) & (contact.efc_address >= 0)
        pressed: dict[tuple[bool, int], dict[int, Array]] = {}
        for k in np.flatnonzero(wanted).tolist():
            finger = int(sides[k, 1] > 0)
            body = int(bodies[k, 1 - finger])
            root = int(self._compiled.body_weldid[body])
            forces = pressed.setdefault((root > 0, root or body), {}).setdefault(body, np.zeros(2))
            forces[sides[k, finger] - 1] += data.efc_force[contact.efc_address[k]]
        found = {}
        for parts in pressed.values():
            most = max(parts, key=lambda body: float(parts[body].sum()))
            one, other = sum(parts.values(), np.zeros(2)).tolist()
            found[self._names[most]] = one, other
        return found
