"""Random trees in all notations of MJCF have the poses of MuJoCo."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco_oracle import Pair

from hypothesis_profiles import attempts

SHORT = st.floats(-2, 2).map(lambda x: round(x, 6))
POINT = st.tuples(SHORT, SHORT, SHORT)
DIRECTION = POINT.filter(lambda p: math.hypot(*p) > 0.1)
# MuJoCo takes turns of less than 1e-6 for none.
ANGLE = st.floats(-170, 170).map(lambda x: round(x, 2))
KINDS = st.sampled_from(["hinge", "slide", "ball"])


def spelt(numbers) -> str:
    return " ".join(map(repr, numbers))


@st.composite
def orientations(draw, degrees: bool) -> str:
    """Return a strategy for all notations of an orientation."""
    way = draw(st.sampled_from(["", "quat", "axisangle", "euler", "xyaxes", "zaxis"]))
    angle = 1.0 if degrees else math.pi / 180
    if way == "quat":
        return f'quat="{spelt(draw(st.tuples(SHORT, SHORT, SHORT, SHORT).filter(lambda q: math.hypot(*q) > 0.1)))}"'
    if way == "axisangle":
        return f'axisangle="{spelt(draw(DIRECTION))} {draw(ANGLE) * angle!r}"'
    if way == "euler":
        return f'euler="{spelt(a * angle for a in draw(st.tuples(ANGLE, ANGLE, ANGLE)))}"'
    if way == "xyaxes":
        x, y, z = draw(DIRECTION)
        other = (y, -x, 0.3) if abs(x) + abs(y) > 0.1 else (0.3, z, 0.1)
        return f'xyaxes="{spelt((x, y, z))} {spelt(other)}"'
    return f'zaxis="{spelt(draw(DIRECTION))}"' if way == "zaxis" else ""


@st.composite
def joints(draw, name: str, degrees: bool, classes: int) -> str:
    kind = draw(KINDS)
    words = [f'<joint type="{kind}"']
    if draw(st.booleans()):
        words.append(f'name="{name}"')
    if draw(st.booleans()):
        words.append(f'class="c{draw(st.integers(0, classes - 1))}"')
    if kind != "ball":
        words.append(f'axis="{spelt(draw(DIRECTION))}"')
        unit = 1.0 if kind == "slide" or not degrees else 50.0
        if draw(st.booleans()):
            words.append(f'ref="{draw(SHORT) * unit!r}"')
        if draw(st.booleans()):
            low, high = sorted(draw(st.tuples(SHORT, SHORT).filter(lambda p: p[0] != p[1])))
            words.append(f'range="{low * unit!r} {high * unit!r}"')
    if kind != "slide" and draw(st.booleans()):
        words.append(f'pos="{spelt(draw(POINT))}"')
    return " ".join(words) + "/>"


@st.composite
def trees(draw) -> str:
    degrees, classes = draw(st.booleans()), 2
    sequence = draw(st.sampled_from(["", "XYZ", "zyx", "xzx", "Zyz"]))
    count = iter(range(1000))

    def body(depth: int, top: bool) -> str:
        number = next(count)
        named = f'name="b{number}"' if draw(st.booleans()) else ""
        turned = draw(orientations(degrees))
        place = f'pos="{spelt(draw(POINT))}"' if draw(st.booleans()) else ""
        inside = [f'<geom size="{draw(st.sampled_from([".1", ".2"]))}"/>']
        if top and draw(st.integers(0, 3)) == 0:
            inside.append(draw(st.sampled_from(["<freejoint/>", '<joint type="free"/>'])))
        else:
            kinds = [draw(joints(f"j{number}_{k}", degrees, classes)) for k in range(draw(st.integers(0, 3)))]
            # MuJoCo lets a body have six degrees of freedom.
            balls = [k for k in kinds if 'type="ball"' in k]
            inside += [k for k in kinds if k not in balls] + balls[:1]
        if draw(st.booleans()):
            inside.append(f'<site pos="{spelt(draw(POINT))}" {draw(orientations(degrees))}/>')
        if depth:
            inside += [body(depth - 1, False) for _ in range(draw(st.integers(0, 2)))]
        text = f"<body {named} {place} {turned}>{''.join(inside)}</body>"
        if draw(st.integers(0, 3)) == 0:
            text = f'<frame pos="{spelt(draw(POINT))}" {draw(orientations(degrees))}>{text}</frame>'
        return text

    bodies = "".join(body(draw(st.integers(0, 3)), True) for _ in range(draw(st.integers(1, 3))))
    angle = "degree" if degrees else "radian"
    order = f'eulerseq="{sequence}"' if sequence else ""
    compiler = f'<compiler angle="{angle}" {order}/>'
    defaults = "".join(
        f'<default class="c{k}"><joint pos=".{k} 0 .1" damping="{k}"/></default>' for k in range(classes)
    )
    return f"<mujoco>{compiler}<default>{defaults}</default><worldbody>{bodies}</worldbody></mujoco>"


@settings(max_examples=attempts(6), deadline=None)
@given(trees())
def test_random_trees_have_the_poses_of_mujoco(text):
    Pair.of_text(text).compare(samples=2)
