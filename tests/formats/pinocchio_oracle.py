"""Poses and Jacobians of a URDF in pinocchio, by the coordinates and speeds of Kineverse.

Pinocchio supports mimic joints of one type only. So they are independent there, and follow by multiplier and
offset here, their Jacobian columns by a matrix. The mimic relations are read from the text without Kineverse.
"""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest

pin = pytest.importorskip("pinocchio")

Matrix = npt.NDArray[np.float64]
FORMS = {
    "world_aligned": pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
    "world": pin.ReferenceFrame.WORLD,
    "body": pin.ReferenceFrame.LOCAL,
}
COORDINATES = {"planar": ("x", "y", "angle"), "floating": ("x", "y", "z", "qx", "qy", "qz", "qw")}


class PinocchioReference:
    """Robot in pinocchio, at the configuration set by :meth:`place`.

    ``speeds`` are the names of Kineverse's speeds. ``speed_map``, (nv, n), maps them to pinocchio's speeds.
    """

    def __init__(self, text: str) -> None:
        self.model = pin.buildModelFromXML(text)
        self.data = self.model.createData()
        plain = re.sub(r"<\?xml[^>]*\?>", "", text)  # which may be misspelt
        elements = {e.get("name"): e for e in ElementTree.fromstring(plain).findall("joint")}
        self._kinds = {name: e.get("type") for name, e in elements.items()}
        self._mimics = {
            name: (mimic.get("joint"), float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0)))
            for name, e in elements.items()
            if (mimic := e.find("mimic")) is not None
        }
        self.speeds: list[str] = []
        self.speed_map = np.zeros((self.model.nv, 0))

    def random_values(self, rng: np.random.Generator) -> dict[str, float]:
        """Return a value for every coordinate; quaternions have length one."""
        values: dict[str, float] = {}
        for name in self.model.names[1:]:
            if self._kinds[name] in COORDINATES:
                own = rng.uniform(-2, 2, len(COORDINATES[self._kinds[name]]))
                own[3:] /= np.linalg.norm(own[3:])
                names = (f"{name}/{c}" for c in COORDINATES[self._kinds[name]])
                values |= dict(zip(names, own.tolist(), strict=True))
            elif name not in self._mimics:
                values[name] = rng.uniform(-2, 2)
        return values

    def place(self, values: dict[str, float]) -> None:
        """Set pinocchio's configuration to the coordinates of Kineverse."""
        configuration: list[float] = []
        columns: dict[str, Matrix] = {}
        for name, moving in zip(self.model.names[1:], self.model.joints[1:], strict=True):
            numbers, speeds, block = self._of_joint(name, values)
            configuration += numbers
            for speed, column in zip(speeds, block.T, strict=True):
                whole = columns.setdefault(speed, np.zeros(self.model.nv))
                whole[moving.idx_v : moving.idx_v + moving.nv] = column
        self.speeds = list(columns)
        self.speed_map = np.column_stack([np.zeros((self.model.nv, 0)), *columns.values()])
        pin.computeJointJacobians(self.model, self.data, np.array(configuration))
        pin.updateFramePlacements(self.model, self.data)

    def pose(self, link: str) -> Matrix:
        """Return root_T_link."""
        return np.array(self.data.oMf[self._frame(link)].homogeneous)

    def jacobian(self, link: str, form: str) -> Matrix:
        """Return the 6×n Jacobian, with a column for each of ``speeds``."""
        if not self.model.nv:
            return np.zeros((6, 0))  # pinocchio 4.1.0 crashes when it hands out a matrix without columns
        own = pin.getFrameJacobian(self.model, self.data, self._frame(link), FORMS[form])
        return np.reshape(own, (6, self.model.nv)) @ self.speed_map

    def _frame(self, link: str) -> int:
        return int(self.model.getFrameId(link, pin.FrameType.BODY))

    def _of_joint(self, name: str, values: dict[str, float]) -> tuple[list[float], list[str], Matrix]:
        """Return pinocchio's coordinates, the speeds of Kineverse, and pinocchio's speeds by these."""
        kind = self._kinds[name]
        if kind == "planar":
            # Pinocchio's speeds are in axes of the child, ours in those of the joint's frame.
            x, y, angle = (values[f"{name}/{c}"] for c in COORDINATES[kind])
            c, s = np.cos(angle), np.sin(angle)
            speeds = [f"{name}/{s}:velocity" for s in ("x", "y", "angle")]
            return [x, y, c, s], speeds, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        if kind == "floating":
            # The same holds for the linear ones; the angular ones are in axes of the child in both.
            numbers = [values[f"{name}/{c}"] for c in COORDINATES[kind]]
            turn = pin.XYZQUATToSE3(np.array(numbers)).rotation
            speeds = [f"{name}/{s}:velocity" for s in ("x", "y", "z", "wx", "wy", "wz")]
            nothing = np.zeros((3, 3))
            return numbers, speeds, np.block([[turn.T, nothing], [nothing, np.eye(3)]])
        source, factor, offset = self._source(name)
        value = factor * values[source] + offset
        numbers = [np.cos(value), np.sin(value)] if kind == "continuous" else [value]
        return numbers, [f"{source}:velocity"], np.array([[factor]])

    def _source(self, name: str) -> tuple[str, float, float]:
        """Return the joint at the end of a mimic chain, with the composed multiplier and offset."""
        if name not in self._mimics:
            return name, 1.0, 0.0
        leader, factor, offset = self._mimics[name]
        source, inner_factor, inner_offset = self._source(leader)
        return source, factor * inner_factor, factor * inner_offset + offset
