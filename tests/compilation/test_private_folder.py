"""The cache under attack: whatever others planted, re-pointed or swapped is not loaded."""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.compilation import cache
from kineverse.compilation.c_library import SourceLibrary
from kineverse.compilation.cache import LibraryCache, library_cache, private_subfolder
from kineverse.compilation.private_folder import NotPrivateError, PrivateFolder
from kineverse.compilation.toolchain import toolchain
from kineverse.geometry.decomposition import result

NOBODY = 65534
KEY = "key"

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="there are no users here")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "libraries"
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(folder))
    return folder


@pytest.fixture
def open_place() -> Generator[Path]:
    """A folder that other users can get to, as the tests' own one need not be."""
    place = Path(tempfile.mkdtemp(prefix="kineverse-attacked-"))
    place.chmod(0o755)
    yield place
    shutil.rmtree(place)


def whole(content: bytes) -> bytes:
    return content + cache._MARK + hashlib.sha256(content).digest()


def content_of(path: str) -> bytes:
    return Path(path).read_bytes().partition(cache._MARK)[0]


def as_root(test: Callable[..., None]) -> Callable[..., None]:
    reason = f"{test.__name__} plants files as another user, which only root can."
    return pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason=reason)(test)


def as_nobody(script: str, given: bytes) -> None:
    """Run a script of the shell as a user without rights, who need not be able to reach Python."""
    nobody = {"user": NOBODY, "group": NOBODY, "extra_groups": []}
    subprocess.run(["/bin/sh", "-ec", script], input=given, cwd="/", check=True, **nobody)  # type: ignore[call-overload]


def test_stored_libraries_are_private_and_loaded(folder: Path) -> None:
    before = os.umask(0o002)
    try:
        library = Path(library_cache().create_build_folder(), "library.so")
        library.write_bytes(b"good")
        library_cache().store(KEY, str(library))
    finally:
        os.umask(before)
    assert (folder / f"{KEY}.so").stat().st_mode & 0o777 == 0o600
    assert library_cache().load(KEY, content_of) == b"good"


def plant_group_writable(path: Path, elsewhere: Path) -> None:
    path.write_bytes(whole(b"evil"))
    path.chmod(0o660)


def plant_link(path: Path, elsewhere: Path) -> None:
    path.symlink_to(elsewhere)


def plant_dangling_link(path: Path, elsewhere: Path) -> None:
    path.symlink_to(elsewhere.with_name("nothing"))


def plant_hard_link(path: Path, elsewhere: Path) -> None:
    path.hardlink_to(elsewhere)


def plant_pipe(path: Path, elsewhere: Path) -> None:
    os.mkfifo(path)


PLANTED = {
    plant_group_writable: "can be written by others",
    plant_link: "is a link",
    plant_dangling_link: "is a link",
    plant_hard_link: "has other names",
    plant_pipe: "is no plain file",
}


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_planted_libraries_are_removed_and_not_loaded(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, plant: Callable[[Path, Path], None]
) -> None:
    elsewhere = tmp_path / "elsewhere.so"
    elsewhere.write_bytes(whole(b"evil"))
    elsewhere.chmod(0o600)
    found = library_cache()
    plant(folder / f"{KEY}.so", elsewhere)
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        assert found.load(KEY, content_of) is None
    assert f"{folder / KEY}.so {PLANTED[plant]} and will be compiled again." in caplog.text
    assert not os.path.lexists(folder / f"{KEY}.so")
    assert elsewhere.read_bytes() == whole(b"evil")
    assert found.find(KEY) is None


@as_root
def test_a_file_of_another_user_is_not_loaded(
    open_place: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder = open_place / "libraries"
    folder.mkdir()
    folder.chmod(0o777)
    as_nobody(f"cat > {folder}/key.so", whole(b"evil"))
    folder.chmod(0o700)
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(folder))
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        assert library_cache().folder == folder
        assert library_cache().load(KEY, content_of) is None
    assert "belongs to another user and will be compiled again" in caplog.text


@as_root
def test_a_folder_that_another_user_replaces_is_not_used(open_place: Path) -> None:
    """Even where the check of the way is left out: what was opened stays what is used."""
    folder = open_place / "libraries"
    folder.mkdir(mode=0o700)
    found = LibraryCache(folder)
    (folder / f"{KEY}.so").write_bytes(whole(b"good"))
    (folder / f"{KEY}.so").chmod(0o600)
    open_place.chmod(0o777)
    as_nobody(f"mv {folder} {folder}.away; mkdir {folder}; cat > {folder}/key.so", whole(b"evil"))
    assert content_of(str(folder / f"{KEY}.so")) == b"evil"
    assert found.load(KEY, content_of) == b"good"
    with pytest.raises(NotPrivateError, match=r"belongs to another user|can be written by others"):
        PrivateFolder(folder)


def test_a_file_that_is_replaced_after_the_check_is_not_loaded(folder: Path) -> None:
    found = library_cache()
    path = folder / f"{KEY}.so"
    path.write_bytes(whole(b"good"))
    path.chmod(0o600)

    def swap_and_load(name: str) -> bytes:
        other = folder / "other"
        other.write_bytes(whole(b"evil"))
        os.replace(other, path)
        return content_of(name)

    assert found.load(KEY, swap_and_load) == b"good"
    assert content_of(str(path)) == b"evil"


@as_root
def test_a_link_of_another_user_on_the_path_is_refused(open_place: Path, tmp_path: Path) -> None:
    link = open_place / "link"
    (tmp_path / "mine").mkdir(mode=0o700)
    link.symlink_to(tmp_path / "mine")
    assert PrivateFolder(link).is_still_private  # one's own link may be meant
    os.lchown(link, NOBODY, NOBODY)
    for path in (link, link / "below"):
        with pytest.raises(NotPrivateError, match=f"is reached through {link}, a link of another user"):
            PrivateFolder(path)


@as_root
def test_a_folder_of_another_user_on_the_path_is_refused(open_place: Path) -> None:
    (open_place / "theirs" / "mine").mkdir(parents=True)
    (open_place / "theirs" / "mine").chmod(0o700)
    os.chown(open_place / "theirs", NOBODY, NOBODY)
    with pytest.raises(NotPrivateError, match=r"is reached through .*/theirs, which belongs to another user"):
        PrivateFolder(open_place / "theirs" / "mine")


@pytest.mark.parametrize(("mode", "refused"), [(0o777, True), (0o1777, False), (0o755, False), (0o757, True)])
def test_a_parent_that_others_can_write_to_is_refused_unless_it_is_sticky(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, mode: int, refused: bool
) -> None:
    parent = folder / "parent"
    parent.mkdir(parents=True)
    parent.chmod(mode)
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(parent / "libraries"))
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        assert (library_cache().folder != parent / "libraries") == refused
    if refused:
        assert (
            f"is reached through {parent}, which can be written by others (its mode is {mode:o})"
            in caplog.text
        )


def test_a_folder_that_becomes_writable_by_others_is_not_used(folder: Path) -> None:
    assert library_cache().folder == folder
    folder.chmod(0o777)
    assert library_cache().folder != folder


def test_a_removed_folder_is_created_again(folder: Path) -> None:
    assert library_cache().folder == folder
    folder.rmdir()
    assert library_cache().folder == folder
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_advice_is_to_remove_a_folder_and_not_to_trust_it(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder.mkdir()
    folder.chmod(0o777)
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        library_cache()
    assert caplog.messages == [
        f"Compiled functions are not kept for other processes: the cache folder {folder} can be written by "
        "others (its mode is 777). Others may have left code in it: remove it with all it holds, or set "
        "KINEVERSE_CACHE_DIR to a folder of your own."
    ]


def test_a_private_copy_is_loaded_without_paths_of_descriptors(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "_DESCRIPTORS", "/nowhere/")
    found = library_cache()
    (folder / f"{KEY}.so").write_bytes(whole(b"good"))
    (folder / f"{KEY}.so").chmod(0o600)
    paths = []
    assert found.load(KEY, lambda path: paths.append(path) or content_of(path)) == b"good"  # type: ignore[func-returns-value]
    assert not os.path.exists(paths[0])
    assert Path(paths[0]).parent.stat().st_mode & 0o777 == 0o700


def test_every_library_is_loaded_by_a_unique_path(folder: Path) -> None:
    found = library_cache()
    (folder / f"{KEY}.so").write_bytes(whole(b"good"))
    (folder / f"{KEY}.so").chmod(0o600)
    assert len({found.load(KEY, lambda path: path) for _ in range(9)}) == 9


# -- libraries that are whole but not what was looked for ------------------------------------------------------


@pytest.fixture(scope="module")
def another_library(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A library of this machine that holds none of our functions."""
    found = toolchain()
    assert found is not None
    path = tmp_path_factory.mktemp("another") / "library.so"
    environment = found.environment(str(path.parent))
    subprocess.run(
        found.arguments((), str(path)), input=b"int nothing_of_use = 1;", check=True, env=environment
    )
    return path.read_bytes()


def replace(path: Path, content: bytes) -> None:
    """Put another file there: the old one is loaded and has to stay as it is."""
    path.unlink()
    path.write_bytes(content)
    path.chmod(0o600)


def other_machine(library: bytes) -> bytes:
    """The header of a library for another processor."""
    return library[:18] + (0xF7).to_bytes(2, "little") + library[20:]


@pytest.mark.compiler
@pytest.mark.parametrize("what", ["another library", "another machine"])
def test_a_library_without_the_function_is_compiled_again(
    folder: Path, another_library: bytes, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    planted = whole(another_library if what == "another library" else other_machine(another_library))
    a = kv.position("planted/a")

    def function() -> kv.CompiledFunction:
        return kv.compile([a * 1.625 + len(what), kv.array([a, a])], tier="c", wait=True)

    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        function().batch([[1.0]])
        libraries = sorted(folder.glob("*.so"))
        assert len(libraries) >= 2
        for path in libraries:
            replace(path, planted)
        f = function()
        assert f.tier == "c"
        assert f([2.0])[0] == 3.25 + len(what)
        assert f.batch([[2.0]])[0][0] == 3.25 + len(what)
    assert "cannot be used" in caplog.text
    anew = [path for path in libraries if path.read_bytes() != planted]
    assert len(anew) >= 2  # the function and its batch; the extension was loaded before


@pytest.mark.compiler
def test_hand_written_c_is_compiled_again_if_the_cache_has_another_library(
    folder: Path, another_library: bytes
) -> None:
    def declare(code: ctypes.CDLL) -> None:
        code.bound.restype = None

    def library() -> SourceLibrary:
        return SourceLibrary("qp.c", declare)

    assert library().prepare(wait=True)
    (path,) = folder.glob("*.so")
    replace(path, whole(another_library))
    again = library()
    assert again.prepare(wait=True)
    assert again.code.bound


# -- decompositions ------------------------------------------------------------------------------------------


def test_a_folder_of_decompositions_that_leads_elsewhere_is_not_used(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    elsewhere.chmod(0o777)
    library_cache()
    (folder / "decompositions").symlink_to(elsewhere)
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        assert result.folder() != folder / "decompositions"
        assert result.find_entry("0" * 40) is None
    assert "can be written by others" in caplog.text
    assert list(elsewhere.iterdir()) == []


def test_a_decomposition_that_is_a_link_counts_as_absent(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    inside, target = private_subfolder("decompositions"), tmp_path / "target"
    target.write_bytes(b"content")
    (inside.path / "abc-def.hulls").symlink_to(target)
    with caplog.at_level(logging.WARNING, "kineverse.geometry"):
        assert result.find_entry("abc", "def") is None
    assert "abc-def.hulls is a link and counts as absent." in caplog.text
    assert target.read_bytes() == b"content"
