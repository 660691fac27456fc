"""Contents of a recorded run at a time, to be drawn."""

from __future__ import annotations

import numpy as np

from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.view.poses import complete
from kineverse.view.run_drawing import RunDrawing, RunMoment, find_arrows, format_contact_lines
from kineverse.view.triangle_mesh import Floats
from kineverse.worlds import RunRecording


class RecordedScene:
    """Contents of a recorded run at a time."""

    def __init__(self, recording: RunRecording) -> None:
        self.recording = recording
        self.trajectory = as_trajectory(recording)
        self.drawing = RunDrawing(recording.model)

    def values_at(self, time: float) -> dict[str, float]:
        """Return the true values of all symbols by name at a time [s]."""
        return self.drawing.values(self.recording.states.at(time))

    def at(self, time: float) -> RunMoment:
        """Return the things to draw at a time [s]."""
        arrows = find_arrows(self.recording.vectors.last(time) or {})
        return RunMoment(self._ghosts(time), arrows, self._describe(time))

    def _ghosts(self, time: float) -> dict[str, Floats]:
        beliefs = self.recording.beliefs
        if not len(beliefs) or time < beliefs.times[0]:
            return {}
        poses = self.recording.belief_poses.last(time)
        return self.drawing.find_ghosts(self.recording.states.at(time), beliefs.at(time), poses)

    def _describe(self, time: float) -> list[str]:
        """Return lines about a time [s]: phase, contacts, and at the end the outcome."""
        phase = self.recording.phases.last(time)
        lines = [f"phase: {phase}"] if phase else []
        lines += format_contact_lines(self.recording.contacts.last(time) or ())
        outcome = self.recording.outcome
        if outcome is not None and time >= self.recording.duration - 1e-9:
            lines.append(f"{'done' if outcome.get('done') else 'not done'}: {outcome.get('reason', '')}")
        return lines


def as_trajectory(recording: RunRecording) -> Trajectory | None:
    """Return the true states of a run as a trajectory with the same times; None without any.

    Before the first state it stands still. Velocities are differences of the neighbours.
    """
    states = recording.states
    if not len(states):
        return None
    columns = [k for k, s in enumerate(states.symbols) if s.role == "dof" and not s.order]
    times, positions = states.times, states.values[:, columns]
    symbols = tuple(states.symbols[k] for k in columns)
    defaults = complete(recording.model)
    before = np.array([defaults.get(str(symbol), 0.0) for symbol in symbols])
    for k, row in enumerate(positions):
        positions[k] = before = np.where(np.isnan(row), before, row)
    if times[0] > 0.0:
        times = np.concatenate([[0.0], times])
        positions = np.concatenate([positions[:1], positions])
    velocities = np.gradient(positions, times, axis=0) if len(times) > 1 else np.zeros_like(positions)
    return Trajectory(symbols, times, positions, velocities)
