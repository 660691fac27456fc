"""Data structures and functions of the C kernels.

The kernels are compiled in the background. Until then, and without a compiler, numpy computes the same.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.compilation.c_library import SourceLibrary
from kineverse.errors import ShapeError
from kineverse.lie import Array, transform

from .motion_model import LinearisedPoses

if TYPE_CHECKING:
    from .families import GroupMotion, JointFamily

# No other path has to agree with these numbers to the last bit, so contraction is allowed.
_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-rounding-math", "-lm")
_FAMILY = ("rows", "joints", "lefts", "rights", "pitches", "pitched", "reach", "slides")
_SCALES = (
    "reach_scale", "pitch_scale", "close", "little", "narrowest", "settled", "better", "slid", "weight"
)  # fmt: skip
_COUNTS = ("steps", "first_steps", "turns", "sliding_turns", "mirrored_turns", "mirrored_steps", "widths")
# Largest number of parameters, and of all unknowns, of a family in C.
_PARAMETERS, _UNKNOWNS = 12, 16
MOTION_SIZE = 25  # size of the C structure of a motion, in doubles


class _Belief(ctypes.Structure):
    _fields_ = (("mean", ctypes.c_double * 6), ("precision", ctypes.c_double * 6))


class _Noise(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("covariance", "inverse")),
        *((name, ctypes.c_int64) for name in ("stride", "round")),
    )


class Given(ctypes.Structure):
    """C structure of observations."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("count", "known", "fresh", "softer")),
        *((name, ctypes.c_void_p) for name in ("parent", "child", "parent_covariance", "child_covariance")),
        ("softness", ctypes.c_void_p),
    )


class Problem(ctypes.Structure):
    """C structure of a problem: family, observations, constants and work fields."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in _FAMILY),
        *((name, ctypes.c_int64 * 6) for name in ("joint", "left", "right", "kind")),
        ("given", Given),
        *((name, ctypes.c_double) for name in _SCALES),
        *((name, ctypes.c_int64) for name in _COUNTS),
        ("grid", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("marginal", "mirrored")),
        ("belief", _Belief),
        ("of_parent", _Noise),
        ("of_child", _Noise),
    )


def _declare(code: Any) -> None:
    pointer, counter = ctypes.c_void_p, ctypes.c_int64
    code.at.argtypes = (pointer, counter, *(pointer,) * 5)
    code.memory_of.argtypes, code.memory_of.restype = (pointer,), counter
    code.likeliest.argtypes = (pointer, counter, *(pointer,) * 4)
    code.rate.argtypes = (pointer, counter, *(pointer,) * 8)
    for stage in (code.solve, code.refine, code.carry_on):
        stage.argtypes = (pointer,) * 3
    for function in (code.at, code.likeliest, code.rate, code.solve, code.refine, code.carry_on):
        function.restype = None


library = SourceLibrary("identification.c", _declare, _FLAGS, MOST=_PARAMETERS, UNKNOWNS=_UNKNOWNS)
"""Compiled functions, shared by the whole process."""


@functools.cache
def fits_kernel(group: JointFamily, rows: int) -> bool:
    """Return True if the C structures have room for a family."""
    freedom = group.parametrisation(rows)
    left, right, joints = (len(part) for part in (freedom.left, freedom.right, freedom.joints))
    return (
        {*freedom.left, *freedom.right, *freedom.joints} <= {*range(6)}
        and max(left, right + joints) <= 6
        and left + right + group.pitch <= _PARAMETERS
        and left + right + group.pitch + joints + group.slides <= _UNKNOWNS
        and max(group.reach, group.slides) <= 3
    )


@functools.cache
def problem_of(group: JointFamily, rows: int) -> Problem:
    """Return a problem with the fields of a family only. It is cached, so callers copy it."""
    freedom, problem = group.parametrisation(rows), Problem()
    problem.rows, problem.joints = rows, len(freedom.joints)
    problem.lefts, problem.rights = len(freedom.left), len(freedom.right)
    problem.pitches = problem.pitched = group.pitch
    problem.reach, problem.slides = group.reach, group.slides if rows == 6 else 0
    for name, components in (("joint", freedom.joints), ("left", freedom.left), ("right", freedom.right)):
        getattr(problem, name)[: len(components)] = components
    problem.kind[: problem.joints] = [j >= 3 for j in freedom.joints]
    return problem


def pack_motion(motion: GroupMotion) -> Array:
    """Return the C structure of a motion: rotation and position of both sides, and the pitch."""
    result = np.empty(MOTION_SIZE)
    for at, side in ((0, motion.left), (12, motion.right)):
        result[at : at + 9].reshape(3, 3)[:] = side[:3, :3]
        result[at + 9 : at + 12] = side[:3, 3]
    result[24] = motion.pitch
    return result


def unpack_motion(motion: GroupMotion, packed: Array) -> GroupMotion:
    """Return a motion with the parameters of a C structure."""
    left, right = (transform(packed[at : at + 9].reshape(3, 3), packed[at + 9 : at + 12]) for at in (0, 12))
    return replace(motion, left=left, right=right, pitch=float(packed[24]))


def evaluate_poses(motion: GroupMotion, values: Array) -> LinearisedPoses:
    """Return the poses at joint values (N, k) and their derivatives, in C."""
    values = np.ascontiguousarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != motion.joints:
        raise ShapeError(
            f"The joint values of a {motion.name} motion have shape (N, {motion.joints}), not {values.shape}."
        )
    count, rows = len(values), motion.rows
    result = LinearisedPoses(
        np.empty((count, 4, 4)), np.empty((count, rows, motion.size)), np.empty((count, rows, motion.joints))
    )
    arrays = (pack_motion(motion), values, *result)
    problem = ctypes.addressof(problem_of(motion.group, rows))
    library.code.at(problem, count, *(array.ctypes.data for array in arrays))
    return result
