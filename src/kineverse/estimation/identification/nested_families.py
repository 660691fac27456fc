"""Lower bounds of the evidence of a family that contains another one.

A joint that hardly moves looks rigid, and a point on a long lever looks as if it moved along a line. So the
evidence of the wider family is at least that of the narrower one times the prior probability of members that
look like it. Laplace's method misses them: it knows only the surroundings of the most likely member, which
follows the noise in these cases.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

import numpy as np

from kineverse.lie import Array

from .families import REACH, GroupMotion
from .motion_model import FamilyMember
from .optimise import Solution

Name = TypeVar("Name")

UNSEEN = 0.05
"""Prior probability that a prismatic or revolute joint hardly moves while it is observed."""


def bound_log_evidences(
    logs: Mapping[Name, float], solutions: Mapping[Name, Solution[FamilyMember]]
) -> dict[Name, float]:
    """Return log evidences, raised to the bounds by the families that are contained in others."""
    result = dict(logs)
    by_family = {
        solution.motion.name: (name, solution)
        for name, solution in solutions.items()
        if isinstance(solution.motion, GroupMotion)
    }
    rigid, line = by_family.get("rigid"), by_family.get("prismatic")
    for family in ("prismatic", "revolute"):
        if rigid is not None and family in by_family:
            name = by_family[family][0]
            result[name] = max(result[name], logs[rigid[0]] + math.log(UNSEEN))
    if line is not None and "revolute" in by_family and line[1].motion.rows == 3:
        name = by_family["revolute"][0]
        result[name] = max(result[name], logs[line[0]] + log_probability_straight(line[1]))
    return result


def log_probability_straight(line: Solution[FamilyMember]) -> float:
    """Return the log prior probability of levers that bend a line by less than a standard deviation.

    The positions of an arc with radius r are off a line by x²/2r. Their regression on x² gives the deviation
    of the curvature. The lever has a Gaussian prior in two components. An arc within one deviation has at
    least exp(-½) times the likelihood of the line.
    """
    assert isinstance(line.motion, GroupMotion)  # only lines of the library have levers
    along = line.values[:, 0]
    if len(along) < 3:
        return -0.5  # any arc goes through two points
    terms = np.column_stack([np.ones_like(along), along, along**2])
    # The residual of x² after regression on 1 and x.
    triangle: Array = np.linalg.qr(terms)[1]
    bend = abs(float(triangle[2, 2]))
    axis = line.motion.left[:3, 2]
    across = np.trace(line.covariance, axis1=1, axis2=2) - axis @ line.covariance @ axis
    curvature = 2.0 * math.sqrt(0.5 * float(across.mean())) / max(bend, 1e-12)
    return -0.5 - 0.5 / (REACH * curvature) ** 2
