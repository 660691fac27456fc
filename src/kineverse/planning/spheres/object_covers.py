"""Covers of collision objects, cached by the content of their shapes."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np

from kineverse.compilation.cache import ContentCache
from kineverse.compilation.cache_kinds import KINDS
from kineverse.errors import FormatError, InvalidValueError
from kineverse.geometry.mesh_files import Floats
from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.shapes import Hull, Solid
from kineverse.model.body import Mesh

from .sphere_cover import MOST, SphereCover, check_cover_settings, cover_solids
from .sphere_tree import SphereTree

_DIGITS = 12  # digits in which poses in a body differ


def cover_objects(
    items: Sequence[CollisionObject],
    protrusion: float | None = None,
    most: int = MOST,
    *,
    force: bool = False,
) -> SphereCover:
    """Return the cover of the collision objects of a body in the frame of the first one.

    See :func:`.cover_solids`. It is computed once for equal shapes and settings, and then kept in memory and
    in the user's cache; with ``force`` it is computed again.

    Raises
    ------
    KineverseError
        If a shape cannot be used, or is a triangle mesh; the message names the body.

    See Also
    --------
    kineverse.planning.spheres.cover_solids
    """
    solids, key = _request(items, protrusion, most)
    result = None if force else find_cover(key)
    if result is None:
        try:
            result = cover_solids(solids, protrusion, most)
        except InvalidValueError as error:
            raise InvalidValueError(
                f"No spheres cover the shapes of body '{items[0].body}' ({_name(items)}): {error} Make them "
                "thicker, or leave the body out: Planner(model, leave_out=[...])."
            ) from None
        _remember(key, result)
        head = {"name": _name(items), "protrusion": result.protrusion, "sizes": [len(result)]}
        COVERS.write(key, _pack(head, result.centres, result.radii))
    return result


def are_covered(items: Sequence[CollisionObject], protrusion: float | None = None, most: int = MOST) -> bool:
    """Return True if the cover of collision objects is cached; for errors see :func:`cover_objects`."""
    return find_cover(_request(items, protrusion, most)[1]) is not None


def _request(
    items: Sequence[CollisionObject], protrusion: float | None, most: int
) -> tuple[list[tuple[Solid, Floats]], str]:
    check_cover_settings(protrusion, most)
    if not items:
        raise InvalidValueError("There is no shape to cover.")
    base = np.linalg.inv(items[0].shape.origin.matrix)
    solids: list[tuple[Solid, Floats]] = []
    for item in items:
        solid = item.make_solid()
        if not solid.is_convex:
            raise InvalidValueError(
                f"Shape {item.number} of body '{item.body}' is a triangle mesh, which has no inside for "
                "spheres to cover: leave the body out of triangles=, so that its hulls are covered."
            )
        # Zeros have one sign.
        solids.append((solid, np.round(base @ item.shape.origin.matrix, _DIGITS) + 0.0))
    return solids, cover_key(solids, protrusion, most)


def _name(items: Sequence[CollisionObject]) -> str:
    geometry = items[0].shape.geometry
    kind = PurePath(geometry.uri).name if isinstance(geometry, Mesh) else geometry.kind
    return f"{items[0].body}: {kind}" + (f" and {len(items) - 1} more" if len(items) > 1 else "")


_LOG = logging.getLogger("kineverse.planning")

COVERS = KINDS["sphere_covers"].make_cache(_LOG, "The sphere cover %s %s and counts as absent.")
TREES = KINDS["sphere_trees"].make_cache(_LOG, "The sphere tree %s %s and counts as absent.")
"""Covers and trees on the disk."""

# Raise the number when the covers or trees of equal solids and settings change.
_VERSION = 5
_MOST_IN_MEMORY = 4096

_in_memory: OrderedDict[str, SphereCover | SphereTree] = OrderedDict()
_lock = threading.Lock()

Kept = TypeVar("Kept", SphereCover, SphereTree)


@dataclass(frozen=True, slots=True)
class CachedCover:
    """Cover in the cache, with what it covers and the size of its file [bytes]."""

    name: str
    cover: SphereCover
    bytes: int


def cover_key(
    solids: Sequence[tuple[Solid, Floats]], protrusion: float | None, most: int | None = None
) -> str:
    """Return the key of the cover or tree of convex solids at poses (4, 4) [m].

    Settings are the largest protrusion [m] and number of spheres; None for the default.
    """
    settings = (_VERSION, None if protrusion is None else float(protrusion).hex(), most)
    digest = hashlib.sha256(repr(settings).encode())
    for solid, pose in solids:
        digest.update(f" {type(solid.surface).__name__} ".encode() + pose.tobytes())
        if isinstance(solid.surface, Hull):
            assert solid.core is not None
            digest.update(np.ascontiguousarray(solid.core.corners).tobytes())
        else:
            digest.update(repr(solid.surface).encode())
    return digest.hexdigest()[:40]


def find_cover(key: str) -> SphereCover | None:
    """Return the cover of a key, see :func:`cover_key`, from memory or the disk; None if there is none."""
    return _find(COVERS, key, lambda content: _parse_cover(content)[1])


def find_or_make_tree(key: str, make: Callable[[], SphereTree]) -> SphereTree:
    """Return the tree of a key, see :func:`cover_key`, from memory or the disk, or a new one."""
    tree = _find(TREES, key + "t", _parse_tree)
    if tree is None:
        tree = make()
        _remember(key + "t", tree)
        head = {
            "order": tree.order.tolist(),
            "first": tree.first.tolist(),
            "ball": [*tree.ball_centre.tolist(), tree.ball_radius],
            "sizes": [len(tree.radii), len(tree.coarse_radii)],
        }
        spheres = (tree.centres, tree.radii, tree.coarse_centres, tree.coarse_radii)
        TREES.write(key + "t", _pack(head, *spheres))
    return tree


def list_covers() -> list[CachedCover]:
    """Return all covers on the disk, sorted by the name of what they cover."""
    kept = [CachedCover(*named, size) for named, size in COVERS.read_all(_parse_cover)]
    return sorted(kept, key=lambda one: (one.name, len(one.cover), one.cover.protrusion))


def clear_covers() -> int:
    """Remove all covers and trees from memory and from the disk, and return the number of covers."""
    with _lock:
        _in_memory.clear()
    TREES.clear()
    return COVERS.clear()


def cover_folder() -> Path:
    """Return the path of the cache folder."""
    return COVERS.folder.path


def _find(cache: ContentCache, key: str, parse: Callable[[bytes], Kept]) -> Kept | None:
    with _lock:
        if key in _in_memory:
            _in_memory.move_to_end(key)
            return _in_memory[key]  # type: ignore[return-value]
    result = cache.read(key, parse)
    if result is not None:
        _remember(key, result)
    return result


def _remember(key: str, content: SphereCover | SphereTree) -> None:
    with _lock:
        _in_memory[key] = content
        _in_memory.move_to_end(key)
        while len(_in_memory) > _MOST_IN_MEMORY:
            _in_memory.popitem(last=False)


def _pack(head: dict[str, Any], *arrays: Floats) -> bytes:
    """Write a line of JSON and the numbers of arrays; an archive of numpy takes longer to read."""
    return json.dumps(head).encode() + b"\n" + b"".join(array.astype("<f8").tobytes() for array in arrays)


def _unpack(content: bytes) -> tuple[dict[str, Any], list[tuple[Floats, Floats]]]:
    """Read the head that :func:`_pack` wrote, and centres (N, 3) and radii (N,) for each size in it."""
    try:
        line, _, numbers = content.partition(b"\n")
        head = json.loads(line)
        rows = np.frombuffer(numbers, dtype="<f8")
        spheres = []
        for size in head["sizes"]:
            spheres.append((rows[: 3 * size].reshape(size, 3), rows[3 * size : 4 * size]))
            rows = rows[4 * size :]
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError("These are not spheres.") from error
    return head, spheres


def _parse_cover(content: bytes) -> tuple[str, SphereCover]:
    head, ((centres, radii),) = _unpack(content)
    return head["name"], SphereCover(centres, radii, head["protrusion"])


def _parse_tree(content: bytes) -> SphereTree:
    head, ((centres, radii), (coarse_centres, coarse_radii)) = _unpack(content)
    order, first, ball = (np.array(head[name]) for name in ("order", "first", "ball"))
    return SphereTree(centres, radii, order, coarse_centres, coarse_radii, first, ball[:3], float(ball[3]))
