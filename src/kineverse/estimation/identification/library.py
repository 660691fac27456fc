"""What of identification is done in C, compiled in the background and kept like compiled functions.

Until then, and without a compiler, numpy does the same.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.compile.source_library import SourceLibrary
from kineverse.compile.toolchain import CLOSED

from .motion import Linear
from .native_source import SOLVE
from .rigid import Array, pose

if TYPE_CHECKING:
    from .groups import Group, GroupMotion

# Numbers of its own, that need not agree with those of an interpreter to the last bit.
_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-rounding-math", "-lm", *CLOSED)
_COUNTS = ("count", "rows", "joints", "lefts", "rights", "pitched", "reach", "known", "marginal")
ARRAYS = ("parent", "child", "parent_covariance", "child_covariance")


class Problem(ctypes.Structure):
    """What is to be solved, as C has it."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_int64 * 6) for name in ("joint", "left", "right")),
        *((name, ctypes.c_void_p) for name in ARRAYS),
        *((name, ctypes.c_double) for name in ("reach_scale", "pitch_scale", "close")),
        *((name, ctypes.c_double * 6) for name in ("mean", "precision")),
    )


def _declare(code: Any) -> None:
    pointer = ctypes.c_void_p
    counter = ctypes.c_int64
    code.solve.argtypes = (pointer, counter, *(pointer,) * 3, counter, counter, *(pointer,) * 6)
    code.solve.restype = ctypes.c_int64
    code.at.argtypes = (pointer, counter, *(pointer,) * 5)
    code.at.restype = None
    code.alone.argtypes = (*(counter,) * 3, ctypes.c_double, *(pointer,) * 5)
    code.widths.argtypes = (counter, counter, *(pointer,) * 3, counter, *(pointer,) * 3)
    code.informed.argtypes = (pointer, counter, counter, *(pointer,) * 9)
    code.informed.restype = None
    code.slid.argtypes = (
        *(pointer, counter, counter, counter),
        *(*(ctypes.c_double,) * 3, counter),
        *(pointer,) * 9,
    )
    code.slid.restype = counter
    code.alone.restype = code.widths.restype = ctypes.c_double


library = SourceLibrary(SOLVE, _declare, _FLAGS)
"""The compiled functions, once there are any; for the whole process."""


@functools.cache
def problem_of(group: Group, rows: int) -> Problem:
    """Return the problem with what a family says, and nothing else. It is shared: copy it."""
    freedom, problem = group.freedom(rows), Problem()
    problem.rows, problem.joints = rows, len(freedom.joints)
    problem.lefts, problem.rights = len(freedom.left), len(freedom.right)
    problem.pitched, problem.reach = group.pitch, group.reach
    for name, components in (("joint", freedom.joints), ("left", freedom.left), ("right", freedom.right)):
        getattr(problem, name)[: len(components)] = components
    return problem


def packed(motion: GroupMotion) -> Array:
    """Return what C knows of a member: rotation and place of both sides, and the pitch."""
    result = np.empty(25)
    for at, side in ((0, motion.left), (12, motion.right)):
        result[at : at + 9] = side[:3, :3].ravel()
        result[at + 9 : at + 12] = side[:3, 3]
    result[24] = motion.pitch
    return result


def unpacked(motion: GroupMotion, packed: Array) -> GroupMotion:
    """Return the member that C calls so."""
    left, right = (pose(packed[at : at + 9].reshape(3, 3), packed[at + 9 : at + 12]) for at in (0, 12))
    return replace(motion, left=left, right=right, pitch=float(packed[24]))


def linear_of(count: int, rows: int, size: int, joints: int) -> Linear:
    """Return room for poses, of which the last rows are there, and their derivatives."""
    poses = np.zeros((count, 4, 4))
    poses[:, 3, 3] = 1.0
    return Linear(poses, np.empty((count, rows, size)), np.empty((count, rows, joints)))


def at(motion: GroupMotion, values: Array) -> Linear:
    """Return the poses at joint values (N, k), as :meth:`.groups.GroupMotion.at` does."""
    result = linear_of(len(values), motion.rows, motion.size, motion.joints)
    moved, values = packed(motion), np.ascontiguousarray(values, dtype=np.float64)
    library.code.at(
        ctypes.addressof(problem_of(motion.group, motion.rows)),
        len(values),
        moved.ctypes.data,
        values.ctypes.data,
        *(array.ctypes.data for array in result),
    )
    return result
