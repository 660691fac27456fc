"""Overlay of a run, live or recorded: the belief as a ghost, vectors of the controller as arrows, text."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from kineverse._rich_display import element
from kineverse.errors import InvalidValueError
from kineverse.lie import rotation_angle
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.state import StateLike
from kineverse.worlds import Contact, RunRecording
from kineverse.worlds.robot_interface import SkillStep

from .drawables import TRACE, Drawable, Rgba, build_spheres, collect_drawables
from .html import BREAK, FONT, HtmlBox
from .poses import FramePoses, complete, keep_known, to_wxyz
from .proximity import build_arrow
from .rendering.triangle_mesh import Floats
from .viewer import PERIOD, Viewer

GHOST: Rgba = (0.16, 0.47, 0.86, 0.35)  # colour of the belief

ARROWS: tuple[Rgba, ...] = (
    (0.86, 0.16, 0.16, 1.0),
    (0.13, 0.55, 0.20, 1.0),
    (0.16, 0.33, 0.88, 1.0),
    (0.80, 0.45, 0.05, 1.0),
    (0.55, 0.20, 0.70, 1.0),
    (0.05, 0.55, 0.60, 1.0),
)
"""Colours of arrows, in the order in which their names come."""

ARROW_SCALE, LONGEST_ARROW = 0.25, 0.6  # length of the arrow of a vector of 1, and the largest length [m]
WAY_RADIUS = 0.008  # half of the width of the way of a hand [m]

_APART, _TURNED = 3e-3, 5e-3
"""Least difference of a belief that is shown [m], [rad]; below, the ghost would flicker on the body."""

_MOST_CONTACTS = 4

Vectors = Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]]
"""Vectors by name, each with its origin in the world (3,) [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class RunMoment:
    """Things to draw of a run at one time."""

    ghosts: Mapping[str, Floats]  # (4, 4)
    arrows: Mapping[str, Floats]  # ends (2, 3) of arrows in the world [m], by name
    lines: Sequence[str] = ()  # lines of text
    way: Floats | None = None  # points (k, 3) of the way ahead of the hand [m]; None without a way
    wanted: Floats | None = None  # pose (4, 4) at which the hand is wanted now [m]


class RunDrawing:
    """Drawing of runs of a model."""

    def __init__(self, model: ModelView) -> None:
        self._model = model
        self.parts = [part for part in collect_drawables(model) if model.fk(part.frame).symbols]
        self._kinematics = FramePoses(model, dict.fromkeys(part.frame for part in self.parts))
        self._colors: dict[str, Rgba] = {}

    def values(self, state: StateLike) -> dict[str, float]:
        """Return the values of all symbols of the model by name; what a state has beyond is left out."""
        named = {str(symbol): float(value) for symbol, value in state.items()}
        return complete(self._model, keep_known(self._model, named))

    def find_ghosts(
        self, truth: StateLike, belief: StateLike, poses: Mapping[str, Floats] | None = None
    ) -> dict[str, Floats]:
        """Return the believed world poses (4, 4) of those bodies that are elsewhere in truth, by frame."""
        values = self.values(truth)
        named = {str(symbol): float(value) for symbol, value in belief.items()}
        true_poses = self._kinematics.evaluate(values)
        believed = self._kinematics.evaluate(values | keep_known(self._model, named))
        for frame, pose in (poses or {}).items():
            if frame in self._kinematics.names:
                believed[self._kinematics.index(frame)] = pose
        apart = np.linalg.norm(believed[:, :3, 3] - true_poses[:, :3, 3], axis=1)
        turned = rotation_angle(np.swapaxes(true_poses[:, :3, :3], 1, 2) @ believed[:, :3, :3])
        different = np.isfinite(believed).all(axis=(1, 2)) & ((apart > _APART) | (turned > _TURNED))
        return {self._kinematics.names[k]: believed[k] for k in np.flatnonzero(different).tolist()}

    def color(self, name: str) -> Rgba:
        """Return the colour of the arrow of a vector."""
        return self._colors.setdefault(name, ARROWS[len(self._colors) % len(ARROWS)])

    def draw_ghosts(self, moment: RunMoment) -> list[Drawable]:
        """Return the bodies where they are believed, as parts in the world."""
        return [
            replace(
                part,
                frame=WORLD,
                surface=replace(part.surface.transform(moment.ghosts[part.frame]), colors=None),
                color=GHOST,
            )
            for part in self.parts
            if part.frame in moment.ghosts
        ]

    def draw_arrows(self, moment: RunMoment) -> list[Drawable]:
        """Return the arrows and the way of the hand, as parts in the world."""
        drawn = [
            Drawable(WORLD, piece, self.color(name), "visual")
            for name, ends in moment.arrows.items()
            for piece in build_arrow(ends, float(np.linalg.norm(ends[1] - ends[0])))
        ]
        if moment.way is not None:
            surface = build_spheres(moment.way, np.full(len(moment.way), WAY_RADIUS))
            drawn.append(Drawable(WORLD, surface, TRACE, "visual"))
        return drawn


def find_arrows(vectors: Vectors) -> dict[str, Floats]:
    """Return the ends (2, 3) of the arrows of vectors, by name [m]; vectors of length 0 have none."""
    found = {}
    for name, (origin, vector) in vectors.items():
        start, along = np.asarray(origin, dtype=float), np.asarray(vector, dtype=float)
        length = float(np.linalg.norm(along))
        if 0.0 < length < np.inf:
            found[name] = np.array([start, start + min(ARROW_SCALE * length, LONGEST_ARROW) / length * along])
    return found


def format_contact_lines(contacts: Sequence[Contact]) -> list[str]:
    """Return a line for each contact, of many the first ones."""
    lines = []
    for contact in contacts[:_MOST_CONTACTS]:
        force = "" if np.isnan(contact.force) else f", {contact.force:.1f} N"
        lines.append(f"contact: {contact.a} and {contact.b}{force}")
    more = len(contacts) - _MOST_CONTACTS
    return [*lines, f"and {more} more contacts"] if more > 0 else lines


class RecordedScene:
    """Contents of a recorded run at a time."""

    def __init__(self, recording: RunRecording) -> None:
        self.recording = recording
        self.trajectory = as_trajectory(recording)
        self.drawing = RunDrawing(recording.model)

    def values_at(self, time: float) -> dict[str, float]:
        """Return the values of all symbols by name at a time [s], the true ones if they are recorded."""
        return self.drawing.values(self.recording.motion.at(time))

    def at(self, time: float) -> RunMoment:
        """Return the things to draw at a time [s]."""
        arrows = find_arrows(self.recording.vectors.last(time) or {})
        return RunMoment(self._ghosts(time), arrows, self._describe(time))

    def _ghosts(self, time: float) -> dict[str, Floats]:
        beliefs = self.recording.beliefs
        if not len(beliefs) or time < beliefs.times[0]:
            return {}
        poses = self.recording.belief_poses.last(time)
        return self.drawing.find_ghosts(self.recording.motion.at(time), beliefs.at(time), poses)

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
    """Return the states of a run as a trajectory with the same times, the true ones if there are any.

    None stands for a run without states. Before the first state it stands still. Velocities are differences
    of the neighbours.
    """
    states = recording.motion
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


_ROOT = "/run"
_CELL = "text-align:left;padding:1px 9px 1px 0;vertical-align:top;white-space:nowrap"


class RunLayer:
    """Ghost, arrows, way, text and table of a run on the page; with ``moment_at``, those of a recording."""

    def __init__(
        self,
        server: Any,
        drawing: RunDrawing,
        title: str,
        moment_at: Callable[[float], RunMoment] | None = None,
    ) -> None:
        self._server, self._drawing, self._moment_at = server, drawing, moment_at
        # Events of the page come from other threads than moments.
        self._lock = threading.RLock()
        self._moment = RunMoment({}, {})
        self._ghosts: dict[str, Any] = {}
        self._arrows: list[Any] = []
        self._way: Any = None
        self._wanted: Any = None
        self._folder = server.gui.add_folder(title, order=-0.9)
        with self._folder:
            self._text = HtmlBox(server.gui, element("div"))
            self._ghost_box = server.gui.add_checkbox("belief", True, hint="Show what the robot believes.")
            self._arrow_box = server.gui.add_checkbox(
                "controller", True, hint="Show vectors of the controller as arrows, and the way of the hand."
            )
            self._table = HtmlBox(server.gui, element("div"))
        for box in (self._ghost_box, self._arrow_box):
            box.on_update(lambda _: self.draw(self._moment))

    def show(self, time: float) -> None:
        """Show the moment of a recording at a time [s]."""
        if self._moment_at is not None:
            self.draw(self._moment_at(time))

    def draw(self, moment: RunMoment) -> None:
        """Show ghost, arrows and text of a moment, in place of those before."""
        with self._lock, self._server.atomic():
            self._moment = moment
            self._draw_ghosts(moment.ghosts if self._ghost_box.value else {})
            self._draw_arrows(moment.arrows if self._arrow_box.value else {})
            self._draw_way(moment if self._arrow_box.value else RunMoment({}, {}))
            lines = [line for text in moment.lines for line in (text, BREAK)]
            self._text.show(element("div", *lines, style=f"{FONT}padding:0 9px"))

    def show_table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Show a table below the text."""
        lines = [element("tr", *(element("th", cell, style=_CELL) for cell in head))]
        lines += [element("tr", *(element("td", cell, style=_CELL) for cell in row)) for row in rows]
        with self._lock:
            self._table.show(
                element(
                    "table",
                    *lines,
                    style=f"{FONT}margin:6px 9px;border-collapse:collapse;display:block;overflow-x:auto",
                )
            )

    def exchange(self, drawing: RunDrawing) -> None:
        """Draw an edited model from the next moment on."""
        with self._lock:
            self._drawing = drawing
            self._server.scene.remove_by_name(_ROOT)
            self._ghosts, self._arrows, self._way, self._wanted = {}, [], None, None

    def remove(self) -> None:
        """Remove everything from the page."""
        with self._lock:
            self._folder.remove()
            self._server.scene.remove_by_name(_ROOT)

    def _draw_ghosts(self, poses: Mapping[str, Floats]) -> None:
        for frame, pose in poses.items():
            node = self._ghosts.get(frame) or self._add_ghost(frame)
            node.position, node.wxyz = pose[:3, 3], to_wxyz(pose[None])[0]
        for frame, node in self._ghosts.items():
            if node.visible != (frame in poses):
                node.visible = frame in poses

    def _add_ghost(self, frame: str) -> Any:
        scene = self._server.scene
        node = self._ghosts[frame] = scene.add_frame(f"{_ROOT}/ghost{len(self._ghosts)}", show_axes=False)
        color = tuple(round(255 * c) for c in GHOST[:3])
        for k, part in enumerate(part for part in self._drawing.parts if part.frame == frame):
            scene.add_mesh_simple(
                f"{node.name}/{k}",
                part.surface.vertices,
                part.surface.faces,
                color=color,
                opacity=GHOST[3],
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        return node

    def _draw_arrows(self, arrows: Mapping[str, Floats]) -> None:
        for node in self._arrows:
            node.remove()
        self._arrows = []
        if not arrows:
            return
        scene, ends = self._server.scene, np.array(list(arrows.values()))
        colors = [[round(255 * c) for c in self._drawing.color(name)[:3]] for name in arrows]
        self._arrows.append(
            scene.add_arrows(
                f"{_ROOT}/arrows",
                ends.astype(np.float32),
                np.array(colors, dtype=np.uint8),
                shaft_radius=0.006,
                head_radius=0.016,
                head_length=0.04,
            )
        )
        self._arrows += [
            scene.add_label(f"{_ROOT}/name{k}", name, position=ends[k, 1], font_screen_scale=0.8)
            for k, name in enumerate(arrows)
        ]

    def _draw_way(self, moment: RunMoment) -> None:
        """Draw the way of the hand as a line, and the pose at which it is wanted as axes."""
        scene = self._server.scene
        if self._way is not None:
            self._way.remove()
            self._way = None
        if moment.way is not None and len(moment.way) > 1:
            color = tuple(round(255 * c) for c in TRACE[:3])
            ends = np.stack([moment.way[:-1], moment.way[1:]], axis=1).astype(np.float32)
            self._way = scene.add_line_segments(f"{_ROOT}/way", ends, color, thickness=2 * WAY_RADIUS)
        if self._wanted is None and moment.wanted is not None:
            self._wanted = scene.add_frame(f"{_ROOT}/wanted", axes_length=0.12, axes_radius=0.005)
        if self._wanted is not None:
            self._wanted.visible = moment.wanted is not None
            if moment.wanted is not None:
                self._wanted.position = moment.wanted[:3, 3]
                self._wanted.wxyz = to_wxyz(moment.wanted[None])[0]


_MOST_ACTIVE = 4
_AHEAD = 0.02  # time by which commands are followed to find the velocity of the hand [s]


class TrueWorld(Protocol):
    """World of which the truth is known, as :class:`.SimulatedWorld` is."""

    @property
    def state(self) -> StateLike:
        """The true state."""

    def contacts(self) -> Sequence[Contact]:
        """Return the contacts of its bodies."""


class LiveRun:
    """Callable for the steps of a session, or of the streams of a live system, which shows them on a page.

    It shows the true state of a world, with the belief as a ghost; without a world, the belief. It draws at
    most thirty times a second, and waits for the clock so that a world that is faster than real time can be
    watched. If the steps have a ``reference`` and a ``command``, as those of a
    :class:`kineverse.manipulation.session.Session`, the way of the hand and the active constraints are shown.
    """

    def __init__(
        self,
        page: Viewer,
        world: TrueWorld | None = None,
        *,
        speed: float = 1.0,
        hand: str | None = None,
        drawing: RunDrawing | None = None,
    ) -> None:
        self._page, self._world, self._speed = page, world, speed
        self._drawing = RunDrawing(page.model) if drawing is None else drawing
        self._layer = RunLayer(page.server, self._drawing, "run")
        self._poses = None if hand is None else FramePoses(page.model, [hand])
        self._drawn = self._begin = 0.0
        self.captions: Sequence[str] = ()

    def __call__(self, step: SkillStep) -> None:
        """Show a step at its time."""
        now = time.monotonic()
        if self._speed:
            due = step.time / self._speed
            if not self._begin or due < now - self._begin:
                self._begin = now - due  # the robot is late, or begins anew
            elif (early := due - (now - self._begin)) > 0.0:
                time.sleep(min(early, 1.0))
                now = time.monotonic()
        if now - self._drawn >= PERIOD:
            self._drawn = now
            self._draw(step)

    def exchange(self, drawing: RunDrawing) -> None:
        """Draw an edited model from the next step on."""
        self._drawing = drawing
        self._layer.exchange(drawing)

    def show_text(self, *lines: str) -> None:
        """Show lines of text below the captions, and no drawings, until the next step."""
        self._layer.draw(RunMoment({}, {}, [*self.captions, *lines]))

    def show_table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Show a table below the text."""
        self._layer.show_table(head, rows)

    def remove(self) -> None:
        """Remove everything of the run from the page."""
        self._layer.remove()

    def _draw(self, step: SkillStep) -> None:
        shown = self._shown(step)
        ghosts = {} if step.state is shown else self._drawing.find_ghosts(shown, step.state)
        lines = [*self.captions, f"{step.time:.1f} s"] + ([f"phase: {step.phase}"] if step.phase else [])
        active = getattr(getattr(step, "command", None), "active", ())[:_MOST_ACTIVE]
        lines += [f"limited by {', '.join(active)}"] if active else []
        lines += [] if self._world is None else format_contact_lines(self._world.contacts())
        reference = getattr(step, "reference", None)
        way, wanted = (None, None) if reference is None else (reference.ahead, reference.pose)
        vectors = {**(getattr(step, "vectors", None) or {}), **self._find_hand_velocity(step)}
        self._page.move(self._drawing.values(shown))
        self._layer.draw(RunMoment(ghosts, find_arrows(vectors), lines, way, wanted))

    def _shown(self, step: SkillStep) -> StateLike:
        return step.state if self._world is None else self._world.state

    def _find_hand_velocity(self, step: SkillStep) -> Vectors:
        """Return the commanded velocity of the hand [m/s], with the hand as its origin."""
        if self._poses is None or not step.commands:
            return {}
        model, here = self._page.model, self._shown(step)
        ends = [
            self._poses.evaluate(self._drawing.values(state))[0, :3, 3]
            for state in (here, model.integrate(here, step.commands, _AHEAD))
        ]
        return {"hand": (ends[0], np.subtract(ends[1], ends[0]) / _AHEAD)}


def play_recording(
    page: Viewer,
    recording: RunRecording,
    *,
    time: float | None = None,
    speed: float = 1.0,
    loop: bool = False,
) -> None:
    """Play a recorded run on a page of its model, with a slider for the time."""
    scene = RecordedScene(recording)
    if scene.trajectory is None:
        raise InvalidValueError(f"{recording.path.name} has no state to play.")
    layer = RunLayer(page.server, scene.drawing, "recording", scene.at)
    page.play(scene.trajectory, speed=speed, loop=loop, layer=layer, at=time)
