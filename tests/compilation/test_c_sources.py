"""Hand-written C is in files, which compile without warnings, and so does what is generated."""

from __future__ import annotations

import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.compilation.c_source import read_source
from kineverse.compilation.codegen import generate_batch_source
from kineverse.compilation.program import Program
from kineverse.compilation.toolchain import FLOATING_POINT_FLAGS
from kineverse.compilation.vector_program import VectorProgram
from kineverse.control import contact_constraints, qp
from kineverse.estimation.identification import native as identification
from kineverse.estimation.tracking import native as tracking
from kineverse.geometry import bindings as geometry
from kineverse.planning import bindings as planning

FOLDER = Path(str(resources.files("kineverse"))) / "_native"
FILES = {path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*") if path.is_file()}
WARNINGS = ("-Wall", "-Wextra", "-Wshadow", "-Werror")
LIBRARIES = {
    library.file: library.flags
    for library in (
        contact_constraints.row_library,
        qp._library,
        identification.library,
        tracking.native_library,
        geometry.collision_library,
        planning._library,
    )
} | {
    "call_extension.c": ("-DMOST_OUTPUTS=256", f"-I{sysconfig.get_path('include')}", f"-I{np.get_include()}")
}


def texts_of(source: str) -> Iterator[tuple[str, int, str]]:
    """The file, number and text of each line, by ``#line``."""
    name, number = "", 0
    for line in source.splitlines():
        found = re.fullmatch(r'#line (\d+) "(.+)"', line)
        if found:
            name, number = found[2], int(found[1])
        else:
            yield name, number, line
            number += 1


def test_each_file_is_part_of_a_library_or_of_a_generated_source() -> None:
    assert {name for name in FILES if name.endswith(".c")} == {*LIBRARIES, "batch.c", "xla_ffi.c"}
    sources = [read_source(name) for name in LIBRARIES] + [read_source("xla_ffi.c", {"program.h": "int n;"})]
    assert {name for source in sources for name, _, _ in texts_of(source)} == {*FILES, "program.h"}


@pytest.mark.parametrize("name", ["geometry.c", "planning.c", "xla_ffi.c"])
def test_compilers_are_told_the_file_and_line_of_each_line(name: str) -> None:
    generated = {"program.h": "int n;\nint m;"}
    found = list(texts_of(read_source(name, generated)))
    for file, number, line in found:
        text = generated[file] if file in generated else (FOLDER / file).read_text(encoding="utf-8")
        assert line == text.splitlines()[number - 1].replace("#pragma once", "")
    # No line is lost but those that include, and none comes twice.
    assert len(found) == len({(file, number) for file, number, _ in found})


@pytest.mark.compiler
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("how", ["-fsyntax-only", pytest.param("-O2", marks=pytest.mark.long)])
@pytest.mark.parametrize("name", LIBRARIES)
def test_hand_written_c_has_no_warnings(compiler: str, how: str, name: str) -> None:
    compile_strictly(compiler, read_source(name), how, *LIBRARIES[name])


@pytest.mark.compiler
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("kind", ["single", "batch", "xla", "float", "double"])
def test_generated_c_has_no_warnings(compiler: str, kind: str) -> None:
    x, y = kv.position("x"), kv.position("y")
    pose = kv.rotation_z(x) @ kv.translation(y, 0, x)
    outputs = [pose, np.tanh(x) + kv.where(x > y, x, 1.0)]
    flags = ["-O1"]
    if kind == "single":  # written by CasADi, whose functions have parameters that few need
        source = Program(outputs, [x, y]).source()
        flags.append("-Wno-unused-parameter")
    elif kind == "batch":
        source = generate_batch_source(Program(outputs, [x, y]))
    elif kind == "xla":
        ffi = pytest.importorskip("jax.ffi")
        source = generate_batch_source(Program(outputs, [x, y]), "xla_ffi.c")
        flags.append(f"-isystem{ffi.include_dir()}")
    else:
        source = VectorProgram(outputs, [x], [y], scalar="float" if kind == "float" else "double")._source()
    compile_strictly(compiler, source, *flags)


def compile_strictly(compiler: str, source: str, *flags: str) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    for_compiler = [flag for flag in flags if not flag.startswith(("-Wl", "-l"))]
    command = [compiler, *FLOATING_POINT_FLAGS, "-std=gnu11", "-fPIC", *WARNINGS, *for_compiler]
    command += ["-c", "-x", "c", "-", "-o", "/dev/null"]
    result = subprocess.run(command, input=source, capture_output=True, encoding="utf-8")
    assert result.returncode == 0, result.stderr
