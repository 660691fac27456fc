from __future__ import annotations

import numpy as np
import pytest
from mujoco_oracle import Pair, model_of, mujoco
from test_mjcf_kinematics import body, mjcf

import kineverse as kv
from kineverse.formats.mjcf import parse_mjcf
from kineverse.formats.reader_warnings import collect_warnings

TWO = body(
    "a", '<joint name="x" ref="10" range="-60 60"/>' + body("b", '<joint name="y" ref="-20"/>', 'pos="1 0 0"')
)


def residuals(pair: Pair) -> np.ndarray:
    """Return what MuJoCo finds left of its active equalities where it was placed."""
    mujoco.mj_fwdPosition(pair.engine, pair.data)
    kinds = pair.data.efc_type[: pair.data.nefc]
    return pair.data.efc_pos[: pair.data.nefc][kinds == mujoco.mjtConstraint.mjCNSTR_EQUALITY]


def check_closed(pair: Pair, samples: int = 12, rows: int | None = None) -> None:
    rng = np.random.default_rng(1)
    for _ in range(samples):
        state = pair.random_state(rng)
        pair.compare_poses(state)
        left = residuals(pair)
        assert len(left) == rows if rows else len(left)
        assert np.abs(left).max() <= 1e-10


def scene(bodies: str, equality: str, more: str = "") -> str:
    return mjcf(f"<worldbody>{bodies}</worldbody><equality>{equality}</equality>{more}")


@pytest.mark.parametrize(
    "coefficients", ["0 1 0 0 0", ".1 -2 0 0 0", ".1 .2 -.3 .4 .5", ".3 0 0 0 0", "0 0 0 0 1"]
)
def test_a_joint_that_follows_is_the_quartic(coefficients):
    pair = Pair.of_text(scene(TWO, f'<joint joint1="y" joint2="x" polycoef="{coefficients}"/>'))
    assert [str(s) for s in pair.model.degrees_of_freedom] == ["x"]
    check_closed(pair)
    pair.compare()


def test_joint_equality_without_leader_fixes_the_joint():
    pair = Pair.of_text(scene(TWO, '<joint joint1="y" polycoef=".3 1 0 0 0"/>'))
    check_closed(pair)
    pair.compare()


def test_chains_are_composed_whatever_their_order():
    three = body("a", '<joint name="x"/>' + body("b", '<joint name="y"/>' + body("c", '<joint name="z"/>')))
    pair = Pair.of_text(
        scene(
            three,
            '<joint joint1="z" joint2="y" polycoef=".1 .5 .3"/><joint joint1="y" joint2="x" polycoef="0 2"/>',
        )
    )
    assert [str(s) for s in pair.model.degrees_of_freedom] == ["x"]
    check_closed(pair, rows=2)
    pair.compare()


def test_equalities_of_joints_that_follow_already_stay_constraints():
    one = '<joint name="forth" joint1="y" joint2="x" polycoef="0 2"/>'
    back = '<joint name="back" joint1="x" joint2="y" polycoef="0 1"/>'
    model = model_of(parse_mjcf(scene(TWO.replace('ref="10"', "").replace('ref="-20"', ""), one + back)), "p")
    (violation,) = model.violations({"p/x": 0.5})
    assert violation.name == "p/back"
    assert violation.value == pytest.approx(-0.5)  # x - y with y = 2x


def test_controllers_keep_remaining_equalities_as_mujoco():
    three = "".join(body(b, f'<joint name="{j}"/>') for b, j in zip("abc", "xyz", strict=True))
    follows = '<joint joint1="y" joint2="x" polycoef=".1 .8 .3 0 0"/>'
    pair = Pair.of_text(
        scene(three, follows + '<joint name="tie" joint1="y" joint2="z" polycoef="0 1 .2 0 0"/>')
    )
    x, z = kv.position("x"), kv.position("z")
    assert pair.model.degrees_of_freedom == (x, z)
    dt = 1e-3
    rows = pair.model.velocity_rows(dt, subject=pair.model.fk("c"))
    assert rows.names == ("tie",)
    for at_x, at_z in np.random.default_rng(0).uniform(-0.5, 0.5, (5, 2)):
        state = {x: at_x, z: at_z}
        pair.place(state)
        left = residuals(pair)
        (violation,) = pair.model.violations(state)
        assert violation.value == pytest.approx(left[1], abs=1e-12)
        jacobian = pair.data.efc_J.reshape(-1, pair.engine.nv)[1]
        along_x = jacobian[0] + jacobian[1] * (0.8 + 0.6 * at_x)
        (row,), (lower,), (upper,) = (pair.value(e, state) for e in (rows.matrix, rows.lower, rows.upper))
        np.testing.assert_allclose(row, [along_x, jacobian[2]], atol=1e-12)
        assert lower == pytest.approx(upper) == pytest.approx(-left[1] / dt)
        # The smallest speeds that the row allows lead back within a step, to second order.
        step = dt * lower * row / (row @ row)
        after = pair.model.violations({x: at_x + step[0], z: at_z + step[1]}, tolerance=0.0)
        assert all(abs(v.value) <= left[1] ** 2 for v in after)


def test_consistent_cycles_of_equalities_are_redundant():
    one = '<joint joint1="y" joint2="x"/>'
    model = model_of(
        parse_mjcf(
            scene(TWO.replace("ref", "armature").replace("-20", "0"), one + '<joint joint1="x" joint2="y"/>')
        )
    )
    assert [str(s) for s in model.degrees_of_freedom] == ["x"]
    assert list(model.constraints) == ["x/position"]


def test_joints_fixed_at_two_positions_are_a_warning():
    text = scene(TWO, '<joint joint1="y" polycoef=".1"/>\n<joint name="no" joint1="y" polycoef=".3"/>')
    with collect_warnings() as remarks:
        model = model_of(parse_mjcf(text, "x.xml"))
    (remark,) = remarks
    assert 'line 3, <joint name="no"> is left out, and never holds: it holds its joint 0.2 away' in remark
    assert [str(s) for s in model.degrees_of_freedom] == ["x"]


def test_inactive_equalities_are_left_out_with_a_remark():
    found = parse_mjcf(scene(TWO, '<joint name="off" joint1="y" joint2="x" active="false"/>'))
    assert found.couplings == ()
    assert found.remarks == ('line 2, <joint name="off"> is left out: it is not active.',)


BARS = body("crank", '<joint name="crank" axis="0 1 0" range="-8 8"/>' + body("coupler", '<joint name="coupler" axis="0 1 0" ref="{ref}"/><site name="tip" pos="1 0 0"/>', 'pos="0 0 .3" euler="0 {turn} 0"')) + body(
    "rocker", '<joint name="rocker" axis="0 1 0" range="-8 8"/><site name="top" pos="0 0 {length}"/>', 'pos="1 0 0" euler="0 {lean} 0"'
)  # fmt: skip


def bars(ref: float = 0.0) -> str:
    # The tip of the coupler is at (cos 20°, 0, .3 + sin 20°), and so is the top of the rocker.
    reach = np.array([np.cos(np.radians(20)), 0.3 + np.sin(np.radians(20))]) - [1.0, 0.0]
    lean = np.degrees(np.arctan2(reach[0], reach[1]))
    return BARS.format(ref=ref, turn=-20, length=float(np.hypot(*reach)), lean=lean)


@pytest.mark.parametrize("ref", [pytest.param(0.0, marks=pytest.mark.long), 30.0])
@pytest.mark.parametrize(
    "equality",
    [
        '<connect name="pin" body1="coupler" body2="rocker" anchor="1 0 0"/>',
        '<connect name="pin" site1="tip" site2="top"/>',
        '<connect name="pin" body1="rocker" body2="coupler" anchor="0 0 {length}"/>',
    ],
)
def test_a_linkage_is_closed_by_a_pin(equality, ref):
    length = np.hypot(np.cos(np.radians(20)) - 1, 0.3 + np.sin(np.radians(20)))
    pair = Pair.of_text(scene(bars(ref), equality.format(length=length)))
    assert [str(s) for s in pair.model.degrees_of_freedom] == [
        "rocker" if 'body1="rocker"' in equality else "crank"
    ]
    check_closed(pair, rows=3)
    pair.compare(samples=2)


def test_a_pin_to_the_world():
    # A slider crank whose slider is held by the world: the bar's end stays on the anchor, so the slide follows.
    parts = body(
        "cart",
        '<joint name="cart" type="slide" axis="1 0 0" range="-2 2"/>'
        + body(
            "bar",
            '<joint name="bar" axis="0 1 0" range="-40 40"/><joint name="lift" type="slide" axis="0 0 1" range="-2 2"/>',
        ),
    )
    pair = Pair.of_text(scene(parts, '<connect body1="bar" anchor="1 0 0"/>'))
    assert len(pair.model.degrees_of_freedom) == 1
    check_closed(pair, rows=3)


def test_a_weld_closes_all_six_directions():
    left = body("l", '<joint name="l" type="slide" axis="1 0 0" range="-1 1"/>')
    right = body(
        "r",
        '<joint name="rx" type="slide" axis="1 0 0" range="-2 2"/><joint name="turn" axis="0 0 1" range="-30 30"/>',
        'pos="0 1 0"',
    )
    pair = Pair.of_text(scene(left + right, '<weld body1="l" body2="r" relpose="0 0 0 0 0 0 0"/>'))
    assert [str(s) for s in pair.model.degrees_of_freedom] == ["l"]
    check_closed(pair, rows=6)
    sites = parts = left.replace("</body>", '<site name="s" pos="0 .5 0"/></body>') + right.replace(
        "</body>", '<site name="t" pos="0 -.5 0"/></body>'
    )
    pair = Pair.of_text(scene(parts, '<weld site1="s" site2="t"/>'))
    assert sites.count("site") == 2
    check_closed(pair, rows=6)


def test_a_weld_with_a_relative_pose_and_an_anchor():
    left = body("l", '<joint name="l" type="slide" axis="1 0 0" range="-1 1"/>')
    right = body(
        "r",
        '<joint name="rx" type="slide" axis="1 0 0" range="-2 2"/><joint name="ry" type="slide" axis="0 1 0" range="-2 2"/><joint name="turn" axis="0 0 1" range="-170 170"/>',
    )
    pair = Pair.of_text(
        scene(left + right, '<weld body1="l" body2="r" anchor=".2 .1 0" relpose=".3 .4 0 .9 0 0 .4"/>')
    )
    assert [str(s) for s in pair.model.degrees_of_freedom] == ["l"]
    check_closed(pair, rows=6)


ARM = body("arm", '<joint name="x" range="-60 60"/><site name="palm" pos="1 0 .2" euler="10 20 30"/>')
BOX = '<body name="box" pos="3 1 2" euler="40 0 10"><freejoint name="f"/><geom size=".1"/><site name="s" pos=".1 .2 .3"/>{}</body>'
MORE = body("lid", '<joint name="y" axis="1 0 0"/>', 'pos="0 0 1"') + body(
    "knob", "", 'pos="0 1 0" euler="1 2 3"'
)


@pytest.mark.parametrize(
    "equality",
    [
        '<weld body1="arm" body2="box"/>',
        '<weld body1="box" body2="arm" relpose=".1 .2 .3 .5 .5 .5 .5" anchor=".1 .1 0"/>',
        '<weld body1="box"/>',
        '<weld body1="arm" body2="knob" relpose=".1 .2 .3 1 2 3 4"/>',
        '<weld site1="s" site2="palm"/>',
    ],
)
@pytest.mark.parametrize("first", ["arm", "box"])
def test_welded_free_body_is_attached_to_its_holder(equality, first):
    parts = [ARM, BOX.format(MORE)]
    pair = Pair.of_text(scene("".join(parts if first == "arm" else parts[::-1]), equality))
    assert [str(s) for s in pair.model.degrees_of_freedom] == ["x", "y"]
    check_closed(pair, rows=6)


@pytest.mark.parametrize(
    "equality",
    [
        '<connect body1="box" body2="arm" anchor=".1 .2 .3"/>',
        '<connect site1="palm" site2="s"/>',
        '<connect body1="knob" anchor="0 0 1"/>',
    ],
)
def test_pinned_free_body_becomes_a_ball_joint(equality):
    pair = Pair.of_text(scene(ARM + BOX.format(MORE), equality))
    assert [str(s) for s in pair.model.degrees_of_freedom] == ["f/qw", "f/qx", "f/qy", "f/qz", "x", "y"]
    check_closed(pair, rows=3)


def test_second_equality_of_a_held_body_closes_a_loop():
    boxes = BOX.format("") + BOX.format("").replace("box", "crate").replace('"f"', '"g"').replace(
        '"s"', '"t"'
    )
    chain = '<weld body1="box" body2="crate"/><weld body1="box" relpose="0 0 1 1 0 0 0"/>'
    check_closed(Pair.of_text(scene(boxes, chain)), rows=12, samples=1)
    with pytest.raises(kv.errors.ModelError, match="rigidly connected"):
        model_of(parse_mjcf(scene(boxes, chain + '<weld body1="crate" relpose="0 0 2 1 0 0 0"/>')))


def test_unsolvable_loops_are_refused_by_name(tmp_path):
    hung = body(
        "a", '<joint type="ball" name="j"/>' + body("b", '<joint type="ball" name="k"/>', 'pos="1 0 0"')
    )
    (tmp_path / "x.xml").write_text(scene(hung, '<connect name="end" body1="b" anchor="1 0 0"/>'))
    with pytest.raises(
        kv.errors.FormatError, match=r"^x\.xml: the equality 'end' closes a loop, which cannot be followed"
    ):
        kv.load(tmp_path / "x.xml", loops="refuse")


def test_equalities_between_rigidly_connected_bodies_are_left_out():
    fixed = body("a", "") + body("b", "", 'pos="1 0 0"')
    assert parse_mjcf(scene(fixed, '<weld name="w" body1="a" body2="b"/>')).remarks == (
        'line 2, <weld name="w"> is left out: it ties bodies that are rigidly connected anyway.',
    )
    apart = parse_mjcf(scene(fixed, '<weld name="w" body1="a" body2="b" relpose=".5 0 0 1 0 0 0"/>'))
    assert [closure.name for closure in apart.closures] == ["w"]
    with pytest.raises(kv.errors.ModelError, match="rigidly connected"):
        model_of(apart)


def test_loop_without_free_coordinate_is_closed():
    pair = Pair.of_text(
        scene(body("a", '<joint name="j"/>', 'pos="1 0 0"'), '<connect body1="a" anchor=".5 .5 0"/>')
    )
    assert pair.model.degrees_of_freedom == ()
    check_closed(pair, rows=3, samples=1)


def test_equalities_of_mocap_bodies_are_left_out():
    parts = body("hand", '<joint name="j" type="slide"/>') + body("handle", "", 'mocap="true"')
    found = parse_mjcf(scene(parts, '<weld name="w" body1="hand" body2="handle"/>'))
    assert found.closures == ()
    assert "by which a user drags another" in found.remarks[0]


TENDONS = """<tendon>
  <fixed name="f" range="-1 2"><joint joint="x" coef="2"/><joint joint="y" coef="-.5"/></fixed>
  <spatial name="s" range="0 3"><site site="p"/><site site="q"/><pulley divisor="2"/><site site="p"/><site site="r"/></spatial>
  <spatial name="rest"><site site="p"/><site site="q"/></spatial>
</tendon>"""
ROPED = body("a", '<site name="p" pos="0 .3 0"/><site name="p2"/><joint name="x" ref="10" range="-60 60"/>' + body("b", '<joint name="y" ref="-20"/><site name="q" pos=".2 0 0"/>', 'pos="1 0 0"')) + '<site name="r" pos="2 0 0"/>'  # fmt: skip


def test_tendons_have_the_lengths_of_mujoco():
    pair = Pair.of_text(mjcf(f"<worldbody>{ROPED}</worldbody>", TENDONS))
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = pair.random_state(rng)
        pair.place(state)
        mujoco.mj_tendon(pair.engine, pair.data)
        lengths = [float(pair.value(pair.model.data[f"{name}/length"], state)) for name in ("f", "s", "rest")]
        np.testing.assert_allclose(lengths, pair.data.ten_length, atol=1e-12)
    assert {name for name in pair.model.constraints if name.endswith("/length")} == {"f/length", "s/length"}
    (violation,) = pair.model.violations({"x": 1.0, "y": -1.0})
    assert (violation.name, violation.value) == ("f/length", pytest.approx(2.5))


def test_tendons_over_followers_have_the_lengths_of_mujoco():
    pair = Pair.of_text(
        mjcf(
            f"<worldbody>{ROPED}</worldbody>",
            TENDONS,
            '<equality><joint joint1="y" joint2="x" polycoef="0 2"/></equality>',
        )
    )
    state = {kv.position("x"): 0.4}
    pair.place(state)
    mujoco.mj_tendon(pair.engine, pair.data)
    found = pair.model.constraints["f/length"].expression
    assert {str(s) for s in found.symbols} == {"x"}
    assert float(found(state)) == pytest.approx(pair.data.ten_length[0], abs=1e-12)


@pytest.mark.parametrize("leader", ['tendon2="s"', ""])
def test_coupled_tendons_are_a_constraint(leader):
    equality = f'<equality><tendon name="e" tendon1="f" {leader} polycoef=".1 .2 .3 .4 .5"/></equality>'
    pair = Pair.of_text(mjcf(f"<worldbody>{ROPED}</worldbody>", TENDONS, equality))
    constraint = pair.model.constraints["e"]
    assert (float(constraint.lower), float(constraint.upper)) == (0.0, 0.0)
    state = pair.random_state(np.random.default_rng(0))
    pair.place(state)
    assert float(pair.value(constraint.expression, state)) == pytest.approx(
        float(residuals(pair)[0]), abs=1e-12
    )


def test_tendons_around_geoms_are_left_out():
    text = mjcf(
        f'<worldbody>{ROPED}<geom name="w" size=".1"/></worldbody><tendon><spatial name="t"><site site="p"/><geom geom="w"/>'
        '<site site="q"/></spatial></tendon><equality><tendon name="e" tendon1="t"/></equality>'
    )
    found = parse_mjcf(text)
    assert (found.tendons, found.tendon_couplings) == ((), ())
    assert found.remarks == (
        'line 2, <spatial name="t"> is left out: it wraps round a geom.',
        'line 2, <tendon name="e"> is left out, as its tendon is.',
    )


def test_ball_joint_limit_is_that_of_mujoco():
    ball = body("a", '<joint name="j" type="ball" range="0 50"/>')
    pair = Pair.of_text(mjcf(f"<worldbody>{ball}</worldbody>"))
    axis = np.array([1.0, 2.0, -2.0]) / 3
    for angle in (0.0, 0.8, 0.9, 3.0):
        q = dict(zip("xyz", np.sin(angle / 2) * axis, strict=True)) | {"w": np.cos(angle / 2)}
        violated = bool(len(pair.model.violations({f"j/q{c}": v for c, v in q.items()})))
        assert violated == (angle > np.radians(50))
