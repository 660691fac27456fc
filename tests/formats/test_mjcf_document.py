"""Models from MJCF are saved as documents, which are read without MuJoCo."""

import pytest
from mujoco_oracle import model_of
from test_mjcf_bodies import HOMED
from test_mjcf_equalities import ARM, BOX, MORE, ROPED, TENDONS, bars, scene
from test_mjcf_kinematics import mjcf

import kineverse as kv
from kineverse.formats.mjcf import parse_mjcf

TEXTS = {
    "tendons": mjcf(
        f"<worldbody>{ROPED}</worldbody>",
        TENDONS.replace('name="f"', 'name="f" stiffness="3"'),
        '<equality><tendon name="e" tendon1="f" tendon2="s"/></equality>',
    ),
    "a linkage": scene(bars(30.0), '<connect name="pin" body1="coupler" body2="rocker" anchor="1 0 0"/>'),
    "home": HOMED.format(""),
    "a body that is held": scene(ARM + BOX.format(MORE), '<connect body1="knob" anchor="0 0 1"/>'),
}


@pytest.mark.parametrize("what", TEXTS)
def test_models_from_mjcf_are_written_as_documents(what, tmp_path):
    model = model_of(parse_mjcf(TEXTS[what]), "p")
    model.save(tmp_path / "x.kv.json")
    back = kv.load(tmp_path / "x.kv.json")
    assert back.default_state() == model.default_state()
    assert dict(back.data) == dict(model.data)
    assert dict(back.constraints) == dict(model.constraints)
    assert dict(back.frames) == dict(model.frames)
