"""Small robot with all joint types that peers support, and a mimic joint."""

LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def joint(name, kind, parent, child, axis, inside=LIMIT):
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    origin = '<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.2 0.1"/>'
    return f'<joint name="{name}" type="{kind}">{origin}{links}<axis xyz="{axis}"/>{inside}</joint>'


MIMIC = f'<mimic joint="finger" multiplier="-0.5" offset="0.1"/>{LIMIT}'

LINKS = ("base", "shoulder", "arm", "hand", "left", "right", "tip")

INERTIA = (
    '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    '<visual><geometry><mesh filename="package://nowhere/arm.dae"/></geometry></visual>'
)

SMALL_ROBOT = "\n".join(
    [
        '<robot name="small">',
        *(f'<link name="{name}">{INERTIA}</link>' for name in LINKS),
        joint("lift", "prismatic", "base", "shoulder", "0 0 1"),
        joint("turn", "continuous", "shoulder", "arm", "0 1 0"),
        joint("elbow", "revolute", "arm", "hand", "1 0 1"),
        joint("finger", "revolute", "hand", "left", "0 0 1"),
        joint("thumb", "revolute", "hand", "right", "0 0 1", MIMIC),
        joint("mount", "fixed", "hand", "tip", "1 0 0", ""),
        "</robot>",
    ]
)
