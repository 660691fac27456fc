"""The scene that lives as things to draw: the truth, what is seen of it, and beside it what is believed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kineverse.model.frame import WORLD
from kineverse.spatial import translation
from kineverse.view.camera import Camera
from kineverse.view.drawables import Drawable
from kineverse.view.triangle_mesh import Floats, TriangleMesh

from . import marker_meshes as marks
from .axis_uncertainty import WITH_AXIS
from .placed_model import Figure, doubtful, on_paper, shaded
from .simulation import Life
from .unknown_mechanisms import BASE, PART

BESIDE = np.asarray(translation(-2.4, -4.9, 0.0)({}))
"""Where the world that is believed is drawn: to the right of the true one."""

CAMERA = Camera((-9.2, 3.2, 4.9), (-1.7, -2.1, 0.5), field_of_view=0.54)
"""Both worlds, over the islands towards the rows."""


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What is drawn of an axis that was learned.

    Attributes
    ----------
    lines, tubes
        Over the truth, and over what is believed.
    """

    lines: tuple[Floats, Floats]
    tubes: tuple[TriangleMesh, TriangleMesh]


class Scenery:
    """What is drawn of a life.

    Attributes
    ----------
    truth, believed
        The kitchens.
    stranger, learned
        What moves without anybody knowing how, and what was made of it; None before that.
    """

    def __init__(self, life: Life) -> None:
        self.life = life
        self.truth = Figure("truth", life.kitchen)
        self.believed = Figure("believed", life.kitchen, BESIDE, on_paper)
        self._owners = self._marker_of_frames()
        self.meet()

    def meet(self) -> None:
        """Take in that there is another stranger."""
        self.known_stranger = self.life.stranger
        self.stranger = Figure("stranger", self.known_stranger.model)
        self.learned = Figure("learned", self.known_stranger.model, None, on_paper)
        key = self.learned.key(PART)
        self.learned.parts = [
            replace(part, color=shaded(doubtful(0.0), part.color)) if part.frame == key else part
            for part in self.learned.parts
        ]

    def _marker_of_frames(self) -> dict[str, int]:
        """Return which marker moves with each frame that moves, by key."""
        life, model = self.life, self.life.kitchen
        owner = {s: k for k, frame in enumerate(life.following.frames) for s in model.fk(frame).symbols}
        found = {}
        for frame in model.frames:
            symbols = () if frame == WORLD else model.fk(frame).symbols
            if symbols and symbols[0] in owner:
                found[self.believed.key(frame)] = owner[symbols[0]]
        return found

    def poses(self) -> dict[str, Floats]:
        """Return where all figures are, by the frames of their parts."""
        life = self.life
        base, part = self.believed_stranger()
        return {
            **self.truth.poses(life.truth),
            **self.believed.poses(life.following.values),
            **{self.stranger.key(n): p for n, p in zip((BASE, PART), life.poses, strict=True)},
            self.learned.key(BASE): base,
            **({} if part is None else {self.learned.key(PART): part}),
        }

    def believed_stranger(self) -> tuple[Floats, Floats | None]:
        """Return where base and part are held to be; None for a part of which nobody knows how it moves."""
        learner = self.life.learner
        part = learner.part
        return BESIDE @ learner.base, None if part is None else BESIDE @ part

    def colors(self) -> dict[str, tuple[float, float, float, float]]:
        """Return the colours of what moves and is believed, by how sure its place is, by key of the frame."""
        doubts = self.life.following.doubt()
        return {key: doubtful(float(doubts[k])) for key, k in self._owners.items()}

    def parts(self) -> list[Drawable]:
        """Return all bodies as they are now."""
        tones = self.colors()
        found = [*self.truth.parts, *self.stranger.parts]
        for part in self.believed.parts:
            tone = tones.get(part.frame)
            color = part.color if tone is None else shaded(tone, part.color)
            found.append(replace(part, color=color))
        known = self.life.learner.model is not None
        found += [p for p in self.learned.parts if known or p.frame == self.learned.key(BASE)]
        return found

    def markers(self) -> Floats:
        """Return the poses of all markers that are seen, those of the stranger last (m, 4, 4)."""
        life = self.life
        return np.concatenate([life.seen.poses[life.seen.there], life.stranger_seen.poses])

    def bars(self) -> Floats:
        """Return where believed markers may be, (m, points, 3)."""
        ways: Floats = self.life.following.ways() + BESIDE[:3, 3]
        return ways

    def axis(self) -> Learned | None:
        """Return the axis that was learned, if it has one and it is known."""
        learner, found = self.life.learner, self.life.learner.found
        if found is None or found.is_ambiguous or found.best.family not in WITH_AXIS:
            return None
        base = learner.base
        middle = (np.linalg.inv(base) @ np.append(learner.seen.mean(axis=0), 1.0))[:3]
        line, tube = marks.axis_line(found.best, middle), marks.axis_tube(found.best, middle)
        beside = BESIDE @ base
        lines = tuple(line @ pose[:3, :3].T + pose[:3, 3] for pose in (base, beside))
        return Learned((lines[0], lines[1]), (tube.moved(base), tube.moved(beside)))

    def cloud(self) -> Floats:
        """Return the places at which the stranger's part was seen, where they are believed (n, 3)."""
        seen: Floats = self.life.learner.seen + BESIDE[:3, 3]
        return seen


def marks_of(scenery: Scenery) -> list[Drawable]:
    """Return everything that is no body, as parts in the world."""
    found = []
    for pose in scenery.markers():
        for rod, color in zip(marks.marker(pose), marks.AXES, strict=True):
            found.append(Drawable(WORLD, rod, (*color, 1.0), "visual"))
    found += [Drawable(WORLD, marks.bar(way), (*marks.BARS, 1.0), "visual") for way in scenery.bars()]
    for point in scenery.cloud():
        dot = marks.rod(point + np.array([[0.0, 0.0, -0.012], [0.0, 0.0, 0.012]]), 0.012)
        found.append(Drawable(WORLD, dot, (*marks.CLOUD, 1.0), "visual"))
    axis = scenery.axis()
    if axis is not None:
        for line, tube in zip(axis.lines, axis.tubes, strict=True):
            found.append(Drawable(WORLD, tube, (*marks.TUBE, 0.4), "visual"))
            found.append(Drawable(WORLD, marks.rod(line, marks.LINE), (*marks.AXIS, 1.0), "visual"))
    return found
