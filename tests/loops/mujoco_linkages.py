"""Linkages told to MuJoCo: a tree of bodies with hinges and slides, closed by pins."""

from __future__ import annotations

import mujoco
import numpy as np
from loop_checks import loops_of

import kineverse as kv
from kineverse.model.basic_operations import AddFrame


def as_mujoco(model: kv.Model) -> tuple[mujoco.MjModel, mujoco.MjData, list[str], list[str]]:
    """Return the open tree of a model with a pin for each loop, the names of joints, and of frames (sites)."""
    bodies: dict[str, list[str]] = {"world": []}
    children: dict[str, list[str]] = {"world": []}
    heads: dict[str, str] = {}
    place: dict[str, tuple[str, np.ndarray]] = {"world": ("world", np.eye(4))}
    for tag in model.history.tags:
        operation = model.history.entry(tag).operation
        if isinstance(operation, (kv.Revolute, kv.Prismatic)):
            body, above = place[operation.parent]
            numbers = _pose(above @ operation.origin.matrix)
            kind = "hinge" if isinstance(operation, kv.Revolute) else "slide"
            axis, name = " ".join(map(repr, map(float, operation.axis))), operation.child
            heads[name] = (
                f'<body name="{name}" {numbers}><joint name="{operation.name}" type="{kind}" axis="{axis}"/>'
            )
            bodies[name], children[name] = [], []
            children[body].append(name)
            place[name] = (name, np.eye(4))
        elif isinstance(operation, AddFrame):
            body, above = place[operation.frame.parent]
            place[operation.name] = (body, above @ model.fk(operation.name, operation.frame.parent)())
    for frame, (body, pose) in place.items():
        bodies[body].append(f'<site name="{frame}" {_pose(pose)}/>')

    def written(body: str) -> str:
        inside = "".join(bodies[body]) + "".join(map(written, children[body]))
        return inside if body == "world" else f'{heads[body]}<geom size=".01"/>{inside}</body>'

    pins = [p for loop in loops_of(model) for p in ((loop.frame, loop.to), *loop.more)]
    equality = "".join(f'<connect site1="{a}" site2="{b}"/>' for a, b in pins)
    text = (
        '<mujoco><compiler angle="radian" autolimits="false"/><option jacobian="dense">'
        '<flag contact="disable"/></option>'
        f"<worldbody>{written('world')}</worldbody><equality>{equality}</equality></mujoco>"
    )
    theirs = mujoco.MjModel.from_xml_string(text)
    joints = [theirs.joint(i).name for i in range(theirs.njnt)]
    return theirs, mujoco.MjData(theirs), joints, [theirs.site(i).name for i in range(theirs.nsite)]


def _pose(matrix: np.ndarray) -> str:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, matrix[:3, :3].ravel())
    return f'pos="{_text(matrix[:3, 3])}" quat="{_text(quaternion)}"'


def _text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in numbers)
