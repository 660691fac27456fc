"""Every error class survives a pickle: one that cannot be unpickled breaks a pool of processes."""

from __future__ import annotations

import importlib
import pickle
import re
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
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


def error_classes() -> list[type[Exception]]:
    for package in (kineverse, kineverse_studies):
        folder = Path(package.__path__[0])
        for path in folder.rglob("*.py"):
            if re.search(r"^class (\w+Error\(|\w+\(.*Error\b)", path.read_text("utf-8"), re.MULTILINE):
                with suppress(MissingDependencyError, ModuleNotFoundError):  # extras that are not installed
                    parts = package.__name__, *path.relative_to(folder).with_suffix("").parts
                    importlib.import_module(".".join(parts).removesuffix(".__init__"))
    kinds: list[type[Exception]] = [Exception]
    for kind in kinds:
        kinds += [one for one in kind.__subclasses__() if one not in kinds]
    ours = [kind for kind in kinds if kind.__module__.partition(".")[0] in ("kineverse", "kineverse_studies")]
    return sorted(ours, key=lambda kind: f"{kind.__module__}.{kind.__qualname__}")


ERRORS = error_classes()
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "SkillError": ("collision", "it hit the table"),
    "ArmEndError": ("reach", "the arm ends"),
    "SlipError": ("other", "the handle slipped"),
    "BlockedError": (Obstacle(position("door"), 1.0, "door", "wall", 0.5, 0.1, 0.4),),
    "UnsupportedError": ("A loop cannot be written.", True, True),
    "ConflictError": ("it met another", ("joint door",), ("frames/door",), 7, "robot"),
    "EditError": ("two failures", {"tag": KineverseError("inner")}),
    "InfeasibleError": ("none", ("row", "other"), (1.0, 2.0)),
    "ElementError": ("the element", "it is wrong"),
    "NotFiniteError": ("not finite", ("task",)),
    "RefusedError": ("conflict", "it met another", "joint door"),
}


@pytest.mark.parametrize("kind", ERRORS, ids=lambda kind: kind.__name__)
def test_error_survives_a_pickle(kind: type[Exception]) -> None:
    error = kind(*ARGUMENTS.get(kind.__name__, ("it went wrong",)))
    if issubclass(kind, KineverseError):
        error.__dict__["added"] = "later"
    after = pickle.loads(pickle.dumps(error))
    assert type(after) is kind
    assert str(after) == str(error)
    assert after.args == error.args
    assert {k: str(v) for k, v in vars(after).items()} == {k: str(v) for k, v in vars(error).items()}


def test_errors_of_live_models_are_those_that_local_code_expects() -> None:
    conflict = kineverse.ConflictError("it met another", ["joint door"], ["frames/door"], 7, "robot")
    assert (conflict.tags, conflict.paths) == (("joint door",), ("frames/door",))
    assert (conflict.revision, conflict.who, conflict.failures) == (7, "robot", {})
    assert isinstance(conflict, kineverse.errors.EditError)
    assert issubclass(kineverse.OfflineError, ConnectionError)
    assert str(kineverse.OfflineError("nobody answers")) == "nobody answers"


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
