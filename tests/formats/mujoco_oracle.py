"""An MJCF in MuJoCo and in Kineverse, compared by poses and Jacobians.

MuJoCo reads the file itself. Joints, bodies and sites correspond by their number, so that those without a name
are compared, too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import kineverse as kv
from kineverse.formats.mjcf import MjcfScene, parse_mjcf
from kineverse.formats.mjcf.operations import mjcf_operations

mujoco = pytest.importorskip("mujoco")

Array = npt.NDArray[np.float64]


def model_of(scene: MjcfScene, prefix: str | None = None) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for operation in mjcf_operations(scene, prefix):
            edit.apply(operation)
    return model


class Pair:
    """Description in MuJoCo and in Kineverse."""

    def __init__(self, text: str | bytes, engine: mujoco.MjModel, folder: str = "") -> None:
        self.scene = parse_mjcf(text, "x.xml", folder)
        self.model = model_of(self.scene)
        self.engine = engine
        self.data = mujoco.MjData(engine)
        self.bodies = [link.name for link in self.scene.links]
        self.joints = [
            joint for link in self.scene.links for joint in link.joints if not self._is_handle(joint.name)
        ]
        assert len(self.bodies) == engine.nbody
        assert len(self.joints) == engine.njnt
        frames = [*self.bodies, *(site.name for site in self.scene.sites)]
        self._poses = self._function([self.model.fk(name) for name in frames])
        self._frames = frames

    @staticmethod
    def of_text(text: str) -> Pair:
        return Pair(text, mujoco.MjModel.from_xml_string(text))

    @staticmethod
    def of_file(path: Path) -> Pair:
        return Pair(path.read_bytes(), mujoco.MjModel.from_xml_path(str(path)), str(path.parent))

    def _is_handle(self, name: str) -> bool:
        return any(name == f"{link.name}/free" for link in self.scene.links)

    def _is_held(self, joint: str) -> bool:
        """Return True if a free body is attached to the link that an equality ties it to."""
        record = self.model.articulations.get(joint)
        return record is None or record.kind != "floating"

    def random_state(self, rng: np.random.Generator) -> dict[kv.Symbol, float]:
        """Return a state within the limits; quaternions have length one."""
        state = dict(self.model.default_state())
        for symbol in state:
            if symbol.path.rpartition("/")[2] in ("qx", "qy", "qz", "qw"):
                state[symbol] = rng.normal()
                continue
            low, high = self.model.limits(symbol)
            state[symbol] = rng.uniform(max(low, -2.0), min(high, 2.0))
        for symbol in state:
            if symbol.path.endswith("/qw"):
                stem = symbol.path[:-1]
                names = [kv.position(stem + c) for c in "xyzw"]
                length = np.linalg.norm([state[n] for n in names])
                state |= {n: state[n] / length for n in names}
        return state

    def _function(self, expressions: list[kv.Expression]) -> kv.Function:
        resolve = self.model.rates.resolve
        return kv.compile([resolve(e) for e in expressions], tier="interpreter")

    @staticmethod
    def _values(function: kv.Function, state: dict[kv.Symbol, float]) -> list[Array]:
        return list(function({s: state[s] for s in function.inputs}))

    def value(self, expression: kv.Expression, state: dict[kv.Symbol, float]) -> Array:
        resolved = self.model.rates.resolve(expression)
        return np.asarray(resolved({s: state[s] for s in resolved.symbols}))

    def place(self, state: dict[kv.Symbol, float]) -> None:
        """Set MuJoCo's joints and mocap bodies to a state."""
        for number, joint in enumerate(self.joints):
            at = int(self.engine.jnt_qposadr[number])
            if joint.kind == "free" and self._is_held(joint.name):
                pose = self.value(self.model.fk(self.bodies[self.engine.jnt_bodyid[number]]), state)
                self.data.qpos[at : at + 3] = pose[:3, 3]
                mujoco.mju_mat2Quat(self.data.qpos[at + 3 : at + 7], pose[:3, :3].ravel())
                continue
            record = self.model.articulations[joint.name]
            if joint.kind in ("hinge", "slide"):
                self.data.qpos[at] = self.value(record.position, state)
                continue
            values = np.array([state[s] for s in record.coordinates])
            wxyz = np.roll(values[-4:], 1)
            if joint.kind == "ball":
                self.data.qpos[at : at + 4] = wxyz
            else:
                body = int(self.engine.jnt_bodyid[number])
                self.data.qpos[at : at + 3], self.data.qpos[at + 3 : at + 7] = self._free(
                    body, values[:3], wxyz
                )
        for body, mocap in enumerate(self.engine.body_mocapid):
            if mocap >= 0:
                record = self.model.articulations[f"{self.bodies[body]}/free"]
                values = np.array([state[s] for s in record.coordinates])
                where = self._free(body, values[:3], np.roll(values[-4:], 1))
                self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = where
        mujoco.mj_kinematics(self.engine, self.data)
        mujoco.mj_comPos(self.engine, self.data)

    def _free(self, body: int, offset: Array, wxyz: Array) -> tuple[Array, Array]:
        """Return the pose of a free body: its pose in the file, and the motion from there."""
        turned, quat = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(turned, offset, self.engine.body_quat[body])
        mujoco.mju_mulQuat(quat, self.engine.body_quat[body], wxyz)
        return self.engine.body_pos[body] + turned, quat

    def compare_poses(self, state: dict[kv.Symbol, float], tolerance: float = 1e-10) -> None:
        self.place(state)
        positions = [*self.data.xpos, *self.data.site_xpos]
        matrices = [*self.data.xmat, *self.data.site_xmat]
        values = self._values(self._poses, state)
        for name, position, matrix, here in zip(self._frames, positions, matrices, values, strict=True):
            pose = np.eye(4)
            pose[:3, 3], pose[:3, :3] = position, matrix.reshape(3, 3)
            np.testing.assert_allclose(here, pose, atol=tolerance, err_msg=name)

    def compare_jacobians(self, state: dict[kv.Symbol, float], tolerance: float = 1e-9) -> None:
        """Compare the columns of Jacobians; MuJoCo's speeds are a linear function of the model's."""
        self.place(state)
        speeds = self.model.speeds
        to_engine = np.zeros((self.engine.nv, len(speeds)))
        for number, joint in enumerate(self.joints):
            at = int(self.engine.jnt_dofadr[number])
            record = self.model.articulations[joint.name]
            if joint.kind in ("hinge", "slide"):
                for key, slope in self.model.rates.resolve(record.position).gradient().items():
                    to_engine[at, speeds.index(key)] = slope({s: state[s] for s in slope.symbols})
                continue
            block = np.eye(len(record.speeds))
            if joint.kind == "free":
                matrix = np.zeros(9)
                mujoco.mju_quat2Mat(matrix, self.engine.body_quat[self.engine.jnt_bodyid[number]])
                block[:3, :3] = matrix.reshape(3, 3)
            columns = [speeds.index(s) for s in record.speeds]
            to_engine[at : at + len(block), columns] = block
        # MuJoCo has no speeds of mocap bodies.
        moving = [k for k, s in enumerate(speeds) if not self._is_handle(s.path.rpartition("/")[0])]
        names = [name for name in self.bodies if self.model.speeds_of(name)]
        if not names:
            return
        jacobians = self._values(self._function([self.model.jacobian(name) for name in names]), state)
        for name, jacobian in zip(names, jacobians, strict=True):
            linear, angular = np.zeros((3, self.engine.nv)), np.zeros((3, self.engine.nv))
            mujoco.mj_jacBody(self.engine, self.data, linear, angular, self.bodies.index(name))
            expected = np.vstack([linear, angular]) @ to_engine
            here = np.zeros((6, len(speeds)))
            here[:, [speeds.index(s) for s in self.model.speeds_of(name)]] = jacobian
            np.testing.assert_allclose(here[:, moving], expected[:, moving], atol=tolerance, err_msg=name)

    def compare(self, samples: int = 5, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        held = any(joint.kind == "free" and self._is_held(joint.name) for joint in self.joints)
        for _ in range(samples):
            self.compare_poses(state := self.random_state(rng))
        if not held:  # MuJoCo's columns know nothing of what holds a body
            self.compare_jacobians(state)
