"""What holds for every input of a reader, whatever it is.

It gives a model that can be used and survives being saved, or one error of our own with a message of bounded
length. There is no other exception and no warning, it takes no more than some seconds and a gigabyte, and no
file is opened but those beside the input.
"""

from __future__ import annotations

import os
import re
import resource
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import kineverse as kv
from kineverse.formats.document import read_operations, to_json

from .edits import edits
from .ways import Way

if TYPE_CHECKING:
    from .targets import Target

MAX_SECONDS = 5.0
MAX_KILOBYTES = 1 << 20
MAX_MESSAGE = 2000
ROUNDING = 1e-6
MOST_FRAMES = 40
"""So many poses are evaluated, which is enough to see how they fail."""

_FILE = re.compile(r"[\w.]+\.(urdf|sdf|xml|json|msgpack|config)[,:]")
"""What errors of readers begin with."""

_HERE = str(Path(__file__).parent)
_LIBRARY = str(Path(kv.__file__).parent)
_OPENING = ("open", "os.listdir", "os.scandir", "os.mkdir", "os.remove", "os.rename")
_REACHING = ("socket.", "subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.fork", "ctypes.dlopen")


class BrokenError(Exception):
    """The law does not hold, in a way that raised nothing."""


@dataclass(frozen=True)
class Finding:
    """An input for which the law does not hold.

    ``signature`` is the same for inputs that fail for the same reason, as far as one can tell; ``detail`` is
    for people.
    """

    signature: str
    detail: str


@dataclass
class Tally:
    """How many inputs gave a model, and how many an error."""

    models: int = 0
    errors: int = 0


def check(
    target: Target, data: bytes, folder: Path, tally: Tally | None = None, way: Way | None = None
) -> Finding | None:
    """Return what is wrong with how a target takes an input, looked at in one way; None if nothing is."""
    way = way or Way()
    tally = tally or Tally()
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    finding = None
    with _watching(folder) as reached, warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            _use(target, _model(target, data, folder, way), way)
            tally.models += 1
        except kv.KineverseError as error:
            tally.errors += 1
            finding = _of_message(error)
        except BrokenError as broken:
            finding = Finding(f"broken: {str(broken).partition(':')[0]}", str(broken))
        except Exception as error:
            detail = "".join(traceback.format_exception(error)[-12:])
            finding = Finding(f"{type(error).__name__} at {_place(error)}", detail[-6000:])
    seconds = time.process_time() - start
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if finding is None and reached:
        finding = Finding(f"reaches out: {reached[0].partition(' ')[0]}", "\n".join(reached[:20]))
    if finding is None and seconds > MAX_SECONDS:
        finding = Finding("slow", f"{seconds:.1f} s")
    if finding is None and grown > MAX_KILOBYTES:
        finding = Finding("large", f"{grown >> 10} MiB")
    return finding


def _model(target: Target, data: bytes, folder: Path, way: Way) -> kv.Model:
    """Return the model that an input describes."""
    try:
        operations = list(target.operations(data, folder, way.prefix))
    except kv.KineverseError as error:
        if not isinstance(error, kv.errors.FormatError):
            raise BrokenError(f"an error of another kind, at {_place(error)}: {error!r}") from error
        if str(error) and not _FILE.match(str(error)):
            raise BrokenError(f"an error without place, at {_place(error)}: {error}") from error
        raise
    if not way.loops:
        operations = [(tag, o) for tag, o in operations if not isinstance(o, kv.CloseLoop)]
    model = kv.Model()
    try:
        with model.edit() as edit:
            for tag, operation in operations:
                edit.apply(operation, tag)
    except kv.KineverseError as error:
        # The reader of a description has seen all of it; of a loop it cannot know whether it closes.
        if target.finite and not isinstance(operation, kv.CloseLoop):
            raise BrokenError(f"what was read cannot be applied, at {_place(error)}: {error!r}") from error
        raise
    return model


def _use(target: Target, model: kv.Model, way: Way) -> None:
    """Do with a model what anybody would do first."""
    text, loaded = _saved(model)
    names = [*model.frames, *model.constraints, *model.data, *(s.path for s in model.symbols)]
    if way.prefix and not all(name.startswith(f"{way.prefix}/") for name in names):
        raise BrokenError(f"a name without the prefix: {names[:50]}")
    _evaluate(target, model)
    if way.seed is None:
        return
    try:
        edits(loaded, way.seed, lambda: _saved(loaded))
    except kv.KineverseError as error:
        raise BrokenError(f"an edit cannot be taken back, at {_place(error)}: {error}") from error
    if to_json(loaded) != text:
        raise BrokenError("an edit that was refused or taken back left something behind")


def _saved(model: kv.Model) -> tuple[str, kv.Model]:
    """Return the document of a model, and what is loaded from it, whose document is the same."""
    try:
        text = to_json(model)
        again = kv.Model()
        with again.edit() as edit:
            for tag, operation in read_operations(text, "saved"):
                edit.apply(operation, tag)
        if to_json(again) != text:
            raise BrokenError("saved and loaded, the model is another one")
    except kv.KineverseError as error:
        raise BrokenError(f"it cannot be saved and loaded, at {_place(error)}: {error}") from error
    return text, again


def _evaluate(target: Target, model: kv.Model) -> None:
    """Ask for positions, poses, and what is violated."""
    state = model.default_state()
    if target.finite and not all(np.isfinite(value) for value in state.values()):
        raise BrokenError(f"a position is not finite: {state}")
    names = list(model.frames)[:MOST_FRAMES]
    if not names:
        return
    model.violations(state)
    model.jacobian(names[-1])(state)
    poses = kv.compile([model.fk(name) for name in names], tier="interpreter")
    values = poses({str(symbol): state[symbol] for symbol in poses.inputs})
    if target.finite:
        for name, value in zip(names, values, strict=True):
            rotation = value[:3, :3]
            if not np.isfinite(value).all():
                raise BrokenError(f"a pose is not finite: that of {name[:80]!r} is\n{value}")
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROUNDING:
                raise BrokenError(f"a pose is not rigid: that of {name[:80]!r} is\n{value}")


def _of_message(error: kv.KineverseError) -> Finding | None:
    message = str(error)
    where = f"{type(error).__name__} at {_place(error)}"
    if len(message) >= MAX_MESSAGE:
        return Finding(f"long message of {where}", f"{len(message)} characters: {message[:1000]} ...")
    if not message.strip():
        return Finding(f"no message of {where}", repr(error))
    try:
        message.encode()
    except UnicodeEncodeError:
        return Finding(f"message of {where} is no text", ascii(message))
    return None


def _place(error: BaseException) -> str:
    """Return the innermost function of the library that an error came through."""
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, RecursionError):
        frames = traceback.StackSummary.from_list(frames[:40])
    ours = [f for f in frames if f.filename.startswith(_LIBRARY)]
    if not ours:
        return f"{Path(frames[-1].filename).name}:{frames[-1].name}" if frames else "nowhere"
    return f"{ours[-1].filename[len(_LIBRARY) + 1 :]}:{ours[-1].name}"


# An audit hook cannot be taken away again, so there is one, which looks where this points.
_watch: tuple[str, list[str]] | None = None
_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _watch is None:
        return
    folder, reached = _watch
    if event.startswith(_REACHING):
        reached.append(f"{event} {arguments!r}"[:300])
    elif event in _OPENING and isinstance(arguments[0], (str, bytes)):
        path = os.path.abspath(os.fsdecode(arguments[0]))
        # Modules are imported when they are needed first, and a traceback shows lines of them.
        if path in map(os.path.abspath, sys.path):
            return
        if not path.startswith((folder, sys.prefix, sys.base_prefix, _LIBRARY, _HERE)):
            reached.append(f"{event} {path}"[:300])


@contextmanager
def _watching(folder: Path) -> Iterator[list[str]]:
    """Note what is opened meanwhile outside of a folder."""
    global _watch, _hooked
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked = True
    reached: list[str] = []
    _watch = str(folder), reached
    try:
        yield reached
    finally:
        _watch = None
