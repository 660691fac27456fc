"""Plot of a recorded run: coordinates, speeds and contacts over time, with its phases as bands."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.lie import Array
from kineverse.model.frame import is_of_robot

from .recording import RunRecording, ValuesOverTime, read_run_recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_BANDS = ("#e8eef7", "#ffffff", "#f7efe2", "#ffffff")
_MOST = 10  # most lines of one plot; those that change most are shown

_STILL = 1e-6


def plot_recording(recording: RunRecording | str | os.PathLike[str], figure: Canvas) -> None:
    """Draw a recorded run on an empty figure.

    The plots are: coordinates of the objects in truth, and dashed as they are believed; commanded speeds;
    contacts between bodies. Without a truth all are as believed. Bands are the phases. Without a robot's name
    in ``about``, a coordinate counts as the robot's if a speed was commanded below the same prefix.
    """
    if not isinstance(recording, RunRecording):
        recording = read_run_recording(recording)
    above, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
    robots = _robots(recording)
    objects = [
        str(s)
        for s in recording.motion.symbols
        if s.role == "dof" and not s.order and not any(is_of_robot(s.path, robot) for robot in robots)
    ]
    _draw_values(above, recording.motion, objects, recording.beliefs)
    above.set_ylabel("object [rad], [m]")
    _draw_values(middle, recording.commands, list(map(str, recording.commands.symbols)))
    middle.set_ylabel("speed [rad/s], [m/s]")
    _draw_contacts(below, recording)
    for axes in (above, middle, below):
        _draw_phases(axes, recording, labels=axes is above)
    below.set_xlabel("time [s]")
    below.set_xlim(0.0, max(recording.duration, 1e-3))


def _robots(recording: RunRecording) -> list[str]:
    robot = recording.about.get("robot")
    return [robot] if robot else sorted({s.path.partition("/")[0] for s in recording.commands.symbols})


def _draw_values(
    axes: Axes, values: ValuesOverTime, names: list[str], beliefs: ValuesOverTime | None = None
) -> None:
    """Draw coordinates that change, or speeds that are not zero; the largest ones first."""
    sizes: dict[str, float] = {}
    for name in names:
        known = values[name][np.isfinite(values[name])]
        if known.size:
            sizes[name] = float(np.ptp(known) if beliefs is not None else np.abs(known).max())
    moving = [name for name in sizes if sizes[name] > _STILL]
    shown = sorted(moving, key=lambda name: -sizes[name])[:_MOST]
    believed = set(map(str, beliefs.symbols)) if beliefs is not None else set()
    for name in shown:
        (drawn,) = axes.plot(values.times, values[name], linewidth=1.2, label=name.removesuffix(":velocity"))
        if beliefs is not None and name in believed:
            axes.plot(beliefs.times, beliefs[name], "--", linewidth=0.8, color=drawn.get_color())
    if shown:
        axes.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    if len(moving) > _MOST:
        note = f"{_MOST} of {len(moving)}"
        axes.text(1.0, 1.0, note, transform=axes.transAxes, fontsize="x-small", ha="right", va="bottom")


def _draw_contacts(axes: Axes, recording: RunRecording) -> None:
    pairs: dict[str, list[float]] = {}
    for time, contacts in zip(recording.contacts.times, recording.contacts.entries, strict=True):
        for label in {f"{one.a} – {one.b}" for one in contacts}:
            pairs.setdefault(label, []).append(float(time))
    longest = sorted(pairs, key=lambda label: (-len(pairs[label]), label))[:_MOST]
    for k, label in enumerate(longest):
        axes.plot(pairs[label], np.full(len(pairs[label]), float(k)), "|", markersize=6)
        axes.text(
            0.005, k - 0.25, label, transform=axes.get_yaxis_transform(), fontsize="x-small", va="bottom"
        )
    axes.set_yticks([])
    axes.set_ylim(max(len(longest), 1) - 0.5, -1.0)
    axes.set_ylabel("contacts")
    if len(pairs) > _MOST:
        note = f"{_MOST} of {len(pairs)}"
        axes.text(1.0, 1.0, note, transform=axes.transAxes, fontsize="x-small", ha="right", va="bottom")


def _draw_phases(axes: Axes, recording: RunRecording, labels: bool) -> None:
    times: Array = np.append(recording.phases.times, recording.duration)
    phase: Any
    for k, phase in enumerate(recording.phases.entries):
        axes.axvspan(times[k], times[k + 1], color=_BANDS[k % len(_BANDS)], zorder=0, linewidth=0)
        if labels and phase:
            place = axes.get_xaxis_transform()
            axes.text(
                times[k], 1.01, f" {phase}", transform=place, fontsize="x-small", va="bottom", rotation=30
            )
