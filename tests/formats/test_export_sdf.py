"""Models written as SDF: the models read back are the same, and poses are those of drake."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_trees import KINDS, trees
from round_trip import CURVES, SCENES, SHIPPED, assert_same_bodies, assert_same_motion, load_cached
from test_export_names import NAMES, named
from test_export_urdf import REFUSED

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.sdf.custom_attributes import NAMESPACE, allowed_name
from kineverse.model.basic_operations import SetBody, SetHome, SoftLimits
from kineverse.model.body import Body, Box, Capsule, Cone, Ellipsoid, Inertia, Mesh, Shape, Sphere

pytest.importorskip("pydrake")

LOOPS = ("slider_crank", "four_bar", "parallel_gripper", "scissor_linkage", "delta_robot", "jansen_leg")


def saved(model: kv.Model, folder: Path) -> kv.Model:
    """Save a model as SDF, check it in drake, and return what is read of it."""
    model.save(folder / "m.sdf")
    check = kv.formats.check_conversion(model, folder / "m.sdf", states=20)
    assert check.ok, check
    assert check.frames == len(model.frames)
    return kv.load(folder / "m.sdf")


def built(*operations: kv.model.Operation) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for operation in operations:
            edit.apply(operation)
    return model


@pytest.mark.parametrize(
    "name", [*SHIPPED, *(scene for scene in SCENES if scene.split("/")[1] not in CURVES)]
)
@pytest.mark.sampled(11)
def test_a_model_that_ships_moves_alike_in_drake_and_when_read_back(name: str, tmp_path: Path) -> None:
    model = load_cached(name)
    again = saved(model, tmp_path)
    assert again.degrees_of_freedom == model.degrees_of_freedom
    assert set(again.rates.dependent) == set(model.rates.dependent)
    if not model.rates.dependent:
        assert_same_motion(model, again)
    assert_same_bodies(model, again)
    home, other = model.default_state(), again.default_state()
    assert {s: other[s] for s in home} == pytest.approx(dict(home), abs=1e-9)


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.sampled(2)
def test_curves_are_refused_by_the_name_of_the_joint(name: str, tmp_path: Path) -> None:
    full = f"articulations/{name}"
    with pytest.raises(
        kv.errors.FormatError, match=r"SDF cannot express .* '.*' (turns|slides) by no multiple"
    ):
        load_cached(full).save(tmp_path / "m.sdf")
    assert full in REFUSED
    assert not (tmp_path / "m.sdf").exists()


@settings(deadline=None, max_examples=attempts(6))
@given(model=trees(), data=st.data())
def test_random_trees_move_alike_in_drake_and_when_read_back(
    tmp_path_factory: pytest.TempPathFactory, model: kv.Model, data: st.DataObject
) -> None:
    assert "screw" in KINDS
    again = saved(model, tmp_path_factory.mktemp("tree"))
    assert_same_motion(model, again)


@pytest.mark.parametrize(
    "name", [*NAMES, "__own__", "a::b", "_", " a", "tab\there", "x_joint", "world_body", "model"]
)
@pytest.mark.sampled(5)
def test_names_are_kept_in_every_role(name: str, tmp_path: Path) -> None:
    if "\t" in name:
        assert allowed_name(name) == "tab_here"
        return
    model = named(name, "sdf")
    with model.edit() as edit:
        edit.apply(kv.articulations.Ball(name=f"{name}/ball", parent=name, child=f"{name}/ball"))
    again = saved(model, tmp_path)
    assert_same_motion(model, again)
    assert_same_bodies(model, again)


def test_a_joint_of_the_name_of_a_link_is_renamed_and_told(tmp_path: Path) -> None:
    model = built(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1)))
    result = model.save(tmp_path / "m.sdf")
    assert any("'door' is 'door_joint'" in remark for remark in result.remarks)
    joint = ElementTree.parse(tmp_path / "m.sdf").find("model/joint[@type='continuous']")
    assert joint is not None
    assert (joint.get("name"), joint.get(f"{{{NAMESPACE}}}name")) == ("door_joint", "door")


@pytest.mark.parametrize("pitch", [0.02, -0.3])
def test_a_screw_is_a_screw_of_the_same_hand(pitch: float, tmp_path: Path) -> None:
    model = built(
        kv.articulations.Screw(
            name="s", parent="world", child="nut", axis=(0, 0.6, 0.8), pitch=pitch, lower=-9, upper=9
        )
    )
    again = saved(model, tmp_path)
    assert [record.kind for record in again.articulations.values()] == ["screw"]
    thread = ElementTree.parse(tmp_path / "m.sdf").findtext("model/joint/screw_thread_pitch")
    assert float(thread or 0) == pytest.approx(pitch, rel=1e-15)
    assert_same_motion(model, again)


def test_a_universal_joint_keeps_its_kind_limits_and_home(tmp_path: Path) -> None:
    model = built(
        kv.articulations.Universal(
            name="u",
            parent="world",
            child="b",
            first=(0, 1, 0),
            second=(1, 0, 0),
            first_limits=kv.articulations.Limits(-1, 1, 2),
            dynamics=(("first/damping", 0.5),),
        ),
        SetHome("u", (0.25, -0.5)),
        kv.Prismatic(name="p", parent="b", child="c", position=0.3 * kv.position("u/second") + 0.1),
    )
    again = saved(model, tmp_path)
    assert again.articulations["u"] == model.articulations["u"]
    assert again.limits("u/first") == (-1, 1)
    assert again.default_state() == model.default_state()


def test_a_free_body_begins_at_its_home(tmp_path: Path) -> None:
    origin = kv.model.Pose.from_matrix(kv.translation(0, 0, 1) @ kv.rotation_x(0.4))
    home = (0.5, -1.0, 2.0, 0.0, math.sin(0.3), 0.0, math.cos(0.3))
    model = built(
        kv.Floating(name="flight", parent="world", child="drone", origin=origin), SetHome("flight", home)
    )
    again = saved(model, tmp_path)
    assert again.articulations["flight"].home == home
    assert_same_motion(model, again)
    assert not ElementTree.parse(tmp_path / "m.sdf").findall("model/joint")


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.sampled(6)
def test_a_loop_closes_at_the_poses_of_the_file(name: str, tmp_path: Path) -> None:
    model = load_cached(f"articulations/{name}")
    again = saved(model, tmp_path)
    assert len(again.rates.dependent) == len(model.rates.dependent)
    loops = {n for n, record in model.articulations.items() if record.kind == "closedloop"}
    assert loops == {n for n, record in again.articulations.items() if record.kind == "closedloop"}
    at = model.default_state()
    for frame in model.frames:
        np.testing.assert_allclose(again.fk(frame)(at), model.fk(frame)(at), rtol=0, atol=1e-9)


def test_models_that_are_included_twice_have_loops_and_homes_of_their_own(tmp_path: Path) -> None:
    model = load_cached("articulations/four_bar")
    model.save(tmp_path / "m.sdf")
    includes = (f"<include><uri>m.sdf</uri><name>{name}</name></include>" for name in ("one", "two"))
    (tmp_path / "w.sdf").write_text(f'<sdf version="1.11"><world name="w">{"".join(includes)}</world></sdf>')
    both = kv.load(tmp_path / "w.sdf")
    assert {str(s) for s in both.degrees_of_freedom} == {"one/four_bar/crank", "two/four_bar/crank"}
    for frame in model.frames:
        expected = model.fk(frame)(kv.State({"four_bar/crank": 0.7}))
        for name in ("one", "two"):
            found = both.fk(f"{name}/{frame}")(kv.State({f"{name}/four_bar/crank": 0.7}))
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_homes_that_are_no_orientation_are_ignored_with_a_remark(tmp_path: Path) -> None:
    model = built(kv.Floating(name="f", parent="world", child="a"), SetHome("f", (1, 0, 0, 0, 0, 0.6, 0.8)))
    model.save(tmp_path / "m.sdf")
    text = (tmp_path / "m.sdf").read_text()
    assert 'home="1 0 0 0 0 0.6 0.8"' in text
    (tmp_path / "m.sdf").write_text(text.replace("0 0 0.6 0.8", "0 0 0 0"))
    with collect_warnings() as remarks:
        again = kv.load(tmp_path / "m.sdf")
    assert "has the quaternion 0 0 0 0, which is no orientation; it is ignored" in remarks[0]
    assert again.default_state()["f/qw"] == 1


def test_two_links_of_one_name_are_refused_on_one_line(tmp_path: Path) -> None:
    links = '<link name="a" kineverse:name="b"/><link name="b"/>'
    (tmp_path / "m.sdf").write_text(
        f'<sdf version="1.11" xmlns:kineverse="{NAMESPACE}"><model name="m">{links}</model></sdf>'
    )
    with pytest.raises(kv.errors.FormatError, match='would be called "b" here, as the link of line 1 is'):
        kv.load(tmp_path / "m.sdf")


def tied(y: float) -> kv.Model:
    """Return a lever whose tip at (1, y) has to meet a slider on the x axis."""
    model = built(
        kv.Revolute(name="a", parent="world", child="a", lower=-0.1, upper=0.1),
        kv.Prismatic(name="b", parent="world", child="b", axis=(1, 0, 0), lower=-2, upper=2),
    )
    with model.edit() as edit:
        edit.add_frame("tip", parent="a", transform=kv.translation(1, y, 0))
        edit.apply(kv.loops.LoopConstraint(name="tie", frame="tip", to="b", mask=("x", "y", "z")))
    return model


def test_a_loop_that_is_a_constraint_stays_one(tmp_path: Path) -> None:
    model = tied(0.0)
    again = saved(model, tmp_path)
    assert again.degrees_of_freedom == model.degrees_of_freedom
    assert again.default_state() == pytest.approx(dict(model.default_state()), abs=1e-9)
    assert again.limits("b") == (-2, 2)
    assert any(record.kind == "loopconstraint" for record in again.articulations.values())


def test_a_loop_that_is_open_at_home_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        kv.errors.FormatError, match="'tie' is open at home, and SDF closes a loop at the poses"
    ):
        tied(0.5).save(tmp_path / "m.sdf")


def test_bodies_are_those_of_the_model(tmp_path: Path) -> None:
    unphysical, nothing = (1.0, 0.0, 0.0, 1.0, 0.0, 3.0), (0.0,) * 6
    model = built(
        kv.Revolute(name="a", parent="world", child="a"),
        kv.Revolute(name="b", parent="a", child="b"),
        kv.Revolute(name="c", parent="b", child="c"),
        kv.Fixed(name="d", parent="c", child="d"),
        SetBody(
            "a", Body((Shape(Box((1, 2, 3)), name="__x__"), Shape(Sphere(0.1))), (), Inertia(2.0, unphysical))
        ),
        SetBody(
            "b", Body((Shape(Ellipsoid((1, 2, 3)), color=(1, 0.5, 0, 0.25)),), (), Inertia(0.0, nothing))
        ),
        SetBody(
            "d", Body((Shape(Mesh("gone.stl", (1, 1, 2))),), (Shape(Capsule(0.1, 1)), Shape(Cone(0.1, 1))))
        ),
    )
    again = saved(model, tmp_path)
    assert_same_bodies(model, again)
    assert ElementTree.parse(tmp_path / "m.sdf").getroot().get("version") == "1.12"
    remarks = model.save(tmp_path / "m.sdf").remarks
    assert any("the inertia of 'a' is that of no body" in remark for remark in remarks)
    assert "SDF has no links without mass: b, c, d weigh 0.001 kg" in remarks


def test_dynamics_and_limits_are_written_or_told(tmp_path: Path) -> None:
    known = (("effort", 3.0), ("damping", 0.5), ("friction", 0.25), ("stiffness", 2.0), ("rest", 0.5))
    model = built(
        kv.Revolute(
            name="a",
            parent="world",
            child="b",
            lower=-1,
            upper=2,
            velocity=3,
            dynamics=(*known, ("jerk", 9.0)),
        ),
        SoftLimits("a", kv.position("a"), -0.5, 0.5),
        kv.articulations.Ball(name="k", parent="b", child="c", dynamics=(("damping", 0.1),)),
    )
    result = model.save(tmp_path / "m.sdf")
    assert result.left_out["a/soft_limits"] == "are soft limits"
    assert "SDF has no jerk here: that of 'a' is left out" in result.remarks
    assert "SDF has no damping here: that of 'k' is left out" in result.remarks
    again = saved(model, tmp_path)
    assert again.limits("a") == (-1, 2)
    assert again.limits("a:velocity") == (-3, 3)
    read = dict(again.articulations["a"].dynamics)
    assert read == {
        "effort": 3.0,
        "damping": 0.5,
        "friction": 0.25,
        "spring_stiffness": 2.0,
        "spring_reference": 0.5,
    }
    with pytest.raises(kv.errors.FormatError, match="'a/soft_limits' are soft limits"):
        model.save(tmp_path / "n.sdf", strict=True)
    stopped = built(kv.Revolute(name="a", parent="world", child="b", velocity=0))
    with pytest.raises(kv.errors.FormatError, match="'a' may not move at all"):
        stopped.save(tmp_path / "n.sdf")
    assert not (tmp_path / "n.sdf").exists()


def test_a_model_without_links_has_one_in_sdf(tmp_path: Path) -> None:
    empty = saved(kv.Model(), tmp_path)
    assert list(empty.frames) == ["world_body"]
    furnished = built(SetBody("world", Body((Shape(Box((1, 1, 1))),))))
    again = saved(furnished, tmp_path)
    assert again.bodies["world_body"].visuals[0].geometry == Box((1, 1, 1))
    assert (
        "the shapes of the world are those of a link 'world_body'"
        in furnished.save(tmp_path / "m.sdf").remarks
    )


def test_curves_within_a_tolerance_stay_within_their_bounds(tmp_path: Path) -> None:
    q = kv.position("q")
    model = built(kv.Revolute(name="q", parent="world", child="a", lower=-0.3, upper=0.3))
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="f", parent="a", child="b", position=kv.array([np.sin(q)])[0]))
        edit.add_frame("tip", parent="b", transform=kv.translation(0.5, 0, 0))
    result = model.save(tmp_path / "m.sdf", tolerance=0.01)
    check = kv.formats.check_conversion(model, tmp_path / "m.sdf", bounds=result.errors)
    assert check.ok
    assert 0 < check.largest.angle <= check.bounds.angle
    assert not kv.formats.check_conversion(model, tmp_path / "m.sdf").ok


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("name", ""),
        ("name", "///"),
        ("zero", "nonsense"),
        ("zero", "1 2"),
        ("home", "nan"),
        ("home", "1 2 3 4"),
        ("loop", "{"),
        ("loop", '{"name": 3, "dependent": null}'),
    ],
)
def test_malformed_attributes_are_ignored_with_a_remark(attribute: str, value: str, tmp_path: Path) -> None:
    model = built(kv.Revolute(name="a", parent="world", child="b", lower=-1, upper=1))
    model.save(tmp_path / "m.sdf")
    text = (tmp_path / "m.sdf").read_text()
    escaped = value.replace('"', "&quot;")
    text = text.replace('<joint name="a"', f'<joint name="a" kineverse:{attribute}="{escaped}"', 1)
    (tmp_path / "m.sdf").write_text(text)
    with collect_warnings() as remarks:
        again = kv.load(tmp_path / "m.sdf")
    assert again.limits("a") == (-1, 1)
    assert bool(remarks) == bool(value)
