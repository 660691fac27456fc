"""Every error class survives a pickle, as it has to between processes."""

from __future__ import annotations

import importlib
import pickle
import re
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

import kineverse
import kineverse_studies
from kineverse.errors import KineverseError, MissingDependencyError
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.swept_volume import Obstacle
from kineverse.symbols import position


def _modules() -> Iterator[str]:
    """Names of the modules that have error classes."""
    for package in (kineverse, kineverse_studies):
        for folder in map(Path, package.__path__):
            for path in sorted(folder.rglob("*.py")):
                if re.search(r"^class \w+Error\(", path.read_text(encoding="utf-8"), re.MULTILINE):
                    yield ".".join((package.__name__, *path.relative_to(folder).with_suffix("").parts))


def _error_classes() -> list[type[Exception]]:
    for name in _modules():
        try:
            importlib.import_module(name)
        except (MissingDependencyError, ModuleNotFoundError):
            continue  # of an extra that is not installed
    found: dict[str, type[Exception]] = {}
    waiting: list[type[Exception]] = [Exception]
    while waiting:
        for kind in waiting.pop().__subclasses__():
            waiting.append(kind)
            if kind.__module__.partition(".")[0] in ("kineverse", "kineverse_studies"):
                found[f"{kind.__module__}.{kind.__qualname__}"] = kind
    return [found[name] for name in sorted(found)]


ERRORS = _error_classes()
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "SkillError": ("collision", "it hit the table"),
    "ArmEndError": ("reach", "the arm ends"),
    "BlockedError": (Obstacle(position("door"), 1.0, "door", "wall", 0.5, 0.1, 0.4),),
    "UnsupportedError": ("A loop cannot be written.", True, True),
    "EditError": ("two failures", {"tag": KineverseError("inner")}),
    "InfeasibleError": ("none", ("row", "other"), (1.0, 2.0)),
    "ElementError": ("the element", "it is wrong"),
    "NotFiniteError": ("not finite", ("task",)),
}


def make_error(kind: type[Exception]) -> Exception:
    return kind(*ARGUMENTS.get(kind.__name__, ("it went wrong",)))


@pytest.mark.parametrize("kind", ERRORS, ids=lambda kind: kind.__name__)
def test_error_survives_a_pickle(kind: type[Exception]) -> None:
    error = make_error(kind)
    after = pickle.loads(pickle.dumps(error))
    assert type(after) is kind
    assert str(after) == str(error)
    assert after.args == error.args
    assert {k: str(v) for k, v in vars(after).items()} == {k: str(v) for k, v in vars(error).items()}


def test_all_error_classes_are_found() -> None:
    names = {kind.__name__ for kind in ERRORS}
    assert names >= {"SkillError", "UnsupportedError", "DisagreementError", "EditError", *ARGUMENTS}
    assert len(names) >= 30


def test_error_in_a_pool_ends_its_job_alone() -> None:
    failing = "from kineverse.manipulation.outcome import SkillError; raise SkillError('time', 'too late')"
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        with pytest.raises(SkillError, match="too late") as caught:
            pool.submit(exec, failing).result()
        assert pool.submit(abs, -3).result() == 3
    assert caught.value.kind == "time"
