"""Bindings of the compiled planner: structures as C reads them, and its functions."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from kineverse.compilation.c_library import SourceLibrary, struct_fields
from kineverse.compilation.interruption import raise_signal
from kineverse.compilation.toolchain import no_compiler
from kineverse.control.contact_constraints import row_library
from kineverse.errors import CompileError
from kineverse.geometry.bindings import collision_library


def _integers(names: str) -> list[tuple[str, type[np.int32]]]:
    return [(name, np.int32) for name in names.split()]


_VECTORS = ("rotation", np.float32, 9), ("translation", np.float32, 3), ("size", np.float32, 3)
OBSTACLE = np.dtype([*_VECTORS, *_integers("kind body first planes aligned object")])
_BOUNDS = ("ball", np.float32, 4), ("low", np.float32, 3), ("high", np.float32, 3)
LINK = np.dtype([*_BOUNDS, *_integers("pose first coarse first_shape shapes exact")])
SHAPE = np.dtype([("pose", np.float64, 12), ("object", np.int64)])
COARSE = np.dtype([("sphere", np.float32, 4), *_integers("first count")])

MOST_COORDINATES = 64  # largest number of coordinates
BOX, CYLINDER, CAPSULE, SPHERE, HULL = range(5)  # kinds of obstacles
FOUND, TIME_IS_UP, TOO_MANY_NODES, NO_MEMORY, TOO_LONG = range(5)  # outcomes of a search


class ObstacleSetStruct(ctypes.Structure):
    """Set of obstacles as C reads it."""

    _fields_ = struct_fields("p items boxes chunks; i count padded padded_chunks pose link")


class CheckerStruct(ctypes.Structure):
    """Tables of a collision checker as C reads them."""

    _fields_ = struct_fields(
        "i coordinates poses conditions stored; p compute kept lower upper; i links bodies; p link coarse "
        "fine planes allowed world moving fineness turns; i pairs moving_pairs; p pair moving_pair shape "
        "objects object_poses object_positions object_centres is_within; d margin"
    )


class ProjectionStruct(ctypes.Structure):
    """Projection onto a manifold as C reads it."""

    _fields_ = struct_fields(
        "p step kept; i stored; d tolerance; i steps; p exact exact_kept; i exact_stored; d exact_tolerance"
    )


class SearchStruct(ctypes.Structure):
    """Search and its results as C reads and writes them."""

    _fields_ = struct_fields(
        "p checker projection; d range resolution seconds; i nodes most_edges seed iterations edges "
        "count_start count_goal status; d elapsed gap"
    )


class RoadmapStruct(ctypes.Structure):
    """Roadmap, a query and its results as C reads and writes them."""

    _fields_ = struct_fields(
        "p checker; d resolution least greed seconds; i seed degree room least_batch; p period columns "
        "lengths targets incoming next node edge passing visits_start visits_goal order_start order_goal; "
        "i count ends drawn round query samples nodes_checked edges_checked reached_start reached_goal "
        "status; d elapsed gap"
    )


def request_planner() -> None:
    """Request the planner in the background, after queries and contact rows, which are needed sooner."""
    for library in (collision_library, row_library, _library):
        library.prepare()


def planning_functions() -> Any:
    """Return the compiled functions of the planner, built first if necessary."""
    if not _library.prepare(wait=True):
        raise CompileError(
            f"Planning needs compiled C, and {_library.error or no_compiler()}. Inverse kinematics "
            "('kineverse reach') and controllers work without it."
        )
    return _library.code


def _declare_signatures(code: Any) -> None:
    pointer, count, number = ctypes.c_void_p, ctypes.c_longlong, ctypes.c_double
    signatures = {
        "kineverse_valid": (ctypes.c_int, [pointer, pointer, count, pointer]),
        "kineverse_edges": (ctypes.c_int, [pointer, pointer, pointer, count, number, number, pointer]),
        "kineverse_certify": (count, [pointer, pointer, count, number, number, number, pointer]),
        "kineverse_poses": (ctypes.c_int, [pointer, pointer, pointer]),
        "kineverse_rrt_connect": (count, [pointer, pointer, count, pointer, count, pointer, count]),
        "kineverse_project": (ctypes.c_int, [pointer, pointer, pointer, count, pointer]),
        "kineverse_relax": (count, [pointer, pointer, count, count]),
        "kineverse_polish": (ctypes.c_int, [pointer, pointer, pointer, count, count, pointer]),
        "kineverse_refine": (count, [pointer, pointer, pointer, count, count, count, number]),
        "kineverse_roadmap": (count, [pointer, pointer, count, pointer, count, pointer, count]),
        "kineverse_shortcut": (count, [pointer, pointer, count, count, count, number]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(code, name)
        function.restype, function.argtypes = result, arguments
        function.errcheck = _ensure_memory if result is ctypes.c_int else _ensure_whole


def _ensure_memory(failed: int, function: Any, arguments: tuple[Any, ...]) -> int:
    """Raise MemoryError where a function of C has failed, which only happens for lack of memory."""
    raise_signal()
    if failed:
        raise MemoryError("There is no memory for the check of configurations.")
    return failed


def _ensure_whole(result: int, function: Any, arguments: tuple[Any, ...]) -> int:
    """Raise the exception that ended a function of C early, if there is one."""
    raise_signal()
    return result


_library = SourceLibrary(
    "planning.c",
    _declare_signatures,
    ("-O3", "-ffp-contract=fast", "-fno-rounding-math"),
    MOST_COORDINATES=MOST_COORDINATES,
)
