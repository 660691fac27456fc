"""Commands that lack extras or a compiler: all of it is named, before they start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from kineverse.cli.arguments import MODULES, require
from kineverse.errors import CompileError, MissingDependencyError


@pytest.fixture
def core_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in MODULES.values():
        monkeypatch.setitem(sys.modules, module, None)


@pytest.mark.usefixtures("core_only", "no_compiler")
def test_require_names_all_that_is_missing_at_once() -> None:
    with pytest.raises(MissingDependencyError) as info:
        require("kineverse open", {"control": True, "view": False, "geometry": True}, compiler=True)
    said = str(info.value)
    assert said.startswith("kineverse open needs the extras 'control' and 'geometry' (daqp, coal): ")
    assert "[control,geometry]'" in said
    assert "a C compiler" in said
    assert "\n" not in said
    with pytest.raises(CompileError, match=r"apt install gcc.*411 MB.*\[compiler\]'$"):
        require("kineverse plan", {}, compiler=True)
    require("kineverse info", {"view": False})


OPEN = ["kitchen", "--robot", "hsr", "--what", "kitchen/fridge_door"]


@pytest.mark.usefixtures("core_only")
@pytest.mark.parametrize(
    ("words", "extras"),
    [
        (["open", *OPEN], "control,geometry"),
        (["push", *OPEN, "--world", "mujoco", "--record", "r.mcap"], "control,geometry,mjcf,recording"),
        (["close", *OPEN, "--view"], "control,geometry,view"),
        (["live"], "control,exchange,geometry,view"),
        (["live", "--headless", "--world", "mujoco"], "control,exchange,geometry,mjcf"),
        (["world", "home", "--record", "r.mcap"], "exchange,geometry,recording"),
        (["behave", "home"], "control,exchange,geometry"),
        (["plan", "kitchen", "--to", "a=1"], "geometry"),
        (["reach", "pr2", "hand", "--pose", "0", "0", "0", "--collisions"], "control,geometry"),
        (["view", "kitchen"], "view"),
        (["view", "kitchen", "--near", "5cm"], "geometry,view"),
        (["spheres", "kitchen"], "geometry"),
        (["decompose", "kitchen"], "decomposition"),
        (["fit", "poses.csv", "--child", "door", "--picture", "f.png"], "figures"),
        (["reproduce", "kitchens", "--figure", "k.png"], "control,figures,geometry"),
        (["reproduce", "lockbox"], "control"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_commands_name_all_missing_extras_before_they_start(run, words: list[str], extras: str) -> None:
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert f"[{extras}]'" in err
    assert err.count("\n") == 1


@pytest.mark.usefixtures("core_only")
def test_a_file_of_mujoco_needs_its_extra_and_a_urdf_of_the_same_suffix_does_not(run, tmp_path: Path) -> None:
    file = tmp_path / "shelf.xml"
    for text, extras in (("<mujoco/>", "geometry,mjcf"), ('<robot name="r"/>', "geometry")):
        file.write_text(text, "utf-8")
        _, _, err = run("plan", file, "--to", "a=1")
        assert f"[{extras}]'" in err


@pytest.mark.usefixtures("no_compiler")
@pytest.mark.parametrize(
    "words",
    [
        ["open", *OPEN],
        ["close", *OPEN],
        ["plan", "kitchen", "--to", "a=1"],
        ["live", "--headless"],
        ["behave", "home"],
        ["reproduce", "kitchens"],
        ["reproduce", "table1-open"],
        ["reproduce", "unknown-objects"],
    ],
    ids=" ".join,
)
def test_commands_that_plan_name_a_missing_compiler_before_they_start(run, words: list[str]) -> None:
    for module in ("coal", "daqp"):
        pytest.importorskip(module)
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert "needs a C compiler, and there is no C compiler (cc, gcc or clang) on the PATH" in err
    assert "apt install gcc" in err
    assert "[compiler]'" in err
    assert err.count("\n") == 1


def test_a_picture_needs_nothing_beyond_the_core(tmp_path: Path) -> None:
    # In another process: here modules have been imported that would not be without the extras.
    program = (
        f"import sys\nfor name in {[*MODULES.values(), 'trimesh', 'collada', 'PIL', 'scipy']!r}: sys.modules[name] = None\n"
        "from kineverse.cli import main\nfrom kineverse.view import pictures\npictures.SAMPLES = 1\n"
        "sys.exit(main(['view', 'articulations/ratchet', '--picture', 'k.png']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, timeout=120, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "k.png").read_bytes().startswith(b"\x89PNG")
