"""Stages of USD that are read: those that others changed or made, their units, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from round_trip import CURVES, SCENES, SHIPPED, compile_poses, load_cached, random_values

import kineverse as kv
from kineverse.errors import FormatError, InvalidValueError, ShapeError, UnknownNameError
from kineverse.formats import check_conversion, document_hash
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.usd import stage_poses
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Box, Capsule, Cone, Cylinder, Ellipsoid, Inertia, Shape, Sphere

pytest.importorskip("newton_usd_schemas")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics

CLOSE = 1e-6  # [m], [rad]: joints of UsdPhysics are in single precision
QUICK = ["shelf_drawers"] + [f"articulations/{n}" for n in ("four_bar", "screw", "ball", "floating")]


def load(file: Path, **options: object) -> tuple[kv.Model, list[str]]:
    with collect_warnings() as remarks:
        return kv.load(file, **options), remarks  # type: ignore[arg-type]


def save(model: kv.Model, file: Path) -> None:
    with collect_warnings():
        model.save(file)


def edit_stage(file: Path, change: Callable[[Usd.Stage], object], target: Path | None = None) -> Path:
    stage = Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(file)))
    change(stage)
    stage.GetRootLayer().Export(str(target or file))
    return target or file


def without_document(stage: Usd.Stage) -> None:
    stage.RemovePrim(stage.GetDefaultPrim().GetPath().AppendChild("kineverse"))


class Arm:
    """Stage of two bodies, a hinge at the world and a slide, in any units."""

    def __init__(self, metres: float = 1.0, up: str = "Z", kilograms: float = 1.0) -> None:
        self.stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageMetersPerUnit(self.stage, metres)
        UsdGeom.SetStageUpAxis(self.stage, up)
        UsdPhysics.SetStageKilogramsPerUnit(self.stage, kilograms)
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/arm").GetPrim())
        unit = 1.0 / metres
        self.near = self.body("/arm/near", (0.0, unit, 0.0))
        self.far = self.body("/arm/far", (0.0, unit, 0.0))
        self.hinge = UsdPhysics.RevoluteJoint.Define(self.stage, "/arm/hinge")
        self.hinge.CreateAxisAttr("Y")
        self.hinge.CreateLocalPos0Attr((0.0, unit, 0.0))
        self.hinge.CreateLowerLimitAttr(-90.0)
        self.hinge.CreateUpperLimitAttr(45.0)
        self.slide = UsdPhysics.PrismaticJoint.Define(self.stage, "/arm/slide")
        self.slide.CreateUpperLimitAttr(0.5 * unit)
        self.connect(self.hinge, None, self.near)
        self.connect(self.slide, self.near, self.far)

    def body(self, path: str, place: tuple[float, float, float], scale: float = 1.0) -> Usd.Prim:
        xform = UsdGeom.Xform.Define(self.stage, path)
        xform.AddTransformOp().Set(Gf.Matrix4d().SetScale(scale) * Gf.Matrix4d().SetTranslate(place))
        UsdPhysics.RigidBodyAPI.Apply(xform.GetPrim())
        return xform.GetPrim()

    def connect(self, joint: UsdPhysics.Joint, a: Usd.Prim | None, b: Usd.Prim) -> None:
        joint.CreateBody0Rel().SetTargets([a.GetPath()] if a else [])
        joint.CreateBody1Rel().SetTargets([b.GetPath()])

    def save(self, file: Path) -> Path:
        self.stage.GetRootLayer().Export(str(file))
        return file


# -- our own stages without their document -------------------------------------------------------------------


def check_stage_alone(name: str, folder: Path) -> None:
    model, file = load_cached(name), folder / "m.usda"
    save(model, file)
    again, _ = load(edit_stage(file, without_document))
    assert set(model.frames) <= set(again.frames)
    assert again.degrees_of_freedom == model.degrees_of_freedom
    for symbol in model.degrees_of_freedom:
        pairs = zip(again.limits(symbol), model.limits(symbol), strict=True)
        assert all(a == b or abs(a - b) < CLOSE * max(1.0, abs(b)) for a, b in pairs)
    frames, rng = list(model.frames), np.random.default_rng(1)
    ours, theirs = compile_poses(model, frames), compile_poses(again, frames)
    for _ in range(3):
        values = random_values(model, rng)
        assert np.abs(np.subtract(ours(values), theirs(values))).max() < CLOSE


@pytest.mark.parametrize("name", QUICK)
def test_the_stage_alone_is_the_same_mechanism(name: str, tmp_path: Path) -> None:
    check_stage_alone(name, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [n for n in (*SHIPPED, *SCENES) if n not in QUICK and n.removeprefix("articulations/") not in CURVES],
)
def test_every_stage_alone_is_the_same_mechanism(name: str, tmp_path: Path) -> None:
    check_stage_alone(name, tmp_path)


def test_a_body_that_moves_freely_in_another_keeps_its_coordinates(tmp_path: Path) -> None:
    model, file = kv.Model(), tmp_path / "m.usda"
    with model.edit() as edit:
        edit.apply(kv.Continuous(name="q", parent="world", child="part"))
        edit.apply(kv.Floating(name="f", parent="part", child="loose"))
    model.save(file)
    assert check_conversion(model, file, states=2).ok
    again, remarks = load(edit_stage(file, without_document))
    assert not remarks
    assert again.degrees_of_freedom == model.degrees_of_freedom


def test_bodies_are_read_from_the_stage(tmp_path: Path) -> None:
    forms = [Box((1.0, 2.0, 3.0)), Sphere(0.5), Cylinder(0.1, 0.4), Capsule(0.1, 0.4), Cone(0.1, 0.4)]
    visuals = tuple(Shape(form, color=(0.25, 0.5, 1.0, 0.5)) for form in [*forms, Ellipsoid((1.0, 2.0, 3.0))])
    inertia = Inertia(2.0, (1.0, 0.0, 0.0, 2.0, 0.0, 2.5))
    body = Body(visuals, tuple(map(Shape, forms)), inertia)
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.Revolute(name="q", parent="world", child="part", dynamics=(("damping", 2.0), ("effort", 4.0)))
        )
        edit.apply(SetBody("part", body))
        edit.apply(kv.Revolute(name="p", parent="part", child="bare"))
    model.save(tmp_path / "m.usda")
    again, _ = load(edit_stage(tmp_path / "m.usda", without_document))
    found = again.bodies["part"]
    assert [shape.color for shape in found.visuals] == [shape.color for shape in visuals]
    numbers = [np.array(list(_numbers(each))) for each in (found, body)]
    assert np.allclose(*numbers, atol=1e-6)
    assert [s.geometry.kind for s in found.visuals] == [s.geometry.kind for s in visuals]
    assert dict(again.articulations["q"].dynamics) == pytest.approx({"damping": 2.0, "effort": 4.0})
    assert "bare" not in again.bodies  # its mass is there for engines only


def _numbers(body: Body) -> list[float]:
    shapes = (*body.visuals, *body.collisions)
    sizes = [
        np.ravel([getattr(s.geometry, f) for f in s.geometry.__struct_fields__]).tolist() for s in shapes
    ]
    poses = [list(s.origin.rows) for s in shapes]
    assert body.inertia is not None
    return [*chain(*sizes, *poses), body.inertia.mass, *body.inertia.tensor]


# -- documents of stages that were changed -------------------------------------------------------------------


@pytest.fixture
def written(tmp_path: Path) -> Path:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="part", lower=0.0, upper=1.0))
        edit.apply(SetBody("part", Body((Shape(Sphere(0.1), color=(1.0, 0.0, 0.0, 1.0)),))))
    model.save(tmp_path / "m.usda")
    return tmp_path / "m.usda"


def change_limit(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/m/joints/q").GetAttribute("physics:upperLimit").Set(90.0)


CHANGES: dict[str, Callable[[Usd.Stage], object]] = {
    "limit": change_limit,
    "colour": lambda stage: (
        stage.GetPrimAtPath("/m/part/visual").GetAttribute("primvars:displayColor").Set([(0, 0, 1)])
    ),
    "place": lambda stage: (
        stage.GetPrimAtPath("/m/part")
        .GetAttribute("xformOp:transform")
        .Set(Gf.Matrix4d().SetTranslate((0, 0, 1)))
    ),
    "target": lambda stage: (
        stage.GetPrimAtPath("/m/joints/q").GetRelationship("physics:body0").ClearTargets(True)
    ),
    "prim": lambda stage: stage.RemovePrim("/m/part/visual"),
    "schema": lambda stage: UsdPhysics.CollisionAPI.Apply(stage.GetPrimAtPath("/m/part/visual")),
    "body": lambda stage: UsdPhysics.RigidBodyAPI.Apply(UsdGeom.Xform.Define(stage, "/other").GetPrim()),
    "unit": lambda stage: UsdGeom.SetStageMetersPerUnit(stage, 0.5),
    "inactive": lambda stage: stage.GetPrimAtPath("/m/part/visual").SetActive(False),
    "animation": lambda stage: (
        stage.GetPrimAtPath("/m/part").GetAttribute("xformOp:transform").Set(Gf.Matrix4d(1.0), 1.0)
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_stage_is_never_the_old_document(change: str, written: Path) -> None:
    before = document_hash(kv.load(written))
    edit_stage(written, CHANGES[change])
    again, remarks = load(written)
    assert document_hash(again) != before
    assert "has changed since Kineverse wrote it" in remarks[0]
    with pytest.raises(FormatError, match="has changed since Kineverse wrote it"):
        load(written, strict=True)


def test_what_was_changed_is_read(written: Path) -> None:
    again, _ = load(edit_stage(written, change_limit))
    assert again.limits("q") == pytest.approx((0.0, math.pi / 2))


def test_a_copy_in_another_form_and_a_light_beside_change_nothing(written: Path, tmp_path: Path) -> None:
    before = document_hash(kv.load(written))

    def add_light(stage: Usd.Stage) -> None:
        UsdLux.DistantLight.Define(stage, "/light")

    for ending in (".usdc", ".usda"):
        copy = edit_stage(written, add_light, tmp_path / f"copy{ending}")
        again, remarks = load(copy)
        assert document_hash(again) == before
        assert not remarks


def test_a_document_below_another_prim_is_passed_over_with_a_warning(written: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.CreateInMemory()
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    robot = UsdGeom.Xform.Define(stage, "/scene/robot")
    robot.AddTranslateOp().Set((0.0, 0.0, 100.0))  # of centimetres
    robot.GetPrim().GetReferences().AddReference(str(written))
    stage.Export(str(tmp_path / "flat.usda"))
    again, remarks = load(tmp_path / "flat.usda")
    assert "has changed since" in remarks[0]
    assert again.limits("q") == pytest.approx((0.0, 1.0))


def test_a_damaged_document_is_an_error(written: Path) -> None:
    text = written.read_text()
    written.write_text(text.replace('\\"kind\\"', '\\"kinds\\"').replace('"kind"', '"kinds"'))
    with pytest.raises(FormatError, match="its document"):
        kv.load(written)


def test_a_file_that_is_written_again_is_read_anew(tmp_path: Path) -> None:
    file = tmp_path / "m.usda"
    for upper in (1.0, 2.0):
        model = kv.Model()
        with model.edit() as edit:
            edit.apply(kv.Revolute(name="q", parent="world", child="part", lower=0.0, upper=upper))
        model.save(file)
        assert kv.load(file).limits("q") == (0.0, upper)


# -- stages of others ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("metres", "up", "kilograms"), [(1.0, "Z", 1.0), (0.01, "Y", 0.001), (0.001, "Z", 1.0)]
)
def test_units_and_the_upward_axis_are_converted(
    metres: float, up: str, kilograms: float, tmp_path: Path
) -> None:
    arm = Arm(metres, up, kilograms)
    mass = UsdPhysics.MassAPI.Apply(arm.far)
    mass.CreateMassAttr(2.0 / kilograms)
    mass.CreateDiagonalInertiaAttr((1 / kilograms / metres**2,) * 3)
    mass.CreateCenterOfMassAttr((0.0, 0.0, 0.25 / metres))
    model, remarks = load(arm.save(tmp_path / "arm.usda"))
    assert not remarks
    assert model.limits("hinge") == pytest.approx((-math.pi / 2, math.pi / 4))
    assert model.limits("slide") == pytest.approx((-math.inf, 0.5))
    there = {"hinge": 0.3, "slide": 0.25}
    expected = kv.translation(0, 1, 0) @ kv.axis_angle((0, 1, 0), 0.3) @ kv.translation(0.25, 0, 0)
    if up == "Y":
        expected = kv.rotation_x(math.pi / 2) @ expected
    assert np.allclose(model.fk("far")(there), expected({}), atol=CLOSE)
    assert np.allclose(stage_poses(tmp_path / "arm.usda", there)["far"], expected({}), atol=CLOSE)
    inertia = model.bodies["far"].inertia
    assert inertia is not None
    assert (inertia.mass, inertia.tensor[0]) == pytest.approx((2.0, 1.0))
    assert np.allclose(inertia.origin.matrix[:3, 3], (0.0, 0.0, 0.25), atol=CLOSE)


def test_units_that_are_not_stated_are_those_of_openusd(tmp_path: Path) -> None:
    arm = Arm()
    for key in ("metersPerUnit", "upAxis"):
        arm.stage.GetRootLayer().pseudoRoot.ClearInfo(key)
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert model.limits("slide") == pytest.approx((-math.inf, 0.005))  # centimetres


def test_the_scale_of_a_body_scales_the_places_of_its_joints(tmp_path: Path) -> None:
    arm = Arm()
    big = arm.body("/arm/big", (0.0, 0.0, 0.0), scale=2.0)
    joint = UsdPhysics.FixedJoint.Define(arm.stage, "/arm/weld")
    arm.connect(joint, arm.far, big)
    joint.CreateLocalPos1Attr((0.25, 0.0, 0.0))
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert np.allclose(model.fk("big", "far")({}), kv.translation(-0.5, 0, 0)({}), atol=CLOSE)


def test_values_of_a_wrong_type_are_refused_or_left_out(tmp_path: Path) -> None:
    arm = Arm()
    UsdGeom.Sphere.Define(arm.stage, "/arm/far/ball").CreateRadiusAttr(0.5)
    text = arm.stage.GetRootLayer().ExportToString()
    file = tmp_path / "arm.usda"
    file.write_text(text.replace("double radius = 0.5", 'string radius = "big"'))
    model, remarks = load(file)
    assert "far" not in model.bodies
    assert "/arm/far/ball has a size that is none" in remarks[0]
    file.write_text(
        text.replace("matrix4d xformOp:transform = (", "double3 xformOp:transform = (0, 0, 0) #", 1)
    )
    with pytest.raises(FormatError, match="no USD that can be read"):
        kv.load(file)


def test_a_mirrored_cone_points_the_other_way(tmp_path: Path) -> None:
    arm = Arm()
    cone = UsdGeom.Cone.Define(arm.stage, "/arm/far/cone")
    cone.AddScaleOp().Set((1.0, 1.0, -1.0))
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    (shape,) = model.bodies["far"].visuals
    assert np.allclose(shape.origin.matrix[:3, 2], (0.0, 0.0, -1.0))


def test_joints_may_lead_inwards(tmp_path: Path) -> None:
    arm, there = Arm(), {"hinge": 0.3, "slide": 0.25}
    straight, _ = load(arm.save(tmp_path / "straight.usda"))
    for joint in (arm.hinge, arm.slide):
        prim = joint.GetPrim()
        ends = [prim.GetRelationship(f"physics:body{k}").GetTargets() for k in (0, 1)]
        places = [prim.GetAttribute(f"physics:localPos{k}").Get() for k in (0, 1)]
        for k in (0, 1):
            prim.GetRelationship(f"physics:body{k}").SetTargets(ends[1 - k])
            prim.GetAttribute(f"physics:localPos{k}").Set(places[1 - k])
    turned, remarks = load(arm.save(tmp_path / "turned.usda"))
    assert len(remarks) == 2
    back = {name: -value for name, value in there.items()}  # the other body moves the other way
    expected = straight.fk("far")(there)
    assert np.allclose(turned.fk("far")(back), expected, atol=CLOSE)
    assert np.allclose(stage_poses(tmp_path / "turned.usda", back)["far"], expected, atol=CLOSE)


def test_shapes_of_instances_are_read(tmp_path: Path) -> None:
    arm = Arm()
    UsdGeom.Cube.Define(arm.stage, "/shapes/cube")
    look = UsdGeom.Xform.Define(arm.stage, "/arm/far/look").GetPrim()
    look.GetReferences().AddInternalReference("/shapes")
    look.SetInstanceable(True)
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert [shape.geometry for shape in model.bodies["far"].visuals] == [Box((2.0, 2.0, 2.0))]


def test_joints_of_instances_are_read(tmp_path: Path) -> None:
    arm = Arm()
    arm.body("/parts/lid", (0.0, 0.0, 0.0))
    UsdPhysics.RevoluteJoint.Define(arm.stage, "/parts/turn").CreateBody1Rel().SetTargets(["/parts/lid"])
    arm.stage.OverridePrim("/parts").SetSpecifier(Sdf.SpecifierClass)
    box = UsdGeom.Xform.Define(arm.stage, "/arm/box").GetPrim()
    box.GetReferences().AddInternalReference("/parts")
    box.SetInstanceable(True)
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert list(map(str, model.degrees_of_freedom)) == ["hinge", "slide", "turn"]
    assert np.allclose(model.fk("lid")({"turn": 0.5}), kv.rotation_x(0.5)({}), atol=CLOSE)


def test_a_base_without_a_joint_moves_freely(tmp_path: Path) -> None:
    arm = Arm()
    arm.stage.RemovePrim("/arm/hinge")
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert "near/free/qw" in map(str, model.degrees_of_freedom)
    assert np.allclose(model.fk("near")(model.default_state()), kv.translation(0, 1, 0)({}))
    pose = np.asarray(kv.translation(1, 2, 3)({}))
    assert np.allclose(stage_poses(tmp_path / "arm.usda", {}, {"near": pose})["far"], pose)


def test_the_state_of_the_stage_is_the_home_of_the_model(tmp_path: Path) -> None:
    arm = Arm()
    place = kv.translation(0, 1, 0) @ kv.axis_angle((0, 1, 0), 0.5)
    for prim in (arm.near, arm.far):
        prim.GetAttribute("xformOp:transform").Set(Gf.Matrix4d(*np.asarray(place({})).T.ravel().tolist()))
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert model.default_state()[model.symbol("hinge")] == pytest.approx(0.5)
    arm.hinge.CreateLowerLimitAttr(180.0)
    arm.hinge.CreateUpperLimitAttr(450.0)  # then home is a turn further
    model, _ = load(arm.save(tmp_path / "arm.usda"))
    assert model.default_state()[model.symbol("hinge")] == pytest.approx(0.5 + math.tau)


def test_mimics_follow_in_degrees_and_chains_of_them(tmp_path: Path) -> None:
    arm = Arm()
    parent, names = arm.near, ["a", "b"]
    for name, leader in zip(names, ("/arm/hinge", "/arm/a"), strict=True):
        body = arm.body(f"/arm/body_{name}", (0.0, 1.0, 0.0))
        joint = UsdPhysics.RevoluteJoint.Define(arm.stage, f"/arm/{name}")
        arm.connect(joint, parent, body)
        prim = joint.GetPrim()
        prim.ApplyAPI("NewtonMimicAPI")
        prim.GetRelationship("newton:mimicJoint").SetTargets([leader])
        prim.GetAttribute("newton:mimicCoef0").Set(90.0)
        prim.GetAttribute("newton:mimicCoef1").Set(2.0)
    file = arm.save(tmp_path / "arm.usda")
    model, _ = load(file)
    assert [str(s) for s in model.degrees_of_freedom] == ["hinge", "slide"]
    there = {"hinge": 0.1}
    a = 2 * 0.1 + math.pi / 2
    b = 2 * a + math.pi / 2
    for name, angle in (("a", a), ("b", b)):
        turn = (kv.translation(0, 1, 0) @ kv.axis_angle((0, 1, 0), 0.1) @ kv.rotation_x(angle))({})
        assert np.allclose(model.fk(f"body_{name}")(there), turn, atol=CLOSE)
        assert np.allclose(stage_poses(file, there)[f"body_{name}"], turn, atol=CLOSE)


def test_joints_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    arm = Arm()
    body = arm.body("/arm/far/near", (0.0, 0.0, 0.0))
    UsdGeom.Xformable(body).SetResetXformStack(True)
    joint = UsdPhysics.RevoluteJoint.Define(arm.stage, "/arm/far/hinge")
    arm.connect(joint, arm.far, body)
    model, remarks = load(arm.save(tmp_path / "arm.usda"))
    assert list(map(str, model.degrees_of_freedom)) == ["hinge", "hinge_2", "slide"]
    assert {"near", "near_2"} <= set(model.frames)
    assert len(remarks) == 2


def test_what_is_not_read_is_said(tmp_path: Path) -> None:
    arm = Arm()
    UsdGeom.Mesh.Define(arm.stage, "/arm/far/mesh")
    off = UsdPhysics.FixedJoint.Define(arm.stage, "/arm/off")
    off.CreateJointEnabledAttr(False)
    arm.connect(off, arm.near, arm.far)
    rope = UsdPhysics.DistanceJoint.Define(arm.stage, "/arm/rope")
    arm.connect(rope, arm.near, arm.far)
    ends = [arm.body(f"/arm/{name}", (0.0, 1.0, 0.0)) for name in ("a", "b")]
    cone = UsdPhysics.SphericalJoint.Define(arm.stage, "/arm/cone")
    cone.CreateConeAngle0LimitAttr(0.0)
    arm.connect(cone, arm.far, ends[0])
    ball = UsdPhysics.Joint.Define(arm.stage, "/arm/ball")
    UsdPhysics.LimitAPI.Apply(ball.GetPrim(), "distance").CreateHighAttr(1.0)
    UsdPhysics.DriveAPI.Apply(ball.GetPrim(), "rotX").CreateDampingAttr(1.0)
    arm.connect(ball, arm.far, ends[1])
    UsdPhysics.MassAPI.Apply(arm.near).CreateDensityAttr(1000.0)
    shape = UsdGeom.Cube.Define(arm.stage, "/arm/far/shape").GetPrim()
    UsdPhysics.CollisionAPI.Apply(shape)
    UsdPhysics.MassAPI.Apply(shape).CreateMassAttr(1.0)
    _, remarks = load(arm.save(tmp_path / "arm.usda"))
    text = "\n".join(remarks)
    for part in (
        "/arm/off is left out: it is not enabled",
        "/arm/rope is left out",
        "1 mesh ",
        "/arm/cone has a cone as its limit",
        "/arm/ball limits a distance",
        "/arm/ball limits or drives its three turns",
        "/arm/near has a density",
        "/arm/far has a density",
    ):
        assert part in text
    with pytest.raises(FormatError, match="is left out"):
        load(tmp_path / "arm.usda", strict=True)


# -- refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("text.usda", b"hello", "can be read: it is not a valid usda layer."),
        ("broken.usda", b'#usda 1.0\ndef Xform "a" {\n oops', "can be read: line 3:2: Expected }"),
        ("empty.usd", b"", "no USD that can be read"),
        ("bad.usdc", b"PXR-USDC" + b"\0" * 60, "no USD that can be read"),
        ("cut.usdc", b"PXR-USDC\0\0", "no USD that can be read"),
        ("nothing.usda", b"#usda 1.0\n", "nothing that moves: it is empty"),
        (
            "still.usda",
            b'#usda 1.0\ndef Xform "a" {\n def Sphere "s" {}\n}',
            "it has 2 prims, and no rigid body",
        ),
        (
            "more.usda",
            b'#usda 1.0\ndef "a" (references = @other.usda@</b>) {}',
            "composed of further files, other",
        ),
        ("unit.usda", b"#usda 1.0\n(\n metersPerUnit = 0\n)\n", "measure nothing"),
    ],
)
def test_files_that_are_none_are_refused_in_one_line(
    name: str, content: bytes, reason: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError) as info:
        kv.load(tmp_path / name)
    assert reason in str(info.value)
    assert "\n" not in str(info.value)
    assert "pxrInternal" not in str(info.value)


def two_turns(arm: Arm) -> None:
    joint = UsdPhysics.Joint.Define(arm.stage, "/arm/cross")
    for freedom in ("transX", "transY", "transZ", "rotZ"):
        limit = UsdPhysics.LimitAPI.Apply(joint.GetPrim(), freedom)
        limit.CreateLowAttr(1.0)
        limit.CreateHighAttr(-1.0)
    arm.connect(joint, arm.far, arm.body("/arm/end", (0.0, 0.0, 0.0)))


def follow(arm: Arm, leader: str) -> None:
    prim = arm.slide.GetPrim()
    prim.ApplyAPI("NewtonMimicAPI")
    prim.GetRelationship("newton:mimicJoint").SetTargets([leader])


WRONG: dict[str, tuple[Callable[[Arm], object], str]] = {
    "missing body": (
        lambda arm: arm.slide.GetBody1Rel().SetTargets(["/nowhere"]),
        "/nowhere.* is not on the stage",
    ),
    "two turns": (two_turns, "turns about two axes"),
    "far away": (lambda arm: arm.slide.CreateLocalPos0Attr((math.nan, 0, 0)), "not finite"),
    "other type": (lambda arm: follow(arm, "/arm/hinge"), "no joint of its type"),
    "no leader": (lambda arm: follow(arm, "/arm/far"), "no joint that is read"),
    "itself": (lambda arm: follow(arm, "/arm/slide"), "mimics itself"),
}


@pytest.mark.parametrize("what", WRONG)
def test_stages_that_make_no_sense_are_refused(what: str, tmp_path: Path) -> None:
    spoil, reason = WRONG[what]
    arm = Arm()
    spoil(arm)
    with pytest.raises(FormatError, match=reason):
        load(arm.save(tmp_path / "arm.usda"))


def test_loops_have_to_be_excluded_for_poses(tmp_path: Path) -> None:
    arm = Arm()
    joint = UsdPhysics.FixedJoint.Define(arm.stage, "/arm/weld")
    arm.connect(joint, None, arm.far)
    with pytest.raises(FormatError, match="closes a loop"):
        stage_poses(arm.save(tmp_path / "arm.usda"), {})


def test_poses_and_models_agree_on_excluded_joints_and_kinematic_bodies(tmp_path: Path) -> None:
    arm, there = Arm(), {"slide": 0.25}
    arm.slide.CreateExcludeFromArticulationAttr(True)  # and nothing else carries the body
    UsdPhysics.RigidBodyAPI(arm.near).CreateKinematicEnabledAttr(True)
    model, remarks = load(arm.save(tmp_path / "arm.usda"))
    assert "hinge" in remarks[0]
    expected = kv.translation(0.25, 1, 0)({})
    assert np.allclose(model.fk("far")(there), expected, atol=CLOSE)
    assert np.allclose(stage_poses(tmp_path / "arm.usda", there)["far"], expected, atol=CLOSE)
    with pytest.raises(UnknownNameError, match="hinge"):
        stage_poses(tmp_path / "arm.usda", {"hinge": 1.0})


def test_unknown_coordinates_and_bodies_are_named(tmp_path: Path) -> None:
    file = Arm().save(tmp_path / "arm.usda")
    with pytest.raises(UnknownNameError, match="hinge"):
        stage_poses(file, {"hing": 1.0})
    with pytest.raises(UnknownNameError, match="fra"):
        stage_poses(file, {}, {"fra": np.eye(4)})
    with pytest.raises(ShapeError, match="4×4"):
        stage_poses(file, {}, {"near": np.eye(3)})
    with pytest.raises(InvalidValueError, match="position of 'hinge'"):
        stage_poses(file, {"hinge": math.nan})
    with pytest.raises(FormatError, match="no such file"):
        stage_poses(tmp_path / "nothing.usda", {})


def test_an_archive_of_usd_is_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "m.usdz").write_bytes(b"PK")
    with pytest.raises(FormatError, match="unzip"):
        kv.load(tmp_path / "m.usdz")
