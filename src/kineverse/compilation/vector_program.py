"""Functions of many configurations at once, for callers in C.

A batch (:meth:`.CompiledFunction.batch`) reads and writes rows of doubles. A :class:`VectorProgram` stays in
vectors: C code that includes :func:`vector_header` fills a vector for each input, calls a function pointer,
and goes on with the vectors of the outputs.
"""

from __future__ import annotations

import ctypes
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import CompileError, ShapeError
from kineverse.expressions import Expression
from kineverse.state import State
from kineverse.symbols import Symbol

from . import codegen
from .batch import allocate_aligned
from .c_library import ProgramLibrary, open_library
from .c_source import Scalar, vector_header
from .codegen import SCALAR, VECTOR, generate_parts, missing_operations
from .program import Program
from .schedule import read_instructions, relax_residuals, schedule, separate_parameters
from .signature import Signature, as_doubles, make_signature
from .toolchain import vector_optimisation_level

__all__ = ["VectorProgram", "vector_header", "vector_source"]

_FUNCTIONS = r"""
EXPORTED const int kineverse_lanes = W, kineverse_kept = {name}_kept, kineverse_stored = {name}_stored;
EXPORTED void kineverse_prepare(const double *parameters, void *kept) {{ {name}_prepare(parameters, kept); }}
EXPORTED void kineverse_compute(const V *x, const V *kept, V *store, V *o) {{
  {name}_compute(x, kept, store, o);
}}
/* Compute blocks of W configurations. */
EXPORTED void kineverse_evaluate(const V *x, const V *kept, V *store, V *o, long long blocks) {{
  for (; blocks > 0; blocks--, x += {inputs}, o += {outputs}) {name}_compute(x, kept, store, o);
}}
"""

# Without contraction C and interpreter agree to the last bit, which no float does. So sums of products may be
# rounded once, which is faster and more accurate.
_FLOAT_FLAGS = ("-ffp-contract=fast",)

# Raise the number when other source is generated from the same program and texts.
_KIND = "vector 3 " + hashlib.sha256(
    (vector_header("float") + vector_header("double") + _FUNCTIONS + repr((VECTOR, SCALAR))).encode()
).hexdigest()  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Code:
    """A loaded library: the functions, their addresses and its numbers."""

    evaluate: Any
    prepare: Any
    compute_address: int
    prepare_address: int
    lanes: int
    kept: int
    stored: int


class VectorProgram:
    """SIMD function of many configurations at once, for callers in C.

    The library has two functions::

        void kineverse_prepare(const double *parameters, void *kept);
        void kineverse_compute(const V *x, const V *kept, V *store, V *o);

    The first computes everything that depends on parameters only, in double, and writes :attr:`kept` vectors
    of it. The second computes the outputs of one vector of configurations, ``o``: the elements of each output
    in C order, one output after the other. It needs memory for :attr:`stored` vectors. All memory of vectors
    begins at multiples of 64 bytes. Both may be called by several threads.
    """

    def __init__(
        self,
        outputs: Sequence[Expression],
        inputs: Sequence[Symbol],
        parameters: Sequence[Symbol] = (),
        *,
        scalar: Scalar = "float",
    ) -> None:
        signature = make_signature(outputs, [*inputs, *parameters])
        self._parameters = Signature(tuple(parameters))
        self._program = program = Program(outputs, signature.inputs)
        self._scalar: Scalar = scalar
        self._dtype = np.dtype(np.float32 if scalar == "float" else np.float64)
        self.size = len(inputs)
        self.sizes = program.sizes
        self.shapes = tuple(e.shape for e in outputs)
        missing = missing_operations(program)
        if missing:
            raise CompileError(f"No vector version exists of: {', '.join(missing)}.")
        self._library: ProgramLibrary[_Code] = ProgramLibrary(
            program,
            f"{_KIND} {scalar} {self.size}",
            self._source,
            _load,
            vector_optimisation_level(program.instructions),
            _FLOAT_FLAGS if scalar == "float" else (),
        )
        if self._library.error is not None:
            raise self._failed()

    @property
    def error(self) -> str | None:
        """The reason why there will be no code; None while there is none."""
        return self._library.error

    def find(self) -> bool:
        """Load the library from the cache, and return True if it is loaded."""
        return self._library.find()

    def request(self) -> None:
        """Request compilation in the background, unless the library is loaded."""
        if not self.find():
            self._library.request()

    def wait(self) -> None:
        """Load the library, and compile it before if it is not in the cache."""
        if not self.find() and not self._library.wait():
            raise self._failed()

    @property
    def lanes(self) -> int:
        """The number of configurations in a vector; this and the following load the library."""
        return self._code.lanes

    @property
    def kept(self) -> int:
        """The number of vectors that depend on parameters only."""
        return self._code.kept

    @property
    def stored(self) -> int:
        """The number of vectors of the store."""
        return self._code.stored

    @property
    def compute_address(self) -> int:
        """The address of ``kineverse_compute``, valid as long as the process lives."""
        return self._code.compute_address

    @property
    def prepare_address(self) -> int:
        """The address of ``kineverse_prepare``, valid as long as the process lives."""
        return self._code.prepare_address

    def allocate(self, *shape: int) -> npt.NDArray[Any]:
        """Return aligned zeros of the program's scalar type, shape (..., lanes)."""
        size = int(np.prod(shape)) * self.lanes
        vectors = allocate_aligned(size * self._dtype.itemsize // 8).view(self._dtype)
        vectors[:] = 0
        return vectors.reshape(*shape, self.lanes)

    def prepare(
        self, values: npt.ArrayLike | Mapping[Any, float] | State = (), out: npt.NDArray[Any] | None = None
    ) -> npt.NDArray[Any]:
        """Return what depends on parameters only, shape (kept, lanes)."""
        vector = self._parameters.vector(values)
        kept = self.allocate(self.kept) if out is None else out
        if (kept.shape, kept.dtype) != ((self.kept, self.lanes), self._dtype) or not kept.flags.c_contiguous:
            raise ShapeError(
                f"out= is an array from allocate({self.kept}), not one of {kept.dtype} {kept.shape}."
            )
        self._code.prepare(vector.ctypes.data, kept.ctypes.data)
        return kept

    def evaluate(
        self, x: npt.ArrayLike, values: npt.ArrayLike | Mapping[Any, float] | State = ()
    ) -> tuple[npt.NDArray[Any], ...]:
        """Return the outputs at many configurations, in the program's scalar type."""
        wanted = f"an array of shape (N, {self.size}), a configuration per row"
        rows = as_doubles(x, wanted)
        if rows.ndim != 2 or rows.shape[1] != self.size:
            raise ShapeError(f"Expected {wanted}, not an array of shape {rows.shape}.")
        kept, lanes = self.prepare(values), self.lanes
        blocks = -(-len(rows) // lanes)
        padded = np.zeros((blocks * lanes, self.size))
        padded[: len(rows)] = rows
        vectors = self.allocate(blocks, self.size)
        with np.errstate(over="ignore"):
            vectors[:] = padded.reshape(blocks, lanes, self.size).swapaxes(1, 2)
        width = sum(self.sizes)
        results = self.allocate(blocks, width)
        store = self.allocate(self.stored)
        self._code.evaluate(*(a.ctypes.data for a in (vectors, kept, store, results)), blocks)
        columns = results.swapaxes(1, 2).reshape(blocks * lanes, width)[: len(rows)]
        ends = itertools.accumulate(self.sizes)
        return tuple(
            columns[:, end - size : end].reshape(len(rows), *shape)
            for end, size, shape in zip(ends, self.sizes, self.shapes, strict=True)
        )

    @property
    def _code(self) -> _Code:
        if self._library.code is None:
            self.wait()
        assert self._library.code is not None
        return self._library.code

    def _failed(self) -> CompileError:
        return CompileError(f"The vector program cannot be compiled: {self._library.error}.")

    def _source(self) -> str:
        functions = _FUNCTIONS.format(name="program", inputs=self.size, outputs=sum(self.sizes))
        return vector_header(self._scalar) + vector_source(self, name="program") + functions


def vector_source(program: VectorProgram, *, name: str) -> str:
    """Return the C source of a vector program for inclusion in other C, behind :func:`vector_header`.

    It defines the static functions ``<name>_prepare`` and ``<name>_compute``, and the constants
    ``<name>_kept`` and ``<name>_stored``, see :class:`VectorProgram`.
    """
    whole = read_instructions(program._program.function)
    preparing, computing = separate_parameters(whole, program.size)
    if program._scalar == "float":
        computing = relax_residuals(computing)
    prepare = schedule(preparing, codegen.PART_LENGTH)
    compute = schedule(computing, codegen.PART_LENGTH)
    return "\n".join(
        [
            f"enum {{ {name}_kept = {len(preparing.outputs)}, {name}_stored = {compute.stored} }};",
            generate_parts(prepare, f"{name}_prepare_in_double", SCALAR),
            f"static void {name}_prepare(const double *parameters, V *kept) {{",
            f"  double store[{prepare.stored + 1}];",
            f"  {name}_prepare_in_double(parameters, 0, store, kept);",
            "}",
            generate_parts(compute, f"{name}_compute", VECTOR, program._scalar),
        ]
    )


def _load(path: str) -> _Code:
    library = open_library(path)
    lanes, kept, stored = (
        ctypes.c_int.in_dll(library, f"kineverse_{name}").value for name in ("lanes", "kept", "stored")
    )
    evaluate, prepare = library.kineverse_evaluate, library.kineverse_prepare
    evaluate.argtypes = (*(ctypes.c_void_p,) * 4, ctypes.c_longlong)
    prepare.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    evaluate.restype = prepare.restype = None
    compute_address, prepare_address = map(_address, (library.kineverse_compute, library.kineverse_prepare))
    return _Code(evaluate, prepare, compute_address, prepare_address, lanes, kept, stored)


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0
