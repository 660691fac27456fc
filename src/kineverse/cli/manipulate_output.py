"""Output of ``kineverse open``, ``close`` and ``push``: phases, result, figures."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.expressions.printing import format_number

from .manipulate_setup import ManipulationScene, is_shut
from .output import format_table, join_lines
from .view import list_mesh_problems, print_mesh_problems

if TYPE_CHECKING:
    from kineverse.manipulation.outcome import Outcome
    from kineverse.worlds import World
    from kineverse.worlds.recorder import RecordedStep


class PhaseLines:
    """Lines on standard error, one for each phase that begins."""

    def __init__(self, scene: ManipulationScene) -> None:
        self._scene, self._phase = scene, ""

    def __call__(self, session: RecordedStep) -> None:
        """Print the phase if it is another one."""
        if session.phase != self._phase:
            self._phase, scene = session.phase, self._scene
            value = f"{session.world.state[scene.coordinate]:.3f} {scene.unit}".rstrip()
            print(f"{session.world.time:7.2f} s  {self._phase:<12}  {value}", file=sys.stderr, flush=True)


def report_outcome(
    arguments: argparse.Namespace, skill: str, scene: ManipulationScene, world: World, outcome: Outcome
) -> None:
    """Print the result of a skill, and write a picture if wanted."""
    if arguments.picture is not None:
        from kineverse.view import save_picture

        save_picture(arguments.picture, scene.model, {str(s): v for s, v in world.state.items()})
        print_mesh_problems(list_mesh_problems(scene.model))
        print(f"picture: {arguments.picture}", file=sys.stderr)
    if arguments.json:
        answer = {
            "claimed": outcome.claimed,
            "done": outcome.done,
            "value": outcome.value,
            "reason": outcome.reason,
            "world": outcome.world,
            "seconds": outcome.seconds,
            "steps": outcome.steps,
            "skill": skill,
            "robot": scene.robot,
            "what": str(scene.coordinate),
            "start": scene.start[scene.coordinate],
            "target": None if arguments.unknown and arguments.to is None else scene.target,
            "hand": None if scene.gripper is None else scene.gripper.hand,
            "measures": outcome.measures,
            "remarks": world.remarks,
        }
        print(json.dumps(_plain(answer), allow_nan=False))
        return
    at = f"{format_number(outcome.value, 4)} {scene.unit}".rstrip()
    if not outcome:
        verdict = f"not done, at {at}. {outcome.reason}"
    else:
        state = "shut" if is_shut(scene) else "done"
        verdict = f"{state} at {at}, after {format_number(outcome.seconds, 4)} s in the {world.name} world"
    print(f"{scene.coordinate}: {join_lines(verdict)}")
    if "family" in outcome.measures:
        if outcome:
            print(outcome.reason)
        print(f"learned joint: {_describe_joint(outcome.measures)}")
    if outcome.steps:
        rows = [("steps", str(outcome.steps))]
        rows += [(name, _format_measure(value)) for name, value in _plain(outcome.measures).items()]
        print(format_table(("measure", "value"), rows))
    if arguments.record is not None:
        print(f"recording: {arguments.record}")


def _describe_joint(measures: Mapping[str, Any]) -> str:
    """Return a learned joint in words: family, axis, and a point on it."""
    words = str(measures["family"])
    for key, link in (("axis", "axis"), ("point", "through")):
        if key in measures:
            words += f", {link} [{', '.join(f'{v:.3f}' for v in np.ravel(measures[key]))}]"
    certain = f"certain after {100 * measures['decided_way']:.1f} cm"
    return f"{words} in {measures['parent']}, {certain} and {math.degrees(measures['decided_turn']):.1f}°"


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: what is not finite is null, and what is unknown is its text."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def _format_measure(value: Any) -> str:
    if isinstance(value, float):
        return format_number(value, 4)
    if isinstance(value, list) and all(isinstance(one, str) for one in value):
        return ", ".join(filter(None, value)) or "-"
    if isinstance(value, (list, dict)):
        return f"{len(value)}, see --json"
    return "-" if value is None else str(value)
