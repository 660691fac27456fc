"""Bindings of the compiled broad and narrow phase, with the numpy path until they are built.

Until the library is built, and without a compiler, numpy and coal compute the same results.
"""

from __future__ import annotations

import ctypes
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.compilation.c_library import SourceLibrary, struct_fields
from kineverse.compilation.toolchain import no_compiler
from kineverse.errors import CompileError

from . import broadphase
from .broadphase import Indices, ObjectTable, PairSelection, build_static_tree
from .mesh_files import Floats
from .narrowphase import ACCURACY

_ARRAYS = (
    "body", "allowed", "active", "centre", "half", "radius",
    "poses", "travel", "position", "low", "high", "bounds", "order", "sorted_boxes",
    "corners", "corner_count", "edges", "radii", "round", "tip", "memory",
)  # fmt: skip

_CONSTANTS = ("TREE_WIDTH", "FURTHEST", "LONGEST_TRAVEL", "PLACED", "TRAVEL_EXCEEDED")

_SEVERAL, _MANY = 2, 16
"""Objects of a body from which on near pairs are found by the boxes of bodies, and pairs of bodies for each
object up to which they are; otherwise objects are swept."""
_GATHERED = ("pieces", "bodies", "distance", "witness")

RankedPairs: TypeAlias = tuple[Indices, Indices, Floats, Floats]
"""Objects (K, 2), their bodies (K, 2), distances (K,) and witnesses (K, 9), nearest first."""

MeasuredPairs: TypeAlias = tuple[Indices, Floats, Floats, Floats]
"""Objects (K, 2), lower bounds (K,), distances (K,) and witnesses (K, 9), valid until the next query."""


class _Struct(ctypes.Structure):
    _fields_ = struct_fields(
        f"i count moving bodies axis; p {' '.join(_ARRAYS)} boxes leaves; i node_count leaf_count resets"
    )


class _QueryStruct(ctypes.Structure):
    _fields_ = struct_fields(
        "d reach radius; i all room; p allowed active known pairs lows distances witnesses order; "
        "i kept; p pieces bodies distance witness"
    )


class _FacingStruct(ctypes.Structure):
    _fields_ = struct_fields("p margins; d usual angle apart")


class _NeighbourStruct(ctypes.Structure):
    _fields_ = struct_fields(
        "d reach; p travel pairs; i found room resets; p selected members first; i count; p boxes"
    )


class FacingPoints:
    """Settings of contact manifolds: which further contact points of near, parallel faces are reported.

    Parallel faces are nearest at every point, and a query finds one of them. Faces that are parallel, up to
    an angle, have up to four further pairs of points, with the distance along the normal of the pair, see
    ``contact_manifold.h``. Meshes of triangles have none, nor has anything without a C compiler.
    """

    def __init__(self, margins: Floats, usual: float, angle: float = 0.02, apart: float = 0.1) -> None:
        self._margins = margins
        self._struct = _FacingStruct(margins.ctypes.data, usual, angle, apart)
        self.address = ctypes.addressof(self._struct)


class ObjectPlacement:
    """Objects of a table at other poses, for other compiled code; the solids are shared."""

    def __init__(self, table: ObjectTable) -> None:
        if not collision_library.prepare(wait=True):
            reason = collision_library.error or no_compiler()
            raise CompileError(f"Distances in other compiled code need compiled C, and {reason}.")
        self._table = table
        self._struct = _Struct.from_buffer_copy(_bind_table(table).struct)
        self.poses, self.positions = table.poses.copy(), table.position.copy()
        self._struct.poses, self._struct.position = self.poses.ctypes.data, self.positions.ctypes.data
        self.address = ctypes.addressof(self._struct)
        self.is_within = ctypes.cast(collision_library.code.is_within, ctypes.c_void_p).value


class MotionStruct(ctypes.Structure):
    """Motion along samples as C reads it, see :class:`.SampledMotion`."""

    _fields_ = struct_fields(
        "i moved still room; p moving standing selected placed boxes compute inputs outputs columns; "
        "i coordinates first; d limit least"
    )


class CollisionLibrary(SourceLibrary):
    """Compiled broad and narrow phase, once it is built; shared by all scenes of the process."""

    def __init__(self) -> None:
        constants = {name: getattr(broadphase, name) for name in _CONSTANTS}
        memory_bits = broadphase.MEMORY_SLOTS.bit_length() - 1
        super().__init__(
            "geometry.c", _declare_signatures, **constants, ACCURACY=ACCURACY, MEMORY_BITS=memory_bits
        )

    def place(self, table: ObjectTable, fresh: Floats) -> int:
        """Place objects as :func:`.broadphase.place_objects` does; ``fresh`` is contiguous."""
        if self._code is None:
            return broadphase.place_objects(table, fresh)
        return int(self._code.place(_bind_table(table).address, fresh.ctypes.data))

    def bind(self, table: ObjectTable) -> int:
        """Return the address of a table as C reads it, valid as long as the table."""
        return int(_bind_table(table).address)

    def near(self, table: ObjectTable, reach: float) -> tuple[Indices, Floats]:
        """Find near pairs as :func:`.broadphase.find_near_pairs` does, among all checked pairs."""
        if self._code is None:
            return broadphase.find_near_pairs(table, reach)
        binding = _bind_table(table)
        while True:
            result = self._code.near(binding.address, reach, *binding.results)
            if result <= len(binding.lows):
                return binding.pairs[:result], binding.lows[:result]
            binding.reserve(2 * result)

    def measure(self, table: ObjectTable, pairs: Indices, limit: float) -> tuple[Floats, Floats]:
        """Measure pairs of objects, (K, 2) with the smaller index first, as far as C can."""
        count = len(pairs)
        if self._code is None or not count:
            return np.full(count, np.nan), np.empty((count, 9))
        distances, witnesses = np.empty(count), np.empty((count, 9))
        where = pairs.ctypes.data, count, limit, distances.ctypes.data, witnesses.ctypes.data
        self._code.measure(_bind_table(table).address, *where)
        return distances, witnesses

    def extend(self, table: ObjectTable, ranked: RankedPairs, facing: FacingPoints) -> RankedPairs:
        """Add further facing points of near pairs to ranked pairs, nearest first; not without C."""
        if self._code is None or not len(ranked[2]):
            return ranked
        binding = _bind_table(table)
        while True:
            binding.take(ranked)
            if self._extend(binding, facing):
                return binding.copy_ranked()

    def _extend(self, binding: _TableBinding, facing: FacingPoints) -> bool:
        """Add facing points to the results of a query; False, with larger buffers, if they were too short."""
        result = self._code.extend(binding.address, binding.query_address, facing.address)
        if result < 0:
            raise MemoryError("There is no memory for the facing points of near bodies.")
        if result <= binding.query.room:
            return True
        binding.reserve(2 * result)
        return False

    def rank(
        self, table: ObjectTable, pairs: Indices, distances: Floats, radius: float, per_shape: bool = False
    ) -> npt.NDArray[np.int64]:
        """Rank pairs as :func:`.broadphase.rank_pairs` does; all arrays are contiguous."""
        if self._code is not None:
            order = np.empty(len(pairs), dtype=np.int64)
            where = pairs.ctypes.data, len(pairs), distances.ctypes.data, radius, per_shape, order.ctypes.data
            result = self._code.rank(_bind_table(table).address, *where)
            if result >= 0:
                return order[:result]
        return broadphase.rank_pairs(table, pairs, distances, radius, per_shape)

    def gather(
        self,
        table: ObjectTable,
        pairs: Indices,
        distances: Floats,
        witnesses: Floats,
        order: npt.NDArray[np.int64],
    ) -> RankedPairs:
        """Gather pairs as :func:`.broadphase.gather_pairs` does; all arrays are contiguous."""
        if self._code is None:
            return broadphase.gather_pairs(table, pairs, distances, witnesses, order)
        count = len(order)
        objects, bodies = np.empty((2, count, 2), dtype=np.int32)
        near, points = np.empty(count), np.empty((count, 9))
        sources = (array.ctypes.data for array in (pairs, distances, witnesses, order))
        made = (array.ctypes.data for array in (objects, bodies, near, points))
        self._code.gather(_bind_table(table).address, *sources, count, *made)
        return objects, bodies, near, points

    def search(
        self,
        table: ObjectTable,
        reach: float,
        radius: float,
        selection: PairSelection | None = None,
        per_shape: bool = False,
        facing: FacingPoints | None = None,
    ) -> tuple[MeasuredPairs | None, RankedPairs | None]:
        """Apply :meth:`near`, :meth:`measure` and, if none is left to coal, :meth:`rank` and :meth:`gather`.

        The search covers the selected pairs of bodies, or all checked pairs if None. With ``facing``, ranked
        pairs are extended, see :meth:`extend`.
        """
        if self._code is None:
            wanted = None if selection is None else selection.bodies
            pairs, lows = broadphase.find_near_pairs(table, reach, wanted)
            return (pairs, lows, *self.measure(table, pairs, radius)), None
        binding = _bind_table(table)
        query = binding.query
        known = binding.ask(table, reach, radius, selection, per_shape)
        while True:
            result = self._code.search(binding.address, binding.query_address)
            if result < 0 and known is not None:
                known.reserve(-2 * result)
            elif result > query.room:
                binding.reserve(2 * result)
            elif query.kept <= 0 or facing is None or self._extend(binding, facing):
                break
        if query.kept < 0:
            pairs, lows = binding.pairs[:result], binding.lows[:result]
            return (pairs, lows, binding.distances[:result], binding.witnesses[:result]), None
        return None, binding.copy_ranked()

    def search_at(
        self,
        table: ObjectTable,
        kinematics: tuple[int, int, int],
        reach: float,
        radius: float,
        selection: PairSelection,
        per_shape: bool,
        facing: FacingPoints | None,
    ) -> RankedPairs | None:
        """Apply :meth:`place` and :meth:`search` in one call.

        ``kinematics`` has the addresses of the C function of poses, of its inputs and of its results. The
        answer is None if both have to be called: without C, if pairs are left to coal, if a pose is not
        finite, or if there is more than there is room for.
        """
        if self._code is None:
            return None
        binding = _bind_table(table)
        binding.ask(table, reach, radius, selection, per_shape)
        wanted = None if facing is None else facing.address
        if self._code.search_at(binding.address, binding.query_address, wanted, *kinematics) < 0:
            return None
        return binding.copy_ranked()


class _TableBinding:
    """Table as C reads it, with buffers for results."""

    def __init__(self, table: ObjectTable) -> None:
        self.struct = _Struct()
        for name in _ARRAYS:
            array = getattr(table, name)
            setattr(self.struct, name, None if array is None else array.ctypes.data)
        self.struct.count, self.struct.moving = table.count, table.moving
        self.struct.bodies = len(table.allowed)
        self.address = ctypes.addressof(self.struct)
        self.query = _QueryStruct()
        self.query_address = ctypes.addressof(self.query)
        self.reserve(256)

    def rebuild_tree(self, table: ObjectTable) -> None:
        static = np.arange(table.moving, table.count, dtype=np.int32)
        self.boxes, self.leaves = build_static_tree(table.low, table.high, static)
        self.struct.boxes, self.struct.leaves = self.boxes.ctypes.data, self.leaves.ctypes.data
        self.struct.node_count, self.struct.leaf_count = len(self.boxes), len(self.leaves)
        table.static_changed = False

    def reserve(self, count: int) -> None:
        self.pairs = np.empty((count, 2), dtype=np.int32)
        self.lows = np.empty(count)
        self.distances, self.witnesses = np.empty(count), np.empty((count, 9))
        self.order = np.empty(count, dtype=np.int64)
        self.results = self.pairs.ctypes.data, self.lows.ctypes.data, count
        objects, bodies = np.empty((2, count, 2), dtype=np.int32)
        self.nearest = objects, bodies, np.empty(count), np.empty((count, 9))
        measured: tuple[npt.NDArray[Any], ...] = self.pairs, self.lows, self.distances, self.witnesses
        arrays = *measured, self.order, *self.nearest
        names = ("pairs", "lows", "distances", "witnesses", "order", *_GATHERED)
        for name, array in zip(names, arrays, strict=True):
            setattr(self.query, name, array.ctypes.data)
        self.query.room = count

    def ask(
        self,
        table: ObjectTable,
        reach: float,
        radius: float,
        selection: PairSelection | None,
        per_shape: bool,
    ) -> _NeighbourBinding | None:
        """Set the parameters of a query, and return the neighbours of its selected pairs."""
        query, known = self.query, None
        query.reach, query.radius, query.all = reach, radius, per_shape
        query.allowed = query.active = query.known = None
        if selection is not None:
            query.allowed, query.active = selection.addresses
            known = selection.binding
            if known is None:
                known = selection.binding = _NeighbourBinding(table, selection)
            query.known = known.address
        return known

    def take(self, ranked: RankedPairs) -> None:
        kept = len(ranked[2])
        if kept > self.query.room:
            self.reserve(2 * kept)
        buffers: tuple[npt.NDArray[Any], ...] = self.nearest
        for buffer, values in zip(buffers, ranked, strict=True):
            buffer[:kept] = values
        self.query.kept = kept

    def copy_ranked(self) -> RankedPairs:
        kept = self.query.kept
        objects, bodies, near, points = self.nearest
        return objects[:kept].copy(), bodies[:kept].copy(), near[:kept].copy(), points[:kept].copy()


class _NeighbourBinding:
    """List of neighbours among selected pairs, as C reads and writes it."""

    def __init__(self, table: ObjectTable, selection: PairSelection) -> None:
        pairs = np.ascontiguousarray(np.argwhere(np.triu(selection.bodies)), dtype=np.int32)
        first = np.searchsorted(np.sort(table.body), np.arange(len(selection.bodies) + 1)).astype(np.int32)
        self._arrays: dict[str, npt.NDArray[Any]] = {
            "travel": np.zeros(table.moving),
            "selected": pairs,
            "members": np.argsort(table.body, kind="stable").astype(np.int32),
            "first": first,
            "boxes": np.empty((len(selection.bodies), 6)),
        }
        self._struct = _NeighbourStruct(resets=-1, count=len(pairs))
        for name, array in self._arrays.items():
            setattr(self._struct, name, array.ctypes.data)
        if table.count < _SEVERAL * len(selection.bodies) or len(pairs) > _MANY * table.count:
            self._struct.boxes = None
        self.address = ctypes.addressof(self._struct)
        self.reserve(1024)

    def reserve(self, count: int) -> None:
        self._pairs = np.empty((count, 2), dtype=np.int32)
        self._struct.pairs, self._struct.room, self._struct.resets = self._pairs.ctypes.data, count, -1


def _bind_table(table: ObjectTable) -> _TableBinding:
    binding: _TableBinding | None = table.binding
    if binding is None:
        binding = table.binding = _TableBinding(table)
    binding.struct.axis, binding.struct.resets = table.axis, table.resets
    if table.static_changed:
        binding.rebuild_tree(table)
    return binding


def _declare_signatures(code: Any) -> None:
    pointer = ctypes.c_void_p
    code.place.argtypes, code.place.restype = (pointer, pointer), ctypes.c_int64
    code.near.argtypes = (pointer, ctypes.c_double, pointer, pointer, ctypes.c_int64)
    code.near.restype = ctypes.c_int64
    code.measure.argtypes = (pointer, pointer, ctypes.c_int64, ctypes.c_double, pointer, pointer)
    code.measure.restype = None
    code.extend.argtypes, code.extend.restype = (pointer, pointer, pointer), ctypes.c_int64
    code.rank.argtypes = (pointer, pointer, ctypes.c_int64, pointer, ctypes.c_double, ctypes.c_int64, pointer)
    code.rank.restype = ctypes.c_int64
    code.gather.argtypes = (*(pointer,) * 5, ctypes.c_int64, *(pointer,) * 4)
    code.gather.restype = None
    code.search.argtypes, code.search.restype = (pointer, pointer), ctypes.c_int64
    code.search_at.argtypes, code.search_at.restype = (pointer,) * 6, ctypes.c_int64
    code.trace.argtypes, code.trace.restype = (pointer, pointer, ctypes.c_int64), ctypes.c_int64
    code.settle.argtypes, code.settle.restype = (pointer, pointer, ctypes.c_int64), ctypes.c_int64
    code.advance.argtypes = (pointer, pointer, ctypes.c_int64, ctypes.c_int64)
    code.advance.restype = ctypes.c_int64


collision_library = CollisionLibrary()
