"""Kineverse: articulation models as symbolic expressions and constraints.

``import kineverse as kv`` gives the whole public face: symbols and expressions (layer 1), :func:`compile`
(layer 2), models, operations and :func:`load` (layer 3). Articulations are in :mod:`kineverse.articulations`;
:mod:`kineverse.geometry` (layer 4), :mod:`kineverse.estimation` and :mod:`kineverse.reasoning` (layer 5) are
imported when they are used, and so is the viewer by :func:`show`.
"""

from typing import TYPE_CHECKING

from . import articulations, logic, spatial
from ._version import __version__
from .articulations import (
    Ackermann,
    Ball,
    Cam,
    Continuous,
    Cylindrical,
    DeskLamp,
    DifferentialDrive,
    DoorWithHandle,
    Faucet,
    Fixed,
    Floating,
    FoldingDoor,
    GarageDoor,
    Gearbox,
    Latch,
    Limits,
    Mecanum,
    Microwave,
    OmniBase,
    PedalBin,
    PistonAndRod,
    Planar,
    Prismatic,
    RackAndPinion,
    Ratchet,
    Revolute,
    ScissorLift,
    Screw,
    ScrewAndNut,
    Universal,
)
from .compile import CompiledFunction, compile  # noqa: A004 - the name the design gives it
from .errors import (
    CompileError,
    EditError,
    ExpressionError,
    FormatError,
    KineverseError,
    MissingExtraError,
    ModelError,
    NameTakenError,
    ShapeError,
    UnknownAttributeError,
    UnknownNameError,
    UnsolvedError,
    ValueRejectedError,
)
from .expressions import Expression, array, total_derivative
from .expressions.functions import clip, maximum, minimum, norm, where
from .expressions.piecewise import spline
from .formats import load, shipped_models
from .locks import blocked_unless, limit_table, unlocked_while
from .logic import less, logic_and, logic_not, logic_or
from .loops import CloseLoop, LoopConstraint
from .model import (
    AddFrame,
    Articulation,
    Attach,
    Body,
    Constrain,
    Constraint,
    Diff,
    Edit,
    Effects,
    Frame,
    Inertia,
    Model,
    Operation,
    Override,
    Pose,
    Reader,
    SetRate,
    Shape,
    Snapshot,
    Write,
    difference,
)
from .spatial import (
    axis_angle,
    inverse,
    point,
    quaternion,
    rotation_x,
    rotation_y,
    rotation_z,
    rpy,
    transform,
    translation,
    vector,
)
from .state import State
from .symbols import Symbol, parameter, position, symbol, velocity

if TYPE_CHECKING:
    from . import estimation, geometry, reasoning
    from .formats.document import document_hash, from_bytes, to_bytes
    from .view.show import show

__all__ = [
    "Ackermann",
    "AddFrame",
    "Articulation",
    "Attach",
    "Ball",
    "Body",
    "Cam",
    "CloseLoop",
    "CompileError",
    "CompiledFunction",
    "Constrain",
    "Constraint",
    "Continuous",
    "Cylindrical",
    "DeskLamp",
    "Diff",
    "DifferentialDrive",
    "DoorWithHandle",
    "Edit",
    "EditError",
    "Effects",
    "Expression",
    "ExpressionError",
    "Faucet",
    "Fixed",
    "Floating",
    "FoldingDoor",
    "FormatError",
    "Frame",
    "GarageDoor",
    "Gearbox",
    "Inertia",
    "KineverseError",
    "Latch",
    "Limits",
    "LoopConstraint",
    "Mecanum",
    "Microwave",
    "MissingExtraError",
    "Model",
    "ModelError",
    "NameTakenError",
    "OmniBase",
    "Operation",
    "Override",
    "PedalBin",
    "PistonAndRod",
    "Planar",
    "Pose",
    "Prismatic",
    "RackAndPinion",
    "Ratchet",
    "Reader",
    "Revolute",
    "ScissorLift",
    "Screw",
    "ScrewAndNut",
    "SetRate",
    "Shape",
    "ShapeError",
    "Snapshot",
    "State",
    "Symbol",
    "Universal",
    "UnknownAttributeError",
    "UnknownNameError",
    "UnsolvedError",
    "ValueRejectedError",
    "Write",
    "__version__",
    "array",
    "articulations",
    "axis_angle",
    "blocked_unless",
    "clip",
    "compile",
    "difference",
    "document_hash",
    "estimation",
    "from_bytes",
    "geometry",
    "inverse",
    "less",
    "limit_table",
    "load",
    "logic",
    "logic_and",
    "logic_not",
    "logic_or",
    "maximum",
    "minimum",
    "norm",
    "parameter",
    "point",
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
    "symbol",
    "to_bytes",
    "total_derivative",
    "transform",
    "translation",
    "unlocked_while",
    "vector",
    "velocity",
    "where",
]


def __getattr__(name: str) -> object:
    import importlib

    if name in ("estimation", "geometry", "reasoning"):
        return importlib.import_module(f"kineverse.{name}")
    if name in ("document_hash", "from_bytes", "to_bytes"):
        return getattr(importlib.import_module("kineverse.formats.document"), name)
    if name == "show":
        return importlib.import_module("kineverse.view.show").show
    from .vocabulary import MODULE, unknown_attribute

    raise unknown_attribute("The package kineverse", name, __dir__(), MODULE)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
