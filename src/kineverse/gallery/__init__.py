"""Gallery: a small scene for every articulation of the library, loaded by name.

>>> import kineverse as kv
>>> model = kv.load("articulations/screw")
>>> model.degrees_of_freedom
(screw/bolt,)

``kineverse view articulations/screw`` shows it. Each module has the scenes of one family: functions that add
joints and bodies to a :class:`~kineverse.gallery.scene.SceneBuilder`. Their name is that of the scene, and
the first line of their docstring its summary.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

from kineverse.errors import UnknownNameError, suggest
from kineverse.gallery import bases, linkages, mechanisms, multi_axis, single_axis, transmissions
from kineverse.model.operation import Operation

from .scene import Build, SceneBuilder

__all__ = ["names", "operations", "summary"]

_FAMILIES = (single_axis, multi_axis, transmissions, bases, mechanisms, linkages)


def names() -> tuple[str, ...]:
    """Return the names of all scenes, family by family."""
    return tuple(_builds())


def summary(name: str) -> str:
    """Return the summary of a scene in one line."""
    shown = (_build(name).__doc__ or "").partition("\n")[0].removeprefix("Show ").rstrip(".")
    return shown[:1].upper() + shown[1:]


def operations(name: str, prefix: str | None = None) -> Iterator[Operation]:
    """Yield the operations of a scene.

    Parameters
    ----------
    name
        Name of the scene.
    prefix
        Prefix of the names of frames, articulations and coordinates, without the slash.

    Raises
    ------
    UnknownNameError
        If there is no such scene, with similar names.
    """
    scene = SceneBuilder(prefix)
    _build(name)(scene)
    yield from scene.operations


@cache
def _builds() -> dict[str, Build]:
    return {build.__name__: build for family in _FAMILIES for build in family.SCENES}


def _build(name: str) -> Build:
    try:
        return _builds()[name]
    except KeyError:
        raise UnknownNameError(
            f"There is no articulation {name!r} in the gallery. {suggest(name, _builds(), 'articulation')}"
        ) from None
