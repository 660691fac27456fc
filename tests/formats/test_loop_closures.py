"""Loops of robots: unsolvable ones stay constraints, and redundant ones are left out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.formats.reader_warnings import collect_warnings

mujoco = pytest.importorskip("mujoco")


def body(name: str, inside: str, place: str = "") -> str:
    mass = '<inertial mass="1" pos="0 0 0" diaginertia=".1 .1 .1"/>'
    return f'<body name="{name}" {place}>{mass}{inside}</body>'


def hinge(name: str, axis: str = "0 0 1", limits: str = 'range="-60 60"') -> str:
    return f'<joint name="{name}" axis="{axis}" {limits}/>'


def scene(bodies: str, equality: str, more: str = "") -> str:
    return f"<mujoco><worldbody>{bodies}</worldbody><equality>{equality}</equality>{more}</mujoco>"


FINGERS = "".join(
    body(
        f"palm_{k}",
        body(
            f"driver_{k}",
            hinge(f"driver_{k}", "0 1 0", 'range="-120 120"')
            + body(f"coupler_{k}", hinge(f"coupler_{k}", "0 1 0", 'range="-90 0"'), 'pos=".03 0 0"'),
            'pos="0 0 0"',
        )
        + body(
            f"spring_{k}",
            hinge(f"spring_{k}", "0 1 0", 'range="-120 120"')
            + body(f"pad_{k}", hinge(f"pad_{k}", "0 1 0", 'range="-50 50"'), 'pos=".01 0 .045"'),
            'pos="-.018 0 .006"',
        ),
        f'euler="0 0 {180 * k}"',
    )
    for k in range(2)
)
"""A gripper with two fingers, each a linkage with two degrees of freedom that does not close everywhere."""

TIES = "".join(
    f'<connect name="finger_{k}" body1="coupler_{k}" body2="pad_{k}" anchor="0 0 .04"/>' for k in range(2)
)

LEG = body(
    "thigh",
    hinge("hip", "0 1 0", 'range="-40 40"')
    + body(
        "rod", '<joint name="ball" type="ball"/>' + '<site name="rod_end" pos="0 0 -.39"/>', 'pos=".1 0 0"'
    )
    + body(
        "shin",
        hinge("knee", "0 1 0", 'range="-60 60"') + '<site name="horn" pos=".1 0 -.1"/>',
        'pos="0 0 -.3"',
    ),
)
"""A leg whose knee is driven by a rod with a ball at each end."""


def load(folder: Path, text: str, name: str = "x.xml", **options: str) -> tuple[kv.Model, list[str]]:
    (folder / name).write_text(text)
    with collect_warnings() as remarks:
        return kv.load(folder / name, **options), remarks


def left_in_mujoco(text: str, model: kv.Model, state: kv.State) -> np.ndarray:
    """Return what MuJoCo finds left of its equalities at a state."""
    engine = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(engine)
    for number in range(engine.njnt):
        name, at = engine.joint(number).name, engine.jnt_qposadr[number]
        if engine.jnt_type[number] == mujoco.mjtJoint.mjJNT_BALL:
            data.qpos[at : at + 4] = [state[f"{name}/q{c}"] for c in "wxyz"]
        else:
            data.qpos[at] = model.rates.resolve(kv.position(name))(state)
    mujoco.mj_fwdPosition(engine, data)
    return data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]


@pytest.mark.parametrize(
    ("text", "kept"),
    [(scene(FINGERS, TIES), 2), (scene(LEG, '<connect name="rod" site1="rod_end" site2="horn"/>'), 1)],
    ids=["fingers", "leg"],
)
@pytest.mark.parametrize("loops", ["solve", "constraint"])
def test_robots_with_loops_load_and_are_closed_by_projection(tmp_path, text, kept, loops):
    model, remarks = load(tmp_path, text, loops=loops)
    assert len([n for n, r in model.articulations.items() if r.kind == "loopconstraint"]) == kept
    assert len([r for r in remarks if "closes a loop" in r]) == kept
    # The default state is closed already, and so is what is made of any other.
    default = model.default_state()
    assert len(model.violations(default)) == 0
    assert np.abs(left_in_mujoco(text, model, default)).max() < 1e-8
    rng = np.random.default_rng(0)
    for _ in range(4):
        limits = {s: model.limits(s) for s in model.degrees_of_freedom if not s.path.startswith("ball/")}
        moved = {s: float(np.clip(default[s] + rng.uniform(-0.2, 0.2), *ends)) for s, ends in limits.items()}
        state = model.project(default.updated(moved))
        assert len(model.violations(state)) == 0
        assert np.abs(left_in_mujoco(text, model, state)).max() < 1e-8


def test_unsolved_loop_warning_names_loop_reason_and_remedy(tmp_path):
    _, remarks = load(tmp_path, scene(LEG, '<connect name="rod" site1="rod_end" site2="horn"/>'))
    assert remarks[0].startswith(
        "x.xml: the equality 'rod' closes a loop, which cannot be followed here: Loop 'rod' "
    )
    assert remarks[0].endswith(
        " So its coordinates stay free, and it is the constraint 'rod': model.project(state) moves a state to "
        "where it holds."
    )
    assert remarks[1].startswith("x.xml: its home is moved to where limits and loops hold: '")


def test_loops_refuse_raises_for_unsolved_loops(tmp_path):
    text = scene(LEG, '<connect name="rod" site1="rod_end" site2="horn"/>')
    with pytest.raises(
        kv.errors.FormatError,
        match=r"^x\.xml: the equality 'rod' closes a loop, which cannot be followed here: .* Remove the equality, "
        r'and close the loop with kv\.CloseLoop; or keep it as a constraint, with loops="solve"\.$',
    ):
        load(tmp_path, text, loops="refuse")
    assert len(kv.load(tmp_path / "x.xml").constraints) > 0  # what was remembered is of that request
    for bad in ("solved", None, 3):
        with pytest.raises(InvalidValueError, match=r"^loops= is 'solve', which keeps .* not "):
            kv.load(tmp_path / "x.xml", loops=bad)
    model = kv.Model()
    for place in (model, "edit"):
        with pytest.raises(kv.errors.FormatError, match="closes a loop"), kv.Model().edit() as edit:
            (edit if place == "edit" else model).include(tmp_path / "x.xml", "leg", loops="refuse")
    with model.edit() as edit:
        assert edit.include(tmp_path / "x.xml", "leg") == list(model.history.tags)
    model.include(tmp_path / "x.xml", "other", loops="constraint")
    assert {"leg/rod/x", "other/rod/x"} <= set(model.constraints)
    assert len(model.violations(model.default_state())) == 0


BARS = body(
    "crank",
    hinge("crank", "0 1 0") + body("coupler", hinge("coupler", "0 1 0"), 'pos="0 0 .3" euler="0 -20 0"'),
) + body("rocker", hinge("rocker", "0 1 0"), 'pos="1 0 0"')
PIN = '<connect name="pin" body1="coupler" body2="rocker" anchor="1 {} 0"/>'


def test_two_pins_on_one_axis_are_a_hinge(tmp_path):
    once, _ = load(tmp_path, scene(BARS, PIN.format("0")), "once.xml")
    twice, remarks = load(tmp_path, scene(BARS, PIN.format("0") + PIN.format(".1").replace("pin", "again")))
    assert remarks == [
        "x.xml: the equality 'again' is left out: it adds nothing, since what it connects coincides in every state."
    ]
    assert twice.degrees_of_freedom == once.degrees_of_freedom == (kv.position("crank"),)
    np.testing.assert_array_equal(twice.fk("rocker")({"crank": 0.2}), once.fk("rocker")({"crank": 0.2}))
    strict, _ = load(tmp_path, (tmp_path / "x.xml").read_text(), loops="refuse")
    assert strict.degrees_of_freedom == once.degrees_of_freedom
    # Asked for as constraints, both are one, and do not hinder each other.
    kept, remarks = load(tmp_path, (tmp_path / "x.xml").read_text(), loops="constraint")
    assert {"pin/x", "pin/z", "again/x", "again/z"} <= set(kept.constraints)
    assert all("as asked for" in remark for remark in remarks)
    state = kept.project(kept.default_state().updated({"crank": 0.2}), fixed="crank")
    for follower in ("coupler", "rocker"):
        assert twice.rates.dependent[kv.position(follower)]({"crank": 0.2}) == pytest.approx(
            state[follower], abs=1e-8
        )


def test_nearly_planar_loops_are_solved_as_planar(tmp_path):
    """Files have six digits."""
    off = BARS.replace('pos="1 0 0"', 'pos="1 3e-7 0"')
    tie = '<connect name="pin" site1="a" site2="b"/>'
    ended = off.replace(
        'name="coupler" axis="0 1 0" range="-60 60"/>',
        'name="coupler" axis="0 1 0" range="-60 60"/><site name="a" pos="1 0 0"/>',
    )
    ended = ended.replace(
        'name="rocker" axis="0 1 0" range="-60 60"/>',
        'name="rocker" axis="0 1 0" range="-60 60"/><site name="b" pos="-.060307 0 .642020"/>',
    )
    model, remarks = load(tmp_path, scene(ended, tie))
    assert remarks == [
        "x.xml: the equality 'pin' ties what is nearly in one plane: that is taken to be exact."
    ]
    assert model.degrees_of_freedom == (kv.position("crank"),)


def test_loop_that_never_closes_is_a_warning(tmp_path):
    rigid = body("a", "") + body("b", "", 'pos="1 0 0"') + body("c", hinge("j"))
    weld = '<weld name="w" body1="a" body2="b" relpose=".5 0 0 1 0 0 0"/>'
    model, remarks = load(tmp_path, scene(rigid, weld))
    assert remarks == [
        "x.xml: the equality 'w' is left out, and never holds: nothing moves what it connects, and 0.5 is left between its ends."
    ]
    assert not model.constraints or "w" not in "".join(model.constraints)
    with pytest.raises(kv.errors.FormatError, match="'w' cannot move"):
        load(tmp_path, scene(rigid, weld), loops="refuse")
    # Two plates that turn, but never meet: the constraint says so wherever they are.
    apart = body("a", hinge("j") + '<site name="s" pos=".5 0 0"/>') + body(
        "b", hinge("k") + '<site name="t" pos=".6 0 0"/>', 'pos="1 0 .2"'
    )
    model, remarks = load(tmp_path, scene(apart, '<connect name="tie" site1="s" site2="t"/>'))
    assert "'s' and 't' are -0.2 apart along 'z', whatever moves" in remarks[0]
    assert remarks[1].startswith(
        "x.xml: loops that were kept as constraints are open at default_state(). The state cannot be projected: at best "
        "'tie/"
    )
    assert "tie/apart" in [v.name for v in model.violations(model.default_state())]


def test_solvable_loops_among_coupled_ones_are_solved(tmp_path):
    rod = body("rod", '<joint name="ball" type="ball"/><site name="rod_end" pos="0 0 .33"/>', 'pos="1 0 .3"')
    text = scene(BARS.replace('<inertial mass="1" pos="0 0 0" diaginertia=".1 .1 .1"/><joint name="rocker"', '<inertial mass="1" pos="0 0 0" diaginertia=".1 .1 .1"/><site name="lug" pos="0 .1 .6"/><joint name="rocker"') + rod, PIN.format("0") + '<connect name="rod" site1="rod_end" site2="lug"/>')  # fmt: skip
    model, remarks = load(tmp_path, text)
    assert set(map(str, model.rates.dependent)) == {"coupler", "rocker"}
    assert len([r for r in remarks if "'rod' closes a loop" in r]) == 1
    assert len(model.violations(model.default_state())) == 0
    state = model.project(model.default_state().updated({"crank": 0.1}))
    assert np.abs(left_in_mujoco(text, model, state)).max() < 1e-8


def key(qpos: str) -> str:
    return f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>'


@pytest.mark.parametrize(
    ("bodies", "equality", "qpos", "told"),
    [
        (body("a", hinge("j", limits='range="-30 30"')), "", "1", "'j' from 1 to 0.523599"),
        (body("a", hinge("j", limits='range="30 60"')), "", "0", "'j' from 0 to 0.523599"),
        (body("a", hinge("j")) + body("b", hinge("k")), '<joint joint1="k" joint2="j" polycoef=".1 .5"/>', ".2 .4", "'k' from 0.4 to 0.2"),
        (BARS, PIN.format("0"), "0 .3 0", "'coupler' from 0.3 to "),
    ],
    ids=["limit", "zero", "follower", "loop"],
)  # fmt: skip
def test_moved_home_position_is_a_warning(tmp_path, bodies, equality, qpos, told):
    _, remarks = load(tmp_path, scene(bodies, equality, key(qpos)))
    assert len(remarks) == 1
    assert remarks[0].startswith("x.xml: its home is moved to where ")
    assert told in remarks[0]


def test_consistent_home_position_is_no_warning(tmp_path):
    _, remarks = load(tmp_path, scene(BARS, PIN.format("0"), key("0 0 0")))
    assert remarks == []
    _, remarks = load(tmp_path, scene(body("a", hinge("j")), "", key(".3")))
    assert remarks == []


def test_contradicting_equalities_are_a_warning(tmp_path):
    two = body("a", hinge("j")) + body("b", hinge("k"))
    both = '<joint joint1="j" polycoef=".1"/><joint joint1="j" polycoef=".3"/>'
    model, remarks = load(tmp_path, scene(two, both))
    assert [r for r in remarks if "never holds: it holds its joint 0.2 away" in r]
    assert kv.position("j") not in model.degrees_of_freedom


def sdf(*parts: str) -> str:
    return f'<sdf version="1.9"><model name="gripper">{"".join(parts)}</model></sdf>'


def link(name: str, x: float, y: float, angle: float = 0.0) -> str:
    return f'<link name="{name}"><pose>{x} {y} 0 0 0 {angle!r}</pose></link>'


def joint(
    name: str, kind: str, ends: str, place: str = "0 0", axis: str = "0 0 1", limit: float = 0.6
) -> str:
    within = f"<limit><lower>{-limit}</lower><upper>{limit}</upper></limit>"
    parent, child = ends.split()
    return (
        f'<joint name="{name}" type="{kind}"><pose>{place} 0 0 0 0</pose><parent>{parent}</parent>'
        f"<child>{child}</child><axis><xyz>{axis}</xyz>{within}</axis></joint>"
    )


GRIPPER = sdf(
    link("palm", 0, 0),
    *(
        part
        for side, sign in (("left", 1), ("right", -1))
        for part in (
            link(f"{side}_finger", 0.08, sign * 0.03),
            link(f"{side}_parallel", 0.06, sign * 0.015),
            link(f"{side}_tip", 0.17, sign * 0.05),
            joint(f"{side}_finger_joint", "revolute", f"palm {side}_finger"),
            joint(f"{side}_parallel_joint", "revolute", f"palm {side}_parallel"),
            joint(f"{side}_tip_joint", "revolute", f"{side}_finger {side}_tip"),
            joint(
                f"{side}_closing_joint", "revolute", f"{side}_parallel {side}_tip", f"-.02 {-sign * 0.015}"
            ),
        )
    ),
    joint("between", "prismatic", "left_tip right_tip", axis="0 1 0", limit=0.1),
)
"""A gripper as the PR2 has one: two fingers, each closed by a parallel link, and a slide between their tips."""


def test_a_gripper_in_sdf_loads_and_moves(tmp_path):
    model, remarks = load(tmp_path, GRIPPER, "gripper.sdf")
    told = [r for r in remarks if "closes a loop" in r or "nothing new" in r]
    assert told
    assert all(r.startswith("gripper.sdf: the joint '") for r in told)
    assert len(model.violations(model.default_state())) == 0
    with pytest.raises(kv.errors.FormatError, match=r"^gripper\.sdf: the joint '.*' closes a loop"):
        load(tmp_path, GRIPPER, "gripper.sdf", loops="refuse")
    kept, _ = load(tmp_path, GRIPPER, "gripper.sdf", loops="constraint")
    start = kept.default_state()
    state = kept.project(start.updated({"left_finger_joint": 0.2}), fixed="left_finger_joint")
    assert state["left_finger_joint"] == 0.2
    assert len(kept.violations(state)) == 0
    for side in ("left", "right"):
        a, b = (kept.fk(f)(state) for f in (f"{side}_closing_joint/closed", f"{side}_closing_joint"))
        np.testing.assert_allclose(a, b, atol=1e-8)


def test_long_ring_is_projected_in_seconds(tmp_path):
    """Its mobility is 18: a box of limits has too many corners to enumerate."""
    count, inner = 20, ""
    for k in reversed(range(count)):
        tip = '<site name="tip" pos=".1 0 0"/>' if k == count - 1 else ""
        place = f'pos="{0.1 if k else 0} 0 0" euler="0 0 {360 / count if k else 0}"'
        inner = body(f"link_{k}", hinge(f"joint_{k}", limits='range="-170 170"') + tip + inner, place)
    text = scene('<site name="base"/>' + inner, '<connect name="ring" site1="tip" site2="base"/>')
    model, remarks = load(tmp_path, text)
    assert len(model.degrees_of_freedom) == count
    assert len(remarks) == 1
    assert len(remarks[0]) < 700
    assert len(model.violations(model.default_state())) == 0
    state = model.project(model.default_state().updated({"joint_3": 0.5}), fixed="joint_3")
    assert len(model.violations(state)) == 0
    assert math.isclose(state["joint_3"], 0.5)
