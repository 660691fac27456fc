"""Page of a model in the browser: its scene, its sliders, and a thread that keeps both up to date."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

from kineverse._rich_display import Html
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.model.kinematics import infer_units
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.planning.trajectories.trajectory import Trajectory
from kineverse.state import State, StateLike

from . import server as web
from .animation import PlaybackLayer, RangeAnimation, TrajectoryPlayback, VelocityDrive, select_animated
from .dragging import FrameDrag
from .drawables import Drawable
from .html import format_failure, format_violations
from .notebook import bundle_display, is_in_notebook
from .page import choose_title
from .panel import Panel
from .poses import complete, keep_known
from .proximity_panel import ProximityPanel
from .rendering.camera import Camera
from .rendering.triangle_mesh import Floats
from .scene import ViewerScene
from .sliders import DisplayUnits, QuaternionAngles, Ranges

logger = logging.getLogger(__name__)

PERIOD = 1.0 / 30.0  # least time between two updates of the page [s]; requests in between are drawn together
PANEL_WIDTH = 380  # width of the controls: room for the names of joints [pixels]


class Viewer:
    """Web page that shows a model, with sliders.

    The page is up when the constructor returns. Use it as a context, or call :meth:`stop`.
    """

    def __init__(
        self,
        model: ModelView,
        state: StateLike | None = None,
        *,
        port: int | None = None,
        label: str | None = None,
        camera: Camera | None = None,
        host: str = web.HOST,
        degrees: bool = False,
    ) -> None:
        if not isinstance(model, ModelView):
            hint = f" Read it first: kv.load({model!r})." if isinstance(model, str | os.PathLike) else ""
            given = f"{model!r:.60}" if hint else f"a {type(model).__name__}"
            raise InvalidValueError(f"A page shows a kineverse.Model, not {given}.{hint}")
        self.model = model
        # The page is built from a snapshot, which is exchanged as a whole after an edit.
        self._shown = _freeze(model)
        self._initial = complete(self._shown, state)
        self._values = dict(self._initial)
        self._change = threading.Condition()
        self._asked, self._done = 1, 0
        self._stopping, self._edited = False, False
        self._driven: set[str] = set()
        self._is_driven = False
        self._ended = threading.Event()
        self._animation: RangeAnimation | TrajectoryPlayback | None = None
        self._playback: TrajectoryPlayback | None = None
        self._drawn = 0.0
        self._camera = camera
        self._display = DisplayUnits(degrees=degrees)
        # A saved notebook must not show whatever has its port later.
        self._server = web.start(port, label or choose_title(model), host, secret=is_in_notebook())
        try:
            self._server.gui.configure_theme(
                show_logo=False, show_share_button=False, brand_color=(34, 104, 172)
            )
            self._server.gui.main_panel.dock_right()
            self._server.gui.main_panel.set_width(PANEL_WIDTH)
            self._scene = ViewerScene(self._server, self._shown, self._values, camera)
            self.collisions = ProximityPanel(self._server, self._scene, model, self._values)
            self._drag = FrameDrag(
                self._server, self._scene, self._shown, self._display, on_change=self._drag_moved
            )
            self._panel = self._build_panel()
        except BaseException:
            web.stop(self._server)
            raise
        listen = getattr(model, "listen", None)  # Snapshots never change and have no listeners.
        self._listener = listen(lambda _: self.refresh()) if listen else None
        self._worker = threading.Thread(target=self._work, name="kineverse-view", daemon=True)
        self._worker.start()

    @property
    def address(self) -> str:
        """The address of the page."""
        return str(self._server.address)

    @property
    def server(self) -> Any:
        """The viser server of the page."""
        return self._server

    @property
    def values(self) -> dict[str, float]:
        """The values of all symbols that the page shows or is about to show, by name."""
        with self._change:
            return dict(self._values)

    @property
    def problems(self) -> list[str]:
        """The meshes that could not be loaded, one line each."""
        return list(self._scene.problems)

    @property
    def unplaced(self) -> list[str]:
        """The frames whose pose is not finite at the values drawn last; their bodies are hidden."""
        return list(self._scene.unplaced)

    def pose(self, frame: str) -> Floats:
        """Return the pose of a frame in the world that was drawn last, 4×4."""
        return self._scene.pose(frame)

    def hide_sliders(self) -> None:
        """Show neither sliders nor the report of constraints: something else moves the model."""
        self._is_driven = True
        self._drag.choose(None)
        self.refresh()

    def show_overlay(self, items: Iterable[Drawable]) -> None:
        """Show further parts over the model, such as spheres; they move with their frames."""
        self._scene.show_overlay(items)

    def move(self, values: StateLike) -> None:
        """Set the values of some symbols, by symbol or name, as their sliders do."""
        # The model may have been edited since. The lock is not held meanwhile, because the thread that edits
        # may wait for it.
        model = _freeze(self.model)
        given = {str(symbol): value for symbol, value in values.items()}
        with self._change:
            moved = complete(model, {**keep_known(model, self._values), **given})
            # Symbols that were removed from the model are dropped when the page is rebuilt.
            self._values = {**self._values, **moved}
            self._quaternions.update(self._values)
            self._request_update(str(name) for name in values)

    def drive(self, speeds: StateLike) -> None:
        """Move the model at speeds, by symbol or name, until they are 0 or violate a constraint.

        These are the speeds of coordinates with rates, such as wheel speeds.
        """
        with self._change:
            for name in map(str, speeds):
                if name not in self._drive.speeds:
                    known = suggest(name, self._drive.speeds, "speed")
                    raise UnknownNameError(f"Nothing is driven by '{name}'. {known}")
            self._drive.speeds.update({str(k): float(v) for k, v in speeds.items()})
            self._drawn = time.monotonic()
            self._request_update()

    def reset(self) -> None:
        """Go back to the initial state, and stop."""
        with self._change:
            self._stop_animation()
            self._drive.stop()
            self._values = dict(self._initial)
            self._quaternions.update(self._values)
            self._request_update(self._values)
        self._panel.playing.value = False

    def play(
        self,
        motion: bool | Trajectory = True,
        *,
        speed: float = 1.0,
        loop: bool = False,
        layer: PlaybackLayer | None = None,
        at: float | None = None,
    ) -> None:
        """Start or stop an animation."""
        if isinstance(motion, Trajectory):
            complete(_freeze(self.model), dict(motion.at(0.0)))  # raises for unknown names
            playback = TrajectoryPlayback(
                self._server.gui,
                motion,
                speed=speed,
                loop=loop,
                on_seek=self._seek,
                on_run=self._run,
                layer=layer,
            )
            if self._playback is not None:
                self._playback.remove()
            self._playback = playback
            self._run(True) if at is None else self._seek(at)
            return
        with self._change:
            start = {**self._values, **self._quaternions.angles}
            limits, angles = self._ranges.limits_at(self._values), self._quaternions.angles
            ranges = select_animated(self._shown, limits, angles, self._values, self._units)
            self._stop_animation()
            self._animation = RangeAnimation(start, ranges, time.monotonic()) if motion else None
            self._request_update()
        self._panel.playing.value = motion

    def _run(self, running: bool) -> None:
        """Start or stop the trajectory that was played last."""
        with self._change:
            self._stop_animation()
            if running and self._playback is not None:
                self._playback.start(time.monotonic())
                self._animation = self._playback
            self._request_update()
        self._panel.playing.value = False

    def _seek(self, time: float) -> None:
        """Show the trajectory that was played last at one of its times [s], and stop there."""
        with self._change:
            self._stop_animation()
            values = {} if self._playback is None else self._playback.seek(time)
        self.move(values)

    def _stop_animation(self) -> None:
        """Stop all animations; the lock has to be held."""
        self._animation = None
        if self._playback is not None:
            self._playback.pause()

    def refresh(self) -> None:
        """Show the present model; values of symbols that remain are kept.

        This happens by itself after every edit of the given model.
        """
        with self._change:
            self._edited = True
            self._request_update()

    def settled(self, timeout: float = 10.0) -> bool:
        """Wait at most ``timeout`` [s] for the page to be up to date; return True if it is."""
        begin = time.monotonic()
        with self._change:
            drawn = self._change.wait_for(lambda: self._done >= self._asked, timeout)
        return drawn and self.collisions.worker.wait_until_idle(timeout - (time.monotonic() - begin))

    def wait(self) -> None:
        """Keep the page up until :meth:`stop` or Ctrl-C; closing it in the browser changes nothing."""
        if self._stopping:
            raise KineverseError(web.TAKEN_DOWN)
        # After an interrupted join the thread counts as finished (Python 3.11), and a wait without a limit
        # cannot be interrupted on every platform.
        while not self._ended.wait(timeout=0.5):
            pass

    def stop(self) -> None:
        """Take the page down; further calls do nothing."""
        with self._change:
            if self._stopping:
                return
            self._stopping = True
            self._change.notify_all()
        if self._listener is not None:
            self._listener.close()
        self._worker.join(timeout=20.0)
        self.collisions.worker.stop()
        web.stop(self._server)
        self._ended.set()

    def __repr__(self) -> str:
        return f"<page of {self.model!r}, {'taken down' if self._stopping else self.address}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        model = _freeze(self.model)
        values = complete(model, keep_known(model, self.values))
        address = "" if self._stopping else self.address
        note = "This page has been taken down." if self._stopping else ""
        return bundle_display(repr(self), model, values, self._camera, address=address, note=note)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _build_panel(self) -> Panel:
        self._ranges = Ranges(self._shown)
        self._quaternions = QuaternionAngles(self._shown, self._values)
        self._drive = VelocityDrive(self._shown)
        self._units = infer_units(self._shown, self._values, self._ranges.names)
        self._units.update(dict.fromkeys(self._quaternions.angles, "rad"))
        return Panel(
            self._server.gui,
            self._scene,
            self.collisions,
            self._ranges,
            self._quaternions,
            self._drive,
            self._units,
            self._values,
            self._drag,
            on_move=self._set_from_slider,
            on_drive=lambda name, speed: self.drive({name: speed}),
            on_reset=self.reset,
            on_play=self.play,
            on_convert=self._request_redraw,
            display=self._display,
            sliders=not self._is_driven,
        )

    def _set_from_slider(self, name: str, value: float) -> None:
        """Take the value of a slider that a user moved; sliders of locked coordinates are moved back."""
        with self._change:
            if name in self._quaternions.angles:
                self._values.update(self._quaternions.set_angle(name, value))
                self._request_update()
            elif name in self._values:
                down, up = (False, False)
                if name in self._ranges.lockable and not self._panel.beyond:
                    down, up = self._ranges.locked_directions(self._values)[name]
                stays = (down and value < self._values[name]) or (up and value > self._values[name])
                if not stays:
                    self._values[name] = value
                self._request_update([name] if stays else ())

    def _request_update(self, set_by_program: Iterable[str] = ()) -> None:
        """Request an update of the page; the lock has to be held.

        Only sliders of values that a program has set are moved: a slider that is being dragged is ahead of
        the drawing, and would jump back.
        """
        self._asked += 1
        self._driven.update(set_by_program)
        self._change.notify_all()

    def _drag_moved(self) -> None:
        """Let the model follow the gizmo, and nothing else."""
        with self._change:
            if self._animation is not None or self._drive.running:
                self._stop_animation()
                self._drive.stop()
                self._panel.playing.value = False
            self._request_update()

    def _request_redraw(self) -> None:
        with self._change:
            self._request_update()

    def _work(self) -> None:
        """Draw the newest values until :meth:`stop`."""
        while True:
            with self._change:
                self._change.wait_for(self._has_work)
                if self._stopping:
                    return
            self._drag.prepare()
            with self._change:
                self._animate(time.monotonic())
                asked, edited, self._edited = self._asked, self._edited, False
                values, driven, self._driven = dict(self._values), self._driven, set()
            self._draw(values, driven, edited)
            self._draw_layer()
            with self._change:
                self._done = max(self._done, asked)
                self._change.notify_all()
                self._change.wait_for(lambda: self._stopping, timeout=PERIOD)

    def _has_work(self) -> bool:
        running = self._animation is not None or self._drive.running or self._drag.pending
        return self._stopping or self._asked > self._done or running

    def _animate(self, now: float) -> None:
        """Set the values that the animation and the speeds give at a time [s]."""
        if self._animation is not None:
            for name, value in self._animation.values_at(now).items():
                turns = name in self._quaternions.angles
                changed = self._quaternions.set_angle(name, value) if turns else {name: value}
                self._values.update(changed)
                self._driven.update(changed)
            if isinstance(self._animation, TrajectoryPlayback):
                self._quaternions.update(self._values)
            if self._animation.finished:
                self._stop_animation()
        if self._drive.running:
            moved = self._drive.step(self._values, now - self._drawn)
            self._values.update(moved)
            self._driven.update(moved)
            self._quaternions.update(self._values)
        if self._drag.pending:
            moved = self._drag.step(self._values)
            self._values.update(moved)
            self._driven.update(moved)
            self._quaternions.update(self._values)
        self._drawn = now

    def _rebuild(self) -> dict[str, float]:
        model = _freeze(self.model)
        with self._change:
            # The present values, because a slider may have moved since the update was requested.
            current = complete(model, keep_known(model, self._values))
            # After a further edit there may be values of symbols that this model does not have yet.
            self._values = {**self._values, **current} if self._edited else dict(current)
            self._initial = complete(model, keep_known(model, self._initial))
            self._shown = model
            self._stop_animation()
            if self._playback is not None and not {*map(str, self._playback.trajectory.symbols)} <= {
                *current
            }:
                self._playback.remove()
                self._playback = None
        self._scene.refresh(model, current)
        self._drag.refresh(model)
        self._panel.remove()
        self._panel = self._build_panel()
        return current

    def _draw(self, values: Mapping[str, float], driven: Iterable[str], edited: bool) -> None:
        """Show values, or the reason why they cannot be shown; then the drawing stays as it was."""
        try:
            if edited:
                values = self._rebuild()
            self._panel.update(values, driven)
            self._scene.update(values)
            self._drag.follow()
            self.collisions.worker.update(values, edited)
            if self.unplaced:
                self._panel.show(format_failure(f"Not finite, and hidden: {', '.join(self.unplaced)}."))
                return
            if self._is_driven:
                self._panel.show(Html(""))
                return
            # An empty mapping would lack values; an empty state is that of a model without symbols.
            violated = self._shown.violations(State(values))
            known = {v.name: self._shown.constraints.get(v.name) for v in violated}
            scales = {name: self._panel.scale_constraint(c) for name, c in known.items() if c is not None}
            self._panel.show(format_violations(violated, violated.unchecked, scales))
        except KineverseError as error:
            self._panel.show(format_failure(str(error)))
        except Exception as error:
            # The thread survives any error at one state, and reports it.
            logger.exception("the page could not be updated")
            self._panel.show(format_failure(f"{type(error).__name__}: {error}"))

    def _draw_layer(self) -> None:
        """Show what belongs to the trajectory that is played, at the time that was drawn."""
        playback = self._playback
        if playback is not None:
            try:
                playback.draw()
            except Exception:
                # The thread survives: the layer may be removed meanwhile.
                logger.exception("the layer of the trajectory could not be updated")


def _freeze(model: ModelView) -> ModelView:
    return model.snapshot() if isinstance(model, Model) else model
