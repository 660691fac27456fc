"""Scenes of the gallery: functions with the names of the scenes, and their summaries as docstrings."""

from __future__ import annotations

import json

import kineverse as kv
from kineverse.formats.document import to_json

from . import bases, linkages, mechanisms, multi_axis, single_axis, transmissions
from .scene_builder import Build, SceneBuilder

SCENES: dict[str, Build] = {
    build.__name__: build
    for family in (single_axis, multi_axis, transmissions, bases, mechanisms, linkages)
    for build in family.SCENES
}


def build_scene(name: str, prefix: str | None = None) -> kv.Model:
    """Build a scene from its operations."""
    scene, model = SceneBuilder(prefix), kv.Model()
    SCENES[name](scene)
    with model.edit() as edit:
        for operation in scene.operations:
            edit.apply(operation)
    return model


def scene_document(name: str) -> str:
    """Return a scene as a document."""
    return to_json(build_scene(name))


def summaries() -> str:
    """Return the names of all scenes and their summaries as JSON, family by family."""
    shown = {name: (build.__doc__ or "").partition("\n")[0] for name, build in SCENES.items()}
    texts = {name: text.removeprefix("Show ").rstrip(".") for name, text in shown.items()}
    listed = {name: text[:1].upper() + text[1:] for name, text in texts.items()}
    return json.dumps(listed, indent=1, ensure_ascii=False) + "\n"
