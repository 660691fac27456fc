"""Libraries on disk: shared by processes, checked before they are loaded, never in anyone else's hands."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from processes import states_of_group

import kineverse as kv
from kineverse.compilation import c_library, cache, call_extension, compiler_information
from kineverse.compilation.cache import LibraryCache, library_cache
from kineverse.compilation.toolchain import toolchain

a, b = kv.position("door/a"), kv.position("door/b")

PROGRAM = """
import sys
import kineverse as kv
a, b = kv.position("door/a"), kv.position("door/b")
f = kv.compile([a * b + {constant}, kv.array([a, b])], tier="c", wait=True)
assert f([2.0, 3.0])[0] == 6.0 + {constant}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "deeper" / "libraries"
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(folder))
    return folder


def outputs() -> list[kv.Expression]:
    return [a * b + 1.75, kv.array([a, b])]


def compiled() -> None:
    f = kv.compile(outputs(), tier="c", wait=True)
    assert f.tier == "c"
    assert f([2.0, 3.0])[0] == 7.75


def store_a_file() -> None:
    store = library_cache()
    path = Path(store.create_build_folder(), "library.so")
    path.write_text("some code")
    store.store("stored", str(path))
    path.parent.rmdir()


def libraries(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.so"))


@pytest.mark.compiler
def test_a_library_is_compiled_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled()
    found = libraries(folder)
    assert found
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not [p for p in folder.iterdir() if p not in found]
    monkeypatch.setattr(c_library, "request", None)
    assert kv.compile(outputs()).tier == "c"
    assert libraries(folder) == found


@pytest.mark.compiler
@pytest.mark.parametrize("damage", ["changed", "truncated", "empty", "text"])
def test_a_damaged_library_is_compiled_again(
    folder: Path, elsewhere: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(elsewhere, folder)
    for path in libraries(folder):
        content = path.read_bytes()
        middle = len(content) // 2
        path.write_bytes(
            {
                "changed": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
                "truncated": content[:middle],
                "empty": b"",
                "text": b"not a library" * 100,
            }[damage]
        )
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        compiled()
    assert "damaged" in caplog.text
    (path,) = [p for p in libraries(folder) if library_cache().find(p.stem)]
    assert path.stat().st_size > 1000


@pytest.mark.compiler
def test_a_library_that_cannot_be_loaded_is_compiled_again(folder: Path, elsewhere: Path) -> None:
    shutil.copytree(elsewhere, folder)
    path = next(p for p in libraries(folder) if p.stem == kv.compile(outputs(), tier="c")._library.key)
    content = b"whole, but no library"
    path.unlink()
    path.write_bytes(content + cache._MARK + hashlib.sha256(content).digest())
    f = kv.compile(outputs())
    assert f.wait(60)
    assert f([2.0, 3.0])[0] == 7.75


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that another process filled: what this one has loaded it would load again from memory."""
    folder = tmp_path_factory.mktemp("elsewhere") / "libraries"
    with run(1.75, KINEVERSE_CACHE_DIR=str(folder)) as process:
        assert process.communicate(timeout=120) == (None, "")
    assert process.returncode == 0
    return folder


def run(constant: float, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(constant=constant)],
        env={**os.environ, **environment},
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.compiler
def test_processes_share_a_folder(tmp_path: Path) -> None:
    processes = [run(constant, KINEVERSE_CACHE_DIR=str(tmp_path / "shared")) for constant in (3.0, 3.0, 4.0)]
    complaints = [process.communicate(timeout=120)[1] for process in processes]
    assert [(p.returncode, said) for p, said in zip(processes, complaints, strict=True)] == [(0, "")] * 3
    stored = list((tmp_path / "shared").iterdir())
    assert all(p.suffix == ".so" for p in stored)
    assert len(stored) in (2, 3)  # the extension is one, where Python's headers are installed
    assert all(LibraryCache(tmp_path / "shared").find(p.stem) for p in stored)


@pytest.mark.compiler
@pytest.mark.parametrize(
    "where",
    [
        "KINEVERSE_CACHE_DIR",
        pytest.param("XDG_CACHE_HOME", marks=pytest.mark.long),
        pytest.param("HOME", marks=pytest.mark.long),
    ],
)
def test_a_folder_that_cannot_be_made_is_replaced_by_a_private_one(tmp_path: Path, where: str) -> None:
    # Not by permissions: they do not bind root, who may run this.
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    (tmp_path / "tmp").mkdir()
    names = ("KINEVERSE_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
    environment = dict.fromkeys(names[: names.index(where)], "")
    process = run(5.0, **environment, **{where: str(blocked / "below")}, TMPDIR=str(tmp_path / "tmp"))
    _, complaints = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "cannot be made" in complaints
    assert list((tmp_path / "tmp").iterdir()) == []


def test_a_folder_that_others_can_write_to_is_refused(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    for mode in (0o777, 0o770, 0o702):
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(mode)
        cache._open.cache_clear()
        with caplog.at_level(logging.WARNING, "kineverse.compile"):
            assert library_cache().folder != folder
            assert library_cache().folder.stat().st_mode & 0o777 == 0o700
        assert "can be written by others" in caplog.text
        caplog.clear()
    store_a_file()
    assert list(folder.iterdir()) == []
    folder.chmod(0o755)
    cache._open.cache_clear()
    assert library_cache().folder == folder


def test_a_folder_of_another_user_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder.mkdir(parents=True)
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        assert library_cache().folder != folder
    assert "belongs to another user" in caplog.text


def test_least_recently_used_libraries_are_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = library_cache()
    monkeypatch.setattr(store._files, "most_bytes", 350)
    place = store.create_build_folder()
    for i, name in enumerate("abcde"):
        path = Path(place, name)
        path.write_bytes(bytes(100 - len(cache._MARK) - 32))
        os.utime(path, (1000 + i, 1000 + i))
        store.store(name, str(path))
        os.utime(folder / f"{name}.so", (1000 + i, 1000 + i))
        assert store.find("a")  # which is a use
    assert [p.stem for p in libraries(folder)] == ["a", "d", "e"]


def test_build_folders_of_killed_processes_are_removed(folder: Path) -> None:
    store = library_cache()
    old, new = Path(store.create_build_folder()), Path(store.create_build_folder())
    (old / "library.so").write_text("half")
    os.utime(old, (1000, 1000))
    store_a_file()
    assert not old.exists()
    assert new.exists()


@pytest.mark.parametrize(
    "end", ["", "os.kill(os.getpid(), signal.SIGTERM)", "os.kill(os.getpid(), signal.SIGKILL)"]
)
@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="there is no /proc")
def test_the_end_of_the_process_ends_the_compiler(tmp_path: Path, end: str) -> None:
    compiler, alive = tmp_path / "cc", tmp_path / "alive"
    # The number of its group is the fifth in what the system says of a process.
    write = f"cut -d' ' -f5 /proc/$$/stat > {alive}.$$; mv {alive}.$$ {alive}"
    compiler.write_text(f"#!/bin/sh\n({write}; while :; do sleep 0.1; done) & wait\n")
    compiler.chmod(0o755)
    program = f"""
import os, pathlib, signal, kineverse as kv
f = kv.compile(kv.position("a") * 3.5 + 1)
alive = pathlib.Path({str(alive)!r})
while not (alive.exists() and alive.read_text().strip()):
    assert not f.wait(0.01)
{end}
"""
    environment = {**os.environ, "CC": str(compiler), "KINEVERSE_CACHE_DIR": str(tmp_path / "folder")}
    subprocess.run([sys.executable, "-c", program], env=environment, timeout=60, check=not end)
    # A killed process cannot wait for its compiler: the shell around that sees the end of a pipe.
    deadline = time.monotonic() + 60.0
    group, folder = int(alive.read_text()), tmp_path / "folder"
    # Each compiler has a group of its own, and there may have been two.
    # After a kill, the folder of a second one that was about to start is left for the next sweep.
    while {*states_of_group(group)} - {"Z"} or len([*folder.iterdir()]) > ("SIGKILL" in end):
        assert time.monotonic() < deadline
        time.sleep(0.01)


LIMITED = """
import resource, sys
import kineverse as kv
resource.setrlimit(resource.RLIMIT_FSIZE, ({bytes}, resource.RLIM_INFINITY))
f = kv.compile(kv.position("a") * 3.25 + 1, wait=True)
assert f([2.0]) == 7.5
print(f.tier)
"""


@pytest.mark.compiler
def test_a_limit_on_files_leaves_the_interpreter_with_the_reason(tmp_path: Path) -> None:
    for size in (0, 1000):
        done = subprocess.run(
            [sys.executable, "-c", LIMITED.format(bytes=size)],
            env={**os.environ, "KINEVERSE_CACHE_DIR": str(tmp_path / "folder")},
            capture_output=True,
            encoding="utf-8",
            timeout=120,
            check=True,
        )
        assert done.stdout == "interpreter\n"
        assert "A function stays with CasADi's interpreter: there is no room to compile in: " in done.stderr
        assert "'ulimit -f'" in done.stderr
    assert list((tmp_path / "folder").iterdir()) == []


@pytest.mark.compiler
def test_a_cache_without_room_is_replaced_by_a_private_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = LibraryCache.store

    def store_unless_full(self: LibraryCache, key: str, library: str) -> str:
        if self.folder == folder:
            raise OSError(errno.ENOSPC, "No space left on device", library)
        return store(self, key, library)

    monkeypatch.setattr(LibraryCache, "store", store_unless_full)
    monkeypatch.setattr(cache, "_without_room", {})
    cache._open.cache_clear()
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        compiled()
        compiled()
    assert [r.getMessage() for r in caplog.records] == [
        "Compiled functions are not kept for other processes: the cache folder "
        f"{folder} has no room (No space left on device)."
    ]
    assert library_cache().folder != folder
    assert libraries(folder) == []
    cache._open.cache_clear()


def test_without_any_folder_functions_are_interpreted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "file" / "folder"))

    def no_folder() -> None:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    no_folder.cache_info = lambda: SimpleNamespace(currsize=0)  # type: ignore[attr-defined]
    no_folder.cache_clear = cache._private_folder.cache_clear  # type: ignore[attr-defined]
    monkeypatch.setattr(cache, "_private_folder", no_folder)
    cache._open.cache_clear()
    f = kv.compile(a * 2.75 + a * a, wait=True)
    assert f.tier == "interpreter"
    assert f([0.0]) == 0.0
    cache._open.cache_clear()


@pytest.mark.parametrize("home", ["", "relative", None])
def test_a_home_that_is_no_absolute_path_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, home: str | None
) -> None:
    pwd = pytest.importorskip("pwd")
    monkeypatch.setattr(pwd, "getpwuid", lambda user: SimpleNamespace(pw_dir=str(tmp_path / "account")))
    monkeypatch.delenv("KINEVERSE_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", "also/relative")
    monkeypatch.delenv("HOME") if home is None else monkeypatch.setenv("HOME", home)
    monkeypatch.chdir(tmp_path)
    assert library_cache().folder == tmp_path / "account" / ".cache" / "kineverse"
    assert [p.name for p in tmp_path.iterdir()] == ["account"]


@pytest.mark.compiler
def test_a_compiler_that_cannot_be_read_as_a_command_is_ignored(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", "'unclosed")
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        assert toolchain() is not None
    assert 'CC is "\'unclosed", which is no command (No closing quotation)' in caplog.text


@pytest.mark.compiler
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_forked_process_compiles_for_itself(tmp_path: Path) -> None:
    program = """
import os, kineverse as kv
a = kv.position("a")
functions = [kv.compile(a * (2.5 + i) + 1) for i in range(4)]
child = os.fork()
good = all(f.wait(60) and f([2.0]) == 2 * (2.5 + i) + 1 for i, f in enumerate(functions))
if child == 0:
    os._exit(0 if good else 1)
assert good
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
"""
    environment = {**os.environ, "KINEVERSE_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-W", "ignore", "-c", program], env=environment, timeout=120, check=True)


def test_compiler_information() -> None:
    found = compiler_information()
    assert found.cache_folder == str(library_cache().folder)
    assert found.vector_unit in ("avx512", "avx2", "avx", "sse2", "neon", "none")
    assert found.cores >= 1
    if found.compiler:
        assert os.path.isabs(found.compiler)
        assert "-ffast-math" not in found.flags
    assert call_extension.MOST_OUTPUTS > 1
