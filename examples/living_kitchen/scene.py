"""Drawable parts of the simulation: the truth with its markers, and beside it the estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kineverse.model.frame import WORLD
from kineverse.spatial import translation
from kineverse.view.drawables import AXIS_COLORS, Drawable
from kineverse.view.rendering.camera import Camera
from kineverse.view.rendering.triangle_mesh import Floats, TriangleMesh

from . import marker_meshes as marks
from .identify import DIRECTED_FAMILIES
from .placed_model import PlacedModel, estimate_color, shade, uncertainty_color
from .simulation import Simulation
from .unknown_mechanisms import BASE, PART

ESTIMATE_POSE = np.asarray(translation(-2.4, -4.9, 0.0)({}))
"""Pose of the estimated world in the scene: to the right of the true one."""

CAMERA = Camera((-9.2, 3.2, 4.9), (-1.7, -2.1, 0.5), field_of_view=0.54)
"""View of both worlds, over the islands towards the rows."""


@dataclass(frozen=True, slots=True, eq=False)
class AxisDrawing:
    """Identified axis with its uncertainty.

    Attributes
    ----------
    lines, tubes
        Line and tube in the true world, and in the estimated one.
    """

    lines: tuple[Floats, Floats]
    tubes: tuple[TriangleMesh, TriangleMesh]


class SceneDrawables:
    """Drawable parts of a simulation.

    Attributes
    ----------
    truth, estimate
        The kitchens.
    mechanism, identified
        The true mechanism, and the identified one.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.truth = PlacedModel("truth", simulation.kitchen)
        self.estimate = PlacedModel("believed", simulation.kitchen, ESTIMATE_POSE, estimate_color)
        self._owners = self._marker_of_frames()
        self.change_mechanism()

    def change_mechanism(self) -> None:
        """Take over a new mechanism of the simulation."""
        self.known_mechanism = self.simulation.mechanism
        self.mechanism = PlacedModel("stranger", self.known_mechanism.model)
        self.identified = PlacedModel("learned", self.known_mechanism.model, None, estimate_color)
        key = self.identified.key(PART)
        self.identified.parts = [
            replace(part, color=shade(uncertainty_color(0.0), part.color)) if part.frame == key else part
            for part in self.identified.parts
        ]

    def _marker_of_frames(self) -> dict[str, int]:
        """Return the index of the marker that moves with each moving frame, by key."""
        simulation, model = self.simulation, self.simulation.kitchen
        owner = {
            s: k for k, frame in enumerate(simulation.kitchen_tracker.frames) for s in model.fk(frame).symbols
        }
        found = {}
        for frame in model.frames:
            symbols = () if frame == WORLD else model.fk(frame).symbols
            if symbols and symbols[0] in owner:
                found[self.estimate.key(frame)] = owner[symbols[0]]
        return found

    def poses(self) -> dict[str, Floats]:
        """Return the poses of all frames that have parts, by key."""
        simulation = self.simulation
        base, part = self.estimated_mechanism()
        return {
            **self.truth.poses(simulation.truth),
            **self.estimate.poses(simulation.kitchen_tracker.values),
            **{self.mechanism.key(n): p for n, p in zip((BASE, PART), simulation.poses, strict=True)},
            self.identified.key(BASE): base,
            **({} if part is None else {self.identified.key(PART): part}),
        }

    def estimated_mechanism(self) -> tuple[Floats, Floats | None]:
        """Return the estimated poses of base and part; None for a part without a model."""
        learner = self.simulation.learner
        part = learner.part
        return ESTIMATE_POSE @ learner.base, None if part is None else ESTIMATE_POSE @ part

    def colors(self) -> dict[str, tuple[float, float, float, float]]:
        """Return the colours of moving frames of the estimate, by their uncertainty, by key."""
        lengths = self.simulation.kitchen_tracker.uncertainty_lengths()
        return {key: uncertainty_color(float(lengths[k])) for key, k in self._owners.items()}

    def parts(self) -> list[Drawable]:
        """Return all bodies in their present colours."""
        tones = self.colors()
        found = [*self.truth.parts, *self.mechanism.parts]
        for part in self.estimate.parts:
            tone = tones.get(part.frame)
            color = part.color if tone is None else shade(tone, part.color)
            found.append(replace(part, color=color))
        known = self.simulation.learner.model is not None
        found += [p for p in self.identified.parts if known or p.frame == self.identified.key(BASE)]
        return found

    def markers(self) -> Floats:
        """Return the poses of all visible markers, those of the mechanism last (m, 4, 4)."""
        simulation = self.simulation
        return np.concatenate(
            [simulation.readings.poses[simulation.readings.visible], simulation.mechanism_readings.poses]
        )

    def uncertainty_bars(self) -> Floats:
        """Return the paths of uncertainty of the estimated markers, (m, points, 3)."""
        paths: Floats = self.simulation.kitchen_tracker.uncertainty_paths() + ESTIMATE_POSE[:3, 3]
        return paths

    def axis(self) -> AxisDrawing | None:
        """Return the identified axis, if there is one."""
        learner, found = self.simulation.learner, self.simulation.learner.result
        if found is None or found.is_ambiguous or found.best.family not in DIRECTED_FAMILIES:
            return None
        base = learner.base
        middle = (np.linalg.inv(base) @ np.append(learner.part_positions.mean(axis=0), 1.0))[:3]
        line, tube = marks.compute_axis_line(found.best, middle), marks.create_axis_tube(found.best, middle)
        shifted = ESTIMATE_POSE @ base
        lines = tuple(line @ pose[:3, :3].T + pose[:3, 3] for pose in (base, shifted))
        return AxisDrawing((lines[0], lines[1]), (tube.transform(base), tube.transform(shifted)))

    def observed_positions(self) -> Floats:
        """Return the stored positions of the mechanism's part, in the estimated world (n, 3)."""
        positions: Floats = self.simulation.learner.part_positions + ESTIMATE_POSE[:3, 3]
        return positions


def create_marks(drawables: SceneDrawables) -> list[Drawable]:
    """Return markers, bars and axes as parts in the world."""
    found = []
    for pose in drawables.markers():
        for rod, color in zip(marks.create_marker(pose), AXIS_COLORS, strict=True):
            found.append(Drawable(WORLD, rod, color, "visual"))
    found += [
        Drawable(WORLD, marks.create_bar(way), (*marks.BARS, 1.0), "visual")
        for way in drawables.uncertainty_bars()
    ]
    for point in drawables.observed_positions():
        dot = marks.create_rod(point + np.array([[0.0, 0.0, -0.012], [0.0, 0.0, 0.012]]), 0.012)
        found.append(Drawable(WORLD, dot, (*marks.CLOUD, 1.0), "visual"))
    axis = drawables.axis()
    if axis is not None:
        for line, tube in zip(axis.lines, axis.tubes, strict=True):
            found.append(Drawable(WORLD, tube, (*marks.TUBE, 0.4), "visual"))
            found.append(Drawable(WORLD, marks.create_rod(line, marks.LINE), (*marks.AXIS, 1.0), "visual"))
    return found
