"""Invariants of the readers, which hold for every input.

A reader returns a usable model that is unchanged by saving and loading, or raises one error of Kineverse with
a message of bounded length. It raises no other exception and no warning, takes at most some seconds and a
gigabyte, and opens only files in the folder of the input.
"""

from __future__ import annotations

import os
import re
import resource
import sys
import threading
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
from kineverse.formats.document import to_json

from .check_options import CheckOptions
from .edits import apply_random_edits

if TYPE_CHECKING:
    from .targets import Target

MAX_SECONDS = 5.0
MAX_KILOBYTES = 1 << 20
MAX_MESSAGE = 2000
ROUNDING = 1e-6
MAX_FRAMES = 40
"""Number of frames whose poses are evaluated."""

_FILE = re.compile(r"[\w.]+\.(urdf|sdf|xml|json|msgpack|config)[,:]")
"""Beginning of the error messages of readers."""

_HERE = str(Path(__file__).parent)
_LIBRARY = str(Path(kv.__file__).parent)
_OPENING = ("open", "os.listdir", "os.scandir", "os.mkdir", "os.remove", "os.rename")
_EXTERNAL_CALLS = (
    "socket.",
    "subprocess.",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "ctypes.dlopen",
)


class InvariantError(Exception):
    """A violated invariant that raised no exception by itself."""


@dataclass(frozen=True)
class Finding:
    """Violation of an invariant by an input.

    ``signature`` is the same for inputs that fail for the same reason; ``detail`` is a description.
    """

    signature: str
    detail: str


@dataclass
class OutcomeCounts:
    """Number of inputs that gave a model, and of those that gave an error."""

    models: int = 0
    errors: int = 0


def check(
    target: Target,
    data: bytes,
    folder: Path,
    counts: OutcomeCounts | None = None,
    options: CheckOptions | None = None,
) -> Finding | None:
    """Check an input with some options; return the violated invariant, None if all of them hold."""
    options = options or CheckOptions()
    counts = counts or OutcomeCounts()
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    finding = None
    with _watching(folder) as reached, warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            _use(target, _model(target, data, folder, options), options)
            counts.models += 1
        except kv.KineverseError as error:
            counts.errors += 1
            finding = _check_message(error)
        except InvariantError as broken:
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


def _model(target: Target, data: bytes, folder: Path, options: CheckOptions) -> kv.Model:
    """Return the model of an input."""
    try:
        operations = list(target.operations(data, folder, options.prefix))
    except kv.KineverseError as error:
        if not isinstance(error, kv.errors.FormatError):
            raise InvariantError(f"an error of another kind, at {_place(error)}: {error!r}") from error
        if str(error) and not _FILE.match(str(error)):
            raise InvariantError(f"an error without place, at {_place(error)}: {error}") from error
        raise
    if not options.loops:
        operations = [(tag, o) for tag, o in operations if not isinstance(o, kv.CloseLoop)]
    model = kv.Model()
    try:
        with model.edit() as edit:
            for tag, operation in operations:
                edit.apply(operation, tag)
    except kv.KineverseError as error:
        # A reader refuses everything that cannot be applied, except for loops that cannot be closed.
        if target.finite and not isinstance(operation, kv.CloseLoop):
            raise InvariantError(f"what was read cannot be applied, at {_place(error)}: {error!r}") from error
        raise
    return model


def _use(target: Target, model: kv.Model, options: CheckOptions) -> None:
    """Save, evaluate and edit a model."""
    text, loaded = _saved(model)
    names = [*model.frames, *model.constraints, *model.data, *(s.path for s in model.symbols)]
    if options.prefix and not all(name.startswith(f"{options.prefix}/") for name in names):
        raise InvariantError(f"a name without the prefix: {names[:50]}")
    _evaluate(target, model)
    if options.seed is None:
        return
    try:
        apply_random_edits(loaded, options.seed, lambda: _saved(loaded))
    except kv.KineverseError as error:
        raise InvariantError(f"an edit cannot be taken back, at {_place(error)}: {error}") from error
    if to_json(loaded) != text:
        raise InvariantError("an edit that was refused or taken back left something behind")


def _saved(model: kv.Model) -> tuple[str, kv.Model]:
    """Return the document of a model, and the model loaded from it, whose document is the same."""
    try:
        text = to_json(model)
        again = kv.formats.from_bytes(text.encode())
        if to_json(again) != text:
            raise InvariantError("saved and loaded, the model is another one")
    except kv.KineverseError as error:
        raise InvariantError(f"it cannot be saved and loaded, at {_place(error)}: {error}") from error
    return text, again


def _evaluate(target: Target, model: kv.Model) -> None:
    """Evaluate the positions, poses and violated constraints of a model."""
    state = model.default_state()
    if target.finite and not all(np.isfinite(value) for value in state.values()):
        raise InvariantError(f"a position is not finite: {state}")
    names = list(model.frames)[:MAX_FRAMES]
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
                raise InvariantError(f"a pose is not finite: that of {name[:80]!r} is\n{value}")
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROUNDING:
                raise InvariantError(f"a pose is not rigid: that of {name[:80]!r} is\n{value}")


def _check_message(error: kv.KineverseError) -> Finding | None:
    """Return a finding for a message that is too long, empty or no text."""
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
    """Return the innermost function of the library in the traceback of an error."""
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, RecursionError):
        frames = traceback.StackSummary.from_list(frames[:40])
    ours = [f for f in frames if f.filename.startswith(_LIBRARY)]
    if not ours:
        return f"{Path(frames[-1].filename).name}:{frames[-1].name}" if frames else "nowhere"
    return f"{ours[-1].filename[len(_LIBRARY) + 1 :]}:{ours[-1].name}"


# An audit hook cannot be removed, so there is one, which records for the current watch.
_watch: tuple[str, list[str], frozenset[threading.Thread]] | None = None
_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Record file accesses outside of the watched folder, and external calls."""
    if _watch is None:
        return
    folder, reached, others = _watch
    if threading.current_thread() in others:
        return
    if event.startswith(_EXTERNAL_CALLS):
        reached.append(f"{event} {arguments!r}"[:300])
    elif event in _OPENING and isinstance(arguments[0], (str, bytes)):
        path = os.path.abspath(os.fsdecode(arguments[0]))
        # Modules are imported when they are first needed, and tracebacks read their lines.
        if path in map(os.path.abspath, sys.path):
            return
        if not path.startswith((folder, sys.prefix, sys.base_prefix, _LIBRARY, _HERE)):
            reached.append(f"{event} {path}"[:300])


@contextmanager
def _watching(folder: Path) -> Iterator[list[str]]:
    """Record the files that are opened outside of a folder, and external calls.

    Threads that have begun before, such as one that waits for a compiler, do not count.
    """
    global _watch, _hooked
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked = True
    reached: list[str] = []
    others = frozenset(threading.enumerate()) - {threading.current_thread()}
    _watch = str(folder), reached, others
    try:
        yield reached
    finally:
        _watch = None
