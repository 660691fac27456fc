"""Layer 3: the model, its data and constraints, and the operations it is made of."""

from typing import TYPE_CHECKING

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .articulation import Articulation
from .basic_operations import AddFrame, Attach, Constrain, Override, SetData, SetRate
from .body import Body, Box, Capsule, Cone, Cylinder, Ellipsoid, Inertia, Mesh, Pose, Shape, Sphere
from .changes import Change, Diff
from .comparison import compare_models
from .constraint import Constraint
from .edit import Edit
from .frame import WORLD, Frame
from .frame_dependence import count_moved_bodies, moved_frames
from .integration import Integrator
from .model import Model, Snapshot
from .operation import Operation, Writes
from .rates import Rates
from .read_recorder import ReadRecorder
from .violations import ConstraintChecker, Violation, Violations

__all__ = [
    "WORLD",
    "AddFrame",
    "Articulation",
    "Attach",
    "Body",
    "Box",
    "Capsule",
    "Change",
    "Cone",
    "Constrain",
    "Constraint",
    "ConstraintChecker",
    "Cylinder",
    "Diff",
    "Edit",
    "Ellipsoid",
    "Frame",
    "Inertia",
    "Integrator",
    "Mesh",
    "Model",
    "Operation",
    "Override",
    "Pose",
    "Rates",
    "ReadRecorder",
    "SetData",
    "SetRate",
    "Shape",
    "Snapshot",
    "Sphere",
    "Violation",
    "Violations",
    "Writes",
    "compare_models",
    "count_moved_bodies",
    "moved_frames",
]


if not TYPE_CHECKING:  # a type checker finds unknown names itself

    def __getattr__(name: str) -> object:
        raise unknown_attribute_error("The package kineverse.model", name, __all__, MODULE_SYNONYMS)
