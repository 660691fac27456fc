"""Hand-written C of the package: the files of ``kineverse/_native``, with their includes expanded."""

from __future__ import annotations

import functools
import posixpath
import re
from collections.abc import Iterator, Mapping
from importlib import resources
from typing import Literal, TypeAlias

Scalar: TypeAlias = Literal["float", "double"]  # the type of the numbers in a vector

_INCLUDE = re.compile(r'#include "(.+)"')
_GENERATED = '#line 1 "generated.c"\n'


def read_source(name: str, generated: Mapping[str, str] | None = None) -> str:
    """Return a file of ``kineverse/_native`` with its includes expanded, for the input of a compiler.

    By ``#line``, compilers, debuggers and sanitizers name files and lines. ``generated`` has the text of
    included files that do not exist, by name.
    """
    return "\n".join(_expand(name, generated or {}, set())) + "\n"


def _expand(name: str, generated: Mapping[str, str], included: set[str]) -> Iterator[str]:
    """Yield the lines of a file. Each file is included once, as ``#pragma once`` says."""
    included.add(name)
    yield f'#line 1 "{name}"'
    text = generated[name] if name in generated else _read(name)
    for number, line in enumerate(text.splitlines(), 1):
        found = _INCLUDE.fullmatch(line)
        if found is None:
            yield "" if line == "#pragma once" else line  # which compilers only take in included files
            continue
        path = posixpath.normpath(posixpath.join(posixpath.dirname(name), found[1]))
        if path not in included:
            yield from _expand(path, generated, included)
        yield f'#line {number + 1} "{name}"'


@functools.cache
def _read(name: str) -> str:
    return (resources.files("kineverse") / "_native" / name).read_text(encoding="utf-8")


@functools.cache
def vector_header(scalar: Scalar) -> str:
    """Return the C header of vectors: types, arithmetic and elementary functions.

    Generated functions and other C that is compiled with the flags of the same :class:`.Toolchain` have the
    same vectors, and so may call each other.

    Notes
    -----
    ``V``, ``I``
        A vector of ``W`` numbers of type ``Real``, and one of as many whole numbers of type ``Bits``.
    ``REAL(1.5)``
        A literal.
    ``INLINE``, ``NOINLINE``, ``APART``, ``EXPORTED``, ``UNROLLED``
        How functions and loops are compiled.
    ``splat``, ``splat_bits``
        The vector of one number.
    ``a < b``, ``any``, ``select_``, ``truth``, ``is_true``
        Masks, whether a lane is set, the choice by a mask, and masks as the numbers 0 and 1 and back.
    ``fused``, ``root``, ``down``, ``up``, ``smaller``, ``larger``, ``magnitude``, ``sign_``, ``with_sign_of``
        Arithmetic.
    ``sincos_``, ``tan_``, ``atan2_``, ``asin_``, ``acos_``, ``atan_``, ``exp_``, ``expm1_``, ``log_``, ...
        Elementary functions, within 4 ulp.
    """
    kind = "#define KINEVERSE_FLOAT\n" if scalar == "float" else ""
    return kind + read_source("simd_functions.h") + _GENERATED
