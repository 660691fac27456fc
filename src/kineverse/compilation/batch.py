"""Evaluation at many points, into reused aligned buffers.

The system fills new memory with zeros at first touch, which takes three times as long as computing and
writing poses. A loop over batches releases one result for each new one, so memory of released results is
reused.
"""

from __future__ import annotations

import ctypes
import itertools
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import CompileError, NoSolutionError, ShapeError
from kineverse.expressions.layout import ArrayShape
from kineverse.lie import Array

from .c_library import ProgramLibrary, cores, open_library, parallel_rows
from .codegen import BATCH_KIND, generate_batch_source, missing_operations
from .evaluator import bind
from .program import CasadiFunction, Program
from .signature import as_doubles
from .toolchain import vector_optimisation_level

_CACHE_LINE = 64
# The C library itself reuses smaller blocks.
_SMALLEST_BUFFER = 4 * 2**20
_LARGEST_TOTAL = 128 * 2**20

# Longest free first. Accessed by atomic operations only: garbage collection may interrupt this code to return
# a block.
_free_blocks: list[Array] = []


def allocate_aligned(size: int) -> Array:
    """Return an uninitialised vector that begins at a cache line.

    Its memory is reused only after this vector and all views of it are deleted.
    """
    if 8 * size < _SMALLEST_BUFFER:
        return _from_line(np.empty(size + _CACHE_LINE // 8))[:size]
    block = _take_free_block(size + _CACHE_LINE // 8)
    if block is None:
        block = np.empty(size + _CACHE_LINE // 8)
    lease = _Lease(block)
    weakref.finalize(lease, _give_back, block).atexit = False
    return _from_line(np.asarray(lease))[:size]


class _Lease:
    """Owner of a block, which lives as long as the last array in the block."""

    __slots__ = ("__array_interface__", "__weakref__")

    def __init__(self, block: Array) -> None:
        self.__array_interface__ = block.__array_interface__


def _from_line(block: Array) -> Array:
    return block[-block.__array_interface__["data"][0] % _CACHE_LINE // 8 :]


def _take_free_block(size: int) -> Array | None:
    for _ in range(len(_free_blocks)):
        try:
            block = _free_blocks.pop(0)
        except IndexError:
            break
        if block.size == size:
            return block
        _free_blocks.append(block)
    return None


def _give_back(block: Array) -> None:
    _free_blocks.append(block)
    while sum(b.nbytes for b in _free_blocks[:]) > _LARGEST_TOTAL:
        try:
            _free_blocks.pop(0)
        except IndexError:
            break


_STREAMED_BYTES = 8 * 2**20  # larger results are written past the caches, which they would not fit
# Seconds on one core, in all and for each instruction, as measured with gcc 12 and CasADi 3.8.
_COMPILING, _COMPILING_ONE = 0.3, 1e-3
_INTERPRETING, _INTERPRETING_ONE = 50e-9, 3e-9
_MAPPED = 32  # rows per call of CasADi's map

BatchFunction = Callable[[int, int, int, int], int]


class Batch:
    """Evaluation of one program at many points.

    The program is compiled for vectors when that pays. A call that would take the interpreter longer than the
    compiler waits for the compiler; smaller calls add up until they start a compilation in the background.
    Programs with other operations stay with CasADi's map over the function of single calls.
    """

    def __init__(self, program: Program, shapes: Sequence[ArrayShape], single: bool, tier: str) -> None:
        self._program = program
        self._shapes = shapes
        self._single = single
        self._insist = tier == "c"
        self._spent = 0.0
        self._library: ProgramLibrary[BatchFunction] | None = None
        self._several: tuple[CasadiFunction, int, CasadiFunction] | None = None  # the last map, slow to make
        if tier != "interpreter" and not missing_operations(program):
            level = vector_optimisation_level(program.instructions)
            self._library = ProgramLibrary(
                program, BATCH_KIND, lambda: generate_batch_source(program), _load, level
            )

    def __call__(self, x: npt.ArrayLike, out: Any, function: CasadiFunction) -> Any:
        """Return the outputs at all rows of ``x``, see :meth:`.CompiledFunction.batch`."""
        points = self._points(x)
        rows = len(points)
        if out is None:
            results = [
                allocate_aligned(rows * size).reshape(rows, *shape)
                for shape, size in zip(self._shapes, self._program.sizes, strict=True)
            ]
        else:
            results = self._check_out(out, rows)
            if _overlap([points, *results]):
                points = points.copy()
        code = self._code(rows)
        if code is None:
            self._interpret(points, results, function)
        else:
            self._run(code, points, results)
        if self._program.implicit:
            self._check(points, results)
        return results[0] if self._single else tuple(results)

    def request(self) -> None:
        """Request compilation in the background, before it pays."""
        if self._library is not None:
            self._code(0)  # an error if C is required and impossible
            self._library.request()

    def _check(self, points: Array, results: Sequence[Array]) -> None:
        rows = np.logical_or.reduce([np.isnan(r).reshape(len(points), -1).any(axis=1) for r in results])
        for row in np.flatnonzero(rows):
            try:
                self._program.check(points[row], [r[row] for r in results])
            except NoSolutionError as error:
                raise NoSolutionError(f"Row {row}: {error}") from None

    def _points(self, x: npt.ArrayLike) -> Array:
        size = self._program.size
        wanted = f"an array of shape (N, {size}), a configuration per row"
        points = as_doubles(x, wanted)
        if points.ndim != 2 or points.shape[1] != size:
            raise ShapeError(f"Expected {wanted}, not an array of shape {points.shape}.")
        return np.ascontiguousarray(points)

    def _check_out(self, out: Any, rows: int) -> list[Array]:
        given = list(out) if isinstance(out, (list, tuple)) else [out]
        if len(given) != len(self._shapes):
            raise ShapeError(f"out= takes {len(self._shapes)} arrays, one per output, not {len(given)}.")
        for i, (array, shape) in enumerate(zip(given, self._shapes, strict=True)):
            wanted = (rows, *shape)
            if not isinstance(array, np.ndarray) or array.dtype != np.float64 or array.shape != wanted:
                found = (
                    f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
                )
                raise ShapeError(
                    f"out= for output {i} must be a float64 array of shape {wanted}, not {found}."
                )
            if not (array.flags.c_contiguous and array.flags.writeable and array.flags.aligned):
                raise ShapeError(f"out= for output {i} must be C-contiguous, aligned and writeable.")
        if _overlap(given):
            raise ShapeError("out= has arrays that share memory.")
        return given

    def _code(self, rows: int) -> BatchFunction | None:
        """Return the compiled code, waiting for it if that pays; None without code."""
        library = self._library
        if library is None or library.error is not None:
            if self._insist and library is not None:
                raise CompileError(f"The batch cannot be compiled: {library.error}.")
            return None
        if library.code is None and not library.find():
            compiling = _COMPILING + _COMPILING_ONE * self._program.instructions
            interpreting = rows * (_INTERPRETING + _INTERPRETING_ONE * self._program.instructions) / cores()
            self._spent += interpreting
            if self._insist or interpreting > compiling:
                library.wait()
                return self._code(0) if self._insist else library.code
            if self._spent > 0.1 * compiling:
                library.request()
        return library.code

    def _run(self, code: BatchFunction, points: Array, results: list[Array]) -> None:
        rows, size = points.shape
        sizes = self._program.sizes
        streaming = sum(result.nbytes for result in results) > _STREAMED_BYTES
        begin, *begins = map(_address, (points, *results))

        def work(first: int, end: int, _alive: object = (points, *results)) -> None:
            places = (ctypes.c_void_p * len(sizes))(
                *(b + 8 * first * s for b, s in zip(begins, sizes, strict=True))
            )
            if code(begin + 8 * first * size, ctypes.addressof(places), end - first, streaming):
                raise MemoryError("There is no memory for a batch.")

        # Some 100 µs of work, twice of what it takes to wake a thread.
        parallel_rows(work, rows, 2_000_000 // (self._program.instructions + 20))

    def _interpret(self, points: Array, results: list[Array], function: CasadiFunction) -> None:
        flat = [r.reshape(len(points), size) for r, size in zip(results, self._program.sizes, strict=True)]
        rows, size = points.shape

        def work(first: int, end: int) -> None:
            count = min(_MAPPED, end - first)
            vectors = np.zeros((count, size))
            outputs = [np.zeros((count, s)) for s in self._program.sizes]
            several = self._several
            if several is None or several[0] is not function or several[1] != count:
                mapped = function.map(count) if count > 1 else function
                several = self._several = function, count, mapped
            run, _keep = bind(several[2], vectors, outputs, None)
            for start in range(first, end, count):
                stop = min(start + count, end)
                # In the last round, rows of the previous one are evaluated again and ignored.
                vectors[: stop - start] = points[start:stop]
                run()
                for target, output in zip(flat, outputs, strict=True):
                    target[start:stop] = output[: stop - start]

        parallel_rows(work, rows, 200_000 // (self._program.instructions + 20), _MAPPED)


def _overlap(arrays: Sequence[Array]) -> bool:
    spans = sorted((_address(array), array.nbytes) for array in arrays if array.nbytes)
    return any(start + size > following for (start, size), (following, _) in itertools.pairwise(spans))


def _address(array: Array) -> int:
    address: int = array.__array_interface__["data"][0]
    return address


def _load(path: str) -> BatchFunction:
    code = open_library(path).kineverse_batch
    code.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_longlong, ctypes.c_int)
    code.restype = ctypes.c_int
    return code
