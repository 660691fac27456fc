"""Proximity queries for display: nearest pairs, their markers, and a background thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from kineverse.errors import KineverseError
from kineverse.geometry import DistanceResult, Rule, Scene
from kineverse.geometry.exclusions import RIGID, ExcludedPairs, find_unusable_shapes, label_unusable_shapes
from kineverse.lie import rotation_along_z, transform, translation
from kineverse.model.body import Cone, Cylinder
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.state import State

from .drawables import Drawable
from .meshes import mesh_geometry
from .rendering.triangle_mesh import Floats, TriangleMesh, mesh_placeholder

RADIUS = 0.1  # default distance within which pairs are shown [m]
MOST_PAIRS = 40  # most pairs that are shown; further ones are counted, not drawn


@dataclass(frozen=True, slots=True)
class ProximityResult:
    """Nearest pairs of bodies at a state."""

    radius: float  # distance within which pairs were searched [m]
    pairs: Sequence[DistanceResult] = ()  # nearest pairs, nearest first, at most MOST_PAIRS of them
    found: int = 0  # number of pairs within the radius
    touching: int = 0  # of those that touch or penetrate
    ignored: Sequence[tuple[DistanceResult, str]] = ()
    checked_pairs: int = 0  # numbers of pairs of bodies that are checked
    unchecked_pairs: int = 0  # that are excluded


class ProximityQuery:
    """Distance queries in a model, for one thread; unusable shapes are excluded."""

    def __init__(self, model: ModelView, decomposed: bool = False) -> None:
        self._model = model
        self.decomposed = decomposed
        self._make()

    def _make(self) -> None:
        self._unusable = find_unusable_shapes(self._model)
        self.problems = label_unusable_shapes(self._model, self._unusable)
        self._scene = self._scene_with(())
        self._all: Scene | None = None
        self._ignored = ExcludedPairs(self._model, self._scene.bodies)

    def _scene_with(self, rules: Iterable[Rule]) -> Scene:
        decomposed = ("*",) if self.decomposed else ()
        return Scene(self._model, rules=rules, decomposed=decomposed, leave_out=self._unusable)

    def refresh(self) -> None:
        """Take over edits of the model."""
        if find_unusable_shapes(self._model) != self._unusable:
            self._make()
        else:
            self._ignored = ExcludedPairs(self._model, self._scene.bodies)

    def evaluate(
        self,
        values: Mapping[str, float],
        radius: float = RADIUS,
        *,
        containing: str = "",
        ignored: bool = False,
    ) -> ProximityResult:
        """Return the nearest pairs at values of all symbols, by name."""
        # A state, because the values may include symbols that the scene does not have.
        self._scene.update(State(values))
        found = _filter_by_name(self._scene.pairs_within(radius), containing)
        checked_pairs, unchecked_pairs = self._ignored.counts
        return ProximityResult(
            radius,
            found[:MOST_PAIRS],
            len(found),
            sum(1 for _ in takewhile(lambda pair: pair.touches, found)),  # contacts come first
            self._find_unchecked_pairs(values, radius, containing) if ignored else (),
            checked_pairs,
            unchecked_pairs,
        )

    def _find_unchecked_pairs(
        self, values: Mapping[str, float], radius: float, containing: str
    ) -> list[tuple[DistanceResult, str]]:
        if self._all is None:
            self._all = self._scene_with([Rule("*", "*", check=True)])
        self._all.update(State(values))
        found = _filter_by_name(self._all.pairs_within(radius), containing)
        reasons = ((pair, self._ignored.reason(pair.a, pair.b)) for pair in found)
        return [(pair, why) for pair, why in reasons if why not in ("", RIGID)][:MOST_PAIRS]


def _filter_by_name(pairs: Sequence[DistanceResult], containing: str) -> Sequence[DistanceResult]:
    text = containing.strip().lower()
    return [pair for pair in pairs if text in pair.a.lower() or text in pair.b.lower()] if text else pairs


FAR, MIDDLE, CLOSE = (0.13, 0.62, 0.20), (0.98, 0.78, 0.05), (0.95, 0.33, 0.10)
"""The colours at the radius, half way, and just before contact."""

CONTACT = (0.86, 0.04, 0.10)
IGNORED = (0.45, 0.48, 0.52)

BALL, LINE, SHAFT, HEAD, TIP = 0.1, 0.05, 0.05, 0.12, 0.35
"""Radii of ends, lines, shafts and heads, and length of tips, as fractions of an arrow's length."""


@dataclass(frozen=True, slots=True, eq=False)
class ProximityMarkers:
    """Lines and arrows at nearest points."""

    lines: Floats  # (N, 2, 3) from a to b, of all pairs [m]; between separate bodies along the normal
    colors: Floats  # (N, 3) red, green, blue in [0, 1]
    arrows: Floats  # (M, 2, 3), [m]
    depths: tuple[str, ...]  # M texts: the penetration depths of these

    @staticmethod
    def from_result(found: ProximityResult, length: float) -> ProximityMarkers:
        """Return the markers of a result, with arrows of a length [m]."""
        touching = [pair for pair in found.pairs if pair.touches]
        pairs = [*found.pairs, *(pair for pair, _ in found.ignored)]
        colors = [distance_color(pair.distance, found.radius) for pair in found.pairs]
        return ProximityMarkers(
            _ends((pair.point_a, pair.point_b) for pair in pairs),
            np.array([*colors, *[IGNORED] * len(found.ignored)]).reshape(-1, 3),
            _ends((pair.point_a, pair.point_a + length * pair.normal) for pair in touching),
            tuple(format_millimetres(-pair.distance) for pair in touching),
        )


def distance_color(distance: float, radius: float) -> tuple[float, float, float]:
    """Return the colour of a distance: green at a radius [m], orange at 0, red in contact."""
    if distance <= 0.0:
        return CONTACT
    share = min(distance / radius, 1.0) if radius > 0.0 else 1.0
    stops = np.array([CLOSE, MIDDLE, FAR])
    red, green, blue = (float(np.interp(share, (0.0, 0.5, 1.0), stops[:, k])) for k in range(3))
    return red, green, blue


def format_millimetres(distance: float) -> str:
    """Format a distance [m] in millimetres, without insignificant digits."""
    value = 1000.0 * distance
    digits = 0 if abs(value) >= 99.5 else 1 if abs(value) >= 0.95 else 2
    rounded = round(value, digits) + 0.0  # and no minus sign before a zero
    return f"{rounded:.{digits}f} mm".replace("-", "−")


def create_marker_drawables(marks: ProximityMarkers, length: float) -> list[Drawable]:
    """Return markers as parts in the world, with arrows of a length [m]."""
    found = []
    for ends, shade in zip(marks.lines, marks.colors, strict=True):
        rgba = (float(shade[0]), float(shade[1]), float(shade[2]), 1.0)
        ball = mesh_placeholder().scale(length * BALL / 0.05)  # which is 0.05 m large
        surfaces = [ball.transform(translation(end)) for end in ends]
        if (rod := _rod(ends, length * LINE)) is not None:
            surfaces.append(rod)
        found += [Drawable(WORLD, surface, rgba, "visual") for surface in surfaces]
    for ends in marks.arrows:
        found += [
            Drawable(WORLD, surface, (*CONTACT, 1.0), "visual") for surface in build_arrow(ends, length)
        ]
    return found


def _ends(pairs: Iterable[Sequence[Floats]]) -> Floats:
    return np.array([np.stack(list(ends)) for ends in pairs]).reshape(-1, 2, 3)


def build_arrow(ends: Floats, length: float) -> list[TriangleMesh]:
    """Return the surfaces of an arrow between two points (2, 3), as thick as one of a length [m]."""
    tip = mesh_geometry(Cone(length * HEAD, length * TIP))
    pose = _pose_along(ends)
    pose[:3, 3] = ends[0] + (1.0 - TIP / 2) * (ends[1] - ends[0])
    shaft = np.array([ends[0], ends[0] + (1.0 - TIP) * (ends[1] - ends[0])])
    rod = _rod(shaft, length * SHAFT)
    return [tip.transform(pose), *([rod] if rod is not None else [])]


def _rod(ends: Floats, radius: float) -> TriangleMesh | None:
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return mesh_geometry(Cylinder(radius, length)).transform(_pose_along(ends)) if length > 1e-6 else None


def _pose_along(ends: Floats) -> Floats:
    """Return the pose in the middle of a line with z along it, 4×4."""
    return transform(rotation_along_z(ends[1] - ends[0]), ends.mean(axis=0))


logger = logging.getLogger(__name__)

QUERY_PERIOD = 1.0 / 20.0  # least time between two queries [s]
PAUSE_FACTOR = 3.0  # pause after a query as a multiple of its duration: Python threads slow each other down


@dataclass(frozen=True, slots=True)
class ProximityRequest:
    """Request for proximity queries: enabled or not, the radius [m], and a text that names contain.

    ``ignored``: also excluded pairs. ``decomposed``: meshes as the hulls of their parts.
    """

    enabled: bool = False
    radius: float = RADIUS
    containing: str = ""
    ignored: bool = False
    decomposed: bool = False


@dataclass(frozen=True, slots=True)
class ProximityStatus:
    """Latest result, the reasons for which bodies and shapes are excluded, and the failure if any."""

    result: ProximityResult | None = None
    problems: Mapping[str, str] | None = None
    failure: str = ""


class ProximityWorker:
    """Background thread that evaluates proximity queries at the newest values."""

    def __init__(
        self, model: ModelView, values: Mapping[str, float], show: Callable[[ProximityStatus], None]
    ) -> None:
        self._model, self._values, self._show = model, dict(values), show
        self._request = ProximityRequest()
        self._query: ProximityQuery | None = None
        self._edited = False
        self._asked, self._done, self._stopping = 0, 0, False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="kineverse-near", daemon=True)
        self._thread.start()

    @property
    def request(self) -> ProximityRequest:
        """The present request."""
        return self._request

    def set_request(self, request: ProximityRequest) -> None:
        """Replace the request."""
        with self._change:
            if request != self._request:
                self._request = request
                self._ask()

    def update(self, values: Mapping[str, float], edited: bool = False) -> None:
        """Evaluate other values, and an edited model if ``edited``."""
        with self._change:
            self._values = dict(values)
            self._edited |= edited
            if self._request.enabled:
                self._ask()

    def wait_until_idle(self, timeout: float) -> bool:
        """Wait at most ``timeout`` [s] for all pending queries; return True if they are done."""
        with self._change:
            return self._change.wait_for(lambda: self._done >= self._asked, timeout)

    def stop(self) -> None:
        """End the thread."""
        with self._change:
            self._stopping = True
            self._change.notify_all()
        self._thread.join(timeout=5.0)

    def _ask(self) -> None:
        self._asked += 1
        self._change.notify_all()

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._stopping or self._asked > self._done)
                if self._stopping:
                    return
                asked, values, request = self._asked, self._values, self._request
                edited, self._edited = self._edited and request.enabled, self._edited and not request.enabled
            begin = time.monotonic()
            try:
                self._show(self._evaluate(values, request, edited))
            except Exception:
                # The page may be closing; the thread survives any error of its display.
                logger.exception("proximity could not be shown")
            took = time.monotonic() - begin
            with self._change:
                self._done = max(self._done, asked)
                self._change.notify_all()
                self._change.wait_for(lambda: self._stopping, timeout=max(QUERY_PERIOD, PAUSE_FACTOR * took))

    def _evaluate(
        self, values: Mapping[str, float], request: ProximityRequest, edited: bool
    ) -> ProximityStatus:
        if not request.enabled:
            return ProximityStatus()
        try:
            if self._query is None or self._query.decomposed != request.decomposed:
                self._query = ProximityQuery(self._model, request.decomposed)
            elif edited:
                self._query.refresh()
            found = self._query.evaluate(
                values, request.radius, containing=request.containing, ignored=request.ignored
            )
            return ProximityStatus(found, self._query.problems)
        except KineverseError as error:
            return ProximityStatus(failure=str(error))
        except Exception as error:
            logger.exception("no distances")
            return ProximityStatus(failure=f"{type(error).__name__}: {error}")
