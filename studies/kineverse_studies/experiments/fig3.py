"""``fig3``: the garage door and its lock (2022 paper, IV-A, Fig. 3).

The paper's coordinate is the position a of an edge in [0, l], where a = l is closed and a = 0 is open. The
angle arccos(a/l) of the door has an infinite slope at a = l. The regular form uses the angle.
The third plot compares the speeds of the upper edge per unit of either coordinate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse.articulations import GarageDoor
from kineverse.compilation import CompiledFunction, compile
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import point
from kineverse.view.plots import Figure

from .registry import Options, Progress
from .report import Report, ReportTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


OPTIONS = ()
LENGTH = 2.0
PARTS = {"A": 0.0, "25 %": 0.25, "50 %": 0.5, "75 %": 0.75, "B": 1.0}
"""Points along the door by name, from the lower edge A to the upper edge B, as fractions of its length."""
_OPENINGS = np.linspace(0.0, LENGTH, 20)
_HANDLE = np.linspace(0.0, 0.6, 50)
_LOCK_AT = (1.0, 2.0)
_BEFORE_CLOSED = tuple(10.0**-k for k in range(1, 9))


@dataclass(frozen=True)
class GarageDoorCurves:
    paths: dict[str, Array]  # paths of points in x and z by name, (20, 2) each [m]
    unlocked: dict[float, Array]  # upper bound of the speed by the position of the door, (50,) each
    published: Array  # speed of the upper edge per unit of a [m/m], and of the angle [m/rad], (200,) each
    regular: Array


def run(progress: Progress, options: Options) -> Report:
    published, regular = _make_door("published"), _make_door("regular")
    paths = {
        name: _edge_path(published, part, _OPENINGS)
        for name, part in progress(PARTS.items(), "fig3", "point")
    }
    angles = np.arccos(_OPENINGS / LENGTH)
    difference = max(
        float(np.abs(_edge_path(regular, part, angles) - paths[n]).max()) for n, part in PARTS.items()
    )
    inputs = [published.symbol("garage/door"), published.symbol("garage/bolt")]
    bound = compile(published.constraints["garage/lock"].upper, inputs)
    unlocked = {a: bound.batch(np.column_stack([np.full(50, a), _HANDLE])) for a in _LOCK_AT}
    slopes = _slopes(published, LENGTH - np.array(_BEFORE_CLOSED))
    regular_slopes = _slopes(regular, np.arccos(1 - np.array(_BEFORE_CLOSED) / LENGTH))
    closed = float(_slopes(regular, np.array([0.0]))[0])
    measured = GarageDoorCurves(
        paths,
        unlocked,
        _slopes(published, np.linspace(0, LENGTH - 1e-3, 200)),
        _slopes(regular, np.linspace(0, math.pi / 2, 200)),
    )
    steps = {a: _unlocking_bolt(bound, a) for a in _LOCK_AT}
    return Report(
        name="fig3",
        title="The garage door and its lock (2022 paper, Fig. 3, Eqs. 11-13)",
        tables=(
            ReportTable(
                "Ends of the door at some openings",
                ("a [m]", "A: x [m]", "A: z [m]", "B: x [m]", "B: z [m]", "angle [deg]"),
                tuple(
                    (a, *paths["A"][i], *paths["B"][i], math.degrees(angles[i]))
                    for i, a in enumerate(_OPENINGS)
                    if i in (0, 5, 10, 15, 19)
                ),
            ),
            ReportTable(
                "The lock: upper bound of the speed of a [m/s], by the position of its bolt b",
                ("a [m]", "b = 0", "b = 0.29", "b = 0.31", "b = 0.6", "unlocked from b ="),
                tuple(
                    (a, *(float(bound([a, b])) for b in (0.0, 0.29, 0.31, 0.6)), steps[a]) for a in _LOCK_AT
                ),
            ),
            ReportTable(
                "How far the upper edge moves, shortly before the door is closed",
                ("before closed [m]", "published [m], per m of a", "regular [m], per rad of the angle"),
                (
                    *zip(_BEFORE_CLOSED, slopes.tolist(), regular_slopes.tolist(), strict=True),
                    ("closed", "no bound", closed),
                ),
            ),
        ),
        numbers={
            "length": LENGTH,
            "a": _OPENINGS.tolist(),
            "paths": {name: path.tolist() for name, path in paths.items()},
            "forms_apart": difference,
            "b": _HANDLE.tolist(),
            "unlocked": {f"a={a:g}": u.tolist() for a, u in unlocked.items()},
            "before_closed": list(_BEFORE_CLOSED),
            "slope_published": slopes.tolist(),
            "slope_regular": regular_slopes.tolist(),
            "slope_regular_closed": closed,
            "paper": {"door": "a = 0 open, a = l closed", "lock_step_at": 0.3, "locked_at": 2.0},
        },
        figure=Figure(lambda canvas: _draw(canvas, measured), (13.0, 4.2)),
    )


def _make_door(form: str) -> Model:
    model = Model()
    with model.edit() as edit:
        edit.apply(GarageDoor(name="garage", parent=WORLD, length=LENGTH, form=form))  # type: ignore[arg-type]
    return model


def _edge_path(model: Model, part: float, coordinates: Array) -> Array:
    """Return the path of a point of the door in x and z at coordinates, (N, 2)."""
    position = (model.fk("garage/door") @ point(0, 0, part * LENGTH))[[0, 2]]
    path: Array = compile(position, [model.symbol("garage/door")]).batch(coordinates[:, None])
    return path


def _unlocking_bolt(bound: CompiledFunction, a: float) -> float:
    """Return the least position of the bolt in [0, .6] at which a door at a is unlocked, by bisection."""
    low, high = 0.0, float(_HANDLE[-1])
    if float(bound([a, low])) > 0.5:
        return low
    while high - low > 1e-12:
        middle = (low + high) / 2
        low, high = (low, middle) if float(bound([a, middle])) > 0.5 else (middle, high)
    return high


def _slopes(model: Model, coordinates: Array) -> Array:
    q = model.symbol("garage/door")
    position = model.fk("garage/upper_edge")[:3, 3]
    derivative = compile(position.jacobian([q]), [q]).batch(coordinates[:, None])
    slopes: Array = np.linalg.norm(derivative.reshape(len(coordinates), 3), axis=1)
    return slopes


def _draw(canvas: Canvas, measured: GarageDoorCurves) -> None:
    door, lock, slope = canvas.subplots(1, 3)
    for i in range(len(_OPENINGS)):
        ends = np.array([measured.paths[name][i] for name in ("A", "B")])
        door.plot(*ends.T, color="0.85", linewidth=1, zorder=1)
    for name, path in measured.paths.items():
        door.plot(*path.T, marker="o", markersize=3, label=name)
    door.set(title="the door, a = 0 … 2 m", xlabel="x [m]", ylabel="z [m]", aspect="equal")
    door.legend(title="along the door")
    for (a, bound), style in zip(measured.unlocked.items(), ("--", "-"), strict=True):
        lock.plot(_HANDLE, bound, style, label=f"a = {a:g} m")
    lock.axvline(0.3, color="0.8", zorder=0)
    lock.set(title="the lock", xlabel="b", ylabel="unlocked", ylim=(-0.1, 1.1))
    lock.legend()
    share = np.linspace(0, 1, 200)
    slope.plot(share * (1 - 5e-4), measured.published, label="published: by a [m/m]")
    slope.plot(1 - share, measured.regular, label="regular: by the angle [m/rad]")
    slope.set(title="speed of the upper edge", xlabel="a/l, and 1 - angle/90°: 1 is closed", ylim=(0, 12))
    slope.legend()
