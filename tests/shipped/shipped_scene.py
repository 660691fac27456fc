"""What the tests ask of a shipped description: its joints, its shapes in the world and how deep they meet.

Read with pinocchio and coal, which know nothing of Kineverse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin

SHIPPED = Path(__file__).parents[2] / "src" / "kineverse" / "shipped"


@dataclass(frozen=True)
class Joint:
    """A movable joint as the file has it."""

    name: str
    kind: str
    child: str
    axis: tuple[float, ...]
    lower: float
    upper: float
    velocity: float
    mimic: tuple[str, float, float] | None

    @property
    def range(self) -> tuple[float, float]:
        return self.lower, self.upper


class Scene:
    """A description, posed by the positions of its degrees of freedom; those not given are 0."""

    def __init__(self, name: str) -> None:
        self.text = (SHIPPED / f"{name}.urdf").read_text(encoding="utf-8")
        self.xml = ElementTree.fromstring(self.text)
        self.model = pin.buildModelFromXML(self.text)
        self.data = self.model.createData()
        self.shapes = self._geometry(pin.GeometryType.COLLISION)
        self.visuals = self._geometry(pin.GeometryType.VISUAL)

    def _geometry(self, kind: pin.GeometryType) -> pin.GeometryModel:
        geometry = pin.buildGeomFromUrdfString(self.model, self.text, kind)
        for shape in geometry.geometryObjects:
            shape.geometry.computeLocalAABB()
        return geometry

    @cached_property
    def links(self) -> list[str]:
        return [link.get("name") for link in self.xml.iterfind("link")]

    @cached_property
    def joints(self) -> dict[str, Joint]:
        """The movable joints, mimicking ones included."""
        return {
            joint.get("name"): _joint(joint)
            for joint in self.xml.iterfind("joint")
            if joint.get("type") != "fixed"
        }

    @cached_property
    def dof(self) -> dict[str, Joint]:
        return {name: joint for name, joint in self.joints.items() if joint.mimic is None}

    def bounds(self, kind: str, positions: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return lowest and highest corner of every "shapes" or "visuals", each (n, 3)."""
        geometry = getattr(self, kind)
        poses = self._place(geometry, positions)
        placed = list(zip(poses, [g.geometry.aabb_local for g in geometry.geometryObjects], strict=True))
        middle = np.array([pose.act((box.max_ + box.min_) / 2) for pose, box in placed])
        reach = np.array([np.abs(pose.rotation) @ (box.max_ - box.min_) / 2 for pose, box in placed])
        return middle - reach, middle + reach

    def penetrations(
        self, positions: Mapping[str, float], concerns: Callable[[int, int], bool], deeper_than: float
    ) -> Iterator[tuple[str, str, float]]:
        """Yield link, link and depth [m] of all pairs of shapes that `concerns` accepts by index."""
        lowest, highest = self.bounds("shapes", positions)
        apart = np.any(lowest[:, None] + deeper_than >= highest[None], axis=2)
        candidates = np.argwhere(np.triu(~(apart | apart.T), k=1))
        poses = [coal.Transform3s(p.rotation, p.translation) for p in self._place(self.shapes, positions)]
        objects = self.shapes.geometryObjects
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        for i, j in candidates.tolist():
            if not concerns(i, j):
                continue
            result.clear()
            distance = coal.distance(
                objects[i].geometry, poses[i], objects[j].geometry, poses[j], request, result
            )
            if distance < -deeper_than:
                yield self.link_of(i), self.link_of(j), -distance

    def link_of(self, shape: int) -> str:
        return self.model.frames[self.shapes.geometryObjects[shape].parentFrame].name

    def body_of(self, shape: int) -> int:
        """Return the moving body a shape belongs to; 0 is what stands still."""
        return self.shapes.geometryObjects[shape].parentJoint

    def is_below(self, body: int, ancestor: int) -> bool:
        while body > ancestor:
            body = self.model.parents[body]
        return body == ancestor

    def joints_between(self, a: int, b: int) -> int:
        """Return how many joints lie on the way from one body to another."""
        steps = 0
        while a != b:
            a, b = (self.model.parents[a], b) if a > b else (a, self.model.parents[b])
            steps += 1
        return steps

    def _place(self, geometry: pin.GeometryModel, positions: Mapping[str, float]) -> list[pin.SE3]:
        unknown = set(positions) - set(self.dof)
        assert not unknown, unknown
        q = pin.neutral(self.model)
        for name, joint in self.joints.items():
            master, factor, offset = joint.mimic or (name, 1.0, 0.0)
            value = factor * positions.get(master, 0.0) + offset
            at = self.model.joints[self.model.getJointId(name)].idx_q
            if joint.kind == "continuous":
                q[at : at + 2] = np.cos(value), np.sin(value)
            else:
                q[at] = value
        data = pin.GeometryData(geometry)
        pin.updateGeometryPlacements(self.model, self.data, geometry, data, q)
        return list(data.oMg)


def _joint(element: ElementTree.Element) -> Joint:
    limit, mimic, axis = element.find("limit"), element.find("mimic"), element.find("axis")
    return Joint(
        name=element.get("name"),
        kind=element.get("type"),
        child=element.find("child").get("link"),
        axis=tuple(float(v) for v in axis.get("xyz").split()),
        lower=float(limit.get("lower", -np.inf)),
        upper=float(limit.get("upper", np.inf)),
        velocity=float(limit.get("velocity")),
        mimic=None if mimic is None else _mimic(mimic),
    )


def _mimic(element: ElementTree.Element) -> tuple[str, float, float]:
    return element.get("joint"), float(element.get("multiplier", 1)), float(element.get("offset", 0))
