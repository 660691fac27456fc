"""``joint-families``: families of random parts that are no hinge and no slider.

The truths are a cylindrical, planar and spherical joint, a screw, a free part, and a random walk: a part in a
wandering hand. Each case is identified in the settings of :mod:`.joint_types`, and observed as there. Noise,
number of observations and ranges are random, within the constants below.

An answer is right if it is the family of the truth, and of a walk if it is ``free`` or a ``curve``, as a walk
is a single path. All others are wrong, also families that contain the truth, and narrower ones that explain
the observations as well as the noise allows. A sure answer that is wrong is an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from kineverse.estimation.identification.solver import solver
from kineverse.lie import Array, exp_so3, transform, translation
from kineverse.view.plots import Figure

from .execution import run_jobs
from .joint_types import (
    SETTINGS,
    JointCase,
    TypeAnswer,
    identify_case,
    log_uniform,
    observe_joint,
    random_direction,
)
from .registry import Options, Progress
from .report import Cell, Report, ReportTable, make_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

OPTIONS = ("quick", "count", "seed", "processes")
CASES, QUICK_CASES = 32, 2  # of each truth
MOST_ERRORS = 2.0  # largest share of sure errors in a cell [%]
COUNTS = (10, 120)  # least and largest number of observations, log-uniform
POSITIONS, ORIENTATIONS = (0.001, 0.015), (math.radians(0.25), math.radians(4.0))
"""Standard deviations of each component of the errors [m], [rad], log-uniform and independent."""
LEVERS = (0.05, 0.6)  # distances of the child's origin from an axis or centre [m], uniform
SLIDES, TURNS = (0.1, 0.6), (math.radians(30.0), math.radians(180.0))
"""Ranges of joint values [m], [rad], uniform; joint values are uniform over them."""
LEADS, SCREW_TURNS = (0.03, 0.3), (math.radians(60.0), math.radians(340.0))
"""Leads [m/revolution] and ranges [rad] of screws, uniform."""
STEPS = (
    0.02,
    0.08,
)  # deviations of a step of a walk [m], uniform; rotations are in the ratio of a radian to .4 m

Draw = Callable[[np.random.Generator, int], Array]


def _place(rng: np.random.Generator) -> Array:
    """Return a random pose of the child on the joint."""
    return transform(exp_so3(rng.uniform(-2.0, 2.0, 3)), rng.uniform(*LEVERS) * random_direction(rng))


def _values(rng: np.random.Generator, count: int, slides: int, turns: int) -> tuple[Array, Array]:
    """Return uniform translations (N, slides) and rotations (N, turns)."""
    slide = rng.uniform(-0.5, 0.5, (count, slides)) * rng.uniform(*SLIDES, slides)
    return slide, rng.uniform(-0.5, 0.5, (count, turns)) * rng.uniform(*TURNS, turns)


def _along_z(values: Array) -> Array:
    return np.asarray(values * np.array([0.0, 0.0, 1.0]))


def _cylindrical(rng: np.random.Generator, count: int) -> Array:
    slide, turn = _values(rng, count, 1, 1)
    return transform(exp_so3(_along_z(turn)), _along_z(slide)) @ _place(rng)


def _screw(rng: np.random.Generator, count: int) -> Array:
    turn = rng.uniform(-0.5, 0.5, (count, 1)) * rng.uniform(*SCREW_TURNS)
    lead = rng.choice((-1.0, 1.0)) * rng.uniform(*LEADS)
    return transform(exp_so3(_along_z(turn)), _along_z(lead / math.tau * turn)) @ _place(rng)


def _planar(rng: np.random.Generator, count: int) -> Array:
    slide, turn = _values(rng, count, 2, 1)
    return transform(exp_so3(_along_z(turn)), np.pad(slide, ((0, 0), (0, 1)))) @ _place(rng)


def _spherical(rng: np.random.Generator, count: int) -> Array:
    _, turn = _values(rng, count, 0, 3)
    return transform(exp_so3(turn), np.zeros((count, 3))) @ _place(rng)


def _free(rng: np.random.Generator, count: int) -> Array:
    slide, turn = _values(rng, count, 3, 3)
    return transform(exp_so3(turn), slide) @ _place(rng)


def _walk(rng: np.random.Generator, count: int) -> Array:
    steps = rng.uniform(*STEPS) * rng.standard_normal((count, 6))
    # Half of the hands change their direction slowly.
    if rng.random() < 0.5:
        smooth = np.zeros_like(steps)
        for k in range(count):
            smooth[k] = 0.8 * smooth[k - 1] + 0.6 * steps[k]
        steps = smooth
    path = np.cumsum(steps, axis=0)
    return transform(exp_so3(path[:, 3:] / 0.4), path[:, :3]) @ _place(rng)


TRUTHS: Mapping[str, Draw] = {
    "cylindrical": _cylindrical,
    "screw": _screw,
    "planar": _planar,
    "spherical": _spherical,
    "free": _free,
    "walk": _walk,
}
RIGHT: Mapping[str, tuple[str, ...]] = {truth: (truth,) for truth in TRUTHS} | {"walk": ("free", "curve")}


def draw_family_case(truth: str, seed: int, number: int) -> JointCase:
    rng = np.random.default_rng([seed, list(TRUTHS).index(truth), number])
    count = round(log_uniform(rng, *COUNTS))
    noise = log_uniform(rng, *POSITIONS), log_uniform(rng, *ORIENTATIONS)
    base = translation(rng.uniform(-0.5, 0.5, 3)) @ transform(exp_so3(rng.uniform(-2.0, 2.0, 3)), np.zeros(3))
    return observe_joint(rng, truth, base @ TRUTHS[truth](rng, count), noise, math.nan)


Answers = Mapping[tuple[str, str], Sequence[TypeAnswer]]  # by truth and setting


def is_right(answer: TypeAnswer) -> bool:
    return answer.family in RIGHT[answer.true]


def identify_family_cases(
    seed: int, count: int, progress: Progress, options: Options | None = None
) -> Answers:
    jobs = [(truth, seed, number) for truth in TRUTHS for number in range(count)]
    found = run_jobs(_identify_job, jobs, progress, "joint-families", "case", options)
    return {
        (truth, setting.title): [some[k] for some in found if some[k].true == truth]
        for truth, (k, setting) in product(TRUTHS, enumerate(SETTINGS))
    }


def _identify_job(job: tuple[str, int, int]) -> list[list[TypeAnswer]]:
    solver.prepare(wait=True)
    case = draw_family_case(*job)
    return [[identify_case(job[2], case, setting) for setting in SETTINGS]]


def run(progress: Progress, options: Options) -> Report:
    count = options.count or (QUICK_CASES if options.quick else CASES)
    return report_families(options.seed, identify_family_cases(options.seed, count, progress, options))


def report_families(seed: int, answers: Answers) -> Report:
    errors = [(given, answer) for (_, given), some in answers.items() for answer in some if _is_error(answer)]
    columns: dict[str, Callable[[tuple[str, TypeAnswer]], Cell]] = {
        "given": lambda one: one[0],
        "case": lambda one: float(one[1].number),
        "true": lambda one: one[1].true,
        "answer": lambda one: one[1].family,
        "N": lambda one: float(one[1].count),
    }
    found = make_table("Sure errors", errors, columns)
    return Report(
        name="joint-families",
        title="Families of parts that are no hinge and no slider",
        tables=(_share_table(answers), found),
        numbers={
            "seed": seed,
            "answers": {" ".join(key): [answer.family for answer in some] for key, some in answers.items()},
        },
        figure=Figure(lambda canvas: draw_families(canvas, answers), (9.0, 4.0)),
    )


def _is_error(answer: TypeAnswer) -> bool:
    return answer.is_sure and not is_right(answer)


def _share(some: Sequence[TypeAnswer], test: Callable[[TypeAnswer], bool]) -> float:
    return 100.0 * sum(map(test, some)) / len(some)


def _share_table(answers: Answers) -> ReportTable:
    rows: list[tuple[Cell, ...]] = []
    for (truth, given), some in answers.items():
        shares = [_share(some, test) for test in (is_right, lambda answer: answer.is_sure, _is_error)]
        rows.append((truth, given, *shares, MOST_ERRORS))
    head = ("truth", "given", "right [%]", "sure [%]", "sure and wrong [%]", "asked for, at most")
    return ReportTable("Right families, sure answers and wrong sure answers", head, tuple(rows))


def draw_families(canvas: Canvas, answers: Answers) -> None:
    axes = canvas.subplots()
    for setting in SETTINGS:
        shares = [_share(answers[truth, setting.title], is_right) for truth in TRUTHS]
        axes.plot(list(TRUTHS), shares, "o", label=setting.title)
    axes.set(ylabel="right [%]", ylim=(0.0, 105.0))
    axes.legend(loc="lower right")
