"""Handles of an articulated object: slim bodies that a joint moves, far from its axis."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse import lie
from kineverse.errors import UnknownNameError
from kineverse.geometry import Scene
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.model.symbolic_view import cached_for_version
from kineverse.state import State
from kineverse.symbols import Symbol

from .finger_branches import path_to_root
from .graspable_features import Part, ProtrudingBar, find_bars, find_parts, free_length

_FREE = 0.15  # free space in front of a bar that a hand needs [m]
_PART_OF_RANGE = 0.05
_WITHIN = 0.5  # cosine above which a bar points along the opening motion, or inside below minus it
_PLACES = 9


@dataclass(frozen=True, slots=True, eq=False)
class Handle:
    """ProtrudingBar that a gripper can hold.

    Attributes
    ----------
    frame
        Frame of the body with the shapes of the bar.
    coordinate
        Coordinate of the object that moves it.
    pose
        Pose frame_T_bar (4, 4) [m]: its origin is the middle of the bar, z is along the bar, x points away
        from what the bar is fixed to: a hand approaches along -x.
    length, thickness, depth, clearance
        Size of the bar along z, across y and along x, and the free space between bar and panel along x [m].
    shape
        Index of the bar among the shapes of the body.
    is_visual
        True if the body has visual shapes alone: the bar is then taken from these.

    See Also
    --------
    kineverse.grasping.find_handle
    """

    frame: str
    coordinate: Symbol
    pose: Array
    length: float
    thickness: float
    depth: float
    clearance: float
    shape: int
    is_visual: bool = False

    @property
    def is_knob(self) -> bool:
        """True if the bar is about as long as thick, so that it has no direction to speak of."""
        return self.length < 1.5 * self.thickness

    def __str__(self) -> str:
        sizes = f"{self.length * 1e3:.0f} mm long, {self.thickness * 1e3:.0f} mm thick"
        kind = ", from visual shapes" if self.is_visual else ""
        return f"handle {self.frame}: {sizes}, {self.clearance * 1e3:.0f} mm free behind it{kind}"


def find_handles(
    model: ModelView, coordinate: Symbol | str, *, decomposed: Iterable[str] = ()
) -> tuple[Handle, ...]:
    """Return the handles that a coordinate moves, the best first; empty if there is none.

    A handle is a bar or a knob: a slim convex shape that stands out from the rest of its rigid link, with
    free space in front of it and not on the inner side. Bars that point along the opening motion come first,
    and of these the ones that the coordinate moves the most: the farthest from the axis of a door.

    Everything else is at its default value. Bodies without collision shapes count by their visual shapes.

    Parameters
    ----------
    coordinate
        Coordinate of a door, a drawer or any other mechanism.
    decomposed
        Bodies, or patterns, as for :class:`kineverse.geometry.Scene`: without them a mesh is its convex hull.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> [handle.frame for handle in kv.grasping.find_handles(model, "kitchen/oven_door")]
    ['kitchen/oven_door_handle']
    """
    return _search(model, coordinate, decomposed)[0]


def find_handle(
    model: ModelView, coordinate: Symbol | str, frame: str | None = None, *, decomposed: Iterable[str] = ()
) -> Handle:
    """Return the best handle that a coordinate moves, or the one at a frame.

    Raises
    ------
    UnknownNameError
        If there is none; the message says which bodies the coordinate moves and why none is a handle.

    Examples
    --------
    >>> handle = kv.grasping.find_handle(kv.load("kitchen"), "kitchen/fridge_door")
    >>> handle.frame, round(handle.length, 2)
    ('kitchen/fridge_door_handle', 0.6)
    """
    result, why = _search(model, coordinate, decomposed)
    if frame is not None:
        model.fk(frame)  # raises for an unknown frame
        at = [handle for handle in result if handle.frame == frame]
        if result and not at:
            listed = ", ".join(repr(handle.frame) for handle in result)
            raise UnknownNameError(f"'{coordinate}' moves no handle at '{frame}'. Its handles: {listed}.")
        result = tuple(at)
    if not result:
        raise UnknownNameError(f"'{coordinate}' moves no handle. {why}")
    return result[0]


def _search(
    model: ModelView, coordinate: Symbol | str, decomposed: Iterable[str]
) -> tuple[tuple[Handle, ...], str]:
    """Return the handles, and a sentence on why there is none; those of whole meshes are kept."""
    symbol = coordinate if isinstance(coordinate, Symbol) else model.symbol(coordinate)
    if patterns := tuple(decomposed):
        return _search_anew(model, symbol, patterns)
    return cached_for_version(model, ("handles", symbol), lambda: _search_anew(model, symbol, ()))


def _search_anew(
    model: ModelView, symbol: Symbol, decomposed: tuple[str, ...]
) -> tuple[tuple[Handle, ...], str]:
    motion = FrameDependence(model, [symbol])
    moved = [name for name in model.frames if motion.moves(name)]
    if not moved:
        return (), "It moves no frame."
    tops = {path_to_root(model, name)[-1] for name in moved}
    if decomposed:
        others = [f for f in model.bodies if path_to_root(model, f)[-1] not in tops]
        scene = Scene(model, leave_out=others, decomposed=decomposed)
    else:
        scene = Scene.of(model)
    bodies = {f for f in scene.bodies if path_to_root(model, f)[-1] in tops}
    if bodies.isdisjoint(moved):
        return (), f"It moves {_listed(moved)}, without shapes."
    state, opening, is_known = _open_a_little(model, symbol)
    scene.update(state)
    parts = find_parts(scene, bodies=bodies)
    poses = {name: scene.pose(name) for name in moved if name in bodies}
    scene.update(opening)
    shifts = {name: scene.pose(name) for name in poses}
    links = {name: _link(model, name) for name in bodies}
    own = [links[f] for f in poses if motion.moving_ancestors(f)[-1] == links[f]]
    further = [links[f] for f in poses if links[f] not in own]  # such as the lever on a door
    still = [part for part in parts if part.body not in poses and not model.speeds_of(part.body)]
    rated = []
    for link in dict.fromkeys((*own, *further)):
        body = [part for part in parts if links[part.body] == link]
        carriers = {*own, *(_link(model, f) for f in path_to_root(model, link))} - {link}
        around = [*still, *(part for part in parts if links[part.body] in carriers)]
        for bar in find_bars(body, around):
            before, after = poses[bar.part.body], shifts[bar.part.body]
            shift = (after @ lie.inverse(before) @ np.append(bar.part.middle, 1.0))[:3] - bar.part.middle
            distance = float(np.linalg.norm(shift))
            along = float(bar.rotation[:, 0] @ shift) / max(distance, 1e-6) if is_known else 0.0
            if along < -_WITHIN or not _is_free(bar, body, around):
                continue
            handle = _make_handle(model, symbol, bar, before, body, around)
            rated.append((link not in own, along < _WITHIN, -round(distance, 4), handle.thickness, handle))
    rated.sort(key=lambda row: row[:4])
    why = f"It moves {_listed([f for f in moved if f in bodies])}: no slim shape of these stands out, "
    why += "with free space in front of it."
    return tuple(row[4] for row in rated), why


def _link(model: ModelView, frame: str) -> str:
    """Return the first frame from a frame upwards that moves in its parent, or the topmost one."""
    path = path_to_root(model, frame)
    return next((f for f in path if model.speeds_of(f, model.frames[f].parent)), path[-1])


def _open_a_little(model: ModelView, symbol: Symbol) -> tuple[State, State, bool]:
    """Return the default state, one nearer to the further limit, and whether one limit is further."""
    state = model.default_state()
    start = state[symbol]
    low, high = model.limits(symbol)
    low, high = (start - 1.0 if math.isinf(low) else low), (start + 1.0 if math.isinf(high) else high)
    end = high if high - start >= start - low else low
    is_known = abs((high - start) - (start - low)) > 0.1 * (high - low)
    return state, state.updated({symbol: start + _PART_OF_RANGE * (end - start)}), is_known


def _is_free(bar: ProtrudingBar, body: Sequence[Part], around: Sequence[Part]) -> bool:
    x = bar.rotation[:, 0]
    front = bar.part.middle + (float(bar.part.extent(x[None])[0]) - float(bar.part.middle @ x) + 1e-4) * x
    return _free_length(front, x, bar, body, around, _FREE) > _FREE


def _free_length(
    origin: Array,
    direction: Array,
    bar: ProtrudingBar,
    body: Sequence[Part],
    around: Sequence[Part],
    length: float = math.inf,
) -> float:
    """Return the length of a ray to the first part but the bar and its mounts [m]."""
    own = free_length(origin, direction, body, but=bar.cluster, length=length)
    return min(own, free_length(origin, direction, around, length=length, hollow=True))


def _make_handle(
    model: ModelView,
    symbol: Symbol,
    bar: ProtrudingBar,
    world_T_frame: Array,
    body: Sequence[Part],
    around: Sequence[Part],
) -> Handle:
    axes = bar.rotation.T
    high, low = bar.part.extent(axes), -bar.part.extent(-axes)
    middle = bar.rotation @ ((high + low) / 2)
    depth, thickness, length = (high - low).tolist()
    x, z = axes[0], axes[2]
    places = np.linspace(-0.4, 0.4, _PLACES) * length
    back = [middle + place * z - (depth / 2 + 1e-5) * x for place in places]
    clearance = float(np.median([_free_length(origin, -x, bar, body, around) for origin in back]))
    pose = lie.round_exact(lie.inverse(world_T_frame) @ lie.transform(bar.rotation, middle))
    frame = bar.part.body
    is_visual = not model.bodies[frame].collisions
    return Handle(frame, symbol, pose, length, thickness, depth, clearance, bar.part.number, is_visual)


def _listed(names: Sequence[str], most: int = 6) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
