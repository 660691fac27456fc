"""Plans are executed by the controller, checked along the way, and made again without parts that are stuck."""

import json

import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import THESIS, draw_tangled_lockbox, make_lockbox_model, make_rings
from kineverse.manipulation import PartMover, Session, execute_unlocking
from kineverse.worlds import MechanismWorld, RunMetrics
from kineverse_studies.experiments.lockbox.unknown_locks import can_be_opened
from robot_interface_proxy import InterfaceOnly
from sliders import A, B, C, goal_of, three_sliders


def execute(world, goal, dt=0.05, **options):
    """Execute a plan through the interface alone, and return its result with what is measured in the world."""
    metrics = RunMetrics(world)
    session = Session(InterfaceOnly(world), dt=dt, on_step=metrics)
    return execute_unlocking(session, goal, **options), metrics


def test_thesis_box_is_opened_in_order():
    world = MechanismWorld(make_lockbox_model(THESIS))
    done, metrics = execute(world, goal_of(THESIS))
    assert done
    assert [str(move.step.coordinate)[-1] for move in done.moves] == list("fedbca")
    assert world.state[kv.position("lockbox/a")] == pytest.approx(1.2, abs=2e-4)
    assert (done.plans, done.stuck) == (1, ())
    assert metrics.violation < 1e-6
    assert str(done).splitlines()[0] == "1. lockbox/f moved to 1.25 in 3.5 s: it holds lockbox/e"
    assert str(done).splitlines()[-1] == "the goal is reached"


@pytest.mark.parametrize("seed", range(8))
def test_random_boxes_are_opened_without_violations(seed):
    """Boxes with negations and circles: those that exhaustive search can open are opened, and no others."""
    box = draw_tangled_lockbox(5, 300 + seed)
    done, metrics = execute(MechanismWorld(make_lockbox_model(box)), goal_of(box))
    assert bool(done) == can_be_opened(box)
    assert all(move.done for move in done.moves)
    assert metrics.violation < 1e-6


def test_keys_return():
    box = make_rings(3)
    done, _ = execute(MechanismWorld(make_lockbox_model(box)), goal_of(box))
    assert done
    assert len(done.moves) == 5


def test_a_move_that_ends_early_stops():
    world = MechanismWorld(three_sliders(a=B > 0.5), [B])
    mover, commands = PartMover(world.model, session := Session(world, dt=0.05)), []
    assert mover.move(B, 1.0) == pytest.approx(0.0)
    assert not session.commands

    def interrupt(step):
        commands.append(dict(step.commands))
        if len(commands) == 3:
            raise KeyboardInterrupt

    mover = PartMover(world.model, Session(world, dt=0.05, on_step=interrupt))
    with pytest.raises(KeyboardInterrupt):
        mover.move(C, 1.0)
    assert all(commands[:3])
    assert commands[3:] == [{}]


def test_jammed_part_is_left_out_of_the_next_plan():
    model = three_sliders(a=(B > 0.5) | (C > 0.5))
    for jammed, other in ((B, C), (C, B)):
        world = MechanismWorld(model, [jammed])
        done, _ = execute(world, {A: 1})
        assert done
        assert done.stuck in ((), (jammed,))
        assert done.plans == 1 + len(done.stuck)
        assert [move.step.coordinate for move in done.moves if move.done] == [other, A]
        assert world.state[jammed] == 0.0


def test_jammed_part_without_another_way_leaves_no_plan():
    world = MechanismWorld(make_lockbox_model(THESIS), ["lockbox/d"])
    done, _ = execute(world, goal_of(THESIS))
    assert not done
    assert [str(s) for s in done.stuck] == ["lockbox/d"]
    assert done.plan.verdict == "refuted"
    assert "cannot be reached without lockbox/d" in str(done)
    assert "lockbox/d stopped at 0 on its way to 0.85" in str(done)
    assert world.time < 60.0


def test_part_that_the_model_takes_for_free_is_found_stuck():
    """The world has a lock that the model lacks."""
    true, believed = three_sliders(a=(B > 0.5) | (C > 0.5), b=C < -1), three_sliders(a=(B > 0.5) | (C > 0.5))
    done, _ = execute(MechanismWorld(true), {A: 1}, model=believed)
    assert done
    assert done.moves[-1].step.coordinate == A
    assert set(done.stuck) <= {B}


class DraggingWorld(MechanismWorld):
    """World in which one part moves along with all others, locked or not."""

    def apply(self, speeds, duration, *, stamp=None):
        super().apply(speeds, duration)
        self._q[self._symbols.index(A)] += 0.01


def test_violation_of_a_lock_in_the_world_is_reported():
    _, metrics = execute(DraggingWorld(three_sliders(a=B > 0.5)), {B: 1})
    assert metrics.limit == "lock a"
    assert metrics.violation > 0.1


def test_goal_that_is_reached_needs_no_move():
    done, _ = execute(MechanismWorld(three_sliders(a=B > 0.5)), {A: 0})
    assert done
    assert (done.moves, done.seconds) == ((), 0.0)


def test_execution_is_data_for_json():
    done, _ = execute(MechanismWorld(three_sliders(a=B > 0.5)), {A: 1})
    data = json.loads(json.dumps(done.as_data(), allow_nan=False))
    assert data["done"]
    assert [move["coordinate"] for move in data["moves"]] == ["b", "a"]


@pytest.mark.parametrize(
    ("goal", "options", "error", "text"),
    [
        ({"d": 1}, {}, UnknownNameError, "'d' is no degree of freedom"),
        ({"a": 1}, {"patience": 0}, InvalidValueError, "patience of a moved part"),
        ({"a": 1}, {"speed": float("nan")}, InvalidValueError, "speed of a moved part"),
        ({"a": 1}, {"dt": 0}, InvalidValueError, "dt="),
    ],
)
def test_bad_input_is_refused(goal, options, error, text):
    with pytest.raises(error, match=text):
        execute(MechanismWorld(three_sliders(a=B > 0.5)), goal, **options)
