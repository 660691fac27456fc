"""Recorder of runs, as MCAP files with JSON messages.

Topics and their messages, times in [s] of the robot:

- ``/model``: the model as a native document, once
- ``/state``, the truth of a simulated world: ``stamp``, ``values`` by name
- ``/belief``: the same, and ``poses`` (4×4) by frame
- ``/command``: ``stamp``, ``speeds`` by name
- ``/contacts``: ``stamp``, ``contacts`` with ``a``, ``b``, ``point``, ``normal``, ``distance``, ``force``
- ``/observation``: ``stamp``, ``joints`` by name, ``poses`` (4×4) by frame, ``touching``
- ``/phase``: ``stamp``, ``phase``, when it changes
- ``/controller``: ``stamp``, ``vectors`` by name, with ``origin`` and ``vector``
- ``/outcome``: result of the skill
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse._extras import install_command
from kineverse.errors import FormatError, InvalidValueError, KineverseError, MissingDependencyError
from kineverse.formats.document.writer import to_json
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike

from .robot_interface import Observation, SkillStep
from .simulated_world import Contact, SimulatedWorld

PROFILE = "kineverse"  # profile in the header of a recording


def _list_of(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _map_to(values: Any) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": values}


_NUMBER: dict[str, Any] = {"type": "number"}
_TEXT: dict[str, Any] = {"type": "string"}
_VECTOR = _list_of(_NUMBER)
_NUMBERS, _POSES = _map_to(_NUMBER), _map_to(_list_of(_VECTOR))
_CONTACT: dict[str, Any] = {
    "a": _TEXT, "b": _TEXT, "point": _VECTOR, "normal": _VECTOR, "distance": _NUMBER,
    "force": {"type": ["number", "null"]},
}  # fmt: skip
_ARROW = {"type": "object", "properties": {"origin": _VECTOR, "vector": _VECTOR}}

TOPICS: dict[str, tuple[str, dict[str, Any]]] = {
    "/model": ("Model", {}),
    "/state": ("State", {"stamp": _NUMBER, "values": _NUMBERS}),
    "/belief": ("Belief", {"stamp": _NUMBER, "values": _NUMBERS, "poses": _POSES}),
    "/command": ("Command", {"stamp": _NUMBER, "speeds": _NUMBERS}),
    "/contacts": (
        "Contacts", {"stamp": _NUMBER, "contacts": _list_of({"type": "object", "properties": _CONTACT})}
    ),
    "/observation": (
        "Observation",
        {"stamp": _NUMBER, "joints": _NUMBERS, "poses": _POSES, "touching": _list_of(_TEXT)}
    ),
    "/phase": ("Phase", {"stamp": _NUMBER, "phase": _TEXT}),
    "/controller": ("Controller", {"stamp": _NUMBER, "vectors": _map_to(_ARROW)}),
    "/outcome": ("Outcome", {"done": {"type": "boolean"}, "reason": _TEXT}),
}  # fmt: skip
"""Topics, with the name of the schema and the properties of its messages."""

_FLUSH = 0.5  # longest time of the world that is lost if the process is killed [s]


class Recorder:
    """MCAP file to which a run is written, and which has everything to play it again.

    What was written up to half a second before the end can be read even if the process is killed. Use it as a
    context, or call :meth:`close`. It is a callable for the steps of a session::

        with Recorder("run.mcap", world.model, world=world) as recorder:
            session = Session(world, on_step=recorder)

    Parameters
    ----------
    path
        Path that ends in ``.mcap``; an existing file is replaced.
    model
        Model of the robot and of everything around it.
    about
        Texts to keep, such as the robot, the world and the sensors.
    world
        Simulated world whose true states and contacts are written with each step of a session; None for a
        robot of which nobody knows the truth, and for callers that write everything themselves.

    Raises
    ------
    MissingDependencyError
        If the extra ``recording`` is not installed.
    FormatError
        If the file cannot be written, or the model is of a kind that a document cannot carry. Methods
        raise it too, such as on a full disk; what was written before can be read.

    Examples
    --------
    >>> model = kv.load("shelf_door")
    >>> with kv.worlds.Recorder("run.mcap", model) as recorder:
    ...     for k in range(3):
    ...         recorder.write_state(0.1 * k, {"shelf_door/door": 0.2 * k})
    >>> run = kv.worlds.read_run_recording("run.mcap")
    >>> run.model, len(run.states.times)
    (<Snapshot: 4 frames, 1 DoF, 2 constraints (version 1)>, 3)
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        model: ModelView,
        about: Mapping[str, str] | None = None,
        *,
        world: SimulatedWorld | None = None,
    ) -> None:
        self.path, self._world = Path(path), world
        check_recording_name(path)
        document = to_json(model).encode()
        writer = import_mcap("mcap.writer")
        try:
            self._file = self.path.open("wb")
        except (OSError, ValueError) as error:
            raise FormatError(f"{path} cannot be written: {getattr(error, 'strerror', error)}.") from None
        self._time, self._flushed, self._count = 0.0, -math.inf, 0
        self._writer: Any = writer.Writer(self._file, chunk_size=1 << 18)
        with self._closing_on_failure():
            self._writer.start(profile=PROFILE)
            self._writer.add_metadata("run", {str(key): str(value) for key, value in (about or {}).items()})
        self._channels = {topic: self._register(topic) for topic in TOPICS}
        self._phase: str | None = None
        self._send("/model", 0.0, document)

    def _register(self, topic: str) -> int:
        name, properties = TOPICS[topic]
        schema = {"title": f"kineverse.{name}", "type": "object", "properties": properties}
        encoded = json.dumps(schema).encode()
        number = self._writer.register_schema(f"kineverse.{name}", "jsonschema", encoded)
        return int(self._writer.register_channel(topic, "json", number))

    def write_state(self, stamp: float, values: StateLike) -> None:
        """Write the true state at a time [s]."""
        self._write("/state", stamp, {"values": _named(values)})

    def write_belief(
        self, stamp: float, values: StateLike, poses: Mapping[str, npt.ArrayLike] | None = None
    ) -> None:
        """Write the believed state at a time [s], and world poses (4, 4) of frames.

        Poses are those that the values alone do not give in the world's model, such as a relearned door's.
        """
        self._write("/belief", stamp, {"values": _named(values), "poses": _listed(poses or {})})

    def write_command(self, stamp: float, speeds: StateLike) -> None:
        """Write commanded speeds [m/s], [rad/s] at a time [s]."""
        self._write("/command", stamp, {"speeds": _named(speeds)})

    def write_contacts(self, stamp: float, contacts: Iterable[Contact]) -> None:
        """Write the contacts at a time [s]."""
        result = [{name: _plain(getattr(one, name)) for name in _CONTACT} for one in contacts]
        self._write("/contacts", stamp, {"contacts": result})

    def write_observation(self, stamp: float, observation: Observation) -> None:
        """Write readings that arrived at a time [s]; they keep their own stamp."""
        message = {
            "stamp": float(observation.stamp),
            "joints": _named(observation.joints),
            "poses": _listed(observation.poses),
            "touching": sorted(observation.touching),
        }
        self._write("/observation", stamp, message)

    def write_phase(self, stamp: float, phase: str) -> None:
        """Write the name of the phase that begins at a time [s]."""
        self._phase = str(phase)
        self._write("/phase", stamp, {"phase": self._phase})

    def write_vectors(self, stamp: float, vectors: Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]]) -> None:
        """Write vectors of a controller at a time [s], to be drawn as arrows.

        Parameters
        ----------
        stamp
            Time [s].
        vectors
            By name, the origin (3,) in the world [m], and the vector (3,).
        """
        result = {
            str(name): {"origin": _plain(origin), "vector": _plain(vector)}
            for name, (origin, vector) in vectors.items()
        }
        self._write("/controller", stamp, {"vectors": result})

    def write_outcome(self, outcome: Any) -> None:
        """Write the result of the skill: a dataclass, or a mapping."""
        known = dataclasses.is_dataclass(outcome) and not isinstance(outcome, type)
        content = _plain(dataclasses.asdict(outcome) if known else dict(outcome))
        self._send("/outcome", self._time, json.dumps(content, allow_nan=False).encode())

    def __call__(self, step: SkillStep) -> None:
        """Write everything of a step of a session at its time."""
        now, world = step.time, self._world
        truth = None if world is None else world.state
        if step.phase != self._phase:
            self.write_phase(now, step.phase)
        if truth is not None:
            self.write_state(now, truth)
        if truth is None or (step.state is not truth and dict(step.state) != dict(truth)):
            self.write_belief(now, step.state)
        self.write_command(now, step.commands)
        if world is not None:
            self.write_contacts(now, world.contacts())
        self.write_observation(now, step.observation)
        if step.vectors:
            self.write_vectors(now, step.vectors)

    def close(self) -> None:
        """Finish the file; further calls do nothing."""
        if not self._file.closed:
            with self._closing_on_failure():
                self._writer.finish()
                self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, topic: str, stamp: float, content: dict[str, Any]) -> None:
        if (time := finite_number(stamp)) is None or time < 0.0:
            raise InvalidValueError(f"The stamp of a message on {topic} is a time from 0 s, not {stamp!r}.")
        try:
            encoded = json.dumps({"stamp": time} | content, allow_nan=False).encode()
        except ValueError:
            raise InvalidValueError(
                f"A message on {topic} has a NaN or an infinity: {content!r:.200}"
            ) from None
        self._send(topic, time, encoded)

    def _send(self, topic: str, time: float, data: bytes) -> None:
        if self._file.closed:
            raise KineverseError(f"The recording {self.path} is closed.")
        self._time = max(self._time, time)
        self._count += 1
        nanoseconds = round(time * 1e9)
        with self._closing_on_failure():
            self._writer.add_message(self._channels[topic], nanoseconds, data, nanoseconds, self._count)
            if abs(time - self._flushed) >= _FLUSH:
                self._writer.flush()
                self._flushed = time

    @contextlib.contextmanager
    def _closing_on_failure(self) -> Iterator[None]:
        """Close a file that cannot be written, and say up to where it can be read."""
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):  # it cannot write its buffer either
                self._file.close()
            raise FormatError(
                f"{self.path} cannot be written: {error.strerror}. The recording ends at "
                f"{max(self._flushed, 0.0):.4g} s of the run."
            ) from None


def check_recording_name(path: str | os.PathLike[str]) -> None:
    """Check that the name of a file ends in .mcap."""
    if Path(path).suffix.lower() != ".mcap":
        raise FormatError(f"Recordings are written as .mcap: '{Path(path).with_suffix('.mcap')}'.")


def import_mcap(module: str) -> Any:
    """Return a module of the package mcap."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        command = install_command("recording")
        raise MissingDependencyError(f"Recordings need the package mcap: {command}") from None


def _named(values: StateLike) -> dict[str, float]:
    return {str(symbol): float(value) for symbol, value in values.items()}


def _listed(poses: Mapping[str, npt.ArrayLike]) -> dict[str, Any]:
    return {str(frame): np.asarray(pose, dtype=float).tolist() for frame, pose in poses.items()}


def _plain(value: Any) -> Any:
    """Return a value as JSON data; numbers that are not finite become null, and other things texts."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
