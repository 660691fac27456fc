"""Articulation models as symbolic expressions and constraints.

``import kineverse as kv`` gives what most programs need. The rest is in the packages below it:
:mod:`kineverse.articulations` (joints, mechanisms, locks), :mod:`kineverse.model` (operations, edits, data),
:mod:`kineverse.errors`, :mod:`kineverse.logic`, :mod:`kineverse.spatial`, :mod:`kineverse.loops` and
:mod:`kineverse.formats`. :mod:`kineverse.geometry`, :mod:`kineverse.estimation`, :mod:`kineverse.reasoning`,
:mod:`kineverse.planning` and the viewer (:func:`show`) are imported on first use.
"""

from typing import TYPE_CHECKING

from kineverse import articulations, errors, expressions, formats, logic, loops, model, spatial, symbols
from kineverse._version import __version__
from kineverse.articulations import Continuous, Fixed, Floating, Limits, Planar, Prismatic, Revolute
from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import KineverseError
from kineverse.expressions import Expression, array
from kineverse.expressions.functions import clip, maximum, minimum, norm, where
from kineverse.expressions.piecewise import spline
from kineverse.formats import load, shipped_models
from kineverse.loops import CloseLoop
from kineverse.model import Constraint, Model, Operation
from kineverse.spatial import (
    axis_angle,
    inverse,
    quaternion,
    rotation_x,
    rotation_y,
    rotation_z,
    rpy,
    transform,
    translation,
)
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol, parameter, position, velocity

if TYPE_CHECKING:
    from kineverse import control, estimation, geometry, grasping, manipulation, planning, reasoning, worlds
    from kineverse.view.page import show

__all__ = [
    "CloseLoop",
    "CompiledFunction",
    "Constraint",
    "Continuous",
    "Expression",
    "Fixed",
    "Floating",
    "KineverseError",
    "Limits",
    "Model",
    "Operation",
    "Planar",
    "Prismatic",
    "Revolute",
    "State",
    "StateLike",
    "Symbol",
    "__version__",
    "array",
    "articulations",
    "axis_angle",
    "clip",
    "compile",
    "control",
    "errors",
    "estimation",
    "expressions",
    "formats",
    "geometry",
    "grasping",
    "inverse",
    "load",
    "logic",
    "loops",
    "manipulation",
    "maximum",
    "minimum",
    "model",
    "norm",
    "parameter",
    "planning",
    "position",
    "quaternion",
    "reasoning",
    "rotation_x",
    "rotation_y",
    "rotation_z",
    "rpy",
    "shipped_models",
    "show",
    "spatial",
    "spline",
    "symbols",
    "transform",
    "translation",
    "velocity",
    "where",
    "worlds",
]

_LAZY = ("control", "estimation", "geometry", "grasping", "manipulation", "planning", "reasoning", "worlds")

# Entries are texts: the packages are imported at first use.
model.registry.register_collection(
    "articulations",
    model.registry.ModelCollection(
        "kineverse.gallery:names",
        summary="one for each articulation",
        find_document="kineverse.gallery:find_document",
    ),
)
model.registry.register_collection(
    "kitchens",
    model.registry.ModelCollection(
        "kineverse.gallery.kitchens:example_seeds",
        summary="one for each seed from 0 on",
        build="kineverse.gallery.kitchens:kitchen_operations",
        accept="kineverse.gallery.kitchens:is_seed",
        prefix="kitchen",
    ),
)
model.registry.register_collection(
    "lockboxes",
    model.registry.ModelCollection(
        "kineverse.gallery.lockboxes:example_boxes",
        summary="one for each seed from 0 on",
        build="kineverse.gallery.lockboxes:lockbox_operations",
        accept="kineverse.gallery.lockboxes:has_lockbox",
        prefix="lockbox",
    ),
)
model.registry.register_service("read_mesh", "kineverse.geometry.mesh_files:read_mesh")


def __getattr__(name: str) -> object:
    import importlib

    if name in _LAZY:
        return importlib.import_module(f"kineverse.{name}")
    if name == "show":
        return importlib.import_module("kineverse.view.page").show
    from kineverse._synonyms import MODULE_SYNONYMS
    from kineverse.errors import unknown_attribute_error

    below: dict[str, str] = {}
    if not name.startswith("_"):
        lazy = (importlib.import_module(f"kineverse.{package}") for package in _LAZY)
        for package in (*lazy, expressions, spatial, logic, errors, loops, formats, model, articulations):
            path, values = package.__name__, vars(package)
            defined = [n for n in values if getattr(values[n], "__module__", "") == path and n[0] != "_"]
            below |= {n: f"kv.{path.removeprefix('kineverse.')}.{n}" for n in values.get("__all__", defined)}
    raise unknown_attribute_error("The package kineverse", name, __all__, MODULE_SYNONYMS, below)


def __dir__() -> list[str]:
    return sorted({*(name for name in globals() if name.startswith("__")), *__all__})
