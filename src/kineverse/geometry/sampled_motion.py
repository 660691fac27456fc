"""Motion of a collision world along configurations of some coordinates, searched for near pairs."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence

import numpy as np

from kineverse.errors import KineverseError
from kineverse.symbols import Symbol

from .bindings import MotionStruct, collision_library
from .broadphase import Flags
from .collision_world import CollisionWorld
from .mesh_files import Floats

_ROOM = 64  # number of samples whose poses are kept at a time


class SampledMotion:
    """Motion of the objects that some coordinates move, at the present version of a model."""

    def __init__(self, world: CollisionWorld, selected: Flags, coordinates: Sequence[Symbol]) -> None:
        self._world, self.coordinates, self.version = world, tuple(coordinates), world.model.version
        self._selected = np.ascontiguousarray(selected, dtype=np.uint8)
        wanted, moves = {*coordinates}, np.zeros(world.table.count, dtype=bool)
        for k, item in enumerate(world.objects[: world.table.moving]):
            moves[k] = not wanted.isdisjoint(item.body_pose.symbols)
        involved = np.asarray(self._selected.any(axis=1))[world.table.body]
        self._moving, self._standing = (
            np.flatnonzero(flags & involved).astype(np.int32) for flags in (moves, ~moves)
        )
        moved_bodies = np.zeros(len(self._selected), dtype=bool)
        moved_bodies[world.table.body[self._moving]] = True
        self._has_still_pairs = bool(self._selected[np.ix_(~moved_bodies, ~moved_bodies)].any())
        place = {s: k for k, s in enumerate(world.inputs)}
        self._columns = np.array([place.get(s, -1) for s in coordinates], dtype=np.int64)
        self._moved = self._columns >= 0
        moved, still = len(self._moving), len(self._standing)
        self._placed, self._boxes = np.empty((moved, _ROOM, 22)), np.empty((7, still))
        self._inputs, self._outputs = np.zeros(len(world.inputs)), np.empty((world.table.moving, 12))
        arrays = self._moving, self._standing, self._selected, self._placed, self._boxes
        more = self._inputs, self._outputs, self._columns
        self.struct = MotionStruct(
            moved, still, _ROOM, *(a.ctypes.data for a in arrays), None, *(a.ctypes.data for a in more)
        )
        self.struct.coordinates = len(self._columns)

    def find_rows(self, Q: Floats, limit: float, first: bool) -> Iterator[int]:
        """Place the world at configurations (N, n) one after the other, and yield their indices.

        Those configurations are passed over at which C finds no pair within the limit [m]. If not ``first``,
        it passes over configurations with near pairs as well, and shrinks ``limit`` and ``least``. The world
        is placed where it was before when all configurations are done.
        """
        world, s = self._world, self.struct
        s.limit, s.least, s.first = limit, np.inf, first
        before = world.values
        values, away = before.copy(), False
        for k in self._pass_over(Q, before):
            values[self._columns[self._moved]] = Q[k, self._moved]
            world.update(values)
            away = True
            yield k
        if away:
            world.update(before)

    def _pass_over(self, Q: Floats, before: Floats) -> Iterator[int]:
        """Yield the indices of the configurations that C does not pass over."""
        code, table = collision_library.code, self._world.table
        if code is None:
            yield from range(len(Q))
            return
        address, motion = collision_library.bind(table), ctypes.addressof(self.struct)
        # Pairs that stand still are as near as at the first one everywhere.
        begin = 0
        if self._has_still_pairs and len(Q):
            yield 0
            begin = 1
        while begin < len(Q) and self.struct.moved:
            rows = np.ascontiguousarray(Q[begin : begin + _ROOM])
            count = code.settle(address, motion, self._trace(rows, before))
            if not count:
                yield begin  # the poses are not finite, and an update says so
                count = 1
            k = -1
            while (k := code.advance(address, motion, k + 1, count)) >= 0:
                yield begin + k
            begin += count

    def _trace(self, rows: Floats, before: Floats) -> int:
        """Compute the poses at some configurations, and return the number of those that have any."""
        self._inputs[:] = before
        address = self._world.kinematics_address
        if address is not None:
            self.struct.compute = address
            return int(
                collision_library.code.trace(ctypes.addressof(self.struct), rows.ctypes.data, len(rows))
            )
        for k, row in enumerate(rows):
            self._inputs[self._columns[self._moved]] = row[self._moved]
            try:
                poses = self._world.compute_poses(self._inputs)
            except KineverseError:
                return k
            self._placed[:, k, :12] = poses[self._moving].reshape(-1, 12)
        return len(rows)
