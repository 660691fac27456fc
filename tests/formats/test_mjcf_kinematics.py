from __future__ import annotations

import pytest
from mujoco_oracle import Pair

GEOM = '<geom size=".1"/>'


def mjcf(*parts: str) -> str:
    return "\n".join(["<mujoco>", *parts, "</mujoco>"])


def body(name: str, inside: str, attributes: str = "") -> str:
    return f'<body name="{name}" {attributes}>{inside}{GEOM}</body>'


FEATURES = {
    "hinge away from the origin": body(
        "a", '<joint name="j" pos=".1 .2 .3" axis="1 2 3"/>', 'pos="1 0 0" euler="10 20 30"'
    ),
    "slide, oblique": body("a", '<joint name="j" type="slide" axis="1 1 0" range="0 1"/>', 'quat="1 2 3 4"'),
    "references": body(
        "a",
        '<joint name="s" type="slide" ref=".3" axis="0 1 1"/><joint name="h" ref="40" axis="1 1 0" pos=".1 0 .2"/>',
    ),
    "ball away from the origin": body("a", '<joint name="j" type="ball" pos=".1 .2 .3"/>', 'pos="0 0 1"'),
    "free, turned": body(
        "a",
        '<freejoint name="j"/>' + body("b", '<joint name="k"/>', 'pos="1 0 0"'),
        'pos="1 2 3" euler="40 50 60"',
    ),
    "several joints in a body": body(
        "a",
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="r" axis="0 1 0" pos="0 .1 .2"/>'
        '<joint name="y" type="slide" axis="0 1 0"/><joint name="b" type="ball" pos=".3 0 0"/>',
        'axisangle="1 1 0 50"',
    ),
    "nothing has a name": '<body pos="1 0 0"><joint/><site pos="0 0 1"/><site/>'
    + GEOM
    + f'<body><joint/><joint type="slide"/>{GEOM}</body></body><body pos="0 1 0">{GEOM}</body><site/>',
    "frames and copies": '<frame pos="1 0 0" euler="0 0 30"><body name="a" pos="0 1 0"><joint/>'
    + GEOM
    + '</body></frame><replicate count="3" offset="0 0 1" euler="0 0 20"><body name="r"><joint axis="1 0 0"/>'
    + GEOM
    + "<site name='t' pos='.1 0 0'/></body></replicate>",
    "a mocap body": body("a", '<site name="s" pos="1 0 0"/>', 'mocap="true" pos="1 2 3" euler="10 20 30"'),
    "body, joint and site of one name": body(
        "a", '<joint name="a" pos="1 0 0"/><site name="a" pos="0 0 1"/>'
    ),
    "orientations": body(
        "a",
        body("b", body("c", '<joint name="k"/>', 'zaxis="1 1 1"'), 'xyaxes="0 1 0 -1 0 1"'),
        'euler="1 2 3"',
    ),
}


@pytest.mark.parametrize("feature", FEATURES)
def test_poses_and_jacobians_are_those_of_mujoco(feature):
    Pair.of_text(mjcf(f"<worldbody>{FEATURES[feature]}</worldbody>")).compare()
