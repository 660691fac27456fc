"""A quaternion of zeros is the identity, as in MuJoCo and libsdformat, so every state has a pose."""

import json

import mujoco
import numpy as np
import pytest

import kineverse as kv
from kineverse.formats.document import read_operations, to_json
from kineverse.formats.mjcf import parse_mjcf
from kineverse.formats.mjcf.operations import mjcf_operations

GEOM = '<geom size=".1"/>'
FREE = f'<body name="b" pos="1 2 3" quat="{{}}"><freejoint/>{GEOM}</body>'
BALL = f'<body name="a" quat="{{}}">{GEOM}<body name="b"><joint type="ball"/>{GEOM}</body></body>'


@pytest.mark.parametrize("turn", ["0 0 0 0", "1e-17 0 0 0", "3 0 3 0", "0 0 -2 0", "1 0 0 0"])
@pytest.mark.parametrize("rest", ["1 0 0 0", "0 1 0 0", "2 1 0 2"])
@pytest.mark.parametrize(("body", "before"), [(FREE, "0 0 1 "), (BALL, "")])
def test_home_positions_with_zero_quaternions_are_those_of_mujoco(turn, rest, body, before):
    key = f'<keyframe><key name="home" qpos="{before}{turn}"/></keyframe>'
    text = f"<mujoco><worldbody>{body.format(rest)}</worldbody>{key}</mujoco>"
    model = kv.Model()
    with model.edit() as edit:
        for operation in mjcf_operations(parse_mjcf(text)):
            edit.apply(operation)
    state = model.default_state()
    quaternion = [state[s] for s in state if str(s).rpartition("/")[2] in ("qx", "qy", "qz", "qw")]
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
    theirs = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(theirs)
    mujoco.mj_resetDataKeyframe(theirs, data, 0)
    mujoco.mj_kinematics(theirs, data)
    pose = model.fk("b")(state)
    np.testing.assert_allclose(pose[:3, 3], data.body("b").xpos, atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3].ravel(), data.body("b").xmat, atol=1e-12)


def test_document_with_a_zero_quaternion_home_is_refused():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Ball(name="j", parent="world", child="b"))
    tree = json.loads(to_json(model))
    tree.pop("sha256", None)
    for operation in tree["operations"]:
        for record in operation["writes"].get("articulations", {}).values():
            record["home"] = [0.0] * 4
    with pytest.raises(kv.errors.FormatError, match="has the quaternion 0 0 0 0"):
        read_operations(json.dumps(tree))
