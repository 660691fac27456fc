"""Contents of a recorded run at a time: true state, belief as a ghost, vectors of the controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from kineverse.lie import rotation_angle
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.view.drawables import Drawable, Rgba, collect_drawables
from kineverse.view.poses import FramePoses, complete, keep_known
from kineverse.view.proximity import build_arrow
from kineverse.view.triangle_mesh import Floats
from kineverse.worlds import RunRecording

GHOST: Rgba = (0.16, 0.47, 0.86, 0.35)
"""Colour of the belief."""

ARROWS: tuple[Rgba, ...] = (
    (0.86, 0.16, 0.16, 1.0),
    (0.13, 0.55, 0.20, 1.0),
    (0.16, 0.33, 0.88, 1.0),
    (0.80, 0.45, 0.05, 1.0),
    (0.55, 0.20, 0.70, 1.0),
    (0.05, 0.55, 0.60, 1.0),
)
"""Colours of arrows, by the order of their names in the recording."""

ARROW_SCALE, LONGEST_ARROW = 0.25, 0.6
"""Length of the arrow of a vector of 1, and the largest length of an arrow [m]."""

_APART, _TURNED = 1e-3, 2e-3
"""Least difference of a belief that is shown [m], [rad]; below, the ghost would flicker on the body."""

_WORLD = "world"


class RecordedScene:
    """Contents of a recorded run at a time.

    Parameters
    ----------
    recording
        The run.

    Attributes
    ----------
    recording
        The run.
    trajectory
        Its true states as a trajectory with the same times; None without any.
    parts
        Visual shapes of the bodies that move.
    """

    def __init__(self, recording: RunRecording) -> None:
        self.recording = recording
        self.trajectory = as_trajectory(recording)
        model = recording.model
        self.parts = [part for part in collect_drawables(model) if model.fk(part.frame).symbols]
        self._kinematics = FramePoses(model, dict.fromkeys(part.frame for part in self.parts))
        names = dict.fromkeys(name for entry in recording.vectors.entries for name in entry)
        self._colors = {name: ARROWS[k % len(ARROWS)] for k, name in enumerate(names)}

    def values_at(self, time: float) -> dict[str, float]:
        """Return the true values of all symbols by name at a time [s]."""
        recorded = {str(s): v for s, v in self.recording.states.at(time).items()}
        return complete(self.recording.model, keep_known(self.recording.model, recorded))

    def ghost_poses(self, time: float) -> dict[str, Floats]:
        """Return the believed world poses (4, 4) of those bodies that are elsewhere in truth, by frame."""
        beliefs = self.recording.beliefs
        if not len(beliefs) or time < beliefs.times[0]:
            return {}
        truth = self.values_at(time)
        believed = {str(s): v for s, v in beliefs.at(time).items()}
        true_poses = self._kinematics.evaluate(truth)
        poses = self._kinematics.evaluate(truth | keep_known(self.recording.model, believed))
        for frame, pose in (self.recording.belief_poses.last(time) or {}).items():
            if frame in self._kinematics.names:
                poses[self._kinematics.index(frame)] = pose
        apart = np.linalg.norm(poses[:, :3, 3] - true_poses[:, :3, 3], axis=1)
        turned = rotation_angle(np.swapaxes(true_poses[:, :3, :3], 1, 2) @ poses[:, :3, :3])
        different = np.isfinite(poses).all(axis=(1, 2)) & ((apart > _APART) | (turned > _TURNED))
        return {self._kinematics.names[k]: poses[k] for k in np.flatnonzero(different).tolist()}

    def arrows(self, time: float) -> dict[str, Floats]:
        """Return the ends (2, 3) of the arrows of the controller's vectors in the world, by name [m]."""
        vectors: Mapping[str, tuple[Floats, Floats]] = self.recording.vectors.last(time) or {}
        found = {}
        for name, (origin, vector) in vectors.items():
            length = float(np.linalg.norm(vector))
            if length > 0.0:
                drawn = min(ARROW_SCALE * length, LONGEST_ARROW) / length * vector
                found[name] = np.array([origin, origin + drawn])
        return found

    def arrow_color(self, name: str) -> Rgba:
        """Return the colour of the arrow of a vector."""
        return self._colors[name]

    def describe(self, time: float) -> list[str]:
        """Return lines about a time [s]: phase, contacts, and at the end the outcome."""
        lines = []
        if phase := self.recording.phases.last(time):
            lines.append(f"phase: {phase}")
        for contact in (self.recording.contacts.last(time) or ())[:4]:
            force = "" if np.isnan(contact.force) else f", {contact.force:.1f} N"
            lines.append(f"contact: {contact.a} and {contact.b}{force}")
        outcome = self.recording.outcome
        if outcome is not None and time >= self.recording.duration - 1e-9:
            lines.append(f"{'done' if outcome.get('done') else 'not done'}: {outcome.get('reason', '')}")
        return lines

    def drawables(self, time: float) -> list[Drawable]:
        """Return ghost and arrows at a time [s], as parts in the world."""
        ghosts = self.ghost_poses(time)
        found = [
            replace(
                part,
                frame=_WORLD,
                surface=replace(part.surface.transform(ghosts[part.frame]), colors=None),
                color=GHOST,
            )
            for part in self.parts
            if part.frame in ghosts
        ]
        for name, ends in self.arrows(time).items():
            pieces = build_arrow(ends, float(np.linalg.norm(ends[1] - ends[0])))
            found += [Drawable(_WORLD, piece, self.arrow_color(name), "visual") for piece in pieces]
        return found


def as_trajectory(recording: RunRecording) -> Trajectory | None:
    """Return the true states of a run as a trajectory with the same times; None without any.

    Before the first state it stands still. Velocities are differences of the neighbours.
    """
    states = recording.states
    if not len(states):
        return None
    columns = [k for k, s in enumerate(states.symbols) if s.role == "dof" and not s.order]
    positions = states.values[:, columns]
    for k in range(1, len(positions)):
        positions[k] = np.where(np.isnan(positions[k]), positions[k - 1], positions[k])
    times = states.times
    if times[0] > 0.0:
        times = np.concatenate([[0.0], times])
        positions = np.concatenate([positions[:1], positions])
    defaults = complete(recording.model)
    names = [states.symbols[k] for k in columns]
    first = np.array([defaults.get(str(s), 0.0) for s in names])
    positions = np.where(np.isnan(positions), first, positions)
    velocities = np.gradient(positions, times, axis=0) if len(times) > 1 else np.zeros_like(positions)
    return Trajectory(tuple(names), times, positions, velocities)
