"""Listeners to what is read of a model, poses and constraints, and values that follow it in the background."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.model import Edit

x, y, s = kv.position("x"), kv.position("y"), kv.position("s")
SHIFT = kv.translation(0, 0, 1)


def arm() -> kv.Model:
    """Return a base, an arm that turns on it, a hand on the arm, and a lamp on the base."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("base", "world", tag="base")
        edit.add_frame("arm", "base", kv.rotation_z(x), tag="arm")
        edit.add_frame("hand", "arm", kv.translation(1, 0, 0), tag="hand")
        edit.add_frame("lamp", "base", kv.translation(y, 0, 0), tag="lamp")
        edit.constrain("limit", -1, y, 1, tag="limit")
    return model


def moved(edit: Edit, tag: str, parent: str, transform: Any) -> None:
    edit.replace(tag, kv.model.AddFrame(tag, kv.model.Frame.from_transform(parent, transform)))


Heard = tuple[tuple[str, ...], tuple[str, ...]]
CHANGES: dict[str, tuple[Callable[[Edit], object], Heard | None, bool]] = {
    "the frame itself": (lambda e: moved(e, "hand", "arm", SHIFT), (("hand",), ("frames/hand",)), False),
    "a joint above": (lambda e: moved(e, "arm", "base", SHIFT), (("hand",), ("frames/arm",)), False),
    "the base": (lambda e: moved(e, "base", "world", SHIFT), (("hand",), ("frames/base",)), False),
    "a sibling": (lambda e: moved(e, "lamp", "base", SHIFT), None, False),
    "an equal joint": (lambda e: moved(e, "arm", "base", [kv.rotation_z(x), np.eye(4)]), None, False),
    "another parent at the same place": (lambda e: moved(e, "arm", "world", kv.rotation_z(x)), None, False),
    "an attached ancestor": (
        lambda e: e.attach("arm", "lamp", kv.rotation_z(x)),
        (("hand",), ("frames/arm",)),
        False,
    ),
    "a constraint": (lambda e: e.constrain("new", 0, x, 1), None, False),
    "a constraint on y": (lambda e: e.constrain("new", 0, y, 1), None, True),
    "the end of a constraint on y": (lambda e: e.remove("limit"), None, True),
    "its rate": (lambda e: e.set_rate(x, {s.derivative(): 2.0}), (("hand",), ("rates/x",)), False),
    "its rate from y": (lambda e: e.set_rate(x, {y.derivative(): 2.0}), (("hand",), ("rates/x",)), True),
    "a rate of a sibling": (lambda e: e.set_rate(y, {s.derivative(): 2.0}), None, True),
    "a rate of others": (lambda e: e.set_rate(s, {kv.velocity("t"): 2.0}), None, False),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_listener_to_frames_and_symbols_hears_what_concerns_them_and_nothing_else(what: str) -> None:
    change, expected, is_about_y = CHANGES[what]
    model = arm()
    heard: list[kv.model.Diff] = []
    about: list[kv.model.Diff] = []
    model.listen(heard.append, frames="hand")
    model.listen(about.append, symbols=[y])
    before = model.fk("hand")
    with model.edit() as edit:
        change(edit)
    assert [(diff.poses, diff.paths) for diff in heard] == ([expected] if expected else [])
    assert (model.fk("hand") != before) == (expected is not None)
    assert bool(about) == is_about_y
    with model.edit() as edit:
        edit.undo(2)
    assert [(diff.poses, diff.paths) for diff in heard[1:]] == ([expected] if expected else [])


def test_what_carries_a_coordinate_is_heard_of_as_the_coordinate_is() -> None:
    model = arm()
    with model.edit() as edit:  # x follows s, and s is driven by a wheel
        edit.apply(Follows("x", 2 * s), "x")
        edit.set_rate(s, {kv.velocity("wheel"): 0.1}, tag="rate")
    heard: list[kv.model.Diff] = []
    about: list[kv.model.Diff] = []
    model.listen(heard.append, frames=["lamp", "hand"], tags=["limit"])
    model.listen(about.append, symbols=[s])
    with model.edit() as edit:
        edit.replace("rate", kv.model.SetRate(s, ((kv.velocity("wheel"), kv.array(0.2)),)))
    with model.edit() as edit:
        edit.constrain("far", -3, x, 3)
    with model.edit() as edit:
        edit.remove("limit")
    assert [(d.poses, d.paths, d.removed) for d in heard] == [
        (("hand",), ("rates/s",), ()),
        ((), (), ("limit",)),
    ]
    assert [d.paths for d in about] == [("rates/s",), ("constraints/far",)]
    with model.edit() as edit:
        edit.remove("hand")
        edit.apply(Follows("y", 1 * s), "y")
    assert heard[-1].poses == ("lamp", "hand")
    model, about = arm(), []
    model.listen(heard.append, frames=["hand"])
    model.listen(about.append, symbols=[y])
    with model.edit() as edit:  # x is driven by the speed of y, and that by a wheel
        edit.set_rate(x, {y.derivative(): 2.0})
    for number in range(2):
        with model.edit() as edit:
            edit.set_rate(y, {kv.velocity("wheel"): 1.0 + number}, override=True, tag=f"y{number}")
            edit.constrain(f"x{number}", 0, x, 1)
    assert [d.poses for d in heard[-3:]] == [("hand",)] * 3
    assert [d.paths for d in about] == [("rates/x",), ("rates/y",), ("rates/y",)]
    followed: list[kv.model.Diff] = []
    model.listen(followed.append, symbols=[x])
    with model.edit() as edit:  # what carries x, too: the speed of y, and what y is driven by
        edit.set_rate(y, {kv.velocity("wheel"): 3.0}, override=True, tag="y2")
    with model.edit() as edit:
        edit.apply(Follows("t", kv.position("u") * 2), "t")
        edit.apply(Follows("x", kv.position("t") * 1), "x")
    with model.edit() as edit:  # x now depends on t and u
        edit.constrain("u", 0, kv.position("u"), 1)
    assert "u" in model.constraints_for([x])
    assert [d.paths for d in followed] == [("rates/y",), ("rates/t", "rates/x"), ("constraints/u",)]
    for name in ("paths", "tags", "frames", "symbols"):
        for wrong in (3, [3], [["a"]]):
            with pytest.raises(kv.KineverseError):
                model.listen(print, **{name: wrong})  # type: ignore[arg-type]


class Follows(kv.Operation):
    overrides = True

    def __init__(self, name: str, expression: kv.Expression) -> None:
        self.name, self.expression = name, expression

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(rates={kv.position(self.name): self.expression})


def shift(model: kv.Model, z: float) -> None:
    with model.edit() as edit:
        moved(edit, "base", "world", kv.translation(0, 0, z))


def height(model: kv.model.Snapshot) -> float:
    return float(model.fk("hand")({"x": 0})[2, 3])


def test_a_follower_is_built_anew_when_what_it_reads_changes() -> None:
    model, threads = arm(), []

    def build(snapshot: kv.model.Snapshot) -> kv.compilation.CompiledFunction:
        threads.append(threading.current_thread())
        return kv.compile(snapshot.fk("hand"))

    with kv.follow(model, build, frames=["hand"]) as follower:
        first = follower.value
        assert (follower.version, threads) == (1, [threading.main_thread()])
        with model.edit() as edit:
            moved(edit, "lamp", "base", SHIFT)
        assert follower.wait(timeout=60)
        assert follower.value is first
        shift(model, 2)
        assert follower.wait(3, timeout=60)
        assert follower.current == (follower.value, 3)
        assert follower.value({"x": 0})[2, 3] == 2
        assert first({"x": 0})[2, 3] == 0
        assert threads[1:] != [threading.main_thread()]
        assert not follower.wait(4, timeout=0)
    shift(model, 3)
    assert (follower.version, follower.wait(timeout=60)) == (3, False)
    follower.close()


def test_a_follower_ends_at_the_newest_of_many_versions() -> None:
    model, builds = arm(), []

    def build(snapshot: kv.model.Snapshot) -> float:
        builds.append(snapshot.version)
        return height(snapshot)

    with kv.follow(model, build) as follower:
        writers = [threading.Thread(target=lambda: [shift(model, k) for k in range(1, 60)]) for _ in range(2)]
        for writer in writers:
            writer.start()
        for writer in writers:
            writer.join()
        shift(model, 99)
        assert follower.wait(timeout=60)
        assert follower.current == (99, model.version) == (99, 120)
        assert builds == sorted(set(builds))


def cannot_start(thread: threading.Thread) -> None:
    raise RuntimeError("no thread")


def test_a_builder_that_fails_keeps_the_old_value_until_one_succeeds(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = arm()

    def build(snapshot: kv.model.Snapshot) -> float:
        if height(snapshot) > 5:
            raise (SystemExit if height(snapshot) == 9 else ValueError)("too high")
        return height(snapshot)

    with kv.follow(model, build, paths="frames", symbols=[x]) as follower, caplog.at_level(logging.ERROR):
        shift(model, 6)
        assert not follower.wait(timeout=60)
        assert (follower.value, follower.version, str(follower.error)) == (0, 1, "too high")
        assert "too high" in caplog.text
        shift(model, 9)
        assert not follower.wait(timeout=60)
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", cannot_start)
            shift(model, 3)
        assert not follower.wait(timeout=60)
        assert (follower.version, str(follower.error)) == (1, "no thread")
        shift(model, 4)
        assert follower.wait(timeout=60)
        assert (follower.value, follower.version, follower.error) == (4, 5, None)
        for arguments in ({"version": "a"}, {"version": 1.5}, {"timeout": float("nan")}, {"timeout": "a"}):
            with pytest.raises(kv.errors.InvalidValueError):
                follower.wait(**arguments)  # type: ignore[arg-type]
    shift(model, 7)
    with pytest.raises(ValueError, match="too high"):
        kv.follow(model, build)
    assert model._listeners.witnesses == []
    for wrong in (lambda: kv.follow(model.snapshot(), build), lambda: kv.follow(model, 3)):
        with pytest.raises(kv.errors.ExpressionError):
            wrong()


def test_an_earlier_version_is_not_waited_for_longer_and_a_closed_follower_keeps_its_value() -> None:
    model, go_on = arm(), threading.Event()

    def build(snapshot: kv.model.Snapshot) -> float:
        if snapshot.version > 2:
            go_on.wait(60)
        return height(snapshot)

    follower = kv.follow(model, build)
    shift(model, 1)
    assert follower.wait(timeout=60)
    shift(model, 2)
    assert follower.wait(2, timeout=0)
    assert not follower.wait(timeout=0.01)
    follower.close()
    workers = [one for one in threading.enumerate() if one.name == "kineverse-follow"]
    go_on.set()
    for worker in workers:
        worker.join()
    assert (len(workers), follower.current) == (1, (1, 2))


AT_EXIT = """
import kineverse as kv, time
model = kv.Model()
def build(snapshot):
    if snapshot.version:
        print("building", flush=True)
        time.sleep(600)
follower = kv.follow(model, build)
with model.edit() as edit:
    edit.write("a", 1)
follower.wait(timeout=0.2)
"""


def test_a_program_ends_while_a_value_is_built() -> None:
    done = subprocess.run([sys.executable, "-c", AT_EXIT], capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr, done.returncode) == ("building\n", "", 0)


def test_a_controller_a_tracker_and_a_scene_are_built_from_what_a_follower_passes() -> None:
    model = arm()

    def build(snapshot: kv.model.Snapshot) -> tuple[kv.control.Controller, kv.estimation.Tracker, Any]:
        goal = kv.control.Goal(snapshot.fk("hand")[1, 3], 0.0)
        controller = kv.control.Controller(snapshot, [goal], dt=0.02, fixed=[y])
        return controller, kv.estimation.Tracker(snapshot, ["hand"]), kv.geometry.Scene(snapshot)

    with kv.follow(model, build, frames=["hand"], symbols=[x]) as follower:
        assert abs(follower.value[0].step({x: 0.0, y: 0.0}).speeds[x.derivative()]) < 1e-6
        with model.edit() as edit:
            moved(edit, "arm", "base", kv.rotation_z(x + 0.5))
        assert follower.wait(timeout=60), follower.error
        controller, tracker, _ = follower.value
        assert controller.step({x: 0.0, y: 0.0}).speeds[x.derivative()] < 0
        assert tracker.symbols == (x,)
