"""The world of a mechanism moves its coordinates as far as the constraints allow, and no farther."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import THESIS, draw_tangled_lockbox, make_lockbox_model
from kineverse.worlds import MechanismWorld, Recorder, read_run_recording

F, E = kv.position("lockbox/f"), kv.position("lockbox/e")


def test_free_part_moves_and_locked_part_stands_still():
    world = MechanismWorld(make_lockbox_model(THESIS))
    world.apply({"lockbox/f:velocity": 0.3, E.derivative(): 0.05}, 2.0)
    assert world.time == 2.0
    assert world.state[F] == pytest.approx(0.6)
    assert world.state[E] == pytest.approx(0.0, abs=1e-6)
    world.apply({F.derivative(): 0.4}, 2.0)
    world.apply({E.derivative(): 0.1}, 1.0)
    assert world.state[E] == pytest.approx(0.1)


def test_speeds_and_positions_end_at_their_limits():
    world = MechanismWorld(make_lockbox_model(THESIS))
    world.apply({F.derivative(): 3.0}, 1.0)
    assert world.state[F] == pytest.approx(0.4, abs=1e-4)
    world.reset({F: 9.9})
    world.apply({F.derivative(): 0.4}, 1.0)
    assert world.state[F] == pytest.approx(10.0, abs=1e-4)
    assert world.time == 1.0


def test_jammed_part_does_not_move():
    world = MechanismWorld(make_lockbox_model(THESIS), ["lockbox/f"])
    world.apply({F.derivative(): 0.4}, 1.0)
    assert world.state[F] == 0.0
    assert world.time == 1.0


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 6))]
)
def test_random_motions_violate_no_constraint(seed):
    """Each part is moved as if nothing held it; the violations are those of the model, not of the world."""
    model, rng = make_lockbox_model(draw_tangled_lockbox(6, seed)), np.random.default_rng(seed)
    world, moved = MechanismWorld(model), 0
    for _ in range(120):
        before = world.state
        world.apply({v: rng.uniform(-0.6, 0.6) for v in model.speeds}, 0.2)
        after = world.state
        speeds = {s.derivative(): (after[s] - before[s]) / 0.2 for s in model.degrees_of_freedom}
        assert all(v.excess < 1e-5 for v in model.violations({**before, **speeds}))
        assert all(v.excess < 1e-5 for v in model.violations(after))
        moved += sum(abs(x) > 1e-3 for x in speeds.values())
    assert moved > 50


def test_coupled_coordinates_move_together():
    a, b = kv.position("a"), kv.position("b")
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("pair", 0, a - b, 0)
        edit.constrain("range", 0, a, 1)
    world = MechanismWorld(model)
    world.apply({a.derivative(): 0.5, b.derivative(): 0.5}, 1.0)
    assert (world.state[a], world.state[b]) == pytest.approx((0.5, 0.5))
    world.apply({a.derivative(): 0.5}, 1.0)
    assert world.state[a] == pytest.approx(0.5, abs=1e-4)


def test_run_is_recorded(tmp_path):
    world = MechanismWorld(make_lockbox_model(THESIS))
    with Recorder(tmp_path / "run.mcap", world.model) as recorder:
        world.apply({F.derivative(): 0.4}, 1.0)
        recorder.write_state(world.time, world.state)
        recorder.write_observation(world.time, world.observe())
    assert read_run_recording(tmp_path / "run.mcap").states.at(1.0)[F] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("speeds", "duration", "error", "text"),
    [
        ({"lockbox/x:velocity": 1.0}, 1.0, UnknownNameError, "no free speed"),
        ({"lockbox/f:velocity": float("nan")}, 1.0, InvalidValueError, "must be finite"),
        ({}, 0.0, InvalidValueError, "positive number of seconds"),
    ],
)
def test_bad_commands_are_refused(speeds, duration, error, text):
    world = MechanismWorld(make_lockbox_model(THESIS))
    with pytest.raises(error, match=text):
        world.apply(speeds, duration)
    assert world.time == 0.0


def test_unknown_jammed_part_is_refused():
    with pytest.raises(UnknownNameError, match="no symbol 'lockbox/x'"):
        MechanismWorld(make_lockbox_model(THESIS), ["lockbox/x"])
