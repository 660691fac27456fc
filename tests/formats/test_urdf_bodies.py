"""Inertias, shapes and colours are kept as data."""

from __future__ import annotations

import numpy as np
import pytest
from urdf_texts import SMALL, robot

from kineverse.formats.urdf import parse_urdf
from kineverse.model.body import Body, Box, Capsule, Cylinder, Mesh, Sphere


def body(inside: str, *others: str) -> Body:
    return parse_urdf(robot(f'<link name="l">{inside}</link>', *others)).links[0].body


def visual(shape: str, inside: str = "") -> str:
    return f"<visual><geometry>{shape}</geometry>{inside}</visual>"


def test_an_empty_link_has_an_empty_body():
    assert body("") == Body()


def test_small_robot_is_read():
    base = parse_urdf(SMALL, folder="/robots").links[0].body
    assert base.inertia.mass == 2.0
    assert base.inertia.origin.matrix[2, 3] == 0.1
    assert base.inertia.tensor == (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    assert base.visuals[0].geometry == Box((1.0, 2.0, 3.0))
    assert base.visuals[0].color == (0.0, 0.0, 0.8, 1.0)
    assert base.collisions[0].name == "hull"
    assert base.collisions[0].geometry == Mesh("package://p/a.stl", (1.0, 1.0, 1.0), "/robots")


@pytest.mark.parametrize(
    ("text", "geometry"),
    [
        ('<box size="1 2 3"/>', Box((1.0, 2.0, 3.0))),
        ('<sphere radius="1"/>', Sphere(1.0)),
        ('<cylinder radius="1" length="2"/>', Cylinder(1.0, 2.0)),
        ('<capsule radius="1" length="2"/>', Capsule(1.0, 2.0)),
        ('<mesh filename="a b.stl" scale="1 -1 1e-3"/>', Mesh("a b.stl", (1.0, -1.0, 1e-3))),
    ],
)
def test_urdf_shapes_are_read(text, geometry):
    both = body(visual(text) + f'<collision><origin xyz="1 2 3"/><geometry>{text}</geometry></collision>')
    assert both.visuals[0].geometry == both.collisions[0].geometry == geometry
    assert np.array_equal(both.collisions[0].origin.matrix[:3, 3], [1, 2, 3])


@pytest.mark.parametrize("text", ['<drake:ellipsoid a="1" b="2" c="3"/>', "", "<plane/>"])
def test_unsupported_urdf_shape_is_left_out_with_a_remark(text):
    sphere = visual('<sphere radius="1"/>')
    description = parse_urdf(robot(f'<link name="l">{visual(text)}{sphere}</link>'))
    assert [shape.geometry for shape in description.links[0].body.visuals] == [Sphere(1.0)]
    assert "left out" in description.remarks[0]


def test_a_visual_without_geometry_is_left_out():
    assert body("<visual/>") == Body()


def test_inertia_defaults_are_those_of_the_schema():
    assert body("<inertial/>").inertia.tensor == (0.0,) * 6
    assert body('<inertial><mass value="3"/><inertia ixx="1"/></inertial>').inertia.mass == 3.0


def test_a_negative_mass_is_kept_and_remarked():
    description = parse_urdf(robot('<link name="l"><inertial><mass value="-1"/></inertial></link>'))
    assert description.links[0].body.inertia.mass == -1.0
    assert "negative mass" in description.remarks[0]


RED, BLUE = (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
SPHERE = '<sphere radius="1"/>'


def colour(name: str, rgba: str = "") -> str:
    return f'<material name="{name}">' + (f'<color rgba="{rgba}"/>' if rgba else "") + "</material>"


@pytest.mark.parametrize("first", [True, False])
def test_materials_of_the_robot_may_come_before_or_after(first):
    link = f'<link name="l">{visual(SPHERE, colour("red"))}</link>'
    parts = [colour("red", "1 0 0 1"), link]
    description = parse_urdf(robot(*(parts if first else parts[::-1])))
    assert description.links[0].body.visuals[0].color == RED
    assert description.remarks == ()


def test_a_visuals_own_colour_counts():
    assert body(visual(SPHERE, colour("red", "0 0 1 1")), colour("red", "1 0 0 1")).visuals[0].color == BLUE


def test_a_material_that_another_visual_defines_is_found_before_and_after():
    text = (
        visual(SPHERE, colour("red"))
        + visual(SPHERE, colour("red", "1 0 0 1"))
        + visual(SPHERE, colour("red"))
    )
    assert [shape.color for shape in body(text).visuals] == [RED] * 3


def test_an_unknown_material_is_remarked():
    description = parse_urdf(robot(f'<link name="l">{visual(SPHERE, colour("mauve"))}</link>'))
    assert description.links[0].body.visuals[0].color is None
    assert 'line 2, <link name="l">: <material name="mauve"> is defined nowhere' in description.remarks[0]


def test_textures_rgb_colours_and_nameless_materials_are_read():
    textured = '<material name="t"><color rgba="1 0 0"/><texture filename="package://p/t.png"/></material>'
    nameless = "<material><color rgba='0 0 1 1'/></material>"
    shapes = body(visual(SPHERE, textured) + visual(SPHERE, nameless) + visual(SPHERE, "<material/>")).visuals
    assert [(shape.color, shape.texture) for shape in shapes] == [
        (RED, "package://p/t.png"),
        (BLUE, ""),
        (None, ""),
    ]


def test_repeated_equal_material_is_accepted():
    assert parse_urdf(robot(colour("red", "1 0 0 1"), colour("red", "1.0 0 0 1"), links=1)).dof == 0
