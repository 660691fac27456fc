"""Layer 3: the model, its data and constraints, and the operations it is made of."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .articulation import Articulation as Articulation
    from .basic_operations import (
        AddFrame as AddFrame,
        Attach as Attach,
        Constrain as Constrain,
        Override as Override,
        SetData as SetData,
        SetRate as SetRate,
    )
    from .body import (
        Body as Body,
        Box as Box,
        Capsule as Capsule,
        Cone as Cone,
        Cylinder as Cylinder,
        Ellipsoid as Ellipsoid,
        Inertia as Inertia,
        Mesh as Mesh,
        Pose as Pose,
        Shape as Shape,
        Sphere as Sphere,
    )
    from .changes import Change as Change, Diff as Diff
    from .commits.follower import BuiltValue as BuiltValue, Follower as Follower, follow as follow
    from .commits.listeners import Listener as Listener
    from .commits.net_changes import NetChanges as NetChanges, PlacedEntry as PlacedEntry
    from .commits.undo import UNDO_LIMIT as UNDO_LIMIT
    from .comparison import BehaviourComparison as BehaviourComparison, compare_models as compare_models
    from .constraint import Constraint as Constraint
    from .edit import Edit as Edit, Savepoint as Savepoint
    from .frame import WORLD as WORLD, Frame as Frame
    from .frame_dependence import count_moved_bodies as count_moved_bodies, moved_frames as moved_frames
    from .history import HistoryEntry as HistoryEntry
    from .integration import Integrator as Integrator
    from .model import Model as Model, Snapshot as Snapshot
    from .operation import Operation as Operation, Writes as Writes
    from .rates import Rates as Rates
    from .read_recorder import ReadRecorder as ReadRecorder
    from .violations import (
        ConstraintChecker as ConstraintChecker,
        Violation as Violation,
        Violations as Violations,
    )

lazy_face(__name__)
