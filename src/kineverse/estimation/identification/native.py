"""Primitives of identification in C, for motions whose functions are generated and compiled.

The library is compiled in the background, and so are the functions of each motion. Until then, and without a
compiler, numpy computes the same.
"""

from __future__ import annotations

import ctypes
import functools
from operator import gt
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from kineverse.compilation import CompiledFunction
from kineverse.compilation import compile as compiled
from kineverse.compilation.c_library import SourceLibrary, struct_fields
from kineverse.expressions.expression import array
from kineverse.lie import Array
from kineverse.spatial import exp_so3, inverse, log_so3, transform
from kineverse.symbols import Symbol

if TYPE_CHECKING:
    from .motion_functions import MotionForm


class LinearisedPoses(NamedTuple):
    """Relative poses and their derivatives."""

    pose: Array  # parent_T_child, (N, 4, 4)
    by_parameters: Array  # twists of the child in the parent's axes, (N, m, n)
    by_joints: Array  # the same per unit of each joint value, (N, m, k)


# No other path has to agree with these numbers to the last bit, so contraction is allowed.
_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-rounding-math", "-lm")
# Largest numbers of parameters, of all unknowns, of a step, a state and a prior's residuals in C.
_SIZES = {"MOST": 12, "UNKNOWNS": 16, "STEPS": 16, "STATES": 64, "PRIORS": 12}
_JOINTS = 6


class _Noise(ctypes.Structure):
    _fields_ = struct_fields("p covariance inverse; i stride round")


class Problem(ctypes.Structure):
    """C structure of a motion's form, observations and the prior of the joint values."""

    _fields_ = (
        *struct_fields("p linearise retract slope prior errors turn_parent"),
        *struct_fields("i states steps all_joints priors rows size beliefs movers joints"),
        *((name, ctypes.c_int64 * _SIZES["MOST"]) for name in ("parameter", "belief", "mover")),
        *((name, ctypes.c_int64 * _JOINTS) for name in ("joint", "kind")),
        *((name, ctypes.c_double * _JOINTS) for name in ("largest", "lower", "upper")),
        ("regular", ctypes.c_double * _SIZES["UNKNOWNS"]),
        *struct_fields("i count; p parent child parent_covariance child_covariance"),
        *struct_fields("d close little; i widths; p grid; i marginal"),
        *((name, ctypes.c_double * _JOINTS) for name in ("mean", "precision")),
        *((name, _Noise) for name in ("of_parent", "of_child")),
    )


def _declare(code: Any) -> None:
    pointer, counter, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    code.memory_of.argtypes, code.memory_of.restype = (counter,), counter
    code.evaluate.argtypes = (pointer, counter, *(pointer,) * 5)
    code.solve.argtypes = (pointer, counter, pointer, counter, counter, pointer, pointer)
    code.rate.argtypes = (pointer, counter, pointer, pointer, number, *(pointer,) * 8)
    for function in (code.evaluate, code.solve, code.rate):
        function.restype = None


library = SourceLibrary("identification.c", _declare, _FLAGS, **_SIZES)
"""Compiled functions, shared by the whole process."""


@functools.cache
def observation_functions() -> tuple[CompiledFunction[Any], CompiledFunction[Any]]:
    """Return functions of poses of an observation, each (3, 4): its errors, and the parent's pose after one.

    The errors are those of the measured parent A and child B in the axes of the estimated parent, against it
    and against the child's pose H in it.
    """

    def pose(name: str) -> tuple[list[Symbol], Any]:
        entries = [Symbol(f"identification/{name} {i}") for i in range(12)]
        top = array(entries).reshape(3, 4)
        return entries, transform(top[:, :3], top[:, 3])

    (estimated, W), (relative, H), (parent, A), (child, B) = map(pose, ("estimated", "relative", "A", "B"))
    of_parent, of_child = inverse(W) @ A, inverse(W) @ B
    turned = transform(of_child[:3, :3] @ H[:3, :3].T, np.zeros(3))
    errors = [of_parent[:3, 3], log_so3(of_parent), of_child[:3, 3] - H[:3, 3], log_so3(turned)]
    error = [Symbol(f"identification/error {i}") for i in range(6)]
    after = W @ transform(exp_so3(array(error[3:])), array(error[:3]))
    return (
        compiled(np.concatenate(errors), [*estimated, *relative, *parent, *child]),
        compiled(after[:3].ravel(), [*estimated, *error]),
    )


def prepare(wait: bool = False) -> bool:
    """Compile what all motions share, in the background, and return True if it is there."""
    ready = library.prepare(wait)
    for function in observation_functions():
        if wait:
            function.wait()
        ready = ready and function.address is not None
    return ready


_problems: WeakKeyDictionary[MotionForm, Problem | None] = WeakKeyDictionary()


def problem_of(form: MotionForm) -> Problem | None:
    """Return the structure of a form only, which callers copy; None if it is not compiled or too large."""
    if not library.is_native:
        return None
    if form in _problems:
        return _problems[form]
    functions, size, joints = form.functions, len(form.parameters), len(form.joints)
    sizes = max(size, len(form.beliefs)), size + joints, functions.steps, functions.states, functions.priors
    if functions.joints > _JOINTS or any(map(gt, sizes, _SIZES.values())):
        return _problems.setdefault(form, None)
    result = Problem(
        states=functions.states, steps=functions.steps, all_joints=functions.joints, priors=functions.priors,
        rows=form.rows, size=size, joints=joints, beliefs=len(form.beliefs), movers=-1,
    )  # fmt: skip
    called = dict(zip(("errors", "turn_parent"), observation_functions(), strict=True))
    names = ("linearise", "retract", "slope", "prior") if size else ("linearise",)
    called |= {name: getattr(functions, name) for name in names}
    for name, function in called.items():
        if function is not None:
            if function.address is None:
                return None
            setattr(result, name, function.address)
    result.parameter[:size], result.joint[:joints] = form.parameters, form.joints
    result.belief[: len(form.beliefs)], result.kind[:joints] = form.beliefs, form.kinds
    if form.movers is not None:
        result.movers = len(form.movers)
        result.mover[: result.movers] = form.movers
    result.regular[: size + joints] = form.precision.tolist()
    result.largest[:joints], result.lower[:joints], result.upper[:joints] = form.limits.tolist()
    return _problems.setdefault(form, result)


def evaluate_poses(problem: Problem, state: Array, values: Array) -> LinearisedPoses:
    """Return the poses at joint values (N, k) and their derivatives, in C."""
    values = np.ascontiguousarray(values, dtype=np.float64)
    count, rows = len(values), problem.rows
    result = LinearisedPoses(
        np.empty((count, 4, 4)),
        np.empty((count, rows, problem.size)),
        np.empty((count, rows, problem.joints)),
    )
    arrays = (state, values, *result)
    library.code.evaluate(ctypes.addressof(problem), count, *(array.ctypes.data for array in arrays))
    return result
