"""Every model there is survives: what ships, every scene of the gallery, every published file that loads."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from trace_models import read_document

import kineverse as kv
from kineverse import gallery
from kineverse.formats.document import to_json

FOLDERS = {
    "articulated_objects": 5,
    "fetch": 1,
    "furniture_sim": 6,
    "hsrb": 1,
    "iai_kitchen": 1,
    "kineverse_shelf_objects": 1,
    "pr2": 1,
    "sdf_joint_types": 13,
    "urdf_conformance": 7,
    "urdf_files_dataset_sample": 7,
}
"""How many of the files below load at least."""

MANY = {"sdf_joint_types": 3, "urdf_conformance": 2, "urdf_files_dataset_sample": 2}
"""Folders with many small files, and how many of a third of a third of them load at least."""

LARGE = ("hsrb", "iai_kitchen", "delta_robot", "jansen_leg", "scissor_linkage")
"""Models that take long and tell nothing that none of the others does."""

SUFFIXES = (".urdf", ".sdf", ".world", ".xml", ".mjcf")
MOST = 3
"""Expressions of a kind that are compared for one model."""


def sample(model: kv.Model) -> kv.Expression:
    """Return the elements of poses, Jacobians, constraints, bounds, and their gradients; of large models a part."""
    draw = random.Random(1)
    frames, names = list(model.frames), list(model.constraints)
    frames = frames if len(frames) <= MOST else draw.sample(frames, MOST)
    names = names if len(names) <= MOST else draw.sample(names, MOST)
    found = [model.fk(frame) for frame in frames]
    for name in names:
        constraint = model.constraints[name]
        found += [constraint.lower, constraint.expression, constraint.upper]
    parts = [
        part for e in found for part in (e, *e.gradient().values(), *e.gradient(heuristic=False).values())
    ]
    parts += [model.jacobian(frame) for frame in frames]
    if len(frames) > 1:
        parts.append(model.jacobian(frames[-1], frames[0], "body"))
    return np.concatenate([part.ravel() for part in parts])  # type: ignore[arg-type, return-value]


def survives(model: kv.Model) -> None:
    """Compare a model with what its document and its packed document say."""
    text = to_json(model)
    again = read_document(text)
    assert again.snapshot() == model.snapshot()
    assert to_json(again) == text
    assert kv.formats.from_bytes(kv.formats.to_bytes(model)).snapshot() == model.snapshot()
    wanted = json.loads(text)["sha256"]
    assert kv.formats.document_hash(model.snapshot()) == wanted
    alone = kv.Model()
    with alone.edit() as edit:
        for tag in model.history.tags:
            entry = kv.formats.operation_from_bytes(kv.formats.operation_to_bytes(model, tag))
            assert edit.apply(entry.operation, entry.tag) == tag
    assert kv.formats.document_hash(alone) == wanted  # written anew, by what came alone
    ours, theirs = sample(model), sample(again)
    home = model.default_state()
    values = np.array([home.get(s, 0.3 if s.value is None else s.value) for s in ours.symbols])
    for scale in (0.0, 0.02):
        moved = values + np.random.default_rng(5).uniform(-scale, scale, len(values))
        at, results = dict(zip(ours.symbols, moved, strict=True)), []
        for elements in (ours, theirs):
            try:
                results.append(elements(at).tobytes())
            except kv.errors.NoSolutionError as error:
                results.append(str(error).encode())
        assert results[0] == results[1]


def unless_large(name: str, *others: object) -> object:
    """Return a case that takes long if its model is large."""
    return pytest.param(name, *others, marks=pytest.mark.long if name in LARGE else ())


@pytest.mark.parametrize("name", [unless_large(name) for name in (*kv.shipped_models(), *gallery.names())])
@pytest.mark.sampled(2)
def test_shipped_models_and_scenes_survive_a_round_trip(name: str) -> None:
    try:
        model = kv.load(name)
    except kv.errors.UnknownNameError:
        model = kv.load(f"articulations/{name}")
    survives(model)


@pytest.mark.parametrize(
    ("folder", "step", "least"),
    [
        *(unless_large(folder, 1, least) for folder, least in FOLDERS.items() if folder not in MANY),
        # Of many small files a part: the readers' tests load all.
        *((folder, 9, least) for folder, least in MANY.items()),
        *(pytest.param(folder, 3, FOLDERS[folder], marks=pytest.mark.long) for folder in MANY),
    ],
)
@pytest.mark.sampled(2)
def test_files_of_other_projects_survive_a_round_trip(
    folder: str, step: int, least: int, published: Callable[..., Path]
) -> None:
    loaded = 0
    paths = sorted(p for p in published(folder).rglob("*") if p.suffix in SUFFIXES and p.is_file())
    for path in paths[::step]:
        try:
            model = kv.load(path, prefix="")
        except kv.errors.FormatError:
            continue  # with a reason, of which other tests are
        survives(model)
        loaded += 1
    assert loaded >= least
