"""Frames that are dragged on the page: a gizmo, and inverse kinematics that follows it.

Each event takes steps of a velocity controller until the frame is as near to the gizmo as possible. So it
respects limits, locks, closed loops and rolling wheels, and nothing jumps to another branch.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse._extras import install_command
from kineverse._rich_display import Html, element
from kineverse.errors import KineverseError
from kineverse.lie import quaternion, rotation_angle
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.model.projection import is_equality
from kineverse.state import State
from kineverse.symbols import Symbol

from .html import FONT, HtmlBox
from .poses import to_wxyz
from .rendering.triangle_mesh import Floats
from .scene import ViewerScene
from .sliders import DisplayUnits, on_input

logger = logging.getLogger(__name__)

_DT = 0.5  # time of a step, for limits of speeds [s]; there is no clock
_STEPS = 40  # most steps for an event: 5 ms for a mobile robot with two arms
_SETTLED = 1e-7  # largest change of a coordinate that ends the steps
_REACH = 0.1, 0.3
"""Distances from the gizmo [m], [rad] beyond which it attracts no more: from afar steps would overshoot."""

_STRIDE = 0.1  # largest change of a coordinate in a step [m], [rad], for limits that are curved

_LEVER = 0.05
"""Weight of what is not dragged, position or orientation, relative to what is: a length [m]."""

_PLANAR = 3  # least number of coordinates of a mobile base


def find_draggable(model: ModelView) -> list[str]:
    """Return the frames that a degree of freedom moves."""
    return [name for name in model.frames if any(s.has_derivative for s in model.fk(name).symbols)]


def find_base(model: ModelView, frame: str) -> list[Symbol]:
    """Return the coordinates of the mobile base that carries a frame; none if nothing else moves it."""
    moving = {s for s in model.fk(frame).symbols if s.has_derivative}
    for record in model.articulations.values():
        base = moving.intersection(record.coordinates)
        if record.parent == WORLD and len(base) >= _PLANAR:
            # Its wheels turn only as it drives.
            alone = _find_speeds(model, base).issuperset(model.speeds_of(frame))
            return [] if alone else sorted(base, key=lambda s: s.sort_key)
    return []


def _find_speeds(model: ModelView, coordinates: Iterable[Symbol]) -> set[Symbol]:
    return {speed for s in coordinates for speed in model.rates.get(s, (s.derivative(),))}


def find_moving(model: ModelView, frame: str) -> set[Symbol]:
    """Return the coordinates that move a frame, and those that equalities and wheels tie to them."""
    dependent = model.rates.dependent
    symbols = (t for s in model.fk(frame).symbols for t in (dependent[s].symbols if s in dependent else (s,)))
    found = {s for s in symbols if s.has_derivative}
    ties = [{s for s in c.symbols if s.has_derivative} for c in model.constraints.values() if is_equality(c)]
    ties += [{symbol, *(s.position for s in row)} for symbol, row in model.rates.items()]
    size = 0
    while size < len(found):
        size = len(found)
        for tie in ties:
            if not found.isdisjoint(tie):
                found |= tie
    return found


class DragSolver:
    """Solver of the configuration nearest to the present one in which a frame is at a pose, or next to it.

    Some coordinates may stand still. The model must not change.
    """

    def __init__(self, model: ModelView, frame: str, still: Iterable[Symbol] = ()) -> None:
        from kineverse.control import Controller, Goal, Target, same_orientation, same_position

        self._model = model
        self._pose, self._point = Target("drag/pose", np.eye(4)), Target("drag/point", np.zeros(3))
        held = model.fk(frame) @ kv.translation(*self._point.expression)
        errors = [error(self._pose.expression, held) for error in (same_position, same_orientation)]
        fixed = {*model.degrees_of_freedom} - find_moving(model, frame) | {*still}
        # A drawer keeps its orientation, for which there is no goal.
        self._weights = {
            k: kv.parameter(f"drag/weight{k}", 1.0)
            for k, error in enumerate(errors)
            if error.gradient().keys() - _find_speeds(model, fixed)
        }
        tasks = [
            Goal(errors[k], gain=1 / _DT, speed=_REACH[k] / _DT, weight=weight)
            for k, weight in self._weights.items()
        ]
        self._controller = Controller(model, tasks, dt=_DT, fixed=fixed, smooth=0.0, posture=0.0)

    def solve(
        self, values: Mapping[str, float], pose: Floats, point: npt.ArrayLike, *, turns: bool
    ) -> tuple[dict[str, float], bool]:
        """Return the values that change, and whether they are final.

        The world pose (4, 4) [m] is that of a point of the frame (3,) [m], with the axes of the frame. With
        ``turns`` the orientation counts before the position, for frames that cannot have both.
        """
        controller = self._controller
        controller.reset()
        controller.set(self._pose, pose)
        controller.set(self._point, point)
        for k, weight in self._weights.items():
            controller.set(weight, 1.0 if bool(k) == turns else _LEVER**2)
        before = state = State(values)
        final = False
        for _ in range(_STEPS):
            speeds = controller.step(state).speeds
            change = _DT * max(map(abs, speeds.values()), default=0.0)
            shorter = min(1.0, _STRIDE / max(change, _SETTLED))
            state = self._model.integrate(state, {s: shorter * v for s, v in speeds.items()}, _DT)
            final = change < _SETTLED
            if final:
                break
        return {s: float(state[s]) for s in values if state[s] != before[s]}, final


@dataclass(frozen=True, slots=True)
class _Grip:
    """Point of a frame that the gizmo holds."""

    frame: str
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)


_NOTHING = "–"
_GIZMO, _REST = "/drag/gizmo", "/drag/rest"
_PIXELS = 110.0  # size of the gizmo on the screen
_FARTHEST = 1e6  # largest coordinate of a gizmo [m]: browsers have single precision
_APART = 1e-3, 0.01  # distances of the frame from the gizmo above which they are shown [m], [rad]


class FrameDrag:
    """Gizmo on a frame of the page, its controls, and the values that follow it.

    ``on_change`` is called when there is something to do for :meth:`step`, by any thread.
    """

    def __init__(
        self,
        server: Any,
        scene: ViewerScene,
        model: ModelView,
        display: DisplayUnits,
        *,
        on_change: Callable[[], None],
    ) -> None:
        self._server, self._scene, self._model, self._display = server, scene, model, display
        self._on_change = on_change
        self.installed = find_spec("daqp") is not None
        # Events of browsers come from other threads than drawings.
        self._lock = threading.RLock()
        self._grip: _Grip | None = None
        self._still = True  # whether mobile bases stand still
        self._gizmo: Any = None
        self._marks: list[Any] = []
        self._controls: tuple[Any, Any] | None = None
        self._note: HtmlBox | None = None
        self._solvers: dict[tuple[str, bool], DragSolver | None] = {}
        self._holder: int | None = None  # the browser that drags
        self._start, self._wanted = np.eye(4), np.eye(4)
        self._pending = False
        self._failure = ""
        server.scene.on_click()(self._pick)

    @property
    def pending(self) -> bool:
        """True if the frame has not yet followed the gizmo."""
        return self._pending

    def add_controls(self, gui: Any) -> None:
        """Add the controls to a panel, with their present settings."""
        with self._lock:
            self._controls, self._note = None, None
            frames = find_draggable(self._model)
            if not frames:
                return
            if not self.installed:
                extra, command = element("b", "control"), install_command("control")
                text = ("Dragging frames needs the extra ", extra, f": {command}")
                self._note = HtmlBox(gui, element("div", *text, style=f"{FONT}padding:2px 9px 8px"))
                return
            chosen = _NOTHING if self._grip is None else self._grip.frame
            options = [_NOTHING, *frames] if chosen in (_NOTHING, *frames) else [_NOTHING, chosen, *frames]
            frame = gui.add_dropdown(
                "drag", options, initial_value=chosen, hint="The frame to drag; a click on a body chooses it."
            )
            has_base = any(find_base(self._model, name) for name in frames)
            still = gui.add_checkbox(
                "base stands still", self._still, hint="Drag the arm alone, not the robot.", visible=has_base
            )
            self._controls, self._note = (frame, still), HtmlBox(gui, Html())
        on_input(frame, lambda name: self.choose(None if name == _NOTHING else name))
        on_input(still, self._hold_base)
        self._tell()

    def forget_controls(self) -> None:
        """Drop the controls before their panel is removed."""
        with self._lock:
            self._controls, self._note = None, None

    def refresh(self, model: ModelView) -> None:
        """Go on with an edited model, unless the frame is gone or does not move any more."""
        with self._lock:
            self._model, self._solvers = model, {}
            grip = self._grip
            if grip is not None and grip.frame not in find_draggable(model):
                self.choose(None)
                self._failure = f"{grip.frame} cannot be dragged any more."

    def choose(self, frame: str | None, point: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the gizmo on a point of a frame [m], or take it away."""
        with self._lock:
            x, y, z = np.asarray(point, dtype=float).tolist()
            self._grip = None if frame is None else _Grip(frame, (x, y, z))
            self._holder, self._pending, self._failure = None, False, ""
            if self._gizmo is not None:
                self._gizmo.remove()
                self._gizmo = None
            if self._grip is not None:
                pose = self._held_pose()
                self._gizmo = self._server.scene.add_transform_controls(
                    _GIZMO,
                    scale=_PIXELS,
                    fixed=True,
                    depth_test=False,
                    position=pose[:3, 3],
                    wxyz=to_wxyz(pose[None])[0],
                )
                # Only coroutines are called in the order of the events.
                self._gizmo.on_update(self._take)
            self._show_distance()
            if self._controls is not None:
                dropdown = self._controls[0]
                shown = _NOTHING if frame is None else frame
                if dropdown.value != shown and shown in dropdown.options:
                    dropdown.value = shown
        self._tell()
        self.prepare()  # so that the first event does not wait for it

    def prepare(self) -> None:
        """Make the solver of the chosen frame, which takes up to a second."""
        with self._lock:
            model, grip, still, solvers = self._model, self._grip, self._still, self._solvers
            if grip is None or (grip.frame, still) in solvers:
                return
        # These are others after an edit.
        try:
            solvers[grip.frame, still] = DragSolver(
                model, grip.frame, find_base(model, grip.frame) if still else ()
            )
        except Exception as error:
            solvers[grip.frame, still] = None
            self._fail(error)
            self._tell()

    def step(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the values that change for the frame to follow the gizmo, once there is a solver."""
        with self._lock:
            grip, wanted, start = self._grip, self._wanted, self._start
            if grip is None or not self._pending:
                return {}
            turns = bool(np.abs(wanted[:3, 3] - start[:3, 3]).max() < 1e-9)
            changed: dict[str, float] = {}
            final, solver = True, self._solvers.get((grip.frame, self._still))
            if solver is not None:
                try:
                    changed, final = solver.solve(values, wanted, grip.point, turns=turns)
                    self._failure = ""
                except Exception as error:
                    self._fail(error)
            # Nothing follows a gizmo that was released.
            self._pending = not final and self._holder is not None
            return changed

    def follow(self) -> None:
        """Show the distance of the frame from the gizmo after a drawing, or bring a released one back."""
        with self._lock:
            if self._gizmo is None:
                return
            if self._holder is None and not self._pending:
                pose = self._held_pose()
                wxyz = to_wxyz(pose[None])[0]
                shown = *self._gizmo.position, *self._gizmo.wxyz
                # NaN, which a browser may have sent, is not close.
                if not np.allclose(shown, (*pose[:3, 3], *wxyz), rtol=0.0, atol=1e-9):
                    self._gizmo.position, self._gizmo.wxyz = pose[:3, 3], wxyz
            self._show_distance()
        self._tell()

    def _fail(self, error: Exception) -> None:
        """Note why a frame does not follow: the thread that draws survives any error."""
        if isinstance(error, KineverseError):
            self._failure = str(error)
        else:
            logger.exception("a frame could not be dragged")
            self._failure = f"{type(error).__name__}: {error}"

    def _held_pose(self) -> Floats:
        assert self._grip is not None
        pose = self._scene.pose(self._grip.frame)
        pose[:3, 3] += pose[:3, :3] @ self._grip.point
        return pose

    async def _take(self, event: Any) -> None:
        """Take an event of the gizmo: the browser that begins drags until its end, others do nothing."""
        with self._lock:
            if event.target is not self._gizmo:
                return  # it was removed while it was dragged
            if event.phase == "start" and self._holder is None:
                self._holder, self._start = event.client_id, self._held_pose()
            if self._holder != event.client_id:
                return
            pose = _read_pose(event.target.position, event.target.wxyz)
            if pose is not None:
                self._wanted, self._pending = pose, True
            if event.phase == "end":
                self._holder = None
        self._on_change()

    def _pick(self, event: Any) -> None:
        """Choose the point of a body that was clicked; nothing where there is none, or none that moves."""
        controls = self._controls
        if controls is None:
            return
        hit = self._scene.pick(event.ray_origin, event.ray_direction)
        if hit is None or hit[0] not in controls[0].options:
            self.choose(None)
        else:
            self.choose(*hit)

    def _hold_base(self, still: bool) -> None:
        self._still = bool(still)

    def _distance(self) -> tuple[float, float]:
        """Return how far the frame is from the gizmo [m], [rad]; zeros unless it is dragged."""
        if self._grip is None or self._holder is None:
            return 0.0, 0.0
        here, there = self._held_pose(), self._wanted
        return float(np.linalg.norm(here[:3, 3] - there[:3, 3])), float(
            rotation_angle(here[:3, :3].T @ there[:3, :3])
        )

    def _describe_distance(self) -> str:
        sizes = zip(self._distance(), _APART, ("m", "rad"), strict=True)
        parts = [self._display.format(size, unit) for size, least, unit in sizes if size > least]
        return f"{', '.join(parts)} away" if parts else ""

    def _show_distance(self) -> None:
        """Draw a line from the frame to the gizmo, and its length, while they are apart."""
        text = self._describe_distance()
        for mark in self._marks if not text else ():
            mark.remove()
        if not text:
            self._marks = []
            return
        ends = np.array([[self._held_pose()[:3, 3], self._wanted[:3, 3]]], dtype=np.float32)
        scene = self._server.scene
        self._marks = [
            scene.add_line_segments(
                f"{_REST}/line", ends, (201, 42, 42), thickness=3.0, thickness_units="screen"
            ),
            scene.add_label(f"{_REST}/label", text, position=ends[0, 1], font_screen_scale=0.8),
        ]

    def _tell(self) -> None:
        """Write what can be done, or what prevents it, below the controls."""
        with self._lock:
            if self._controls is None or self._note is None:
                return
            text = self._failure or self._describe_distance()
            if not text and self._grip is None:
                text = "Click a body, or choose its frame, to drag it."
            self._note.show(element("div", text, style=f"{FONT}padding:2px 9px 8px"))


def _read_pose(position: npt.ArrayLike, wxyz: npt.ArrayLike) -> Floats | None:
    """Return the pose (4, 4) that a browser sent; None if it is none."""
    place, turn = np.asarray(position, dtype=float), np.asarray(wxyz, dtype=float)
    length = np.linalg.norm(turn)
    if place.shape != (3,) or turn.shape != (4,) or not (np.abs(place) < _FARTHEST).all():
        return None
    if not 1e-9 < length < np.inf:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = quaternion(np.roll(turn / length, -1)), place
    return pose
