"""Centre of mass: the mean of the bodies' own, weighted by mass, and pinocchio's."""

from __future__ import annotations

import re
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from random_models import random_pose, random_state, random_tree

import kineverse as kv
from kineverse.errors import ModelError, UnknownNameError
from kineverse.model import Body, Inertia

ROBOTS = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots")
URDF = (
    "talos_data/robots/talos_full_v2.urdf",
    "tiago_description/robots/tiago.urdf",
    "anymal_b_simple_description/robots/anymal.urdf",
    "panda_description/urdf/panda.urdf",
    "hyq_description/robots/hyq_no_sensors.urdf",
)


def with_masses(model: kv.Model, seed: int) -> dict[str, Inertia]:
    """Give some of the frames a body with mass, and return these."""
    rng = np.random.default_rng(seed)
    given = {}
    with model.edit() as edit:
        for name in list(model.frames):
            if rng.random() < 0.7:
                inertia = Inertia(float(rng.uniform(0.1, 5)), (1, 0, 0, 1, 0, 1), random_pose(rng))
                given[f"{name}/body"] = inertia
                edit.add_frame(f"{name}/body", name, np.eye(4), Body(inertia=inertia))
    return given


def is_below(model: kv.Model, name: str, frame: str) -> bool:
    while name not in (frame, "world"):
        name = model.frames[name].parent
    return name == frame


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_mean_of_the_bodies_by_forward_kinematics(seed: int) -> None:
    model = random_tree(seed, 12)
    inertias, state = with_masses(model, seed), random_state(model, seed)
    for frame in ("world", *list(model.frames)[::3]):
        part = {name: i for name, i in inertias.items() if is_below(model, name, frame)}
        if not part:
            continue
        points = [model.fk(name)(state) @ i.origin.matrix[:, 3] for name, i in part.items()]
        masses = [i.mass for i in part.values()]
        assert model.mass(frame) == pytest.approx(sum(masses))
        expected = np.average(points, axis=0, weights=masses)[:3]
        result = model.center_of_mass(frame)
        assert result.shape == (3,)
        np.testing.assert_allclose(result(kv.State(state)), expected, atol=1e-13)
    moving = model.center_of_mass()
    assert {s for s in model.speeds if s in moving.gradient()} == {
        s for s in model.speeds if any(s in model.speeds_of(name) for name in inertias)
    }


@pytest.mark.parametrize("file", URDF)
def test_it_and_its_jacobian_are_those_of_pinocchio(file: str, tmp_path: Path) -> None:
    pin, path = pytest.importorskip("pinocchio"), ROBOTS / file
    if not path.exists():
        pytest.skip(f"no {file} of example-robot-data")
    # Joints that mimic others are free in pinocchio's model.
    text = re.sub(r"<mimic\b[^>]*/>", "", path.read_text())
    robot = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    data = robot.createData()
    (tmp_path / "robot.urdf").write_text(text)
    model = kv.load(tmp_path / "robot.urdf", prefix="robot")
    with model.edit() as edit:
        edit.apply(kv.Floating(name="base", parent="world", child="base"))
        root = next(
            name for name, frame in model.frames.items() if frame.parent == "world" and name != "base"
        )
        edit.attach(root, "base", np.eye(4))
    center = model.center_of_mass()
    joints = {f"robot/{name}": joint for name, joint in zip(robot.names[2:], robot.joints[2:], strict=True)}
    columns = [s.position for s in model.speeds if str(s.position) in joints]
    base = [kv.position(f"base/{c}") for c in ("x", "y", "z", "wx", "wy", "wz")]
    f = kv.compile([center, center.jacobian([*base, *columns])], [*model.symbols], tier="interpreter")
    rng = np.random.default_rng(0)
    for _ in range(3):
        values, q = random_state(model, int(rng.integers(1000))), pin.neutral(robot)
        q[:7] = [values[kv.position(f"base/{c}")] for c in ("x", "y", "z", "qx", "qy", "qz", "qw")]
        for name, joint in joints.items():
            angle = values[kv.position(name)]
            if joint.nq == 2:
                q[joint.idx_q : joint.idx_q + 2] = np.cos(angle), np.sin(angle)
            else:
                q[joint.idx_q] = angle
        expected = pin.centerOfMass(robot, data, q)
        jacobian = pin.jacobianCenterOfMass(robot, data, q)
        result, ours = f({str(s): value for s, value in values.items()})
        np.testing.assert_allclose(result, expected, atol=1e-12)
        # Pinocchio's base moves in its own axes, ours in the world's.
        rotation = model.fk("base")(values)[:3, :3]
        np.testing.assert_allclose(ours[:, :3] @ rotation, jacobian[:, :3], atol=1e-12)
        np.testing.assert_allclose(ours[:, 3:6], jacobian[:, 3:6], atol=1e-12)
        order = [joints[str(s)].idx_v for s in columns]
        np.testing.assert_allclose(ours[:, 6:], jacobian[:, order], atol=1e-12)
    assert model.mass() == pytest.approx(pin.computeTotalMass(robot))


def test_a_closed_loop_carries_its_masses() -> None:
    model = kv.load("articulations/four_bar")
    inertias = with_masses(model, 1)
    (crank,) = model.degrees_of_freedom
    state = model.default_state().updated({crank: 0.3})
    points = [model.fk(name)(state) @ i.origin.matrix[:, 3] for name, i in inertias.items()]
    expected = np.average(points, axis=0, weights=[i.mass for i in inertias.values()])[:3]
    center = model.center_of_mass()
    np.testing.assert_allclose(center(state), expected, atol=1e-12)
    step = 1e-6
    ends = [center(state.updated({crank: 0.3 + h})) for h in (step, -step)]
    np.testing.assert_allclose(
        center.gradient()[crank.derivative()](state), (ends[0] - ends[1]) / (2 * step), atol=1e-8
    )


def test_edits_are_seen() -> None:
    model = random_tree(0, 9)
    state = kv.State(random_state(model, 0))
    for mass, name in ((2.0, "one"), (1.0, "other")):
        with model.edit() as edit:
            body = Body(inertia=Inertia(mass, (1, 0, 0, 1, 0, 1)))
            edit.add_frame(name, f"f{mass:.0f}", kv.translation(kv.position("slide"), 0, 0), body)
        if name == "one":
            state = state.extended({"slide": 0.3})
            np.testing.assert_allclose(
                model.center_of_mass()(state), model.fk(name)[:3, 3](state), atol=1e-14
            )
    assert model.mass() == 3
    assert model.snapshot().mass("other") == 1
    expected = (2 * model.fk("one")[:3, 3] + model.fk("other")[:3, 3]) / 3
    np.testing.assert_allclose(model.snapshot().center_of_mass()(state), expected(state), atol=1e-14)


def test_bodies_without_mass_are_listed() -> None:
    model = kv.load("articulations/four_bar")
    with pytest.raises(ModelError, match=r"No body in the model has a mass.*'four_bar/crank'"):
        model.center_of_mass()
    with pytest.raises(ModelError, match=r"below 'four_bar/crank'.*: 'four_bar/crank'"):
        model.center_of_mass("four_bar/crank")
    assert model.mass() == 0
    with pytest.raises(ModelError, match="There is no body"):
        kv.Model().center_of_mass()
    with pytest.raises(UnknownNameError, match="Did you mean"):
        model.center_of_mass("four_bar/crnk")
    with pytest.raises(UnknownNameError, match="Did you mean"):
        model.mass("four_bar/crnk")
