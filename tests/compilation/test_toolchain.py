"""Which compiler is found, what identifies it, and zig as the compiler."""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.compilation import build_queue, toolchain
from kineverse.compilation.cache import library_cache
from kineverse.compilation.toolchain import Toolchain

VARIABLE = "KINEVERSE_TEST_ZIG"
posix = pytest.mark.skipif(os.name != "posix", reason="the stand-ins for compilers are shell scripts")


def find_anew(monkeypatch: pytest.MonkeyPatch, folder: Path, command: str = "") -> Toolchain | None:
    """Return the compiler that is found with a folder as PATH, as in a new process."""
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("CC", command)
    toolchain._find.cache_clear()
    return toolchain.toolchain()


def write_program(path: Path, script: str = "exit 3") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{script}\n", "utf-8")
    path.chmod(0o755)
    return path


@pytest.fixture
def zig(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Program of a package ziglang that must not be imported; there is no other compiler."""
    monkeypatch.delitem(sys.modules, "ziglang", raising=False)
    others = [path for path in sys.path if not Path(path, "ziglang").exists()]
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site"), *others])
    program = write_program(tmp_path / "site" / "ziglang" / "zig")
    (program.parent / "__init__.py").write_text("raise AssertionError", "utf-8")
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    for name in toolchain._ZIG_FOLDERS:
        monkeypatch.delenv(name, raising=False)
    return program


@posix
def test_zig_of_the_package_is_used_where_there_is_no_other_compiler(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, zig: Path
) -> None:
    found = find_anew(monkeypatch, tmp_path / "nothing")
    assert found is not None
    assert found.is_zig
    assert found.command == (str(zig), "cc", "-g0", "-s", "-fno-sanitize=undefined")
    clang = write_program(tmp_path / "programs" / "clang")
    other = find_anew(monkeypatch, clang.parent)
    assert other is not None
    assert (other.command, other.is_zig) == ((str(clang),), False)
    assert "ziglang" not in sys.modules


@posix
def test_a_folder_with_the_name_of_the_package_is_no_compiler(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, zig: Path
) -> None:
    zig.unlink()
    (zig.parent / "__init__.py").unlink()
    assert find_anew(monkeypatch, tmp_path / "nothing") is None


@posix
@pytest.mark.parametrize("command", ["zig cc", "python -m ziglang cc"])
def test_zig_that_is_named_is_known_as_zig(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str
) -> None:
    write_program(tmp_path / "programs" / "zig")
    write_program(tmp_path / "programs" / "python")
    found = find_anew(monkeypatch, tmp_path / "programs", command)
    assert found is not None
    assert found.is_zig
    assert found.command[-1] == "-fno-sanitize=undefined"


@posix
def test_identity_changes_with_each_program_of_the_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, zig: Path
) -> None:
    programs = tmp_path / "programs"
    ccache, gcc = write_program(programs / "ccache"), write_program(programs / "gcc")
    for folder, command, parts in (
        (tmp_path / "nothing", "", [zig]),
        (programs, "ccache gcc", [ccache, gcc]),
        (programs, f"ccache {gcc}", [ccache, gcc]),
    ):
        identities = []
        for changed in (None, *parts):
            if changed is not None:
                with changed.open("a") as file:
                    file.write("# of another version\n")
            again = [find_anew(monkeypatch, folder, command) for _ in range(2)]
            assert again[0] == again[1]
            identities.append(again[0] and again[0].identity)
        assert len({*identities}) == 1 + len(parts)


RECORD = 'echo "$ZIG_GLOBAL_CACHE_DIR"; echo "$ZIG_LOCAL_CACHE_DIR"; echo "$TMPDIR"; echo "$*"'


def compile_and_record(record: Path, factor: float) -> list[str]:
    with pytest.raises(kv.errors.CompileError):
        kv.compile(kv.position("a") * factor, tier="c", wait=True)
    return record.read_text("utf-8").splitlines()


@posix
def test_zig_keeps_its_files_in_the_cache_folder(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path, zig: Path
) -> None:
    record = tmp_path / "record"
    write_program(zig, f'({RECORD}) > "{record}"; exit 3')
    monkeypatch.setattr(build_queue, "_worker", build_queue._Worker())
    assert find_anew(monkeypatch, tmp_path / "nothing") is not None
    with caplog.at_level(logging.INFO, "kineverse.compile"):
        kept, temporary, same, flags = compile_and_record(record, 2.5)
        compile_and_record(record, 3.5)
    assert Path(kept) == library_cache().folder / "zig" == tmp_path / "cache" / "zig"
    assert Path(kept).stat().st_mode & 0o077 == 0
    assert temporary == same
    assert Path(temporary).parent == tmp_path / "cache"
    assert not Path(temporary).exists()
    assert flags.startswith("cc -g0 -s -fno-sanitize=undefined ")
    assert [r.levelname for r in caplog.records if "zig builds its runtime" in r.getMessage()] == ["INFO"]
    assert not {*toolchain._ZIG_FOLDERS} & {*os.environ}


@posix
def test_zig_keeps_its_files_where_the_user_wants_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, zig: Path
) -> None:
    record = tmp_path / "record"
    write_program(zig, f'({RECORD}) > "{record}"; exit 3')
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(tmp_path / "own"))
    assert find_anew(monkeypatch, tmp_path / "nothing") is not None
    assert compile_and_record(record, 4.5)[0] == str(tmp_path / "own")


@posix
def test_other_compilers_get_no_folder_of_zig(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, zig: Path
) -> None:
    record = tmp_path / "record"
    write_program(tmp_path / "programs" / "cc", f'({RECORD}) > "{record}"; exit 3')
    assert find_anew(monkeypatch, tmp_path / "programs") is not None
    assert compile_and_record(record, 5.5)[:2] == ["", ""]
    assert not (tmp_path / "cache" / "zig").exists()


def test_zig_computes_the_same_bits(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = os.environ.get(VARIABLE)
    if folder:
        monkeypatch.syspath_prepend(folder)
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip(f"there is no zig; install ziglang, or {VARIABLE} names a folder that holds it")
    x, y = (kv.position(name) for name in "xy")
    near, far = np.sin(x) * np.exp(y / 4), np.arctan2(x, y) + np.cosh(x) / (1.0 + x * x)
    outputs = [near, far, np.log1p(x * x) - np.hypot(x, y), x / (y + 7.0) * x - y]
    points = np.random.default_rng(0).normal(size=(300, 2)) * [[3.0, 2.0]]
    interpreted = kv.compile(outputs, [x, y], tier="interpreter")
    found = find_anew(monkeypatch, tmp_path / "nothing")
    assert found is not None
    assert found.is_zig
    compiled = kv.compile(outputs, [x, y], tier="c", wait=True)
    assert compiled.tier == "c"
    single = np.array([compiled(point) for point in points])
    assert single.tobytes() == np.array([interpreted(point) for point in points]).tobytes()
    # Elementary functions of a batch are polynomials; arithmetic has the same bits as in single calls.
    assert compiled.batch(points)[-1].tobytes() == np.ascontiguousarray(single[:, -1]).tobytes()
    assert found.version().startswith("clang")
    assert found.vector_unit() != "none"
