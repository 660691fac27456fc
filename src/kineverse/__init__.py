"""Articulation models as symbolic expressions and constraints.

``import kineverse as kv`` gives what most programs need. The rest is in the packages below it:
:mod:`kineverse.articulations` (joints, mechanisms, locks), :mod:`kineverse.model` (operations, edits, data),
:mod:`kineverse.errors`, :mod:`kineverse.logic`, :mod:`kineverse.spatial`, :mod:`kineverse.loops` and
:mod:`kineverse.formats`. :mod:`kineverse.geometry`, :mod:`kineverse.estimation`, :mod:`kineverse.reasoning`,
:mod:`kineverse.planning`, :mod:`kineverse.exchange` (models that processes share) and the viewer
(:func:`show`) are imported on first use.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face
from kineverse._version import __version__ as __version__

if TYPE_CHECKING:
    from kineverse import (
        articulations as articulations,
        control as control,
        errors as errors,
        estimation as estimation,
        exchange as exchange,
        expressions as expressions,
        formats as formats,
        geometry as geometry,
        grasping as grasping,
        logic as logic,
        loops as loops,
        manipulation as manipulation,
        model as model,
        planning as planning,
        reasoning as reasoning,
        spatial as spatial,
        symbols as symbols,
        worlds as worlds,
    )
    from kineverse.articulations import (
        Continuous as Continuous,
        Fixed as Fixed,
        Floating as Floating,
        Limits as Limits,
        Planar as Planar,
        Prismatic as Prismatic,
        Revolute as Revolute,
    )
    from kineverse.compilation import CompiledFunction as CompiledFunction, compile as compile
    from kineverse.compilation.backends import to_jax as to_jax, to_torch as to_torch
    from kineverse.errors import (
        ConflictError as ConflictError,
        KineverseError as KineverseError,
        OfflineError as OfflineError,
    )
    from kineverse.expressions import Expression as Expression, array as array
    from kineverse.expressions.functions import (
        clip as clip,
        maximum as maximum,
        minimum as minimum,
        norm as norm,
        where as where,
    )
    from kineverse.expressions.piecewise import spline as spline
    from kineverse.formats import load as load, shipped_models as shipped_models
    from kineverse.loops import CloseLoop as CloseLoop
    from kineverse.model import (
        Constraint as Constraint,
        Model as Model,
        Operation as Operation,
        follow as follow,
    )
    from kineverse.spatial import (
        axis_angle as axis_angle,
        inverse as inverse,
        quaternion as quaternion,
        rotation_x as rotation_x,
        rotation_y as rotation_y,
        rotation_z as rotation_z,
        rpy as rpy,
        transform as transform,
        translation as translation,
    )
    from kineverse.state import State as State, StateLike as StateLike
    from kineverse.symbols import (
        Symbol as Symbol,
        acceleration as acceleration,
        parameter as parameter,
        position as position,
        velocity as velocity,
    )
    from kineverse.view import show as show


def _list_names_below() -> dict[str, str]:
    import importlib  # for start-up time

    below: dict[str, str] = {}
    for package in _PACKAGES:
        values = vars(importlib.import_module(f"kineverse.{package}"))
        defined = [n for n in values if getattr(values[n], "__module__", "") == values["__name__"]]
        public = (n for n in values.get("__all__", defined) if not n.startswith("_"))
        below |= {name: f"kv.{package}.{name}" for name in public}
    return below


_PACKAGES = (
    *("exchange", "symbols", "control", "estimation", "geometry", "grasping", "manipulation", "planning"),
    *("reasoning", "worlds", "expressions", "spatial", "logic", "errors"),
    *("loops", "formats", "model", "articulations"),
)
"""Packages and modules of the face; a name that several have is that of the last one."""

lazy_face(__name__, below=_list_names_below)
