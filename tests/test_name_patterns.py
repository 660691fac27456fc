"""Names and patterns in arguments: what they stand for, and what is said of those that match nothing."""

from __future__ import annotations

from collections.abc import Callable
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from kineverse._names import is_pattern, match_names
from kineverse.control import Controller, Goal, InverseKinematics
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.estimation import PlausibilityMonitor, calibrate
from kineverse.geometry import Scene
from kineverse.model.basic_operations import SetBody
from kineverse.model.model_view import find_symbols
from kineverse.planning import planning_space
from kineverse.reasoning import plan_unlocking
from kineverse.worlds import MechanismWorld, Robot, Sensors

NAMES = st.lists(st.text("ab/", min_size=1, max_size=5), unique=True)
PATTERNS = st.lists(st.text("ab/*?", min_size=1, max_size=4), max_size=3)


@given(NAMES, PATTERNS)
def test_patterns_stand_for_their_matches_in_order(names: list[str], patterns: list[str]) -> None:
    wanted = [[n for n in names if n == p or fnmatchcase(n, p)] for p in patterns]
    if not all(wanted):
        with pytest.raises(UnknownNameError):
            match_names(patterns, names, "name")
        return
    assert match_names(patterns, names, "name") == tuple(dict.fromkeys(n for some in wanted for n in some))


@pytest.mark.parametrize(
    ("given_names", "said"),
    [
        ("kitchn/*", "fixed=: no part matches 'kitchn/*'. Did you mean 'kitchen/*'?"),
        ("door*", "fixed=: no part matches 'door*'. Did you mean '*/door*'?"),
        (
            "kitchen/dor",
            "fixed=: there is no part 'kitchen/dor'. Did you mean 'kitchen/door' or 'kitchen/lamp'?",
        ),
        ("zzz*", "fixed=: no part matches 'zzz*'. Available: kitchen/door, kitchen/lamp."),
    ],
)
def test_what_matches_nothing_is_an_error_with_the_nearest(given_names: str, said: str) -> None:
    with pytest.raises(UnknownNameError) as error:
        match_names(given_names, ["kitchen/door", "kitchen/lamp"], "part", "fixed=")
    assert str(error.value) == said


@pytest.mark.parametrize("wrong", [5, None, [3.5], [True]])
def test_what_is_no_name_is_refused(wrong: Any) -> None:
    with pytest.raises(InvalidValueError):
        match_names(wrong, ["a"], "part")


def test_a_name_with_brackets_is_found_as_it_is() -> None:
    assert is_pattern("lamp[1]")
    assert match_names("lamp[1]", ["lamp[1]", "lamp1"], "part") == ("lamp[1]",)


@cache
def cupboard() -> kv.Model:
    """Return a cupboard with a door and a drawer, boxes both, and a lamp that turns."""
    model = kv.Model()
    box = kv.model.Shape(kv.model.Box((0.1, 0.1, 0.1)))
    with model.edit() as edit:
        edit.add_frame("cupboard", "world", kv.translation(1, 0, 0), body=kv.model.Body((box,), (box,)))
        parts = {"cupboard/door": "cupboard", "cupboard/drawer": "cupboard", "lamp/arm": "world"}
        for k, (name, parent) in enumerate(parts.items()):
            make = kv.Prismatic if "drawer" in name else kv.Revolute
            at = kv.translation(0.3 * k, 0.5, 0)
            edit.apply(
                make(name=name, parent=parent, child=name, origin=at, axis=(0, 0, 1), lower=0, upper=1)
            )
            edit.apply(kv.model.Override(SetBody(name, kv.model.Body((box,), (box,)))))
    return model


def _goal() -> Goal:
    parts = [kv.position(name) for name in ("lamp/arm", "cupboard/door", "cupboard/drawer")]
    return Goal(kv.array(parts), [0.5, 0.5, 0.5])


def _moved_speeds(fixed: list[str]) -> set[str]:
    model = cupboard()
    command = Controller(model, [_goal()], dt=0.1, fixed=fixed).step(model.default_state())
    return {str(s) for s in command.speeds}


# What takes names, with what it makes of 'cupboard/*', and the same of the two names.
TAKERS: dict[str, Callable[[list[str]], Any]] = {
    "find_symbols": lambda names: set(find_symbols(cupboard(), names)),
    "project fixed": lambda names: cupboard().project(cupboard().default_state(), fixed=names),
    "moved_frames": lambda names: kv.model.moved_frames(cupboard(), names),
    "count_moved_bodies": lambda names: kv.model.count_moved_bodies(cupboard(), names),
    "Scene.bodies_moved_by": lambda names: Scene(cupboard()).bodies_moved_by(names),
    "Scene.pairs_affected_by": lambda names: Scene(cupboard()).pairs_affected_by(names),
    "Scene leave_out": lambda names: set(Scene(cupboard(), leave_out=names).bodies),
    "Scene.watch": lambda names: Scene(cupboard()).watch(names, "lamp/*").pairs.tolist(),
    "Scene.watch moving": lambda names: Scene(cupboard()).watch(moving=names).pairs.tolist(),
    "InverseKinematics fixed": lambda names: (
        InverseKinematics(cupboard(), [_goal()], fixed=names).coordinates
    ),
    "Controller fixed": _moved_speeds,
    "plan_unlocking fixed": lambda names: set(
        plan_unlocking(cupboard(), {"lamp/arm": 0.5}, fixed=names).fixed
    ),
    "MechanismWorld jammed": lambda names: MechanismWorld(cupboard(), names).jammed,
    "Sensors marked": lambda names: set(
        Sensors(marked=tuple(names)).find_frames(Robot.of_mechanism(cupboard()))[1]
    ),
    "PlausibilityMonitor frames": lambda names: set(PlausibilityMonitor(cupboard(), names).frames),
}


@pytest.mark.parametrize("taker", TAKERS)
def test_a_pattern_is_as_good_as_its_names(taker: str) -> None:
    take = TAKERS[taker]
    assert take(["cupboard/*"]) == take(["cupboard/door", "cupboard/drawer"])


@pytest.mark.parametrize("taker", TAKERS)
@pytest.mark.parametrize("wrong", ["cupbaord/*", "cupboard/dor"])
def test_a_misspelt_one_leads_to_the_right_one(taker: str, wrong: str) -> None:
    with pytest.raises(UnknownNameError) as error:
        TAKERS[taker]([wrong])
    assert ("cupboard/*" if "*" in wrong else "cupboard/door") in str(error.value)


def test_a_planner_moves_what_a_pattern_names() -> None:
    moving = planning_space._find_moving(cupboard(), "cupboard/*")
    assert list(map(str, moving)) == ["cupboard/door", "cupboard/drawer"]
    with pytest.raises(UnknownNameError, match="Did you mean 'cupboard/\\*'"):
        planning_space._find_moving(cupboard(), ["cupbaord/*"])


def test_calibration_names_joints_by_patterns() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'cupboard/\\*'"):
        calibrate(cupboard(), [], "offsets cupbaord/*")


def test_files_leave_out_what_a_pattern_names(tmp_path: Any) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'cupboard/\\*'"):
        cupboard().save(tmp_path / "a.urdf", leave_out=["cupbaord/*"])
    cupboard().save(tmp_path / "a.urdf", leave_out="cupboard/*")


def test_listeners_follow_frames_of_a_pattern() -> None:
    model = cupboard().copy()
    heard: list[kv.model.Diff] = []
    model.listen(heard.append, frames=["cupboard/*"])
    with model.edit() as edit:
        edit.attach("lamp/arm", "world", kv.translation(0, 0, 1))
    assert not heard
    with model.edit() as edit:
        edit.add_frame("cupboard/shelf", "cupboard", kv.translation(0, 0, 1))
    assert heard[0].poses == ("cupboard/shelf",)
