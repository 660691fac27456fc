"""Validation of a model file: mistakes, and problems of limits, loops, poses, inertias, mesh files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, isnan

import numpy as np

from kineverse.errors import KineverseError, summarize_error
from kineverse.expressions.printing import format_number
from kineverse.loops.loop_records import find_loops
from kineverse.model.body import Inertia, Mesh
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.model.registry import LoopTreatment, find_scheme
from kineverse.model.sampling import StateSamples
from kineverse.state import State

from .document import OpaqueOperation
from .file_formats import is_mjcf
from .files import read_file
from .loader import load
from .locate import Source, locate_model
from .reader_warnings import Fault, collect_warnings
from .resource_paths import locate_mesh

SAMPLED_STATES = 32  # number of random states within the limits in which poses and loops are checked

INERTIA_TOLERANCE = 1e-3
"""Tolerance of the triangle inequality of moments of inertia, relative to the largest.

Files have few digits, and for a thin plate the largest is exactly the sum of the others.
"""

LEAST_INERTIA = 1e-12  # moments of inertia below this count as zero [kg m²]: a grain of sand has more


@dataclass(frozen=True, slots=True)
class ModelProblem:
    """Problem of a model."""

    kind: str  # kind of the part: limit, loop, pose, inertia or mesh
    where: str  # name of the part
    text: str  # description of the problem


def find_problems(model: ModelView, meshes: bool = True) -> Iterator[ModelProblem]:
    """Yield the problems of a model."""
    yield from _find_limit_problems(model)
    samples = StateSamples(model, count=SAMPLED_STATES)
    allowed = _states_within_limits(model, samples)
    yield from _find_open_loops(model, samples, allowed)
    yield from _find_pose_problems(model, samples, allowed)
    for name, body in model.bodies.items():
        if body.inertia is not None:
            for text in find_inertia_errors(body.inertia):
                yield ModelProblem("inertia", name, text)
    if meshes:
        yield from _find_missing_meshes(model)


def _find_limit_problems(model: ModelView) -> Iterator[ModelProblem]:
    state = model.default_state()
    crossed = set()
    varying = {name: c for name, c in model.constraints.items() if c.lower.symbols or c.upper.symbols}
    ends = StateSamples(model, count=0).values([e for c in varying.values() for e in (c.lower, c.upper)])
    for name, lower, upper in zip(varying, ends[::2], ends[1::2], strict=True):
        if lower[0] > upper[0]:
            crossed.add(name)
            bounds = f"lower {format_number(float(lower[0]))}, upper {format_number(float(upper[0]))}"
            yield ModelProblem("limit", name, f"leaves no value at the default state: {bounds}")
    for violation in model.violations(state):
        if violation.name in crossed or violation.name not in model.constraints:  # loops have their own say
            continue
        if isnan(violation.value):
            yield ModelProblem("limit", violation.name, "is about what is not finite at the default state")
            continue
        value, low, high = map(format_number, (violation.value, violation.lower, violation.upper))
        text = f"is broken at the default state: {value} is not in [{low}, {high}]"
        yield ModelProblem("limit", violation.name, text)


def _states_within_limits(model: ModelView, samples: StateSamples) -> list[int]:
    """Return the indices of the sampled states that violate no constraint, and of the default state, 0."""
    symbols = model.symbols
    result = [0]
    for k in range(1, samples.size) if symbols else ():
        state = State({symbol: samples.values_of(symbol)[k] for symbol in symbols})
        # Values that are not finite are the problem to find, and no violation.
        if all(isnan(violation.excess) for violation in model.violations(state)):
            result.append(k)
    return result


def _find_open_loops(model: ModelView, samples: StateSamples, allowed: list[int]) -> Iterator[ModelProblem]:
    rates = model.rates
    values = samples.values([rates.carry(symbol) for symbol in rates.dependent])
    open_at = {
        str(symbol): np.isnan(column[allowed]).tolist()
        for symbol, column in zip(rates.dependent, values, strict=True)
        if np.isnan(column[allowed]).any()
    }
    for loop in find_loops(model):
        bad = [open_at[follower] for follower in loop.dependent if follower in open_at]
        if bad:
            yield ModelProblem(
                "loop",
                loop.name,
                f"does not close {_format_states([any(states) for states in zip(*bad, strict=True)])}",
            )


def _find_pose_problems(
    model: ModelView, samples: StateSamples, allowed: list[int]
) -> Iterator[ModelProblem]:
    names = list(model.frames)
    for name, poses in zip(names, samples.values([model.fk(name) for name in names]), strict=True):
        bad = [not np.isfinite(poses[k]).all() for k in allowed]
        if any(bad):
            yield ModelProblem("pose", name, f"is not finite {_format_states(bad)}")


def _format_states(bad: Sequence[bool]) -> str:
    """Return as text in which of the allowed states a check fails; the first is the default state."""
    if bad[0]:
        return "at the default state"
    return f"in {sum(bad)} of {len(bad)} states within the limits"


def find_inertia_errors(inertia: Inertia) -> Iterator[str]:
    """Yield the reasons why an inertia is physically impossible."""
    ixx, ixy, ixz, iyy, iyz, izz = inertia.tensor
    if not isfinite(inertia.mass) or inertia.mass < 0.0:
        yield f"a mass of {format_number(inertia.mass)} kg"
    if not all(map(isfinite, inertia.tensor)):
        yield "moments of inertia that are not finite"
        return
    moments = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    if abs(moments).max() < LEAST_INERTIA:
        return
    moments[abs(moments) < 1e-9 * abs(moments).max()] = 0.0
    least, middle, most = moments.tolist()
    shown = f"principal moments {format_number(least)}, {format_number(middle)}, {format_number(most)} kg m²"
    if least < -INERTIA_TOLERANCE * max(most, 0.0):
        yield f"{shown}, one of which is negative"
    elif most - least - middle > INERTIA_TOLERANCE * most:
        yield f"{shown}: the largest exceeds the sum of the others"
    elif inertia.mass == 0.0 and most > 0.0:
        yield f"{shown} without any mass"


def _find_missing_meshes(model: ModelView) -> Iterator[ModelProblem]:
    missing: dict[Mesh, str] = {}
    found: set[Mesh] = set()
    for name, body in model.bodies.items():
        shapes = [shape.geometry for shape in (*body.visuals, *body.collisions)]
        for mesh in dict.fromkeys(g for g in shapes if isinstance(g, Mesh)):
            if mesh not in found and mesh not in missing:
                try:
                    locate_mesh(mesh)
                    found.add(mesh)
                except (KineverseError, OSError) as error:
                    # The folders searched are the same for all meshes.
                    missing[mesh] = summarize_error(error)
            if mesh in missing:
                yield ModelProblem("mesh", name, missing[mesh])


_FORMATS = {
    ".kv.json": "document",
    ".urdf": "URDF",
    ".sdf": "SDF",
    ".world": "SDF",
    ".mjcf": "MJCF",
    "mobility_v2.json": "PartNet-Mobility",
}

VALID, INVALID, UNREADABLE = 0, 1, 2  # values of ValidationResult.status


@dataclass(frozen=True)
class ValidationResult:
    """Findings in one file.

    Attributes
    ----------
    name
        Name or path as given.
    format
        Format of the file; empty if unknown.
    model
        Loaded model; None if the file cannot be read, for the reason in ``error``.
    error
        Why it cannot be read.
    facts
        Header of a document: its ``version``, and ``sha256``, the hash of its content.
    remarks
        Reader warnings: content left out or interpreted.
    faults
        Mistakes that a strict reader refuses.
    strict
        True if remarks count as problems.

    See Also
    --------
    kineverse.formats.validate_file
    """

    name: str
    format: str = ""
    model: Model | None = None
    error: KineverseError | OSError | None = None
    facts: Mapping[str, int | str] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    faults: Sequence[str] = ()
    problems: Sequence[ModelProblem] = ()
    strict: bool = False

    @property
    def status(self) -> int:
        """Exit status for this file."""
        if self.model is None or self.faults:
            return UNREADABLE
        return INVALID if self.problems or (self.strict and self.remarks) else VALID

    @property
    def reason(self) -> str:
        """Reason on one line if the file cannot be read."""
        if isinstance(self.error, OSError) and self.error.strerror:
            return self.error.strerror
        return " ".join(str(self.error).split())


def validate_file(
    name: str | os.PathLike[str],
    *,
    meshes: bool = True,
    strict: bool = False,
    root: str | os.PathLike[str] | None = None,
    loops: LoopTreatment = "solve",
    further: Callable[[ModelView], Iterable[ModelProblem]] | None = None,
) -> ValidationResult:
    """Validate a file, as ``kineverse validate`` does; mistakes in it are returned, not raised.

    Parameters
    ----------
    name
        Name of a shipped model, path of a file, or address of a live model.
    meshes
        True to check that mesh files exist.
    strict
        True if remarks count as problems.
    root, loops
        See :func:`kineverse.load`.
    further
        Function that yields further problems of a model.

    Examples
    --------
    >>> result = kv.formats.validate_file("kitchen")
    >>> result.format, result.status, result.model
    ('URDF', 0, <Model: 54 frames, 23 DoF, 46 constraints (version 1)>)
    """
    name, language = os.fspath(name), ""
    with collect_warnings() as remarks:
        try:
            source = None if find_scheme(name) else locate_model(name)
            language = "live model" if source is None else detect_format(source)
            model = load(name, root=root, loops=loops)
            facts = {} if source is None else _document_header(source)
            problems = (*find_problems(model, meshes), *(further(model) if further else ()))
        except (KineverseError, OSError) as error:
            return ValidationResult(name, language, error=error, remarks=remarks, strict=strict)
    faults = [remark for remark in remarks if isinstance(remark, Fault)]
    others = [remark for remark in remarks if not isinstance(remark, Fault)]
    return ValidationResult(
        name, language, model, None, facts, [*others, *_frozen_operations(model)], faults, problems, strict
    )


def _frozen_operations(model: Model) -> list[str]:
    """Return a line for each operation that does not follow changes of what it reads, with the reason."""
    operations = {tag: model.history.operation(tag) for tag in model.history.tags}
    return [
        f"operation {tag!r} is frozen: {operation.frozen}"
        for tag, operation in operations.items()
        if isinstance(operation, OpaqueOperation) and operation.frozen
    ]


def detect_format(source: Source) -> str:
    """Return the format of a model; empty if its suffix is unknown."""
    if source.collection:
        return f"model of the collection '{source.collection}'"
    if source.path.name.endswith(".xml"):
        return "MJCF" if is_mjcf(source.path.name, read_file(source.path)) else "URDF"
    endings = (name for name in _FORMATS if source.path.name.endswith(name))
    return _FORMATS.get(next(endings, ""), "")


def _document_header(source: Source) -> dict[str, int | str]:
    if source.collection or not source.path.name.endswith(".kv.json"):
        return {}
    head = json.loads(read_file(source.path))
    return {key: head[key] for key in ("version", "sha256") if key in head}
