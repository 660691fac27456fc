"""``loop``: forward kinematics of a four-bar linkage with the crank as its coordinate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from kineverse.articulations import Revolute
from kineverse.compile import compile  # noqa: A004
from kineverse.lie import Array
from kineverse.loops import CloseLoop
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model import Model
from kineverse.spatial import translation

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .result import BenchmarkResult, bound_median, compare_speed

BOUND, PLAIN = "kineverse, bound call with input", "kineverse, plain call"
ROOTFINDER = "casadi, rootfinder in the interpreter"

_CRANK, _COUPLER, _ROCKER, _GROUND = 0.4, 1.1, 0.9, 1.0
_CHECKED = 50


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the position and Jacobian of the coupler's end over full turns of the crank."""
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, settings.configurations)
    participants = Contenders([*_ours(angles), _rootfinder(angles)])
    measured = time_contenders("loop", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="loop",
        work=(
            "position of the coupler's end and its derivative by the crank of a four-bar linkage; the crank "
            f"goes through {len(angles)} angles all around"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            bound_median(measured[BOUND], 5e-6),
            bound_median(measured[PLAIN], 5e-6),
            compare_speed(measured, BOUND, ROOTFINDER),
        ),
        missing=tuple(participants.missing),
    )


def make_four_bar() -> Model:
    """Return a four-bar linkage: crank and coupler, closed with the rocker."""
    model = Model()
    with model.edit() as edit:
        for name, parent, x in (
            ("crank", WORLD, 0.0),
            ("coupler", "crank", _CRANK),
            ("rocker", WORLD, _GROUND),
        ):
            origin = Pose.from_matrix(translation(x, 0, 0))
            edit.apply(Revolute(name=name, parent=parent, child=name, origin=origin, axis=(0.0, 0.0, 1.0)))
        for name, length in (("coupler", _COUPLER), ("rocker", _ROCKER)):
            edit.add_frame(
                f"{name} end", name, Frame.from_transform(name, translation(length, 0, 0)).transform
            )
        home = (("coupler", 1.0), ("rocker", 1.5))
        edit.apply(CloseLoop(name="four-bar", frame="coupler end", to="rocker end", home=home))
    return model


def _ours(angles: Array) -> Iterator[Contender]:
    model = make_four_bar()
    crank = model.symbol("crank")
    position = model.fk("coupler end")[:3, 3]
    function = compile([position, position.jacobian([crank])], [crank], wait=True)
    evaluator = function.bind()
    points = [np.array([angle]) for angle in angles]

    def bound() -> None:
        for point in points:
            evaluator(point)

    def plain() -> None:
        for point in points:
            function(point)

    def results() -> list[Array]:
        found = [function(point) for point in points[:_CHECKED]]
        return [np.array([p[:2] for p, _ in found]), np.array([j[:2, 0] for _, j in found])]

    yield Contender(BOUND, time_calls(bound, len(points)), results)
    yield Contender(PLAIN, time_calls(plain, len(points)), results)


def _rootfinder(angles: Array) -> Contender:
    crank, x = ca.SX.sym("crank"), ca.SX.sym("x", 2)
    end = _link_transform(crank, _CRANK) + _link_transform(x[0], _COUPLER)
    gap = end - _link_transform(x[1], _ROCKER) - ca.vertcat(_GROUND, 0)
    solver = ca.rootfinder("four_bar", "fast_newton", {"x": x, "p": crank, "g": gap})
    start, angle = ca.MX.sym("start", 2), ca.MX.sym("angle")
    solution = solver(x0=start, p=angle)["x"]
    position = ca.Function("end", [x, crank], [end])(solution, angle)
    function: Any = ca.Function("loop", [start, angle], [position, ca.jacobian(position, angle)])
    starts = [_closing_angles(angle) for angle in angles]
    buffer, run = function.buffer()
    guess, given, out, derivative = np.zeros(2), np.zeros(1), np.zeros(2), np.zeros(2)
    buffer.set_arg(0, guess.data)
    buffer.set_arg(1, given.data)
    buffer.set_res(0, out.data)
    buffer.set_res(1, derivative.data)

    def evaluate(angle: float, near: Array, reference: Any = buffer) -> None:
        guess[:] = near
        given[0] = angle
        run()

    def work() -> None:
        for angle, near in zip(angles, starts, strict=True):
            evaluate(angle, near)

    def results() -> list[Array]:
        found = []
        for angle, near in zip(angles[:_CHECKED], starts, strict=False):
            evaluate(angle, near)
            found.append((out.copy(), derivative.copy()))
        return [np.array([p for p, _ in found]), np.array([d for _, d in found])]

    return Contender(ROOTFINDER, time_calls(work, len(angles)), results)


def _link_transform(angle: ca.SX, length: float) -> ca.SX:
    return length * ca.vertcat(ca.cos(angle), ca.sin(angle))


def _closing_angles(crank: float) -> Array:
    """Return angles of coupler and rocker near those that close the loop, by intersecting two circles."""
    pin = _CRANK * np.array([np.cos(crank), np.sin(crank)])
    offset = np.array([_GROUND, 0.0]) - pin
    distance = np.linalg.norm(offset)
    along = (_COUPLER**2 - _ROCKER**2 + distance**2) / (2 * distance)
    across = np.sqrt(_COUPLER**2 - along**2)
    end = pin + (along * offset + across * np.array([-offset[1], offset[0]])) / distance
    to_end, from_ground = end - pin, end - np.array([_GROUND, 0.0])
    angles = np.array(
        [np.arctan2(to_end[1], to_end[0]), np.arctan2(from_ground[1], from_ground[0])], dtype=np.float64
    )
    return angles + 0.05
