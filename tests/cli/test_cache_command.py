"""``kineverse cache``: what is kept, how large it may grow, and its removal."""

from __future__ import annotations

import json
import os
import re
import time
from hashlib import sha256
from pathlib import Path

import pytest

import kineverse as kv
import kineverse.geometry.decomposition.result as decompositions
import kineverse.geometry.shapes as shapes
import kineverse.planning.spheres.object_covers as covers
from kineverse.cli.cache import format_last_use
from kineverse.cli.output import format_bytes
from kineverse.compilation.cache import library_cache
from kineverse.compilation.cache_kinds import KINDS, clear_kind, measure_kind
from kineverse.exchange import meshes
from kineverse.exchange.meshes import FetchedFiles

ROOT = Path(__file__).parents[2]
CACHES = {
    "decompositions": decompositions.DECOMPOSITIONS,
    "mesh_hulls": shapes._MESH_HULLS,
    "sphere_covers": covers.COVERS,
    "sphere_trees": covers.TREES,
    "meshes": meshes._MESHES,
}


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache folder."""
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "kept"))
    return tmp_path / "kept"


def fill(folder: Path) -> dict[str, int]:
    """Put a file of each kind into the cache, and return the size of its content."""
    sizes = {name: 100 * (k + 1) for k, name in enumerate(CACHES)}
    for name, cache in CACHES.items():
        cache.write("a" * 40, bytes(sizes[name]))
    store = library_cache()
    library = Path(store.create_build_folder(), "made.so")
    library.write_bytes(b"code")
    store.store("b" * 40, str(library))
    (folder / "zig" / "o").mkdir(parents=True, mode=0o700)
    (folder / "zig" / "o" / "crt1.o").write_bytes(bytes(45))
    return sizes


def test_an_empty_cache_has_all_kinds_and_makes_no_folder(folder: Path, run) -> None:
    status, out, err = run("cache")
    assert (status, err) == (0, "")
    assert all(re.search(rf"^{name} .* 0 ", out, re.MULTILINE) for name in KINDS)
    assert out.splitlines()[-1] == f"0 files, 0 B in {folder}"
    assert not folder.exists()


def test_each_kind_counts_its_own_files(folder: Path, run) -> None:
    sizes = fill(folder)
    found = json.loads(run("cache", "--json")[1])
    assert found["folder"] == str(folder)
    assert {name: kind["files"] for name, kind in found["kinds"].items()} == dict.fromkeys(KINDS, 1)
    ends = {name: found["kinds"][name]["bytes"] - size for name, size in sizes.items()}
    assert len({*ends.values()}) == 1  # the digest
    assert found["kinds"]["zig"]["bytes"] == 45
    on_disk = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(kind["bytes"] for kind in found["kinds"].values()) == sum(p.stat().st_size for p in on_disk)
    assert "7 files" in run("cache")[1]


def test_one_kind_is_cleared_and_the_others_stay(folder: Path, run) -> None:
    fill(folder)
    status, out, _ = run("cache", "--clear", "sphere_trees", "zig")
    assert status == 0
    assert "sphere_trees: 1 file removed" in out
    assert "zig: 1 file removed, 45 B" in out
    assert out.splitlines()[-1].startswith(f"2 files removed from {folder}, ")
    assert not (folder / "zig").exists()
    assert CACHES["sphere_covers"].list_keys() == ["a" * 40]
    assert {name for name in KINDS if measure_kind(name).files} == {*KINDS} - {"sphere_trees", "zig"}


def test_all_kinds_are_cleared(folder: Path, run) -> None:
    fill(folder)
    assert {
        kind["files"] for kind in json.loads(run("cache", "--clear", "--json")[1])["removed"].values()
    } == {1}
    assert not any(path.is_file() for path in folder.rglob("*"))
    assert "0 files removed" in run("cache", "--clear")[1]


def test_what_does_not_belong_to_a_kind_stays(folder: Path, run) -> None:
    fill(folder)
    (folder / "note.txt").write_text("mine", "utf-8")
    run("cache", "--clear")
    assert (folder / "note.txt").read_text("utf-8") == "mine"


def test_links_and_other_names_of_files_are_removed_and_not_what_they_lead_to(
    folder: Path, tmp_path: Path, run
) -> None:
    fill(folder)
    theirs = [tmp_path / "theirs" / name for name in ("linked", "named")]
    theirs[0].parent.mkdir()
    for path in theirs:
        path.write_text("theirs", "utf-8")
    (folder / "c.so").symlink_to(theirs[0])
    (folder / "files" / "c.mesh").hardlink_to(theirs[1])
    (folder / "zig" / "o" / "c").symlink_to(theirs[0].parent)
    assert run("cache", "--clear")[0] == 0
    assert [path.read_text("utf-8") for path in theirs] == ["theirs"] * 2
    assert not any(path.is_symlink() or path.is_file() for path in folder.rglob("*"))


def test_kinds_of_an_option_that_stands_twice_are_both_cleared(folder: Path, run) -> None:
    fill(folder)
    run("cache", "--clear", "meshes", "--clear", "zig")
    assert {name for name in KINDS if not measure_kind(name).files} == {"meshes", "zig"}


@pytest.mark.parametrize("words", [(), ("--clear",)], ids=["shown", "cleared"])
def test_a_folder_that_cannot_be_used_is_named_and_no_other_is_cleared(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run, words: tuple[str, ...]
) -> None:
    fill(folder)
    folder.chmod(0o777)
    status, out, err = run("cache", *words)
    assert (status, out) == (2, "")
    assert f"the cache folder {folder} can be written by others" in err
    assert (folder / "zig" / "o" / "crt1.o").is_file()
    (tmp_path / "file").write_text("mine", "utf-8")
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "file"))
    status, out, err = run("cache", *words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert f"{tmp_path / 'file'} cannot be" in err


@pytest.mark.parametrize("target", ["spheres", "files"])
def test_a_link_in_place_of_a_folder_is_not_followed(folder: Path, tmp_path: Path, run, target: str) -> None:
    fill(folder)
    for path in (folder / target).iterdir():
        path.unlink()
    (folder / target).rmdir()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o777)
    os.chmod(elsewhere, 0o777)
    (elsewhere / "x.tree").write_text("theirs", "utf-8")
    (elsewhere / "x.mesh").write_text("theirs", "utf-8")
    (folder / target).symlink_to(elsewhere)
    status, _, err = run("cache", "--clear")
    assert status == 2
    assert "can be written by others" in err
    assert err.count("\n") == 1
    assert len([*elsewhere.iterdir()]) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--clear", "library"), "There is no kind 'library' of cached files."),
        (("libraries",), "takes no argument 'libraries'"),
        (("--claer",), "--clear"),
        (("--clear", ""), "There is no kind ''"),
        (("--clear", "../.."), "There is no kind '../..'"),
    ],
    ids=str,
)
def test_nonsense_is_answered_in_a_line_and_removes_nothing(folder: Path, run, words, said) -> None:
    fill(folder)
    status, out, err = run("cache", *words)
    assert (status, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1
    assert all(measure_kind(name).files == 1 for name in KINDS)


@pytest.mark.parametrize("name", CACHES)
def test_a_kind_that_reaches_its_limit_loses_what_was_not_used_for_the_longest_time(
    folder: Path, name: str
) -> None:
    cache, most = CACHES[name], KINDS[name].most_bytes
    assert cache.most_bytes == most
    for k, key in enumerate(("a", "b", "c")):
        cache.write(key, bytes(1000))
        os.utime(cache.path(key), (1e9 - k, 1e9 - k))
    cache.most_bytes = 2000
    try:
        cache.write("d", bytes(900))
        cache.write("e", bytes(3000))  # never fits
    finally:
        cache.most_bytes = most
    assert sorted(cache.list_keys()) == ["a", "d"]


def test_a_mesh_of_a_server_is_asked_for_once(folder: Path) -> None:
    content, asked = b"solid" * 99, []

    def fetch_part(digest: str, offset: int) -> bytes:
        asked.append(offset)
        return content[offset : offset + 300]

    files = FetchedFiles(fetch_part)
    digest = sha256(content).hexdigest()
    assert [files.fetch(digest, len(content)) for _ in range(3)] == [content] * 3
    assert asked == [0, 300]
    assert clear_kind("meshes").files == 1
    assert files.fetch(digest, len(content)) == content
    assert len(asked) == 4


@pytest.mark.compiler
def test_a_loaded_library_outlives_its_file(folder: Path) -> None:
    q = kv.Symbol("q")
    f = kv.compile(q * q + 3, tier="c")
    f.wait()
    assert clear_kind("libraries").files > 0
    assert measure_kind("libraries").files == 0
    assert f({"q": 2.0}) == 7.0


def test_sizes_and_ages_are_read_at_a_glance() -> None:
    now = time.time()
    assert [format_bytes(n) for n in (0, 1023, 1024, 45 * 2**20, 512 * 2**20, 2**30)] == [
        "0 B",
        "1023 B",
        "1 KiB",
        "45 MiB",
        "512 MiB",
        "1 GiB",
    ]
    assert [format_last_use(now - age) for age in (1, 130, 7300, 200_000)] == [
        "now",
        "2 minutes ago",
        "2 hours ago",
        "2 days ago",
    ]


def test_the_page_of_the_installation_has_all_kinds_and_limits() -> None:
    page = (ROOT / "docs" / "installation.md").read_text("utf-8")
    for name, kind in KINDS.items():
        limit = "none" if kind.most_bytes is None else format_bytes(kind.most_bytes)
        assert re.search(rf"\| .*`{name}`.* \|.*\| {limit}\b", page), name
