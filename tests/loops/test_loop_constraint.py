"""A closure that is kept as constraints: what they say, and that it is recorded, saved, edited and written."""

from __future__ import annotations

import math

import numpy as np
import pytest
from linkages import Y, at, bar, four_bar

import kineverse as kv
from kineverse.errors import DuplicateNameError, InvalidValueError, ModelError, UnknownNameError
from kineverse.loops.loop_records import find_loops

AXES = ("x", "y", "z", "rx", "ry", "rz")


def kept(**options) -> kv.Model:
    model = four_bar(close=False, limits={"lower": -2, "upper": 2})
    with model.edit() as edit:
        edit.apply(kv.loops.LoopConstraint(name="four-bar", frame="coupler_tip", to="rocker_tip", **options))
    return model


STATE = kv.State({"crank": 0.3, "coupler": 0.2, "rocker": 1.1})


def test_its_constraints_are_the_rows_of_the_residual():
    model = kept()
    assert [n for n in model.constraints if n.startswith("four-bar/")] == ["four-bar/x", "four-bar/y"]
    offset = model.fk("coupler_tip", "rocker_tip")(STATE)[:3, 3]
    for name, value in zip("xy", offset, strict=False):
        constraint = model.constraints[f"four-bar/{name}"]
        assert constraint.expression(STATE) == value
        assert (float(constraint.lower), float(constraint.upper)) == (0, 0)
    assert {v.name: v.value for v in model.violations(STATE)} == pytest.approx(
        {"four-bar/x": offset[0], "four-bar/y": offset[1]}
    )
    assert len(model.degrees_of_freedom) == 3
    (loop,) = find_loops(model)
    assert (loop.ends, loop.mask, loop.dependent) == ((("coupler_tip", "rocker_tip"),), ("x", "y", "z"), ())
    assert loop.constraints == ("four-bar/x", "four-bar/y")


def test_turns_count_and_half_a_turn_is_none():
    model = kept(mask=AXES)
    assert set(model.constraints) >= {"four-bar/x", "four-bar/y", "four-bar/rz", "four-bar/upright"}
    half = {"crank": 0.0, "coupler": math.pi, "rocker": 0.0}
    assert "four-bar/upright" in {v.name for v in model.violations(half)}
    assert "four-bar/rz" not in {v.name for v in model.violations(half)}


def test_a_rigid_gap_becomes_a_constraint_that_never_holds():
    model = four_bar(close=False)
    with model.edit() as edit:
        edit.add_frame("lifted", "rocker_tip", kv.translation(0, 0, 0.2))
        edit.apply(kv.loops.LoopConstraint(name="four-bar", frame="coupler_tip", to="lifted"))
    apart = model.constraints["four-bar/apart"].expression(STATE)
    assert apart == pytest.approx(np.linalg.norm(model.fk("coupler_tip", "lifted")(STATE)[:3, 3]))
    assert apart >= 0.2


def test_several_pairs():
    model = four_bar(close=False)
    with model.edit() as edit:
        edit.apply(
            kv.loops.LoopConstraint(
                name="both",
                frame="coupler_tip",
                to="rocker_tip",
                more=[["coupler_tip", "world"]],
                mask=["x", "y"],
            )
        )
    assert list(model.constraints)[-4:] == ["both/x", "both/y", "both/1/x", "both/1/y"]


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"mask": ("x", "q")}, InvalidValueError, r"mask of loop 'tie'.*'q'"),
        ({"mask": ()}, InvalidValueError, r"mask of loop 'tie'.*\(\)"),
        ({"mask": "rx"}, InvalidValueError, "mask of loop 'tie'.*not 'rx'"),
        ({"mask": ("z",)}, ModelError, "'tie' cannot move: nothing changes what its mask names"),
        ({"to": "coupler"}, ModelError, "'tie' cannot move: nothing changes .* 'coupler_tip' and 'coupler'"),
        ({"frame": "lid"}, UnknownNameError, "no frame 'lid'"),
        ({"name": "crank"}, DuplicateNameError, "an articulation 'crank' already"),
    ],
)
def test_options_that_do_not_fit(options, error, text):
    model = four_bar(close=False)
    before = model.snapshot()
    with pytest.raises(error, match=text), model.edit() as edit:
        edit.apply(
            kv.loops.LoopConstraint(**({"name": "tie", "frame": "coupler_tip", "to": "rocker_tip"} | options))
        )
    assert model.snapshot() == before


def test_a_loop_constraint_follows_earlier_edits_also_without_its_code(tmp_path):
    model = kept(mask=AXES)
    model.save(tmp_path / "bars.kv.json")
    copy = kv.load(tmp_path / "bars.kv.json")
    assert copy.snapshot() == model.snapshot()
    longer = kv.model.AddFrame(
        "coupler_tip", kv.model.Frame.from_transform("coupler", kv.translation(1.2, 0.1, 0))
    )
    for either in (model, copy):
        with either.edit() as edit:
            edit.replace("frame coupler_tip", longer)
    for name, constraint in model.constraints.items():
        assert copy.constraints[name].expression(STATE) == constraint.expression(STATE)
    assert list(find_loops(copy)) == list(find_loops(model))
    # In a plane that is another one, other rows would move; what was recorded does not know them.
    tilted = kv.model.AddFrame(
        "coupler_tip", kv.model.Frame.from_transform("coupler", kv.translation(1.2, 0, 0.3))
    )
    with model.edit() as edit:
        edit.replace("frame coupler_tip", tilted)
    assert "four-bar/apart" in model.constraints
    with pytest.raises(kv.errors.EditError, match="'loop four-bar'"), copy.edit() as edit:
        edit.replace("frame coupler_tip", tilted)


def test_documents_under_a_prefix(tmp_path):
    kept().save(tmp_path / "bars.kv.json")
    (loop,) = find_loops(kv.load(tmp_path / "bars.kv.json", prefix="left"))
    assert loop.constraints == ("left/four-bar/x", "left/four-bar/y")
    assert loop.ends == (("left/coupler_tip", "left/rocker_tip"),)


def test_removed_with_its_operation():
    model = kept()
    with model.edit() as edit:
        edit.remove("loop four-bar")
    assert list(model.constraints) == ["crank/position"]
    assert list(find_loops(model)) == []


def test_mjcf_says_it_as_an_equality_and_urdf_names_it(tmp_path):
    pytest.importorskip("mujoco")
    model = kept()
    assert model.save(tmp_path / "bars.xml").remarks == ()
    assert (tmp_path / "bars.xml").read_text().count("<connect ") == 1
    read = kv.load(tmp_path / "bars.xml")
    assert set(read.constraints) == set(model.constraints)
    assert read.degrees_of_freedom == model.degrees_of_freedom
    for name in ("four-bar/x", "four-bar/y"):
        ours, theirs = (m.constraints[name].expression(STATE) for m in (model, read))
        assert ours == pytest.approx(theirs, abs=1e-12)
    with pytest.raises(kv.errors.FormatError, match="'four-bar/x' is no multiple of one coordinate"):
        model.save(tmp_path / "bars.urdf", strict=True)
    # A tie that leaves out what moves is none that MuJoCo knows.
    partly = four_bar(close=False)
    with partly.edit() as edit:
        bar(edit, "door", "world", at(0, 2), Y)
        edit.apply(kv.loops.LoopConstraint(name="level", frame="door", mask=("ry",)))
    with pytest.raises(kv.errors.FormatError, match="level/ry"):
        partly.save(tmp_path / "partly.xml", strict=True)


def test_velocity_rows_keep_it_closed():
    """Where it is closed its rows are equalities; where it is not, nothing may open it further."""
    model = kept()
    rows = model.velocity_rows(0.1)
    ask = kv.compile([rows.matrix, rows.lower, rows.upper], model.degrees_of_freedom, tier="interpreter")
    for state, is_closed in ((model.project(STATE), True), (STATE, False)):
        matrix, lower, upper = ask([state[str(s)] for s in model.degrees_of_freedom])
        for axis in "xy":
            sides = [i for i, n in enumerate(rows.names) if n == f"four-bar/{axis}"]
            constraint = model.constraints[f"four-bar/{axis}"].expression
            slope = constraint.jacobian([s.integral() for s in rows.speeds])(state)
            for side in sides:
                np.testing.assert_allclose(matrix[side], slope, rtol=0, atol=1e-12)
            least, most = lower[sides].max(), upper[sides].min()
            if is_closed:
                assert (least, most) == pytest.approx((0, 0), abs=1e-7)
            else:
                value = constraint(state)
                assert least <= most
                assert (least >= 0 and most > 0) if value < 0 else (most <= 0 and least < 0)


@pytest.mark.parametrize("kind", [kv.CloseLoop, kv.loops.LoopConstraint])
def test_masks_and_ends_are_given_alike(kind):
    one = kind(name="l", frame="a", mask="xz", more=[["b", "c"]])
    assert one == kind(name="l", frame="a", mask=["x", "z"], more=(("b", "c"),))
    assert (one.mask, one.more) == (("x", "z"), (("b", "c"),))
    for wrong in (5, "bc", ("b", "c"), [("b",)], [("b", "c", "d")], [(1, 2)], None):
        with pytest.raises(
            kv.errors.InvalidValueError, match=r"^Loop 'l' takes more=\(\(frame, to\), \.\.\.\), pairs of"
        ):
            kind(name="l", frame="a", more=wrong)
    for wrong in (5, "q", "xx", (), [["x"]], None):
        with pytest.raises(
            kv.errors.InvalidValueError, match=r"^The mask of loop 'l' has names out of x, y, z, rx"
        ):
            kind(name="l", frame="a", mask=wrong)
