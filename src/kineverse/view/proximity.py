"""Proximity queries for display: nearest pairs, their markers, and a background thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
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
from kineverse.view.drawables import Drawable
from kineverse.view.meshes import mesh_geometry
from kineverse.view.triangle_mesh import Floats, TriangleMesh, mesh_placeholder

RADIUS = 0.1
"""Within what distance pairs are shown unless somebody says otherwise [m]."""

MOST_PAIRS = 40
"""Pairs that are shown: more than these are counted, not drawn."""


@dataclass(frozen=True, slots=True)
class ProximityResult:
    """What was found at a state.

    Attributes
    ----------
    radius
        Within what distance was looked [m].
    pairs
        The nearest pairs, nearest first, at most :data:`MOST_PAIRS` of them.
    found, touching
        How many pairs there are within the radius, and how many of them touch or penetrate.
    ignored
        Pairs within the radius that are not looked at although they can move with respect to each other, with
        the reason, nearest first; at most :data:`MOST_PAIRS`.
    looked_at, not_looked_at
        How many pairs of bodies there are of either kind.
    """

    radius: float
    pairs: Sequence[DistanceResult] = ()
    found: int = 0
    touching: int = 0
    ignored: Sequence[tuple[DistanceResult, str]] = field(default=())
    looked_at: int = 0
    unchecked_pairs: int = 0


class ProximityQuery:
    """Distances in a model, for one thread; shapes that cannot be used are left out.

    Parameters
    ----------
    model
        The model; after an edit :meth:`follow` has to be called.
    decomposed
        Whether meshes are the hulls that they were decomposed into, as far as they were.

    Attributes
    ----------
    problems
        Why bodies, or shapes of bodies, are left out, by what people call them.

    Raises
    ------
    MissingDependencyError
        If the extra ``geometry`` is not installed.
    """

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

    def follow(self) -> None:
        """Look at the model as it is now."""
        if find_unusable_shapes(self._model) != self._unusable:
            self._make()
        else:
            self._ignored = ExcludedPairs(self._model, self._scene.bodies)

    def at(
        self,
        values: Mapping[str, float],
        radius: float = RADIUS,
        *,
        containing: str = "",
        ignored: bool = False,
    ) -> ProximityResult:
        """Return what is near at values of all symbols, by name.

        Parameters
        ----------
        values
            [m], [rad].
        radius
            How near [m].
        containing
            Only pairs of which a name contains this, whatever its case.
        ignored
            Whether to look at ignored pairs as well.

        Raises
        ------
        KineverseError
            If there are no distances at these values, as where a pose is not finite.
        """
        # A state, for the values may be of more symbols than the scene has.
        self._scene.update(State(values))
        found = _filter_by_name(self._scene.pairs_within(radius), containing)
        looked_at, unchecked_pairs = self._ignored.counts
        return ProximityResult(
            radius,
            found[:MOST_PAIRS],
            len(found),
            sum(1 for _ in takewhile(lambda pair: pair.touches, found)),  # they come first
            self._find_unchecked_pairs(values, radius, containing) if ignored else (),
            looked_at,
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
"""Radii of the ends and middles of lines and arrows, and how long tips are, as parts of an arrow's length."""


@dataclass(frozen=True, slots=True, eq=False)
class ProximityMarkers:
    """What is drawn of nearest points.

    Attributes
    ----------
    lines
        (N, 2, 3) from a to b, of all pairs [m]. Between bodies that are apart that is along the normal.
    colors
        (N, 3) red, green, blue in [0, 1].
    arrows
        (M, 2, 3) along the normal, out of a where that is deepest in b, of the pairs that touch [m].
    depths
        M texts: how deep these are.
    """

    lines: Floats
    colors: Floats
    arrows: Floats
    depths: tuple[str, ...]

    @staticmethod
    def of(found: ProximityResult, length: float) -> ProximityMarkers:
        """Return the marks of what was found, with arrows of a length [m]."""
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
    """Return green at a radius [m], over yellow to orange the nearer it is; red in contact."""
    if distance <= 0.0:
        return CONTACT
    share = min(distance / radius, 1.0) if radius > 0.0 else 1.0
    stops = np.array([CLOSE, MIDDLE, FAR])
    red, green, blue = (float(np.interp(share, (0.0, 0.5, 1.0), stops[:, k])) for k in range(3))
    return red, green, blue


def format_millimetres(distance: float) -> str:
    """Return a distance [m] in millimetres, with no more digits than one can make use of."""
    value = 1000.0 * distance
    digits = 0 if abs(value) >= 99.5 else 1 if abs(value) >= 0.95 else 2
    rounded = round(value, digits) + 0.0  # and no minus sign before a zero
    return f"{rounded:.{digits}f} mm".replace("-", "−")


def create_marker_drawables(marks: ProximityMarkers, length: float) -> list[Drawable]:
    """Return marks as parts in the world, for a picture with arrows of a length [m]."""
    found = []
    for ends, shade in zip(marks.lines, marks.colors, strict=True):
        rgba = (float(shade[0]), float(shade[1]), float(shade[2]), 1.0)
        ball = mesh_placeholder().scaled(length * BALL / 0.05)  # which is 0.05 m large
        surfaces = [ball.moved(translation(end)) for end in ends]
        if (rod := _rod(ends, length * LINE)) is not None:
            surfaces.append(rod)
        found += [Drawable(WORLD, surface, rgba, "visual") for surface in surfaces]
    for ends in marks.arrows:
        found += [Drawable(WORLD, surface, (*CONTACT, 1.0), "visual") for surface in _arrow(ends, length)]
    return found


def _ends(pairs: Iterable[Sequence[Floats]]) -> Floats:
    return np.array([np.stack(list(ends)) for ends in pairs]).reshape(-1, 2, 3)


def _arrow(ends: Floats, length: float) -> list[TriangleMesh]:
    tip = mesh_geometry(Cone(length * HEAD, length * TIP))
    pose = _pose_along(ends)
    pose[:3, 3] = ends[0] + (1.0 - TIP / 2) * (ends[1] - ends[0])
    shaft = np.array([ends[0], ends[0] + (1.0 - TIP) * (ends[1] - ends[0])])
    rod = _rod(shaft, length * SHAFT)
    return [tip.moved(pose), *([rod] if rod is not None else [])]


def _rod(ends: Floats, radius: float) -> TriangleMesh | None:
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return mesh_geometry(Cylinder(radius, length)).moved(_pose_along(ends)) if length > 1e-6 else None


def _pose_along(ends: Floats) -> Floats:
    """Return the pose in the middle of a line with z along it, 4×4."""
    return transform(rotation_along_z(ends[1] - ends[0]), ends.mean(axis=0))


logger = logging.getLogger(__name__)

QUERY_PERIOD = 1.0 / 20.0
"""Least time between two looks [s]."""

PAUSE_FACTOR = 3.0
"""How many times as long as a look took is waited for the next one: python threads slow each other down."""


@dataclass(frozen=True, slots=True)
class ProximityRequest:
    """What to look for: whether at all, within what radius [m], names containing what, what else.

    ``ignored``: also pairs that are not looked at. ``decomposed``: meshes as the hulls of their parts.
    """

    on: bool = False
    radius: float = RADIUS
    containing: str = ""
    ignored: bool = False
    decomposed: bool = False


@dataclass(frozen=True, slots=True)
class ProximityStatus:
    """What was seen last: what is near, why bodies and shapes are left out, and what went wrong if it did."""

    nearness: ProximityResult | None = None
    problems: Mapping[str, str] | None = None
    failure: str = ""


class ProximityWorker:
    """Looks at the newest values whenever there are some, and hands on what it sees.

    Parameters
    ----------
    model
        The model.
    values
        The values of all symbols at first, by name [m], [rad].
    show
        Called by the thread with what it sees; nothing of it while nothing is wanted.
    """

    def __init__(
        self, model: ModelView, values: Mapping[str, float], show: Callable[[ProximityStatus], None]
    ) -> None:
        self._model, self._values, self._show = model, dict(values), show
        self._wanted = ProximityRequest()
        self._near: ProximityQuery | None = None
        self._edited = False
        self._asked, self._done, self._stopping = 0, 0, False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="kineverse-near", daemon=True)
        self._thread.start()

    @property
    def wanted(self) -> ProximityRequest:
        """What it looks for."""
        return self._wanted

    def set_request(self, wanted: ProximityRequest) -> None:
        """Look for something else from now on."""
        with self._change:
            if wanted != self._wanted:
                self._wanted = wanted
                self._ask()

    def update(self, values: Mapping[str, float], edited: bool = False) -> None:
        """Look at other values, and if it was edited, at a model that has changed."""
        with self._change:
            self._values = dict(values)
            self._edited |= edited
            if self._wanted.on:
                self._ask()

    def settled(self, timeout: float) -> bool:
        """Wait at most ``timeout`` [s] for all that was asked for; return whether it was seen."""
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
                asked, values, wanted = self._asked, self._values, self._wanted
                edited, self._edited = self._edited and wanted.on, self._edited and not wanted.on
            begin = time.monotonic()
            try:
                self._show(self._look(values, wanted, edited))
            except Exception:
                # The page may be going away, and the thread outlives whatever it is shown.
                logger.exception("what is near could not be shown")
            took = time.monotonic() - begin
            with self._change:
                self._done = max(self._done, asked)
                self._change.notify_all()
                self._change.wait_for(lambda: self._stopping, timeout=max(QUERY_PERIOD, PAUSE_FACTOR * took))

    def _look(self, values: Mapping[str, float], wanted: ProximityRequest, edited: bool) -> ProximityStatus:
        if not wanted.on:
            return ProximityStatus()
        try:
            if self._near is None or self._near.decomposed != wanted.decomposed:
                self._near = ProximityQuery(self._model, wanted.decomposed)
            elif edited:
                self._near.follow()
            found = self._near.at(values, wanted.radius, containing=wanted.containing, ignored=wanted.ignored)
            return ProximityStatus(found, self._near.problems)
        except KineverseError as error:
            return ProximityStatus(failure=str(error))
        except Exception as error:
            logger.exception("no distances")
            return ProximityStatus(failure=f"{type(error).__name__}: {error}")
