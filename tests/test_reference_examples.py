"""The examples of docstrings: all of them run and print what they say, and each public name has one or leads to one."""

from __future__ import annotations

import contextlib
import doctest
import importlib
import inspect
import re
import tempfile
from functools import cache
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from markdown_examples import agree
from test_faces import SRC, find_faces, list_modules

MODULES = ("errors", "lie", "logic", "spatial", "state", "symbols", "intervals")
"""Public modules of names that no lazy face has."""

SLOW = (
    "compilation.backends.jax.to_jax",
    "estimation.identification.families.Family",
    "estimation.identification.kinematic_graph.identify_graph",
    "estimation.plausibility.check.check_plausibility",
    "estimation.recordings.recorded_joint.identify_recorded_joint",
    "formats.conversion_check.check_conversion",
    "formats.usd.kinematics.stage_poses",
    "geometry.decomposition.convex_decomposition.decompose",
    "grasping.grasp_sampling.sample_grasps",
    "grasping.gripper_detection.find_grippers",
    "live.model_estimator.ModelEstimator",
    "live.world_process.WorldProcess",
    "manipulation.belief.TrackedBelief",
    "manipulation.opening.base_placement.PlacementSearch",
    "manipulation.opening.grasped_opening.open_object",
    "manipulation.pushing.push_skill.push",
    "manipulation.unlocking.lock_exploration.explore_locks",
    "planning.planner.Planner",
    "planning.planner.Planner.hold",
    "planning.planner.Planner.valid",
    "view",
    "view.page.show",
    "view.page.view",
    "worlds.mujoco_world.MujocoWorld",
)
"""Examples that take more than half a second, or compile much C: names below ``kineverse``."""

EXAMPLE = re.compile(r"^\s*>>> ", re.MULTILINE)
SEE_ALSO = re.compile(r"^See Also\n-{8}\n(.+?)(?:\n\n|\Z)", re.MULTILINE | re.DOTALL)


@cache
def public_names() -> dict[str, Any]:
    """Return classes and functions of faces and public modules, each under its shortest public name."""
    names = [(f"{package}.{name}") for package, found in find_faces().items() for name, _ in found]
    for module in MODULES:
        names += [f"kineverse.{module}.{n}" for n in importlib.import_module(f"kineverse.{module}").__all__]
    found: dict[int, tuple[str, Any]] = {}
    for name in names:
        value = find(name)
        is_documented = inspect.isclass(value) or inspect.isfunction(value)
        if is_documented and (id(value) not in found or len(name) < len(found[id(value)][0])):
            found[id(value)] = name, value
    return dict(sorted(found.values()))


def find(name: str) -> Any:
    """Return the value of a dotted public name."""
    value: Any = kv
    for part in name.split(".")[1:]:
        value = inspect.getattr_static(value, part) if inspect.isclass(value) else getattr(value, part)
    return value


def doc(value: Any) -> str:
    """Return the text of a docstring of its own, not of a base class."""
    return inspect.cleandoc(getattr(value, "__doc__", None) or "")


def modules_with_examples() -> list[str]:
    """Return the modules whose text has examples, without importing them."""
    files = {name: SRC / name.replace(".", "/") for name in list_modules()}
    texts = {
        name: (file / "__init__.py" if file.is_dir() else file.with_suffix(".py")).read_text("utf-8")
        for name, file in files.items()
    }
    return [name for name, text in texts.items() if EXAMPLE.search(text)]


def examples_of(module: str) -> list[doctest.DocTest]:
    """Return the examples of all docstrings of a module; each has names of its own."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    found = finder.find(
        importlib.import_module(module), module, globs={"kv": kv, "np": np, "__name__": "example"}
    )
    return [one for one in found if one.examples]


class Checker(doctest.OutputChecker):
    """Comparison without regard to white space and last digits, as for the pages."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        return agree(want, got)


def run(one: doctest.DocTest) -> None:
    """Run an example as at a prompt: ``kv`` and ``np`` are imported, and the folder is empty."""
    runner = doctest.DebugRunner(Checker(), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        try:
            runner.run(one, clear_globs=True)
        except doctest.UnexpectedException as error:
            raise error.exc_info[1] from None
        except doctest.DocTestFailure as failure:
            says, does = failure.example.want or "nothing", failure.got or "nothing"
            pytest.fail(
                f"{one.name}: after\n{failure.example.source}it says\n{says}\nand there is\n{does}", False
            )


MISSING = (kv.errors.MissingDependencyError, kv.errors.CompileError, ModuleNotFoundError)
"""Errors of an example where an extra, another library or a C compiler is not installed."""


@pytest.mark.parametrize("module", modules_with_examples())
def test_examples_print_what_they_say(module: str) -> None:
    missing = []
    for one in examples_of(module):
        if one.name.removeprefix("kineverse.") in SLOW:
            continue
        try:
            run(one)
        except (kv.errors.MissingDependencyError, ModuleNotFoundError) as error:
            missing.append(str(error))
    if missing:
        pytest.skip("; ".join(missing))


@pytest.mark.long
@pytest.mark.parametrize("name", SLOW)
def test_slow_examples_print_what_they_say(name: str) -> None:
    name = f"kineverse.{name}"
    module = max((m for m in modules_with_examples() if f"{name}.".startswith(f"{m}.")), key=len)
    (one,) = (one for one in examples_of(module) if one.name == name)
    try:
        run(one)
    except MISSING as error:
        if isinstance(error, kv.errors.CompileError) and kv.compilation.compiler_information().compiler:
            raise
        pytest.skip(str(error))


def test_each_public_name_has_an_example_or_leads_to_one() -> None:
    names = public_names()
    assert len(names) > 400
    bare = [
        name
        for name, value in names.items()
        if not EXAMPLE.search(doc(value)) and not leads_to_example(value)
    ]
    assert not bare, "\n".join(bare)


def leads_to_example(value: Any) -> bool:
    """Return whether a docstring names, in ``See Also``, something that has an example."""
    section = SEE_ALSO.search(doc(value))
    return section is not None and any(EXAMPLE.search(doc(find(name))) for name in section[1].split("\n"))


def test_references_lead_somewhere() -> None:
    """Names in ``See Also`` are full public names, one a line."""
    for value in public_names().values():
        for name in section[1].split("\n") if (section := SEE_ALSO.search(doc(value))) else ():
            assert find(name) is not None, (value, name)
