"""Openings of lockboxes by a controller, with each rule of trends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import and_, mul
from time import thread_time
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from kineverse.control import Controller, unlock
from kineverse.gallery.lockboxes import Lockbox, make_lockbox_model
from kineverse.symbols import position
from kineverse.worlds import Recorder
from kineverse_studies.experiments.report import ReportTable, format_yes, make_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Rule: TypeAlias = Literal["and", "product", "none", "undemanded"]
RULES: Mapping[Rule, str] = {
    "and": "trends of & and |",
    "product": "product rule",
    "none": "exact gradients alone",
}
"""Rules of trends, with their names in tables."""
LOCK_RULES: Mapping[Rule, str] = {**RULES, "undemanded": "trends without demand"}
"""Rules for locks: also the pursuit of all locks, whether or not something needs them."""
DT, STEPS = 0.19, 200  # control period [s] and largest number of steps (thesis)
_REACHED = 0.01
_BEGUN = 0.1


@dataclass(frozen=True, slots=True)
class UnlockingRun:
    done: bool  # whether the goal was reached, and the number of steps
    steps: int
    order: tuple[str, ...]
    cpu: tuple[float, ...]  # CPU times of the steps [s]

    def as_data(self) -> dict[str, Any]:
        return {"done": self.done, "steps": self.steps, "order": list(self.order)}


def run_unlocking(
    box: Lockbox, rule: Rule = "and", steps: int = STEPS, recorder: Recorder | None = None
) -> UnlockingRun:
    """Open a box by the tasks of :func:`kineverse.control.unlock`."""
    model = make_lockbox_model(box, None, mul if rule == "product" else and_)
    q = {name: position(name) for name in box.parts}
    tasks = unlock(model, box.goal, demand=rule not in ("product", "undemanded"))
    if rule == "none":
        tasks = tasks[: len(box.goal)]
    controller = Controller(model, tasks, dt=DT, smooth=1e-3, posture=0.0, tier="interpreter")
    state = model.default_state()
    order: dict[str, None] = {}
    cpu: list[float] = []
    for step in range(steps):
        if all(abs(state[q[name]] - value) <= _REACHED for name, value in box.goal.items()):
            return UnlockingRun(True, step, tuple(order), tuple(cpu))
        begin = thread_time()
        command = controller.step(state)
        cpu.append(thread_time() - begin)
        state = model.integrate(state, command.speeds, DT)
        if recorder is not None:
            recorder.write_state((step + 1) * DT, state)
            recorder.write_command((step + 1) * DT, command.speeds)
        begun = (name for name, part in box.parts.items() if state[q[name]] > _BEGUN * min(part.upper, 1.2))
        order.update(dict.fromkeys(begun))
    return UnlockingRun(False, steps, tuple(order), tuple(cpu))


FIGURE_SIZE = (9.0, 3.5)
_COLORS: Mapping[Rule, str] = {
    "and": "tab:blue",
    "product": "tab:orange",
    "none": "0.5",
    "undemanded": "tab:green",
}


def draw_boxes(canvas: Canvas, boxes: Mapping[tuple[Rule, int], Sequence[UnlockingRun]]) -> None:
    """Draw the share of opened boxes over the number of steps, a panel for each number of parts."""
    longest = 1.1 * max((run.steps for own in boxes.values() for run in own if run.done), default=1)
    parts = list(dict.fromkeys(count for _, count in boxes))
    panels = np.atleast_1d(canvas.subplots(1, len(parts), sharey=True))
    for axes, count in zip(panels, parts, strict=True):
        for rule, name in LOCK_RULES.items():
            own = boxes.get((rule, count))
            if not own:
                continue
            steps = sorted(run.steps for run in own if run.done)
            share = np.arange(len(steps) + 1) / len(own)
            # Later curves are thinner, so that all are seen where they agree.
            style = {"color": _COLORS[rule], "linewidth": 4.0 - len(axes.lines), "label": name}
            axes.step([0, *steps, longest], [*share, share[-1]], where="post", **style)
        axes.set_title(f"boxes of {count} parts")
        axes.set_xlabel("steps")
        axes.set_ylim(-0.02, 1.02)
    panels[0].set_ylabel("share opened")
    canvas.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)


def make_thesis_table(title: str, order: str, runs: Mapping[Rule, UnlockingRun]) -> ReportTable:
    return make_table(
        title,
        runs.items(),
        {
            "trends": lambda pair: LOCK_RULES[pair[0]],
            "opened": lambda pair: format_yes(pair[1].done),
            "steps": lambda pair: pair[1].steps,
            order: lambda pair: ", ".join(pair[1].order),
        },
    )
