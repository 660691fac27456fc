"""What compiles functions here, for people to see."""

from __future__ import annotations

from dataclasses import dataclass

from .cache import library_cache
from .library import optimisation
from .rows import cores
from .toolchain import ARITHMETIC, toolchain


@dataclass(frozen=True, slots=True)
class CompilerInformation:
    """What compiles functions on this machine.

    Attributes
    ----------
    compiler
        The path of the C compiler; None if there is none, so that everything stays interpreted.
    version
        What the compiler says it is.
    flags
        What it is told about optimisation and arithmetic, for functions of moderate size.
    vector_unit
        The widest vector instructions that batches use: ``avx512``, ``avx2``, ``avx``, ``sse2``, ``neon``,
        ``none``.
    cores
        How many cores batches are spread over.
    cache_folder
        Where compiled libraries are kept.
    """

    compiler: str | None
    version: str | None
    flags: tuple[str, ...]
    vector_unit: str
    cores: int
    cache_folder: str


def compiler_information() -> CompilerInformation:
    """Return what compiles functions on this machine; it asks the compiler, which takes some milliseconds."""
    found = toolchain()
    return CompilerInformation(
        compiler=found.command[0] if found else None,
        version=found.version() if found else None,
        flags=(optimisation(0) or "", *ARITHMETIC) if found else (),
        vector_unit=found.vector_unit() if found else "none",
        cores=cores(),
        cache_folder=str(library_cache().folder),
    )
