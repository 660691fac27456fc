"""Models written as URDF: the models read back are the same, and poses are those of pinocchio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pinocchio_oracle import PinocchioReference
from random_trees import trees
from round_trip import (
    SCENES,
    SHIPPED,
    assert_same_bodies,
    assert_same_motion,
    load_cached,
    poses,
    readable_urdf_files,
)

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.urdf import read_urdf
from published_data import published_path, relative_name

FILES = readable_urdf_files()

# What cannot be said of a scene or a model that ships: a part of the refusal. All others are said exactly.
REFUSED = {
    "pr2": "'pr2/base/speed' is no multiple of one coordinate",
    "hsr": "'hsr/base/speed' is no multiple of one coordinate",
    "fetch": "'fetch/base' moves by speeds that are not its own",
    "articulations/ball": "'ball/stick' turns by a quaternion",
    "articulations/cam": "'cam/valve' slides by no multiple",
    "articulations/mimic": "'mimic/middle' turns by",
    "articulations/omni_base": "'omni_base/base/speed' is no multiple of one coordinate",
    "articulations/differential_drive": "'differential_drive/base' moves by speeds that are not its own",
    "articulations/ackermann": "'ackermann/car' moves by speeds that are not its own",
    "articulations/mecanum": "'mecanum/base' moves by speeds that are not its own",
    "articulations/garage_door": "'garage_door/garage/lock' has bounds that depend on garage_door/garage/bolt",
    "articulations/garage_door_as_published": "garage/door' turns by no multiple",
    "articulations/folding_door": "'folding_door/door/lower_panel' turns by no multiple",
    "articulations/door_with_handle": "'door_with_handle/room/lock' has bounds that depend on",
    "articulations/latch": "'latch/gate/latch' has bounds that depend on",
    "articulations/microwave": "'microwave/oven/latch' has bounds that depend on",
    "articulations/piston": "'piston/engine/rod' turns by no multiple",
    "articulations/pedal_bin": "'pedal_bin/bin/lid' turns by no multiple",
    "articulations/ratchet": "'ratchet/winch/lock' has bounds that depend on",
    "articulations/four_bar": "'four_bar/rocker' turns by no multiple",
    "articulations/slider_crank": "'slider_crank/slider' slides by no multiple",
    "articulations/spatial_four_bar": "'spatial_four_bar/driven' turns by no multiple",
    "articulations/parallel_gripper": "'parallel_gripper/left_outer' turns by no multiple",
    "articulations/scissor_linkage": "'scissor_linkage/slide' slides by no multiple",
    "articulations/delta_robot": "'delta_robot/px' slides by no multiple",
    "articulations/jansen_leg": "'jansen_leg/top_1' turns by no multiple",
}


def saved(model: kv.Model, folder: Path, **options: object) -> kv.Model:
    model.save(folder / "m.urdf", **options)
    return kv.load(folder / "m.urdf")


@pytest.mark.sampled(5)
@pytest.mark.data
@pytest.mark.parametrize("file", FILES, ids=relative_name)
def test_urdf_files_are_read_back_unchanged(file: Path | None, tmp_path: Path) -> None:
    if file is None:
        file = published_path()
    model = kv.load(file)
    again = saved(model, tmp_path)
    assert_same_motion(model, again, count=1)
    assert_same_bodies(model, again)
    # Of what is no tree, one root carries the others by joints that do not move.
    further = [name for name in again.articulations if name not in model.articulations]
    assert [name for name in again.articulations if name not in further] == list(model.articulations)
    roots = read_urdf(file).more_roots
    assert len(further) == (len(roots) + 1 if roots else 0)
    assert all(not again.articulations[name].coordinates for name in further)


LARGE = {f"articulations/{name}" for name in ("delta_robot", "jansen_leg", "scissor_linkage")}
"""Linkages that take long to be closed, and are refused as the others are."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.long if name in LARGE else ()) for name in (*SHIPPED, *SCENES)],
)
@pytest.mark.sampled(2)
def test_shipped_models_are_written_or_refused_by_name(name: str, tmp_path: Path) -> None:
    model = load_cached(name)
    if name in REFUSED:
        with pytest.raises(kv.errors.FormatError) as info:
            model.save(tmp_path / "m.urdf", strict=True)
        message = str(info.value)
        names = [f"'{n}'" for n in (*model.frames, *model.constraints, *model.articulations)]
        assert any(n in message for n in names)
        assert REFUSED[name] in message or "more" in message
        assert not list(tmp_path.iterdir())
    else:
        assert_same_motion(model, saved(model, tmp_path))


@pytest.mark.parametrize(
    ("name", "left_out"),
    [
        ("pr2", ["pr2/base/speed"]),
        ("fetch", ["fetch/base"]),
        ("articulations/garage_door", ["garage_door/garage/lock"]),
        ("articulations/ratchet", ["ratchet/winch/lock"]),
    ],
)
def test_leave_out_removes_constraints_and_speed_relations(
    name: str, left_out: list[str], tmp_path: Path
) -> None:
    model = kv.load(name)
    report = model.save(tmp_path / "m.urdf", leave_out=left_out)
    assert f"'{left_out[0]}' is left out, as asked for" in report.remarks
    assert "left out, as asked for" in report.path.read_text()
    assert_same_motion(model, kv.load(report.path))


@settings(max_examples=attempts(6), deadline=None)
@given(model=trees(), seed=st.integers(0, 99))
def test_random_trees_saved_as_urdf_move_alike_in_pinocchio(
    model: kv.Model, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("trees")
    assert_same_motion(model, saved(model, folder))
    reference = PinocchioReference((folder / "m.urdf").read_text())
    values = reference.random_values(np.random.default_rng(seed))
    assert set(values) == {str(s) for s in model.degrees_of_freedom}
    reference.place(values)
    frames = list(model.frames)
    for name, pose in zip(frames, poses(model, frames, values), strict=True):
        np.testing.assert_allclose(reference.pose(name), pose, rtol=0, atol=1e-10, err_msg=name)


def test_custom_frames_become_joints(tmp_path: Path) -> None:
    a, model = kv.position("lift"), kv.Model()
    with model.edit() as edit:
        edit.add_frame("plate", parent="world", transform=kv.translation(0, 0, 2 * a))
        edit.constrain("range", 0, a, 0.4)
        edit.constrain("pace", -0.5, 2 * a.derivative(), 0.5)
    again = saved(model, tmp_path)
    assert_same_motion(model, again)
    assert again.limits("lift:velocity") == (-0.25, 0.25)
    assert "'lift' has a link of its own that carries nothing" in (tmp_path / "m.urdf").read_text()


def test_translations_along_ellipses_become_chains_of_rotations(tmp_path: Path) -> None:
    """A shelf that swings without turning, a slider by a cosine, and an ellipse."""
    q, model = kv.position("q"), kv.Model()
    with model.edit() as edit:
        edit.add_frame(
            "shelf", parent="world", transform=kv.translation(0, 0.3 * np.cos(2 * q), 0.3 * np.sin(2 * q))
        )
        edit.add_frame("yoke", parent="shelf", transform=kv.translation(0.2 * np.cos(q), 0, 1))
        x, y = 0.5 * np.cos(q) + 0.1 * np.sin(q), 0.3 * np.sin(q)
        edit.add_frame("oval", parent="yoke", transform=kv.translation(x, y, x + y) @ kv.rotation_y(q))
        edit.constrain("range", -1, q, 2)
    assert_same_motion(model, saved(model, tmp_path), count=5)


def test_transforms_in_one_matrix_are_decomposed(tmp_path: Path) -> None:
    a, b, c = (kv.position(n) for n in "abc")
    axis = np.array([1.0, 2.0, -2.0]) / 3
    motion = (
        kv.translation(0.3, 0, 0)
        @ kv.axis_angle(axis, a)
        @ kv.translation(0, 0.2 * b, 0.1)
        @ kv.rotation_x(1.0)
        @ kv.rotation_y(0.5 * c - 1)
        @ kv.translation(0, 0.5, 0.7)
    )
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", parent="world", transform=motion)
        edit.add_frame("g", parent="f", transform=kv.axis_angle(axis, 2 * a) @ kv.translation(-b, 0.1, 0))
    assert_same_motion(model, saved(model, tmp_path))
    # Moved by one coordinate at two places, with something else between them, it is no such product.
    with model.edit() as edit:
        edit.add_frame("h", parent="g", transform=motion @ kv.translation(a, 0, 0))
    with pytest.raises(kv.errors.FormatError, match="'h' is moved by more than multiples and waves"):
        model.save(tmp_path / "m.urdf")


def test_parameters_are_written_with_their_values_and_a_remark(tmp_path: Path) -> None:
    length, q = kv.parameter("length", 0.7), kv.position("q")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("tip", parent="world", transform=kv.rotation_z(q) @ kv.translation(length, 0, 0))
        edit.constrain("range", -length, q, length)
    report = model.save(tmp_path / "m.urdf")
    assert "the parameter 'length' is written with its value 0.7" in report.remarks
    assert_same_motion(model, kv.load(report.path))


def test_missing_limits_are_missing_when_read_back(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="free", parent="world", child="free"))
        edit.apply(kv.Prismatic(name="half", parent="world", child="half", lower=0.1))
        edit.apply(kv.Revolute(name="turn", parent="half", child="turn", upper=2.0, velocity=1.5))
    again = saved(model, tmp_path)
    assert again.limits("free") == (-np.inf, np.inf)
    assert again.limits("half") == (0.1, np.inf)
    assert again.limits("turn") == (-np.inf, 2.0)
    assert not [n for n in again.constraints if n.startswith(("free/", "half/velocity"))]
    assert not again.articulations["free"].dynamics


def test_error_names_all_unsupported_features(tmp_path: Path) -> None:
    a, b, c = (kv.position(n) for n in "abc")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("curve", parent="world", transform=kv.rotation_x(a**2))
        edit.add_frame("given", parent="world", transform=kv.rotation_x(c.augment({c.derivative(): 3})))
        edit.add_frame("wheel", parent="world", transform=kv.rotation_z(b))
        edit.constrain("sum", 0, a + b, 1)
        edit.constrain("lock", -(a > 0.5), b.derivative(), 1)
        edit.constrain("jerky", -1, b.derivative().derivative(), 1)
        edit.constrain("one way", 0, b.derivative(), 1)
        edit.constrain("mixture", 0, b.derivative() - a.derivative(), 1)
    with pytest.raises(kv.errors.FormatError) as info:
        model.save(tmp_path / "m.urdf", strict=True)
    message = str(info.value)
    assert "URDF cannot express 7 things" in message
    assert "and 1 more" in message
    for part in ("'curve' turns by", "it moves with a", "'given' moves with a gradient", "'sum'", "'lock'"):
        assert part in message
    assert ".kv.json" in message
    assert "leave_out" in message
    with pytest.raises(kv.errors.UnknownNameError, match=r"'lok'.*Did you mean 'lock'"):
        model.save(tmp_path / "m.urdf", leave_out=["lok"])
    assert not list(tmp_path.iterdir())


def test_frames_held_by_loops_are_refused_with_that_reason(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        for name, x in (("a", 0.0), ("b", 1.0)):
            origin = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
            edit.apply(kv.Revolute(name=name, parent="world", child=name, axis=(0, 0, 1), origin=origin))
            edit.add_frame(f"{name}_end", parent=name, transform=kv.translation(0.8, 0, 0))
        edit.close_loop("a_end", "b_end", home={"a": 1.0, "b": 2.0})
    assert not model.degrees_of_freedom
    with pytest.raises(
        kv.errors.FormatError, match="'a' turns by no multiple of a coordinate; loops hold it where it is"
    ):
        model.save(tmp_path / "m.urdf")


def test_contradicting_limits_are_refused(tmp_path: Path) -> None:
    q, model = kv.position("q"), kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", parent="world", transform=kv.rotation_z(q))
        edit.constrain("one", 0, q, 1)
        edit.constrain("other", 2, q, 3)
    with pytest.raises(kv.errors.FormatError, match="'q' cannot be anywhere"):
        model.save(tmp_path / "m.urdf")


def test_names_with_xml_characters_are_escaped(tmp_path: Path) -> None:
    name, model = """a<b>&"c" 'd' 50% : é -- 漢""", kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name=name, parent="world", child=name, lower=0, upper=1))
        edit.add_frame(f"{name}/x", parent=name, transform=kv.rotation_z(2 * kv.position(name)))
    assert_same_motion(model, saved(model, tmp_path))


def test_intermediate_links_have_unique_names(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Screw(name="s", parent="world", child="s", axis=(0, 1, 1), pitch=0.1))
        edit.apply(kv.Revolute(name="s/slide", parent="s", child="s/slide", lower=0, upper=1))
        edit.apply(kv.Fixed(name="t", parent="s", child="s/turn"))
    assert_same_motion(model, saved(model, tmp_path))


def test_empty_model_is_read_back_empty(tmp_path: Path) -> None:
    again = saved(kv.Model(), tmp_path)
    assert not again.frames
    assert not again.degrees_of_freedom


def test_bodies_are_read_back_from_another_folder(tmp_path: Path) -> None:
    from kineverse.model.body import Body, Box, Cone, Inertia, Mesh, Shape

    (tmp_path / "meshes").mkdir()
    body = Body(
        (Shape(Mesh("a.stl", (1, 1, -1), str(tmp_path / "meshes")), name="m"), Shape(Cone(0.1, 0.2))),
        (Shape(Box((1, 2, 3))),),
        Inertia(1.5, (1, 0.1, 0, 1, 0, 1), kv.model.Pose.from_matrix(kv.translation(0, 1, 0))),
    )
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", parent="world", transform=kv.translation(1, 0, 0), body=body)
    report = model.save(tmp_path / "m.urdf")
    assert report.remarks == ("URDF has no cone: one of 'f' is left out (visual)",)
    mesh = kv.load(report.path).bodies["f"].visuals[0].geometry
    assert (mesh.uri, mesh.scale) == ("meshes/a.stl", (1.0, 1.0, -1.0))


def test_non_finite_numbers_are_refused(tmp_path: Path) -> None:
    from kineverse.model.body import Body, Shape, Sphere

    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", parent="world", transform=np.eye(4), body=Body((Shape(Sphere(np.nan)),)))
    with pytest.raises(kv.errors.FormatError, match=r"m\.urdf is not written.*finite numbers only"):
        model.save(tmp_path / "m.urdf")


def test_default_positions_are_told(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        for name, at in (("q", 0.5), ("r", 0.25)):
            edit.apply(kv.Revolute(name=name, parent="world", child=name, lower=0.25, upper=1))
            edit.apply(kv.model.basic_operations.SetHome(name, (at,)))
        edit.apply(kv.Floating(name="f", parent="world", child="f"))
        edit.apply(kv.model.basic_operations.SetHome("f", (0, 0, 1, 0, 0.6, 0, 0.8)))
    remarks = model.save(tmp_path / "m.urdf").remarks
    assert remarks == ("URDF has no default positions: those of q, f/z, f are left out",)
