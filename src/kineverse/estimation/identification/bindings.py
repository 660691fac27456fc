"""Data structures and functions of the C kernels.

Until then, and without a compiler, numpy does the same.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.compile.c_library import SourceLibrary
from kineverse.compile.toolchain import NO_UNDEFINED_FLAGS
from kineverse.errors import ShapeError
from kineverse.estimation.c_source.identification_stages import IDENTIFICATION_SOURCE
from kineverse.lie import Array, transform

from .motion_model import LinearisedPoses

if TYPE_CHECKING:
    from .families import GroupMotion, JointFamily

# Numbers of its own, that need not agree with those of an interpreter to the last bit.
_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-rounding-math", "-lm", *NO_UNDEFINED_FLAGS)
_FAMILY = ("rows", "joints", "lefts", "rights", "pitches", "pitched", "reach", "slides")
_SCALES = ("reach_scale", "pitch_scale", "close", "little", "narrowest", "settled", "better", "slid")
_COUNTS = ("steps", "first_steps", "turns", "sliding_turns", "mirrored_turns", "mirrored_steps", "widths")
# So many parameters C has room for, and so many unknowns of a family altogether.
_PARAMETERS, _UNKNOWNS = 12, 16
MOTION_SIZE = 25
"""How many numbers C has for a member of a family."""


class _Belief(ctypes.Structure):
    _fields_ = (("mean", ctypes.c_double * 6), ("precision", ctypes.c_double * 6))


class _Noise(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("covariance", "inverse")),
        *((name, ctypes.c_int64) for name in ("stride", "round")),
    )


class Given(ctypes.Structure):
    """What was observed, as C has it."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("count", "known", "fresh", "softer")),
        *((name, ctypes.c_void_p) for name in ("parent", "child", "parent_covariance", "child_covariance")),
        ("softness", ctypes.c_void_p),
    )


class Problem(ctypes.Structure):
    """What is to be solved, as C has it: a family, what was observed, and room for what C works with."""

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
    code.rate.argtypes = (pointer, counter, *(pointer,) * 7)
    for stage in (code.solve, code.refine, code.carry_on):
        stage.argtypes = (pointer,) * 3
    for function in (code.at, code.likeliest, code.rate, code.solve, code.refine, code.carry_on):
        function.restype = None


library = SourceLibrary(IDENTIFICATION_SOURCE, _declare, _FLAGS)
"""The compiled functions, once there are any; for the whole process."""


@functools.cache
def fits_kernel(group: JointFamily, rows: int) -> bool:
    """Return whether C has room for a family."""
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
    """Return the problem with what a family says, and nothing else. It is shared: copy it."""
    freedom, problem = group.parametrisation(rows), Problem()
    problem.rows, problem.joints = rows, len(freedom.joints)
    problem.lefts, problem.rights = len(freedom.left), len(freedom.right)
    problem.pitches = problem.pitched = group.pitch
    problem.reach = group.reach
    problem.slides = group.slides if rows == 6 else 0
    for name, components in (("joint", freedom.joints), ("left", freedom.left), ("right", freedom.right)):
        getattr(problem, name)[: len(components)] = components
    problem.kind[: problem.joints] = [j >= 3 for j in freedom.joints]
    return problem


def pack_motion(motion: GroupMotion) -> Array:
    """Return what C knows of a member: rotation and place of both sides, and the pitch."""
    result = np.empty(MOTION_SIZE)
    for at, side in ((0, motion.left), (12, motion.right)):
        result[at : at + 9].reshape(3, 3)[:] = side[:3, :3]
        result[at + 9 : at + 12] = side[:3, 3]
    result[24] = motion.pitch
    return result


def unpack_motion(motion: GroupMotion, packed: Array) -> GroupMotion:
    """Return the member that C calls so."""
    left, right = (transform(packed[at : at + 9].reshape(3, 3), packed[at + 9 : at + 12]) for at in (0, 12))
    return replace(motion, left=left, right=right, pitch=float(packed[24]))


def evaluate_poses(motion: GroupMotion, values: Array) -> LinearisedPoses:
    """Return the poses at joint values (N, k), as :meth:`.groups.GroupMotion.at` does.

    Raises
    ------
    ShapeError
        For values of another shape.
    """
    values = np.ascontiguousarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != motion.joints:
        raise ShapeError(
            f"The joint values of a {motion.name} motion have shape (N, {motion.joints}), not {values.shape}."
        )
    count, rows = len(values), motion.rows
    result = LinearisedPoses(
        np.empty((count, 4, 4)), np.empty((count, rows, motion.size)), np.empty((count, rows, motion.joints))
    )
    moved = pack_motion(motion)
    library.code.at(
        ctypes.addressof(problem_of(motion.group, rows)),
        count,
        moved.ctypes.data,
        values.ctypes.data,
        *(array.ctypes.data for array in result),
    )
    return result
