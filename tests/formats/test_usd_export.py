"""Models written as USD: poses, names, limits and units as OpenUSD reads them, and the document inside."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from mesh_bytes import tetrahedron
from random_trees import trees
from round_trip import CURVES, SCENES, SHIPPED, load_cached

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats import check_conversion, document_hash
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.usd import stage_poses
from kineverse.formats.usd.pxr_api import pxr as load_pxr
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Inertia,
    Mesh,
    Pose,
    Shape,
    Sphere,
)
from kineverse.model.registry import SaveResult, find_service

pytest.importorskip("newton_usd_schemas")
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdValidation

FOUR_BAR, SCREW, PLANAR, CAM = (f"articulations/{name}" for name in ("four_bar", "screw", "planar", "cam"))
QUICK = ["hsr", "kitchen", FOUR_BAR, SCREW, "articulations/ball", "articulations/floating", PLANAR]


def save(model: kv.Model, file: Path, **options: object) -> SaveResult:
    with collect_warnings():
        return model.save(file, **options)  # type: ignore[arg-type]


def open_stage(file: Path) -> Usd.Stage:
    return Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(file)))


def named(stage: Usd.Stage, name: str, kind: type = UsdPhysics.Joint) -> Usd.Prim:
    """Return the joint, or the prim of another type, that has a name in the model."""
    (found,) = (
        prim
        for prim in stage.Traverse()
        if prim.IsA(kind) and prim.GetAttribute("kineverse:name").Get() == name
    )
    return found


def value(prim: Usd.Prim, name: str) -> float:
    return prim.GetAttribute(name).Get()


def one_joint(**options: object) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="part", **options))  # type: ignore[arg-type]
    return model


# -- poses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", QUICK)
def test_poses_of_the_stage_are_those_of_the_model(name: str, tmp_path: Path) -> None:
    model, file = load_cached(name), tmp_path / "model.usda"
    save(model, file)
    check = check_conversion(model, file, states=10)
    assert check.ok, check.wrong
    assert check.frames == len(model.frames)
    assert check.version


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in (*SHIPPED, *SCENES) if n not in QUICK])
def test_poses_of_every_model_are_those_of_its_stage(name: str, tmp_path: Path) -> None:
    model, file = load_cached(name), tmp_path / "model.usda"
    saved = save(model, file)
    check = check_conversion(model, file)
    assert check.ok, check.wrong
    assert (
        (name.removeprefix("articulations/") in CURVES)
        == any("not compared" in text for text in check.remarks)
        == any("stays at home" in text for text in saved.remarks)
    )


@settings(deadline=None, max_examples=attempts(6))
@given(model=trees())
def test_random_trees_move_alike_on_the_stage(
    tmp_path_factory: pytest.TempPathFactory, model: kv.Model
) -> None:
    file = tmp_path_factory.mktemp("tree") / "m.usda"
    save(model, file)
    assert check_conversion(model, file, states=2).ok
    assert document_hash(kv.load(file)) == document_hash(model)


@pytest.mark.parametrize("name", [FOUR_BAR, "articulations/desk_lamp"])
def test_bodies_on_the_stage_are_at_home(name: str, tmp_path: Path) -> None:
    model, file = load_cached(name), tmp_path / "model.usda"
    save(model, file)
    stage, home = open_stage(file), model.default_state()
    for frame in model.frames:
        placed = UsdGeom.XformCache().GetLocalToWorldTransform(named(stage, frame, UsdGeom.Xform))
        assert np.allclose(np.array(placed).T, model.fk(frame)(home), atol=1e-12), frame


def test_a_wrong_joint_is_found_by_its_name(tmp_path: Path) -> None:
    model, file = load_cached("shelf_door"), tmp_path / "model.usda"
    save(model, file)
    text = file.read_text()
    changed = re.sub(r"(point3f physics:localPos0 = \()", r"\g<1>0.00001", text, count=1)
    assert changed != text
    file.write_text(changed)
    assert not check_conversion(model, file, states=2).ok


def test_the_check_sees_a_wrong_axis_and_loops_that_are_open(tmp_path: Path) -> None:
    model, file = load_cached(FOUR_BAR), tmp_path / "model.usda"
    save(model, file)
    stage = open_stage(file)
    loop = next(p for p in stage.Traverse() if p.GetAttribute("kineverse:loop").Get())
    loop.GetAttribute("physics:localPos1").Set((0.01, 0.0, 0.0))
    stage.GetRootLayer().Export(str(file))
    check = check_conversion(model, file, states=2)
    assert list(check.wrong) == [value(loop, "kineverse:name")]


# -- the document --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "ending"),
    [("hsr", ".usdc"), (FOUR_BAR, ".usda"), (SCREW, ".usd"), (CAM, ".usda")],
)
def test_our_own_file_is_read_exactly(name: str, ending: str, tmp_path: Path) -> None:
    model, file = load_cached(name), tmp_path / f"model{ending}"
    save(model, file)
    again = kv.load(file)
    assert document_hash(again) == document_hash(model)
    assert again.history.tags == model.history.tags


def test_a_prefix_is_that_of_the_document(tmp_path: Path) -> None:
    model = one_joint(lower=0, upper=1)
    model.save(tmp_path / "m.usda")
    model.save(tmp_path / "m.kv.json")
    again = kv.load(tmp_path / "m.usda", prefix="left")
    assert document_hash(again) == document_hash(kv.load(tmp_path / "m.kv.json", prefix="left"))
    assert list(again.frames) == ["left/part"]


def test_meshes_are_those_of_a_document(tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "tip.stl").write_bytes(tetrahedron())
    model = one_joint()
    with model.edit() as edit:
        edit.apply(
            SetBody("part", Body((Shape(Mesh("tip.stl", folder=str(folder))), Shape(Mesh("lost.stl")))))
        )
    found = []
    for name in ("m.usda", "m.kv.json"):
        save(model, tmp_path / name)
        with collect_warnings() as remarks:
            found.append((kv.load(tmp_path / name).bodies["part"], [r.partition(":")[2] for r in remarks]))
    assert found[0] == found[1]
    mesh = found[0][0].visuals[0].geometry
    assert len(find_service("read_mesh")(mesh).faces) == 4


def test_the_same_model_is_the_same_file(tmp_path: Path) -> None:
    first, second = tmp_path / "a" / "m.usdc", tmp_path / "b" / "m.usdc"
    for file in (first, second):
        file.parent.mkdir()
        save(load_cached(FOUR_BAR), file)
    assert first.read_bytes() == second.read_bytes()


def test_an_empty_model_is_kept(tmp_path: Path) -> None:
    saved = kv.Model().save(tmp_path / "empty.usda")
    assert saved.remarks == ()
    assert not kv.load(tmp_path / "empty.usda").frames


# -- names, units and limits ---------------------------------------------------------------------------------


def test_units_and_axes_are_stated(tmp_path: Path) -> None:
    save(one_joint(), tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetName() == "m"
    assert stage.GetDefaultPrim().HasAPI(UsdPhysics.ArticulationRootAPI)


def test_names_become_identifiers_and_are_kept(tmp_path: Path) -> None:
    names = ["1/ü-x y", "1/ü-x.y", "joints", "kineverse", "__x__", "a::b"]
    model = kv.Model()
    with model.edit() as edit:
        for name in names:
            edit.apply(kv.Revolute(name=name, parent="world", child=name))
        edit.add_frame("two\nlines", parent="a::b", transform=kv.rotation_x(kv.position(names[0])))
    model.save(tmp_path / "1 ü.usda")
    stage = open_stage(tmp_path / "1 ü.usda")
    paths = [named(stage, name, UsdGeom.Xform).GetPath() for name in names]
    assert len(set(paths)) == len(names)
    assert str(paths[0]) == "/_1__/_1___x_y"
    assert all(re.fullmatch(r"[A-Za-z_/][\w/]*", str(path), re.ASCII) for path in paths)
    poses = stage_poses(tmp_path / "1 ü.usda", {names[0]: 1.0})
    assert np.allclose(poses[names[0]], model.fk(names[0])({names[0]: 1.0}), atol=1e-7)
    assert kv.load(tmp_path / "1 ü.usda").frames == model.frames


def test_limits_are_in_degrees_and_dynamics_by_the_degree(tmp_path: Path) -> None:
    dynamics = {
        "effort": 30.0,
        "damping": 0.5,
        "friction": 0.2,
        "spring_stiffness": 2.0,
        "spring_reference": 0.1,
    }
    model = one_joint(lower=-1.0, upper=2.0, velocity=3.0, dynamics=tuple(dynamics.items()))
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="s", parent="part", child="slide", lower=0.0, upper=0.25, velocity=0.5))
        edit.apply(kv.Continuous(name="wheel", parent="part", child="wheel"))
        edit.apply(kv.Revolute(name="one", parent="part", child="one", lower=0.0))
    model.save(tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    q, degree = named(stage, "q"), math.degrees(1.0)
    expected = {
        "physics:lowerLimit": -degree,
        "physics:upperLimit": 2 * degree,
        "newton:velocityLimit": 3 * degree,
        "newton:friction": 0.2,
        "drive:angular:physics:maxForce": 30.0,
        "drive:angular:physics:damping": 0.5 / degree,
        "drive:angular:physics:stiffness": 2.0 / degree,
        "drive:angular:physics:targetPosition": 0.1 * degree,
    }
    assert {name: value(q, name) for name in expected} == pytest.approx(expected, rel=1e-6)
    slide = named(stage, "s")
    assert (value(slide, "physics:upperLimit"), value(slide, "newton:velocityLimit")) == (0.25, 0.5)
    for name, bounds in (("wheel", (-math.inf, math.inf)), ("one", (0.0, math.inf))):
        prim = named(stage, name)
        assert (value(prim, "physics:lowerLimit"), value(prim, "physics:upperLimit")) == bounds


def test_axes_are_part_of_the_frames_of_a_joint(tmp_path: Path) -> None:
    model = kv.Model()
    axes = {"x": (1, 0, 0), "minus_z": (0, 0, -1), "any": (0.6, 0.0, -0.8)}
    with model.edit() as edit:
        for name, axis in axes.items():
            edit.apply(kv.Revolute(name=name, parent="world", child=name, axis=axis))
    model.save(tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    assert [value(named(stage, name), "physics:axis") for name in axes] == ["X", "Z", "Z"]
    there = dict.fromkeys(axes, 0.7)
    found = stage_poses(tmp_path / "m.usda", there)
    for name in axes:
        assert np.allclose(found[name], model.fk(name)({name: 0.7}), atol=1e-7)


# -- joints --------------------------------------------------------------------------------------------------


def test_a_joint_that_follows_one_of_its_type_mimics_it(tmp_path: Path) -> None:
    model = one_joint()
    with model.edit() as edit:
        follows = -0.5 * kv.position("q") + 0.1
        edit.apply(kv.Revolute(name="f", parent="world", child="follower", position=follows))
    assert model.save(tmp_path / "m.usda").remarks == ()
    stage = open_stage(tmp_path / "m.usda")
    follower = named(stage, "f")
    assert "NewtonMimicAPI" in follower.GetAppliedSchemas()
    assert follower.GetRelationship("newton:mimicJoint").GetTargets() == [named(stage, "q").GetPath()]
    assert value(follower, "newton:mimicCoef1") == -0.5
    assert value(follower, "newton:mimicCoef0") == pytest.approx(math.degrees(0.1))


def test_a_slide_that_follows_a_turn_is_left_out_by_its_name(tmp_path: Path) -> None:
    model, file = load_cached(SCREW), tmp_path / "m.usda"
    saved = save(model, file)
    assert list(saved.left_out) == ["screw/bolt/slide"]
    assert "NewtonMimicAPI" not in file.read_text().partition("kineverse:document")[0]
    with pytest.raises(FormatError, match=r"'screw/bolt/slide' slides with the turn of 'screw/bolt'"):
        save(model, tmp_path / "strict.usda", strict=True)
    assert not (tmp_path / "strict.usda").exists()
    assert not save(model, file, strict=True, leave_out=["screw/bolt"]).left_out


def test_a_plane_is_one_joint_and_a_free_body_has_none(tmp_path: Path) -> None:
    plane = kv.Model()
    with plane.edit() as edit:
        edit.apply(kv.articulations.Planar(name="p", parent="world", child="puck"))
    plane.save(tmp_path / "plane.usda")
    stage = open_stage(tmp_path / "plane.usda")
    there = {"p/x": 0.5, "p/y": -0.25, "p/angle": 1.0}
    found = stage_poses(tmp_path / "plane.usda", there)["puck"]
    assert np.allclose(found, plane.fk("puck")(there), atol=1e-7)
    (joint,) = (prim for prim in stage.Traverse() if prim.GetTypeName() == "PhysicsJoint")
    locked = [str(s) for s in joint.GetAppliedSchemas() if s.startswith("PhysicsLimitAPI")]
    assert {"PhysicsLimitAPI:transZ", "PhysicsLimitAPI:rotX", "PhysicsLimitAPI:rotY"} <= set(locked)
    save(load_cached("articulations/floating"), tmp_path / "free.usda")
    stage = open_stage(tmp_path / "free.usda")
    free = named(stage, "floating/plane", UsdGeom.Xform)
    joints = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Joint)]
    assert free.GetPath() not in [p for j in joints for p in j.GetRelationship("physics:body1").GetTargets()]


def test_two_turns_of_one_link_have_a_body_between(tmp_path: Path) -> None:
    save(load_cached("articulations/universal"), tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    kinds = [prim.GetTypeName() for prim in stage.Traverse() if prim.IsA(UsdPhysics.Joint)]
    assert kinds.count("PhysicsRevoluteJoint") == 2
    assert "PhysicsJoint" not in kinds


def test_joints_that_close_loops_are_excluded_from_the_articulation(tmp_path: Path) -> None:
    save(load_cached(FOUR_BAR), tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    found = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(stage, ["/"])
    excluded = [d for _, ds in found.values() for d in ds if getattr(d, "excludeFromArticulation", False)]
    assert len(excluded) == 1
    assert all(d.isValid for _, ds in found.values() for d in ds)


@pytest.mark.parametrize("name", ["shelf_door", FOUR_BAR, SCREW, PLANAR, CAM, "articulations/ball"])
def test_the_validators_of_openusd_find_nothing(name: str, tmp_path: Path) -> None:
    save(load_cached(name), tmp_path / "m.usda")
    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(every).Validate(open_stage(tmp_path / "m.usda"))
    assert [error.GetMessage() for error in errors] == []


# -- what UsdPhysics cannot say ------------------------------------------------------------------------------


def test_what_moves_as_no_joint_is_kinematic_and_refused_if_strict(tmp_path: Path) -> None:
    model, file = load_cached(CAM), tmp_path / "m.usda"
    saved = save(model, file)
    assert saved.remarks[0].startswith("the document in the file has all of the model")
    assert list(saved.left_out) == ["cam/valve"]
    stage = open_stage(file)
    assert value(named(stage, "cam/valve", UsdGeom.Xform), "physics:kinematicEnabled") is True
    with pytest.raises(FormatError, match=r"^m.usda is not written: .*'cam/valve' slides by no multiple"):
        save(model, file, strict=True)


def test_locks_are_left_out_by_name(tmp_path: Path) -> None:
    model = load_cached("articulations/garage_door")
    lock = "garage_door/garage/lock"
    assert list(save(model, tmp_path / "m.usda").left_out) == [lock]
    with pytest.raises(FormatError, match=lock):
        save(model, tmp_path / "m.usda", strict=True)
    saved = save(model, tmp_path / "m.usda", strict=True, leave_out=[lock])
    assert saved.remarks[-1] == f"'{lock}' is left out, as asked for"


def test_curves_within_a_tolerance_are_joints_and_the_document_is_exact(tmp_path: Path) -> None:
    model, file = load_cached("articulations/pedal_bin"), tmp_path / "m.usda"
    saved = save(model, file, tolerance=0.1)
    assert 0 < saved.error.angle < 0.1
    assert not saved.left_out
    assert document_hash(kv.load(file)) == document_hash(model)
    assert check_conversion(model, file, states=10, bounds=saved.errors).ok


# -- bodies --------------------------------------------------------------------------------------------------


def test_inertia_is_about_principal_axes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(3, 3))
    tensor = a @ a.T
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor.tolist()
    origin = kv.translation(0.1, 0.2, 0.3) @ kv.rotation_x(0.4)
    inertia = Inertia(3.0, (xx, xy, xz, yy, yz, zz), Pose.from_matrix(origin({})))
    model = one_joint()
    with model.edit() as edit:
        edit.apply(SetBody("part", Body(inertia=inertia)))
    model.save(tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    prim = named(stage, "part", UsdGeom.Xform)
    turn = np.array(rotation_of(value(prim, "physics:principalAxes")))
    found = turn @ np.diag(value(prim, "physics:diagonalInertia")) @ turn.T
    rotation = inertia.origin.matrix[:3, :3]
    assert np.allclose(found, rotation @ tensor @ rotation.T, rtol=1e-5, atol=1e-5)
    assert value(prim, "physics:mass") == 3.0
    assert np.allclose(value(prim, "physics:centerOfMass"), (0.1, 0.2, 0.3))


def rotation_of(quaternion: object) -> np.ndarray:
    from pxr import Gf

    return np.array(Gf.Matrix3d(Gf.Quatd(quaternion))).T  # type: ignore[call-overload]


def test_shapes_and_colours(tmp_path: Path) -> None:
    (tmp_path / "tip.stl").write_bytes(tetrahedron())
    red, place = (1.0, 0.0, 0.0, 0.5), Pose.from_matrix(kv.translation(0.0, 0.0, 0.5)({}))
    forms = [Box((1.0, 2.0, 3.0)), Sphere(0.5), Cylinder(0.1, 0.4), Capsule(0.1, 0.4), Cone(0.1, 0.4)]
    forms += [Ellipsoid((1.0, 2.0, 3.0)), Mesh("tip.stl", (1.0, 1.0, -2.0), str(tmp_path)), Mesh("lost.stl")]
    model = one_joint()
    with model.edit() as edit:
        shapes = tuple(Shape(form, place, name=f"a {form.kind}", color=red) for form in forms)
        edit.apply(SetBody("part", Body(shapes, shapes)))
    saved = save(model, tmp_path / "m.usda")
    text = " ".join(saved.remarks)
    assert "lost.stl is left out" in text
    assert "an ellipsoid to touch of 'part' is left out" in text
    stage = open_stage(tmp_path / "m.usda")
    part = named(stage, "part", UsdGeom.Xform)
    kinds = [child.GetTypeName() for child in part.GetChildren()]
    simple = ["Cube", "Sphere", "Cylinder", "Capsule", "Cone"]
    assert kinds == [*simple, "Sphere", "Mesh", *simple, "Mesh"]
    for child in part.GetChildren():
        is_collider = child.HasAPI(UsdPhysics.CollisionAPI)
        assert is_collider == (UsdGeom.Imageable(child).ComputePurpose() == "guide")
        assert list(child.GetAttribute("primvars:displayColor").Get()[0]) == [1.0, 0.0, 0.0]
        assert list(child.GetAttribute("primvars:displayOpacity").Get()) == [0.5]
    box = UsdGeom.BBoxCache(0.0, ["default"]).ComputeLocalBound(part.GetChildren()[0]).ComputeAlignedRange()
    assert np.allclose([*box.GetMin(), *box.GetMax()], [-0.5, -1.0, -1.0, 0.5, 1.0, 2.0])
    mesh = part.GetChildren()[6]
    points, corners = np.array(value(mesh, "points")), np.reshape(value(mesh, "faceVertexIndices"), (-1, 3))
    a, b, c = points[corners].transpose(1, 0, 2)
    volume = float((a * np.cross(b, c)).sum() / 6)
    assert volume == pytest.approx(2 * 0.001)  # mirrored, and still not inside out


def test_moving_bodies_without_mass_get_a_small_one_that_is_not_read(tmp_path: Path) -> None:
    save(one_joint(), tmp_path / "m.usda")
    stage = open_stage(tmp_path / "m.usda")
    prim = named(stage, "part", UsdGeom.Xform)
    assert 0 < value(prim, "physics:mass") < 0.01
    assert value(prim, "kineverse:massless") is True


# -- without the extra ---------------------------------------------------------------------------------------


def test_without_openusd_the_error_has_the_line_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "newton_usd_schemas", None)
    load_pxr.cache_clear()
    try:
        for what in (lambda: one_joint().save(tmp_path / "m.usda"), lambda: kv.load(tmp_path / "in.usda")):
            (tmp_path / "in.usda").write_text("#usda 1.0\n")
            with pytest.raises(MissingDependencyError, match=r"pip.* install .*usd"):
                what()
    finally:
        load_pxr.cache_clear()
    assert not (tmp_path / "m.usda").exists()
