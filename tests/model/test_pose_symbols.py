"""The symbols of a pose, in the order in which the chain meets them."""

from __future__ import annotations

import numpy as np
import pytest

import kineverse as kv


@pytest.fixture(scope="module")
def arm() -> kv.Model:
    """A lift on a floating base, with an arm whose names are not in their order; a mimic and a scaled link."""
    model, length = kv.Model(), kv.parameter("length", 0.4)
    with model.edit() as edit:
        edit.apply(kv.Floating(name="base", parent="world", child="base"))
        edit.apply(kv.Prismatic(name="torso", parent="base", child="torso", axis=(0, 0, 1)))
        edit.apply(kv.Revolute(name="shoulder", parent="torso", child="upper", axis=(0, 1, 0)))
        edit.add_frame("lengthened", "upper", kv.translation(length, 0, 0))
        edit.apply(kv.Revolute(name="elbow", parent="lengthened", child="lower", axis=(0, 1, 0)))
        follower = kv.position("shoulder") * 2
        edit.apply(
            kv.Revolute(name="follower", parent="lower", child="tip", axis=(1, 0, 0), position=follower)
        )
        edit.apply(kv.Revolute(name="camera", parent="torso", child="camera", axis=(0, 0, 1)))
    return model


BASE = [f"base/{c}" for c in ("x", "y", "z", "qx", "qy", "qz", "qw")]


def test_from_the_root_to_the_tip(arm: kv.Model) -> None:
    assert [str(s) for s in arm.symbols_of("tip")] == [*BASE, "torso", "shoulder", "length", "elbow"]
    assert [str(s) for s in arm.symbols_of("tip", "torso")] == ["shoulder", "length", "elbow"]
    # From the tip, the first joint on the way is the one that follows the shoulder.
    assert [str(s) for s in arm.symbols_of("camera", "tip")] == ["shoulder", "elbow", "length", "camera"]
    assert arm.symbols_of("base", "base") == ()
    with pytest.raises(kv.errors.UnknownNameError, match="camera"):
        arm.symbols_of("camara")


def test_they_are_those_of_the_pose(arm: kv.Model) -> None:
    for model in (arm, kv.load("kitchen"), kv.load("pr2")):
        frames = list(model.frames)
        for frame, other in zip(frames[::9], frames[::-9], strict=True):
            assert set(model.symbols_of(frame, other)) == set(model.fk(frame, other).symbols)
            assert set(model.symbols_of(frame)) == set(model.fk(frame).symbols)


def test_symbols_of_a_loop_are_the_free_coordinates() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.Revolute(name="z_crank", parent="world", child="crank", axis=(0, 0, 1), lower=0, upper=0.5)
        )
        edit.add_frame("crank_end", "crank", kv.translation(0.3, 0, 0))
        edit.apply(kv.Revolute(name="a_coupler", parent="crank_end", child="coupler", axis=(0, 0, 1)))
        edit.add_frame("coupler_end", "coupler", kv.translation(1.0, 0, 0))
        rocker = kv.Revolute(
            name="rocker", parent="world", child="rocker", axis=(0, 0, 1), origin=kv.translation(1, 0, 0)
        )
        edit.apply(rocker)
        edit.add_frame("rocker_end", "rocker", kv.translation(0.7, 0, 0))
        edit.close_loop("coupler_end", "rocker_end")
    for frame in ("coupler_end", "rocker_end"):
        assert [str(s) for s in model.symbols_of(frame)] == ["z_crank"]


def test_inputs_in_the_order_of_the_chain(arm: kv.Model) -> None:
    chain, pose = arm.symbols_of("tip", "torso"), arm.fk("tip", "torso")
    ordered, sorted_ = (
        kv.compile(pose, inputs=chain, tier="interpreter"),
        kv.compile(pose, tier="interpreter"),
    )
    assert ordered.names == ("shoulder", "length", "elbow")
    assert sorted_.names == ("elbow", "length", "shoulder")
    np.testing.assert_array_equal(ordered([0.1, 0.4, 0.7]), sorted_([0.7, 0.4, 0.1]))
    columns = arm.jacobian("tip", "torso", symbols=[s for s in chain if s.has_derivative])
    assert columns == arm.jacobian("tip", "torso")[:, [1, 0]]
