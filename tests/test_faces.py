"""Faces of packages: names that are imported at first use, and what the import of a face and a command costs."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import kineverse as kv

SRC = Path(kv.__file__).parents[1]


@cache
def list_modules() -> tuple[str, ...]:
    found = pkgutil.walk_packages(kv.__path__, "kineverse.")
    return ("kineverse", *(one.name for one in found if not one.name.endswith(("__main__", "._coacd_main"))))


@cache
def find_faces() -> dict[str, list[tuple[str, str]]]:
    """Return the names of each lazy face, each with the module that it is said to come from."""
    faces = {}
    for path in sorted((SRC / "kineverse").rglob("__init__.py")):
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                faces[".".join(path.parent.relative_to(SRC).parts)] = [
                    (alias.name, "." * item.level + (item.module or ""))
                    for item in node.body
                    if isinstance(item, ast.ImportFrom)
                    for alias in item.names
                    if alias.asname == alias.name
                ]
    return faces


def run(program: str, *arguments: str) -> Any:
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def test_type_checkers_see_the_names_of_the_faces() -> None:
    assert len(find_faces()) > 25
    for package, names in find_faces().items():
        face = importlib.import_module(package)
        assert sorted(name for name, _ in names) == [n for n in face.__all__ if n != "__version__"], package
        assert [n for n in dir(face) if n[:2] != "__"] == [n for n in face.__all__ if n[:2] != "__"]


def test_no_public_name_is_the_name_of_its_module() -> None:
    modules = set(list_modules())
    for package, names in find_faces().items():
        same = [n for n, home in names if f"{package}.{n}" in modules and home not in (package, ".")]
        assert not same, package


IN_ANY_ORDER = """
import importlib, json, random, sys
faces, modules, seed = json.loads(sys.argv[1]), json.loads(sys.argv[2]), int(sys.argv[3])
steps = [(module, None) for module in modules] + [(face, name) for face in faces for name in faces[face]]
random.Random(seed).shuffle(steps)
first = {}
for module, name in steps:
    imported = importlib.import_module(module)
    if name is not None:
        first[module, name] = getattr(imported, name)
changed = [f"{m}.{n}" for (m, n), value in first.items() if getattr(sys.modules[m], n) is not value]
print(json.dumps([len(first), changed]))
"""


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_a_public_name_is_one_object_in_any_order_of_imports(seed: int) -> None:
    faces = {package: [name for name, _ in names] for package, names in find_faces().items()}
    count, changed = run(IN_ANY_ORDER, json.dumps(faces), json.dumps(list_modules()), str(seed))
    assert count > 280
    assert not changed


def test_a_name_that_a_face_does_not_have_is_answered_with_similar_ones() -> None:
    with pytest.raises(kv.errors.UnknownAttributeError, match="'Controller'"):
        _ = kv.control.Controler
    with pytest.raises(kv.errors.UnknownAttributeError, match=r"kineverse\.planning has no '_hidden'"):
        _ = kv.planning._hidden
    assert not hasattr(kv, "__wrapped__")


def test_a_module_of_a_package_is_imported_at_first_use() -> None:
    assert run("import json, kineverse as kv; print(json.dumps(kv.control.tasks.__name__))") == (
        "kineverse.control.tasks"
    )


COUNT = """
import json, sys
{program}
names = [name for name in sys.modules if name.partition(".")[0] == "kineverse"]
print(json.dumps([len(names), *(int(name in sys.modules) for name in {others!r})]))
"""


def imported(program: str, *others: str) -> list[int]:
    """Return how many modules of ours a program imports, and if it imports each of some others."""
    counts: list[int] = run(COUNT.format(program=program, others=others))
    return counts


def test_a_face_imports_nothing_before_it_is_used() -> None:
    assert imported("import kineverse", "numpy", "casadi") == [3, 0, 0]
    count, *heavy = imported("\n".join(f"import {package}" for package in find_faces()), "numpy", "casadi")
    assert count <= len(find_faces()) + 4
    assert heavy == [0, 0]


IN_PROCESS = "import io, contextlib; from kineverse.cli import main; out = io.StringIO()\n"
QUIETLY = (
    IN_PROCESS + "with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out): main({words!r})"
)


def test_help_imports_nothing_heavy() -> None:
    unneeded = ("numpy", "casadi", "rich", "viser", "trimesh", "scipy", "PIL", "websockets")
    count, *heavy = imported(QUIETLY.format(words=["--help"]), *unneeded)
    assert count <= 10
    assert not any(heavy)


def test_a_model_that_is_only_read_imports_what_reads_it() -> None:
    program = "import kineverse as kv; kv.load('kitchen').fk('kitchen/fridge_door_handle')"
    unneeded = ("compilation.function", "model.integration", "model.projection", "loops.close_loop")
    count, *heavy = imported(program, "logging", "subprocess", *(f"kineverse.{name}" for name in unneeded))
    assert count <= 75
    assert not any(heavy)


def test_a_controller_without_a_scene_imports_no_geometry() -> None:
    program = (
        "import kineverse as kv; m = kv.load('pr2'); hand = m.fk('pr2/l_gripper_tool_frame')[:3, 3]\n"
        "kv.control.Controller(m, [kv.control.Goal(hand, [0.5, 0.2, 1.0])], dt=0.02).step(m.default_state())"
    )
    _, geometry, coal = imported(program, "kineverse.geometry.scene", "coal")
    assert not geometry
    assert not coal


@pytest.mark.compiler
def test_a_skill_imports_what_it_needs() -> None:
    for module in ("coal", "daqp"):
        pytest.importorskip(module)
    words = ["push", "kitchen", "--robot", "hsr", "--what", "kitchen/sink_left_upper_drawer"]
    unneeded = ("mujoco_world", "recorder")
    count, *others = imported(QUIETLY.format(words=words), *(f"kineverse.worlds.{name}" for name in unneeded))
    assert count <= 265
    assert others == [0, 0]
