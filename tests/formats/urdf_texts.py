"""Small URDF texts for the tests."""

from __future__ import annotations

import kineverse as kv
from kineverse.formats.urdf import parse_urdf
from kineverse.formats.urdf.operations import urdf_operations

LIMIT = '<limit lower="-1" upper="2" effort="10" velocity="3"/>'


def model_of(text: str, prefix: str | None = None, parent: str = "world") -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        if parent != "world":
            edit.add_frame(parent, "world", kv.translation(0, 0, 1))
        for operation in urdf_operations(parse_urdf(text), prefix, parent):
            edit.apply(operation)
    return model


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT) -> str:
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{links}{inside}</joint>\n'


def robot(*parts: str, links: int = 0, attributes: str = 'name="r"') -> str:
    """Return a robot of links ``l0 l1 ...`` and further elements, each on a line of its own."""
    lines = [f"<robot {attributes}>", *(f'<link name="l{i}"/>' for i in range(links)), *parts, "</robot>"]
    return "\n".join(line.rstrip("\n") for line in lines)


def pair(inside: str = LIMIT, kind: str = "revolute", attributes: str = 'name="r"') -> str:
    return robot(joint("j", "l0", "l1", kind, inside), links=2, attributes=attributes)


def chain(length: int, inside: str = LIMIT, kind: str = "revolute") -> str:
    """Return a chain of joints ``j0 j1 ...``; ``{i}`` and ``{before}`` in ``inside`` are filled in."""
    return robot(
        *(
            joint(f"j{i}", f"l{i}", f"l{i + 1}", kind, inside.format(i=i, before=max(i - 1, 0)))
            for i in range(length)
        ),
        links=length + 1,
    )


SMALL = """<?xml version="1.0"?>
<!-- a bit of everything -->
<robot name="small">
  <material name="blue"><color rgba="0 0 .8 1"/></material>
  <link name="base">
    <inertial>
      <origin xyz="0 0 0.1"/><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
    </inertial>
    <visual><geometry><box size="1 2 3"/></geometry><material name="blue"/></visual>
    <collision name="hull">
      <origin rpy="0 0 1.57"/><geometry><mesh filename="package://p/a.stl"/></geometry>
    </collision>
  </link>
  <link name="arm"/>
  <gazebo/>
  <joint name="elbow" type="revolute">
    <parent link="base"/><child link="arm"/>
    <origin xyz="1 0 0" rpy="0 0 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
</robot>
"""
