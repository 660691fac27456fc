"""A solution in one piece of memory, as C begins with it and leaves it there."""

from __future__ import annotations

import math

import numpy as np

from .groups import GroupMotion
from .library import MOTION, packed, unpacked
from .motion import Linear
from .rigid import Array
from .solving import Belief, Solution

# Numbers behind those of the motion. Mean and precision of what is believed are for six joint values at most.
_COST, _CONVERGED, _MARGINAL, _LOG = range(MOTION, MOTION + 4)
_MEAN, _PRECISION, _HEAD = MOTION + 4, MOTION + 10, MOTION + 16


class Answer:
    """All numbers of a solution, and the arrays that they are.

    Parameters
    ----------
    motion
        A member of the family.
    belief
        What is believed of joint values.
    values, parents
        Joint values (N, k) and true poses of the parent (N, 4, 4) to begin with.
    """

    __slots__ = ("_covariances", "_linear", "_motion", "_parents", "_residuals", "_values", "numbers")

    def __init__(self, motion: GroupMotion, belief: Belief, values: Array, parents: Array) -> None:
        count, rows, joints, size = len(parents), motion.rows, motion.joints, motion.size
        shapes = ((joints,), (4, 4), (rows,), (rows, rows), (4, 4), (rows, size), (rows, joints))
        lengths = [count * math.prod(shape) for shape in shapes]
        self.numbers = np.empty(_HEAD + sum(lengths))
        arrays, at = [], _HEAD
        for shape, length in zip(shapes, lengths, strict=True):
            arrays.append(self.numbers[at : at + length].reshape(count, *shape))
            at += length
        self._values, self._parents, self._residuals, self._covariances, *linear = arrays
        self._linear = Linear(*linear)
        self._motion = motion
        self._values[:] = values
        self._parents[:] = parents
        head = self.numbers
        head[:MOTION] = packed(motion)
        head[_MARGINAL] = belief.marginal
        head[_MEAN : _MEAN + joints] = belief.mean
        head[_PRECISION : _PRECISION + joints] = belief.precision

    @staticmethod
    def of(solution: Solution[GroupMotion]) -> Answer:
        """Return a solution in memory of its own."""
        answer = Answer(solution.motion, solution.belief, solution.values, solution.parent)
        answer.numbers[_COST], answer.numbers[_CONVERGED] = solution.cost, solution.converged
        answer._residuals[:] = solution.residuals
        answer._covariances[:] = solution.covariance
        for to, array in zip(answer._linear, solution.linear, strict=True):
            to[:] = array
        return answer

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence."""
        return float(self.numbers[_LOG])

    @property
    def solution(self) -> Solution[GroupMotion]:
        """What C has left here. It shares this memory."""
        head, joints = self.numbers, self._values.shape[1]
        return Solution(
            motion=unpacked(self._motion, head),
            values=self._values,
            cost=float(head[_COST]),
            residuals=self._residuals,
            covariance=self._covariances,
            linear=self._linear,
            parent=self._parents,
            belief=Belief(
                head[_MEAN : _MEAN + joints],
                head[_PRECISION : _PRECISION + joints],
                bool(head[_MARGINAL]),
            ),
            converged=bool(head[_CONVERGED]),
        )
