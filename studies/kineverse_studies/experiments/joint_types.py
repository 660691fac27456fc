"""``joint-types``: families of random hinges and sliders, with and without stated noise.

Each case is identified from poses and from positions of the child, with the noise stated and unknown. The
report compares the shares of right and of wrong sure answers with the targets, and probabilities with
frequencies.

Noise, number of observations, range and lever are random, within the constants below. The axis goes through
the origin of the parent in a random direction; the origin of a slider's child is on it. In :data:`MOVING` of
the cases the observer has a random pose at each observation and measures the parent with the same noise as
the child. In the others the parent is exact. Errors are in the observer's axes:
``(p + δp, Exp(δθ) R)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.estimation import identify, pose_covariance
from kineverse.estimation.identification.result import SURE, NoiseDeviations
from kineverse.estimation.identification.solver import solver
from kineverse.estimation.noise import UNKNOWN_NOISE
from kineverse.lie import Array, exp_so3, quaternion, retract, transform, translation, unit_vector
from kineverse.view.plots import Figure

from .estimation_grid.cramer_rao import Joint
from .execution import run_jobs
from .registry import Options, Progress
from .report import Cell, Report, ReportTable, format_yes, make_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

SEED = 2017
COUNTS = (6, 120)  # least and largest number of observations, log-uniform
POSITIONS = (0.0007, 0.04)
ORIENTATIONS = (math.radians(0.25), math.radians(7.0))
"""Standard deviations of each component of the errors [m], [rad], log-uniform and independent."""
RANGES: dict[Joint, tuple[float, float]] = {
    "revolute": (math.radians(12.0), math.radians(130.0)),
    "prismatic": (0.04, 0.6),
}
"""Ranges [rad], [m], uniform."""
BETA = (0.7, 0.9)  # parameters of the Beta distribution of the joint values over the range
LEVERS = (0.08, 0.9)  # distances of the child's origin from the axis of a hinge [m], uniform
MOVING = 0.6  # share of the cases with a moving observer and a parent that is measured with noise, too


@dataclass(frozen=True, eq=False)
class JointCase:
    joint: str  # true family
    position: float  # standard deviations of the errors [m], [rad]
    orientation: float
    range: float  # range of the joint [rad], [m]
    # measured poses of the parent, (N, 4, 4); None if they are exact and the observer's frame
    parent: Array | None
    child: Array  # measured poses of the child, (N, 4, 4)


def draw_case(number: int) -> JointCase:
    rng = np.random.default_rng([SEED, number])
    joint: Joint = "revolute" if rng.random() < 0.5 else "prismatic"
    count = round(log_uniform(rng, *COUNTS))
    noise = log_uniform(rng, *POSITIONS), log_uniform(rng, *ORIENTATIONS)
    reach = rng.uniform(*RANGES[joint])
    axis = random_direction(rng)
    lever = rng.uniform(*LEVERS) * _random_orthogonal(rng, axis)
    turn = rng.uniform(-math.pi, math.pi) * random_direction(rng)
    along = reach * rng.beta(*BETA, count)[:, None] * axis
    if joint == "prismatic":
        children = translation(along) @ transform(exp_so3(turn), np.zeros(3))
    else:
        children = transform(exp_so3(along), np.zeros(3)) @ transform(exp_so3(turn), lever)
    return observe_joint(rng, joint, children, noise, reach)


def observe_joint(
    rng: np.random.Generator, joint: str, children: Array, noise: tuple[float, float], reach: float
) -> JointCase:
    """Return a case with noisy observations of poses of the child in the parent."""
    count, parents = len(children), None
    if rng.random() < MOVING:
        wxyz = rng.standard_normal((count, 4))
        parents = transform(quaternion(np.roll(wxyz, -1, axis=-1)), rng.uniform(-1.0, 1.0, (count, 3)))
        children = parents @ children

    def observe(poses: Array) -> Array:
        return retract(poses, rng.standard_normal((count, 6)) * np.repeat(noise, 3))

    return JointCase(joint, *noise, reach, None if parents is None else observe(parents), observe(children))


def log_uniform(rng: np.random.Generator, least: float, most: float) -> float:
    return float(least * (most / least) ** rng.random())


def random_direction(rng: np.random.Generator) -> Array:
    return unit_vector(rng.standard_normal(3))


def _random_orthogonal(rng: np.random.Generator, axis: Array) -> Array:
    return unit_vector(np.cross(axis, random_direction(rng)))


CASES = 1000
_CHUNK = 10  # number of cases that a process identifies at a time


@dataclass(frozen=True)
class Setting:
    poses: bool  # true for poses of the child, False for its positions
    stated: bool  # true if the noise is stated

    @property
    def title(self) -> str:
        return f"{'poses' if self.poses else 'positions'}, noise {'stated' if self.stated else 'unknown'}"


SETTINGS = tuple(Setting(poses, stated) for poses in (True, False) for stated in (False, True))


@dataclass(frozen=True, eq=False)
class TypeAnswer:
    number: int
    true: str  # true and most probable family
    family: str
    probability: float
    is_ambiguous: bool  # true if the answer is not sure for another reason, too
    count: int  # number of observations
    truth: NoiseDeviations  # true standard deviations of the noise
    noise: NoiseDeviations | None  # estimated ones; None if the noise was stated

    @property
    def is_right(self) -> bool:
        return self.family == self.true

    @property
    def is_sure(self) -> bool:
        """True if the answer is unambiguous and more probable than 95 %."""
        return self.probability > SURE and not self.is_ambiguous


def identify_case(number: int, case: JointCase, setting: Setting) -> TypeAnswer:
    noise = pose_covariance(case.position, case.orientation) if setting.stated else None
    child: Array = case.child if setting.poses else case.child[:, :3, 3]
    found = identify(case.parent, child, noise=noise)
    has_orientation = setting.poses or case.parent is not None
    return TypeAnswer(
        number=number,
        true=case.joint,
        family=found.best.family,
        probability=found.best.probability,
        is_ambiguous=found.is_ambiguous,
        count=len(child),
        truth=NoiseDeviations(case.position, case.orientation if has_orientation else np.nan),
        noise=found.noise,
    )


def identify_cases(
    count: int, progress: Progress, options: Options | None = None
) -> dict[Setting, list[TypeAnswer]]:
    chunks = [range(k, min(k + _CHUNK, count)) for k in range(0, count, _CHUNK)]
    found = run_jobs(_identify_chunk, chunks, progress, "joint-types", "chunk", options)
    return {setting: [answer for chunk in found for answer in chunk[k]] for k, setting in enumerate(SETTINGS)}


def _identify_chunk(numbers: Sequence[int]) -> list[list[list[TypeAnswer]]]:
    solver.prepare(wait=True)
    return [[[identify_case(n, draw_case(n), setting) for n in numbers] for setting in SETTINGS]]


Answers = Mapping[Setting, Sequence[TypeAnswer]]
OPTIONS = ("quick", "processes")
QUICK_CASES = 30
FIGURE_SIZE = (13.0, 5.0)
TARGETS = {Setting(True, False): (0.92, 0.02), Setting(True, True): (0.98, 0.002)}
"""Least share of right answers, and largest share of wrong sure ones, of the settings that have a target."""
PROBABILITIES = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
RATIOS = (0.0, 1 / 8, 1 / 2, 2.0, 8.0, math.inf)
"""Bins of probabilities, and of ratios of position to orientation noise, relative to 5 mm : 1°."""


def run(progress: Progress, options: Options) -> Report:
    return report_answers(identify_cases(QUICK_CASES if options.quick else CASES, progress, options))


def report_answers(answers: Answers) -> Report:
    count = max(len(some) for some in answers.values())
    return Report(
        name="joint-types",
        title=f"Types of {count} random hinges and sliders",
        tables=(
            _target_table(answers),
            _binned_table(
                "How often an answer of some probability is right", "probability", answers, PROBABILITIES, _p
            ),
            _binned_table(
                "By ratio of position to orientation noise, over 5 mm : 1 deg",
                "ratio",
                answers,
                RATIOS,
                noise_ratio,
            ),
            _noise_table(answers),
            _error_table(answers),
        ),
        numbers={
            "seed": SEED,
            "cases": {
                "count": COUNTS,
                "position": POSITIONS,
                "orientation": ORIENTATIONS,
                "range": RANGES,
                "beta": BETA,
                "lever": LEVERS,
                "moving": MOVING,
            },
            "answers": {setting.title: list(map(_numbers, some)) for setting, some in answers.items()},
        },
        figure=Figure(lambda canvas: draw_answers(canvas, answers), FIGURE_SIZE),
    )


def noise_ratio(answer: TypeAnswer) -> float:
    """Return the ratio of position to orientation noise over 5 mm : 1°; 1 without orientations."""
    position, orientation = np.divide(answer.truth, UNKNOWN_NOISE).tolist()
    return 1.0 if math.isnan(orientation) else position / orientation


def share_right(answers: Sequence[TypeAnswer]) -> float:
    return sum(answer.is_right for answer in answers) / len(answers) if answers else math.nan


def share_of_sure_errors(answers: Sequence[TypeAnswer]) -> float:
    errors = sum(answer.is_sure and not answer.is_right for answer in answers)
    return errors / len(answers) if answers else math.nan


def _p(answer: TypeAnswer) -> float:
    return answer.probability


def _target_table(answers: Answers) -> ReportTable:
    rows = []
    for setting, some in answers.items():
        right, wrong = share_right(some), share_of_sure_errors(some)
        sure = sum(answer.is_sure for answer in some) / len(some)
        asked, holds = "-", "-"
        if setting in TARGETS:
            least, most = TARGETS[setting]
            asked = f"{100 * least:g}, at most {100 * most:g}"
            holds = format_yes(right >= least and wrong <= most)
        rows.append((setting.title, 100 * right, 100 * sure, 100 * wrong, asked, holds))
    head = ("given", "right [%]", "sure [%]", "sure and wrong [%]", "asked for", "holds")
    return ReportTable("Right types, sure answers and wrong sure answers", head, tuple(rows))


def _binned_table(
    title: str, name: str, answers: Answers, edges: Sequence[float], of: Callable[[TypeAnswer], float]
) -> ReportTable:
    rows = []
    for low, high in pairwise(edges):
        cells: list[float | str] = []
        for some in answers.values():
            chosen = [answer for answer in some if low < of(answer) <= high]
            wrong = sum(answer.is_sure and not answer.is_right for answer in chosen)
            cells.append(f"{100 * share_right(chosen):.1f} of {len(chosen)} ({wrong})" if chosen else "-")
        rows.append((f"{low:.3g} to {high:.3g}", *cells))
    titles = tuple(f"{setting.title} [%]" for setting in answers)
    return ReportTable(f"{title} (sure errors)", (name, *titles), tuple(rows))


def _noise_table(answers: Answers) -> ReportTable:
    rows = []
    for setting, some in answers.items():
        for kind, name in enumerate(("position", "orientation")):
            ratios = np.array([answer.noise[kind] / answer.truth[kind] for answer in some if answer.noise])
            ratios = ratios[np.isfinite(ratios)]
            if len(ratios):
                quantiles = np.quantile(ratios, (0.05, 0.5, 0.95)).tolist()
                rows.append((setting.title, name, *quantiles))
    head = ("given", "noise of", "5 % quantile", "median", "95 % quantile")
    return ReportTable("Estimated noise over the true one", head, tuple(rows))


def _error_table(answers: Answers) -> ReportTable:
    errors = [
        (setting.title, answer)
        for setting, some in answers.items()
        if setting in TARGETS
        for answer in some
        if answer.is_sure and not answer.is_right
    ]
    columns: dict[str, Callable[[tuple[str, TypeAnswer]], Cell]] = {
        "given": lambda one: one[0],
        "case": lambda one: float(one[1].number),
        "true": lambda one: one[1].true,
        "answer": lambda one: one[1].family,
        "probability [%]": lambda one: f"{100 * one[1].probability:.2f}",
        "N": lambda one: float(one[1].count),
        "noise [mm]": lambda one: 1e3 * one[1].truth.position,
        "noise [deg]": lambda one: math.degrees(one[1].truth.orientation),
    }
    found = make_table("Wrong sure answers from poses", errors, columns)
    return found if found.rows else replace(found, rows=(("-",) * len(columns),))


def draw_answers(canvas: Canvas, answers: Answers) -> None:
    calibration, ratios = canvas.subplots(1, 2)
    for setting, some in answers.items():
        for axes, of, edges in (
            (calibration, _p, PROBABILITIES),
            (ratios, noise_ratio, np.geomspace(1 / 64, 64, 7)),
        ):
            bins = [[answer for answer in some if low < of(answer) <= high] for low, high in pairwise(edges)]
            full = [chosen for chosen in bins if chosen]
            across = [float(np.median([of(answer) for answer in chosen])) for chosen in full]
            style = "-o" if setting.poses else ":o"
            axes.plot(across, [100 * share_right(chosen) for chosen in full], style, label=setting.title)
    calibration.plot([0.0, 1.0], [0.0, 100.0], color="0.7", linewidth=1.0)
    calibration.set(xlabel="probability", ylabel="right [%]", title="calibration", xlim=(0.3, 1.01))
    ratios.set(xscale="log", xlabel="position to orientation noise over 5 mm : 1°", title="by ratio")
    ratios.legend(loc="lower left")


def _numbers(answer: TypeAnswer) -> dict[str, Any]:
    return {
        "case": answer.number,
        "true": answer.true,
        "family": answer.family,
        "probability": answer.probability,
        "sure": answer.is_sure,
        "count": answer.count,
        "true_noise": answer.truth,
        "noise": answer.noise,
    }
