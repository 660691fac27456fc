"""A whole live system: each process is killed or frozen while the robot moves, and all is done in the end."""

import pytest
from faults import live as faults

import kineverse as kv

for module in ("coal", "daqp", "zenoh"):
    pytest.importorskip(module)

BUSY = 20.0
"""Times the bars that are held on a machine that does other things as well; ``make faults ARGS=live`` has 1."""


@pytest.mark.compiler
@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.long)])
def test_what_is_killed_or_frozen_stops_the_robot_which_finishes_later(number):
    model = kv.Model()
    with model.edit() as edit:
        edit.include("shelf_drawers")
        for root in [f for f, one in model.frames.items() if one.parent == "world"]:
            edit.attach(root, "world", kv.translation(1.6, 0.0, 0.7))
        edit.constrain("slow", -0.1, kv.velocity("shelf_drawers/upper_drawer"), 0.1)
    setting = faults.Setting(
        model, "shelf_drawers/upper_drawer", "shelf_drawers/upper_drawer_handle", world="kinematic"
    )
    found = faults.try_faults(setting, faults.FAULTS[number : number + 1], BUSY)
    assert len(found) == 1
    assert found[0]["way"] < 0.1
