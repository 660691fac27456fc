"""Proximity controls, report and markers on the page."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from kineverse._extras import install_command
from kineverse._rich_display import Html, element, join_html
from kineverse.errors import InvalidValueError
from kineverse.geometry import DistanceResult
from kineverse.geometry.exclusions import is_installed
from kineverse.geometry.shapes import import_coal
from kineverse.model.model_view import ModelView

from .html import BREAK, FONT, HtmlBox, format_significant
from .proximity import (
    BALL,
    CONTACT,
    HEAD,
    RADIUS,
    SHAFT,
    TIP,
    ProximityMarkers,
    ProximityRequest,
    ProximityResult,
    ProximityStatus,
    ProximityWorker,
    distance_color,
    format_millimetres,
)
from .scene import ViewerScene
from .sliders import on_input

LINES = 12  # lines of the list; further pairs are counted, not listed
EXCLUDED_LINES = 5  # excluded bodies and shapes that are named with the reason; further ones are counted
TOUCHING = 5e-6  # contacts less deep than this are said to touch, instead of being 0.00 mm deep [m]

_GREY = "#868e96"


def format_proximity(found: ProximityResult, problems: Mapping[str, str]) -> Html:
    """Return HTML: the number of near pairs, the nearest with their distances, and excluded shapes."""
    lines = [element("b", _summary(found))]
    lines += [_line(pair, distance_color(pair.distance, found.radius)) for pair in found.pairs[:LINES]]
    lines += _more(found.found - LINES)
    if found.ignored:
        lines.append(_heading("Near, but not looked at"))
        lines += [_line(pair, None, why) for pair, why in found.ignored[:LINES]]
        lines += _more(len(found.ignored) - LINES)
    if problems:
        lines.append(_heading("No distances to"))
        lines += [element("div", f"{name}: {why}") for name, why in list(problems.items())[:EXCLUDED_LINES]]
        lines += _more(len(problems) - EXCLUDED_LINES)
    pairs = f"{found.checked_pairs} pairs are looked at, {found.unchecked_pairs} are not"
    lines.append(element("div", pairs, style=f"color:{_GREY};margin-top:5px"))
    return wrap_report(*lines)


def wrap_report(*content: str) -> Html:
    """Return content in the font of the panel."""
    return element("div", *content, class_="kineverse-near", style=f"{FONT}padding:2px 9px 8px")


def _summary(found: ProximityResult) -> str:
    if not found.found:
        return f"No pair is within {format_significant(found.radius)} m."
    near = f"{found.found} pair{'' if found.found == 1 else 's'} within {format_significant(found.radius)} m"
    if not found.touching:
        return f"{near}, none touches"
    return f"{near}, {found.touching} touch{'es' if found.touching == 1 else ''}"


def _line(pair: DistanceResult, rgb: tuple[float, float, float] | None, why: str = "") -> Html:
    shade = _GREY if rgb is None else f"rgb({','.join(str(round(255 * c)) for c in rgb)})"
    distance = format_millimetres(pair.distance)
    if pair.touches:
        distance = f"{format_millimetres(-pair.distance)} deep" if pair.distance < -TOUCHING else "touching"
    aside = join_html(" ", element("span", why, style=f"color:{_GREY}")) if why else ""
    return element(
        "div",
        element("span", "●", style=f"color:{shade}"),
        element("span", f"{pair.a} – {pair.b}", aside, style="flex:1"),
        element("span", distance, style="white-space:nowrap"),
        style="display:flex;gap:6px;margin-top:2px",
    )


def _heading(text: str) -> Html:
    return element("div", element("b", text), style="margin-top:5px")


def _more(count: int) -> list[Html]:
    return [element("div", f"and {count} more", style=f"color:{_GREY}")] if count > 0 else []


LARGEST_RADIUS = 0.5  # the largest radius on offer [m]
LONGEST_ARROW = 0.2  # largest length of an arrow on the page [m], also in a large kitchen
LABELS = 8  # depths that are written beside their arrows; more would cover the scene

WAITING = wrap_report(element("b", "Reading shapes …"))


class ProximityPanel:
    """Contacts and nearest pairs of bodies on the page, with their controls."""

    def __init__(
        self, server: Any, scene: ViewerScene, model: ModelView, values: Mapping[str, float]
    ) -> None:
        self._server, self._scene = server, scene
        self._report: HtmlBox | None = None
        self._folder: Any = None
        self._shapes: Any = None
        self._controls: tuple[Any, ...] = ()
        self._drawn: dict[str, Any] = {}
        self.status = ProximityStatus()
        # Programs, controls and the background thread write to a folder that edits of the model replace.
        self._lock = threading.RLock()
        self.worker = ProximityWorker(model, values, self._show)

    def add_folder(self, gui: Any) -> None:
        """Add the controls to a panel, with their present settings."""
        with self._lock:
            self._add_controls(gui, self.worker.request)
            self._write_report()

    def forget_folder(self) -> None:
        """Drop the controls before their panel is removed."""
        with self._lock:
            self._report, self._shapes, self._controls = None, None, ()

    def show_near(
        self, radius: float | None = RADIUS, *, containing: str = "", ignored: bool = False
    ) -> None:
        """Show nearest pairs of bodies, as the controls do."""
        if radius is None:
            self._apply(replace(self.worker.request, enabled=False))
            return
        if not 0.0 <= radius < float("inf"):
            raise InvalidValueError(f"A radius is a distance from 0 on [m], not {radius!r}.")
        import_coal()
        decomposed = self.worker.request.decomposed
        self._apply(ProximityRequest(True, float(radius), containing, ignored, decomposed))

    def show_shapes(self, shown: bool = True) -> None:
        """Show or hide the collision shapes, half transparent."""
        with self._lock:
            self._scene.show_collisions(shown)
            if self._shapes is not None:
                self._shapes.value = shown

    def show_decomposed(self, shown: bool = True) -> None:
        """Take meshes as the hulls of ``kineverse decompose``, for shapes and distances.

        Meshes that were not decomposed stay one hull; the log names them.
        """
        import_coal()
        self._apply(replace(self.worker.request, decomposed=shown))

    @property
    def result(self) -> ProximityResult | None:
        """The result shown last; None if there is no request, or if there are no distances."""
        return self.status.result

    def _add_controls(self, gui: Any, request: ProximityRequest) -> None:
        self._folder = gui.add_folder("Collisions", expand_by_default=request.enabled)
        with self._folder:
            self._shapes = gui.add_checkbox(
                "collision shapes",
                self._scene.collisions_shown,
                hint="What distances are computed to; bluish where hulls of what is seen stand in.",
            )
            self._shapes.on_update(lambda event: self._scene.show_collisions(event.target.value))
            if not is_installed():
                self._report = HtmlBox(gui, Html())
                return
            near = gui.add_checkbox("nearest pairs", request.enabled, hint="Lines where bodies are nearest.")
            radius = gui.add_slider(
                "within [m]",
                min=0.0,
                max=max(LARGEST_RADIUS, request.radius),
                step=0.005,
                initial_value=request.radius,
                hint="Green lines are that long; the nearer, the redder.",
            )
            only = gui.add_text("only", request.containing, hint="Only pairs with a name that contains this.")
            ignored = gui.add_checkbox(
                "ignored pairs", request.ignored, hint="Also pairs that are joined, or excepted by rules."
            )
            decomposed = gui.add_checkbox(
                "decomposed meshes", request.decomposed, hint="Meshes as the hulls of kineverse decompose."
            )
            self._report = HtmlBox(gui, Html())
        self._controls = near, radius, only, ignored, decomposed
        for control in self._controls:
            on_input(control, self._apply_controls)

    def _apply_controls(self, _: Any) -> None:
        request = ProximityRequest(*(control.value for control in self._controls))
        self._scene.decompose(request.decomposed)
        self.worker.set_request(request)
        self._write_report()

    def _apply(self, request: ProximityRequest) -> None:
        with self._lock:
            self._scene.decompose(request.decomposed)
            self.worker.set_request(request)
            if self._controls:
                near, radius, only, ignored, decomposed = self._controls
                self._folder.expand_by_default = request.enabled  # for browsers that open the page later
                radius.max = max(LARGEST_RADIUS, request.radius)
                near.value, radius.value = request.enabled, request.radius
                only.value, ignored.value = request.containing, request.ignored
                decomposed.value = request.decomposed
            self._write_report()

    def _show(self, status: ProximityStatus) -> None:
        """Draw a status; called by the background thread."""
        self._write_report(status)
        self._scene.show_transparent(self.worker.request.enabled)
        with self._server.atomic():
            before = self._drawn
            result = status.result
            marks = None if result is None else ProximityMarkers.from_result(result, self._length)
            self._drawn = self._draw(marks) if marks is not None and len(marks.lines) else {}
            # A node that is added under the name of another replaces it without flicker.
            for name in before.keys() - self._drawn.keys():
                before[name].remove()

    def _write_report(self, new: ProximityStatus | None = None) -> None:
        """Write the report of the latest status, which is ``new`` if given."""
        with self._lock:
            self.status = status = new or self.status
            text = Html()
            if not is_installed():
                extra, command = element("b", "geometry"), install_command("geometry")
                text = wrap_report("Distances need the extra ", extra, f": {command}")
            if status.failure:
                head = element("b", "There are no distances now.", style="color:#c92a2a")
                text = wrap_report(head, BREAK, status.failure)
            elif status.result is not None:
                text = format_proximity(status.result, status.problems or {})
            elif self.worker.request.enabled:
                text = WAITING
            if self._report is not None:
                self._report.show(text)

    @property
    def _length(self) -> float:
        return min(self._scene.length, LONGEST_ARROW)

    def _draw(self, marks: ProximityMarkers) -> dict[str, Any]:
        scene, length = self._server.scene, self._length
        colors = np.repeat(np.round(255 * marks.colors).astype(np.uint8)[:, None], 2, axis=1)
        nodes = [
            scene.add_line_segments(
                "/near/lines", marks.lines, colors, thickness=3.0, thickness_units="screen"
            ),
            scene.add_point_cloud(
                "/near/ends",
                marks.lines.reshape(-1, 3),
                colors.reshape(-1, 3),
                point_size=BALL * length,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            ),
        ]
        if len(marks.arrows):
            shaft, head, tip = SHAFT * length, HEAD * length, TIP * length
            red = tuple(round(255 * c) for c in CONTACT)
            nodes.append(
                scene.add_arrows(
                    "/near/arrows", marks.arrows, red, shaft_radius=shaft, head_radius=head, head_length=tip
                )
            )
        for k, (ends, depth) in enumerate(zip(marks.arrows[:LABELS], marks.depths, strict=False)):
            nodes.append(scene.add_label(f"/near/depth{k}", depth, position=ends[1], font_screen_scale=0.8))
        return {node.name: node for node in nodes}
