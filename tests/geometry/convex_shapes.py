"""Random convex shapes, their support functions, and their MuJoCo geoms."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from kineverse.geometry.shapes import Solid, _hull_solid, solid_from_geometry
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

KINDS = ("box", "sphere", "capsule", "hull", "cylinder", "ellipsoid", "cone")
EXACT = KINDS[:4]
"""Polytopes, spheres and capsules, whose distances are closed forms or small linear programs."""

_AROUND = 256


@dataclass
class Convex:
    """A shape of a kind: its solid, its support function, and its MuJoCo geom."""

    kind: str
    solid: Solid
    sizes: np.ndarray
    points: np.ndarray | None = None

    def support(self, n: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return max nᵀx over the shape at a (3, 4) pose, for (..., 3) directions."""
        x, y, _ = self.sizes
        along = n @ pose[:, :3]
        side = np.hypot(along[..., 0], along[..., 1])
        if self.kind == "hull":
            reach = (along @ self.points.T).max(axis=-1)
        elif self.kind == "box":
            reach = np.abs(along) @ self.sizes
        elif self.kind == "sphere":
            reach = x
        elif self.kind == "capsule":
            reach = x + np.abs(along[..., 2]) * y
        elif self.kind == "cylinder":
            reach = x * side + np.abs(along[..., 2]) * y
        elif self.kind == "ellipsoid":
            reach = np.linalg.norm(along * self.sizes, axis=-1)
        else:
            reach = np.maximum(along[..., 2] * y, x * side - along[..., 2] * y)
        return n @ pose[:, 3] + reach

    def geom(self, number: int) -> tuple[str, str]:
        """Return the asset and the attributes of a MuJoCo geom."""
        x, y, z = map(repr, self.sizes.tolist())
        if self.kind in ("hull", "cone"):
            points = " ".join(map(repr, self.mesh_points().ravel().tolist()))
            return f'<mesh name="m{number}" vertex="{points}"/>', f'type="mesh" mesh="m{number}"'
        size = {"box": f"{x} {y} {z}", "ellipsoid": f"{x} {y} {z}", "sphere": x}.get(self.kind, f"{x} {y}")
        return "", f'type="{self.kind}" size="{size}"'

    def mesh_points(self) -> np.ndarray:
        """Return the points whose hull is the shape; of a cone, nearly."""
        if self.kind == "hull":
            return self.points
        angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
        radius, half = self.sizes[:2]
        # Between the inscribed and the circumscribed polygon.
        radius *= (1 + 1 / np.cos(np.pi / _AROUND)) / 2
        ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(_AROUND, -half)], axis=1)
        return np.concatenate([ring, [[0, 0, half]]])


def random_shape(kind: str, rng: np.random.Generator) -> Convex:
    """Return a shape of a decimetre or so."""
    sizes = rng.uniform(0.05, 0.3, 3)
    x, y, z = sizes.tolist()
    if kind == "hull":
        points = rng.normal(size=(20, 3)) * sizes / 2
        points = points.astype(np.float32).astype(float)  # as MuJoCo keeps them
        return Convex(kind, _hull_solid(points), sizes, points)
    geometry = {
        "box": Box((2 * x, 2 * y, 2 * z)),
        "sphere": Sphere(x),
        "capsule": Capsule(x, 2 * y),
        "cylinder": Cylinder(x, 2 * y),
        "ellipsoid": Ellipsoid((x, y, z)),
        "cone": Cone(x, 2 * y),
    }[kind]
    return Convex(kind, solid_from_geometry(geometry), sizes)


def random_pose(rng: np.random.Generator, spread: float) -> np.ndarray:
    """Return a (3, 4) pose."""
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return np.hstack([rotation, rng.normal(size=(3, 1)) * spread])


class MujocoPairs:
    """Shapes that MuJoCo measures in pairs."""

    def __init__(self, shapes: list[Convex]) -> None:
        geoms = [shape.geom(number) for number, shape in enumerate(shapes)]
        bodies = "".join(f'<body mocap="true"><geom {geom}/></body>' for _, geom in geoms)
        self._model = mujoco.MjModel.from_xml_string(
            '<mujoco><option ccd_tolerance="1e-9" ccd_iterations="200"/>'
            f"<asset>{''.join(asset for asset, _ in geoms)}</asset><worldbody>{bodies}</worldbody></mujoco>"
        )
        self._data = mujoco.MjData(self._model)
        self._fromto = np.zeros(6)

    def distance(self, i: int, j: int, poses: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the signed distance at two poses, and the unit direction that it is about."""
        for k, pose in zip((i, j), poses, strict=True):
            self._place(k, pose)
        distance = mujoco.mj_geomDistance(self._model, self._data, i, j, 10.0, self._fromto)
        way = self._fromto[3:] - self._fromto[:3]
        return distance, way / distance if distance else way

    def _place(self, k: int, pose: np.ndarray) -> None:
        rotation, position = pose[:, :3], pose[:, 3]
        mesh = self._model.geom_dataid[k]
        if mesh >= 0:  # MuJoCo moves meshes to their principal axes.
            own = np.zeros(9)
            mujoco.mju_quat2Mat(own, self._model.mesh_quat[mesh])
            position = rotation @ self._model.mesh_pos[mesh] + position
            rotation = rotation @ own.reshape(3, 3)
        self._data.geom_xpos[k] = position
        self._data.geom_xmat[k] = rotation.ravel()


def gap(a: Convex, b: Convex, poses: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the gaps between two shapes along unit directions, which are lower bounds of the distance."""
    return -a.support(n, poses[0]) - b.support(-n, poses[1])
