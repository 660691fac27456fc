"""Models that ship, their poses, and what readers say of files."""

from __future__ import annotations

import logging
import os
import tempfile
import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from inventory.bounded import each

STATES = 100
WRITTEN = (".urdf", ".xml", ".kv.json", ".kv.msgpack")
SUFFIXES = (".urdf", ".sdf", ".world", ".xml", ".xacro", ".mjcf", ".json")


# -- sections ------------------------------------------------------------------------------------------------


def shipped(data: Path | None) -> dict[str, Any]:
    """Return the names of all models that come with the package, with the prefix that each gets."""
    import kineverse as kv

    return {name: _prefix(kv.load(name)) for name in _shipped_names()}


def poses(data: Path | None) -> dict[str, Any]:
    """Return counts and digests of all models that come with the package, and of files made of them."""
    names = _shipped_names()
    return dict(zip(names, each(_describe_and_save, names, 120), strict=True))


def verdicts(data: Path | None) -> dict[str, Any]:
    """Return what readers say of each model file below a folder: read, read strictly."""
    if data is None:
        return {"": "skipped: there is no --data FOLDER"}
    files = [p for p in sorted(data.rglob("*")) if p.suffix in SUFFIXES and p.is_file() and _is_model(p)]
    names = [file.relative_to(data).as_posix() for file in files]
    return dict(zip(names, each(partial(read_verdict, data), names, 120), strict=True))


# -- one model -----------------------------------------------------------------------------------------------


def describe_model(source: Any) -> dict[str, Any]:
    """Return counts of a model, and digests at random states, by its name or from itself."""
    import kineverse as kv

    model = kv.load(source) if isinstance(source, str) else source
    frames = sorted(model.frames)
    symbols = list(model.degrees_of_freedom)
    expressions = [model.fk(name) for name in frames]
    moved = max(frames, key=lambda name: (len(model.fk(name).symbols), name), default=None)
    constraints = [
        part for _, c in sorted(model.constraints.items()) for part in (c.lower, c.expression, c.upper)
    ]
    return {
        "frames": len(frames),
        "names": zlib.crc32("\n".join(frames).encode()),
        "coordinates": [str(symbol) for symbol in symbols],
        "constraints": len(model.constraints),
        "constraint_names": zlib.crc32("\n".join(sorted(model.constraints)).encode()),
        "bodies": len(model.bodies),
        "shapes": sum(len(body.collisions) + len(body.visuals) for body in model.bodies.values()),
        "mass": float(model.mass()),
        "limits": [[*map(float, model.limits(s))] for s in symbols],
        "poses": digest(expressions, model),
        "velocities": digest([model.jacobian(moved)] if moved else [], model),
        "constraint_values": digest(constraints, model),
    }


def _describe_and_save(name: str) -> dict[str, Any]:
    import kineverse as kv

    saved: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for suffix in WRITTEN:
            file = Path(folder) / f"model{suffix}"
            try:
                kv.load(name).save(file)
                saved[suffix] = zlib.crc32(file.read_bytes())
            except kv.KineverseError as error:
                saved[suffix] = f"{type(error).__name__}: {error}".replace(folder, "TMP")
    return {**describe_model(name), "saved": saved}


def digest(expressions: Sequence[Any], model: Any) -> list[float]:
    """Return three random projections of the values of expressions at random states.

    They stay the same but for rounding if the last bits of values change, as a hash would not. What is not
    finite counts as a number that nothing has.
    """
    import kineverse as kv

    if not expressions:
        return []
    inputs = sorted({s for e in expressions for s in e.symbols}, key=str)
    columns = [_values(symbol, model) for symbol in inputs]
    states = np.array(columns).T.reshape(STATES, len(inputs))
    function = kv.compile(list(expressions), inputs, tier="interpreter")
    with np.errstate(all="ignore"):
        values = np.array(
            [np.concatenate([np.ravel(part) for part in function(row)]) for row in states]
        ).ravel()
    values = np.where(np.isfinite(values), values, 7.1234567)
    weights = np.random.default_rng(0).normal(size=(3, len(values))) / np.sqrt(len(values))
    return [round(float(x), 12) for x in weights @ values]


def _values(symbol: Any, model: Any) -> np.ndarray:
    """Return random values of a symbol within its limits, which do not depend on other symbols."""
    rng = np.random.default_rng(zlib.crc32(str(symbol).encode()))
    try:
        lower, upper = map(float, model.limits(symbol))
    except Exception:
        lower, upper = -1.0, 1.0
    low, high = max(lower, -np.pi), min(upper, np.pi)
    return rng.uniform(low, high, STATES) if low < high else np.full(STATES, low)


# -- names and files -----------------------------------------------------------------------------------------


def _shipped_names() -> list[str]:
    import kineverse as kv
    from kineverse import gallery

    scenes = [f"articulations/{name}" for name in gallery.names()]
    kitchens = [f"kitchens/{seed}" for seed in (*range(10), 17, 123)]
    boxes = [f"lockboxes/{name}" for name in ("thesis", "rings-7", *range(5))]
    return sorted([*kv.shipped_models(), *scenes, *kitchens, *boxes])


def _prefix(model: Any) -> list[str]:
    return sorted({name.partition("/")[0] for name in model.frames})


def _is_model(file: Path) -> bool:
    """Return whether a file is meant for a reader of models: not a part of another one, nor other data."""
    if file.suffix == ".json":
        return file.name.endswith(".kv.json")
    return file.suffix != ".xml" or b"<mujoco" in file.read_bytes() or b"<robot" in file.read_bytes()


def read_verdict(data: Path, name: str) -> dict[str, Any]:
    """Return what readers say of a file."""
    os.environ["KINEVERSE_MODEL_PATH"] = str(data)
    return {"read": _read(data, name, strict=False), "strict": _read(data, name, strict=True)}


def _read(data: Path, name: str, strict: bool) -> Any:
    import kineverse as kv

    warnings: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: warnings.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("kineverse")
    log.addHandler(handler)
    try:
        model = kv.load(data / name, prefix="p", strict=strict)
    except kv.KineverseError as error:
        return {"refused": type(error).__name__, "message": str(error).replace(str(data), "DATA")}
    finally:
        log.removeHandler(handler)
    if strict:
        return "read"
    return {"warnings": [text.replace(str(data), "DATA") for text in warnings], **describe_model(model)}
