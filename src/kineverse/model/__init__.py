"""Layer 3: the model, its data and constraints, and the operations it is made of."""

from .articulation import Articulation
from .body import Body, Box, Capsule, Cone, Cylinder, Ellipsoid, Inertia, Mesh, Pose, Shape, Sphere
from .constraint import Constraint
from .diff import Change, Diff
from .difference import difference
from .edit import AddFrame, Attach, Constrain, Edit, Override, SetRate, Write
from .frame import WORLD, Frame
from .model import Model, Snapshot
from .operation import Effects, Operation
from .rates import Rates
from .reader import Reader
from .violations import Violation, Violations

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
    "Cylinder",
    "Diff",
    "Edit",
    "Effects",
    "Ellipsoid",
    "Frame",
    "Inertia",
    "Mesh",
    "Model",
    "Operation",
    "Override",
    "Pose",
    "Rates",
    "Reader",
    "SetRate",
    "Shape",
    "Snapshot",
    "Sphere",
    "Violation",
    "Violations",
    "Write",
    "difference",
]
