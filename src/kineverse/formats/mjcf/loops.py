"""Closed loops as operations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from kineverse.formats.poses import IDENTITY
from kineverse.formats.ways import way_between
from kineverse.loops.operation import AXES, CloseLoop
from kineverse.model.edit import AddFrame
from kineverse.model.frame import Frame
from kineverse.model.operation import Operation
from kineverse.symbols import symbol_name

from .description import SUFFIXES, WORLD, Closure, Joint, Scene
from .following import Followers

Named = Callable[[str], str]


def loop_operations(scene: Scene, named: Named, followers: Followers) -> Iterator[Operation]:
    """Yield the operations that close the loops of a scene, in the order of the file."""
    parents = {link.name: link.parent for link in scene.links if link.name != WORLD}
    parents |= {site.name: site.parent for site in scene.sites}
    joints = {link.name: link.joints for link in scene.links}
    by_name = {joint.name: joint for link in scene.links for joint in link.joints}
    tied: set[str] = set()
    for closure in scene.closures:
        if closure.dependent is not None:
            inside_it = [by_name[name] for name in (*closure.free, *closure.dependent)]
            yield from _closure(closure, named, [v for joint in inside_it for v in _at_home(joint, named)])
            tied |= {joint.name for joint in inside_it}
            continue
        inside: dict[str, Joint] = {}
        for link in way_between(closure.first, closure.second, parents):
            for joint in joints.get(link, ()):
                name: str | None = joint.name
                while name is not None and name in followers:
                    name = followers.leaders[name]
                if name is not None:
                    inside[name] = by_name[name]
        # What an earlier loop determines is none of this one's coordinates.
        rest = [v for name, joint in inside.items() if name not in tied for v in _rest(joint, named)]
        tied |= inside.keys()
        yield from _closure(closure, named, rest)


def _closure(closure: Closure, named: Named, home: Iterable[tuple[str, float]]) -> Iterator[Operation]:
    name, follow = named(closure.name), closure.dependent
    pairs: list[list[str]] = []
    for k, part in enumerate((closure, *closure.more)):
        pairs.append([])
        for suffix, frame, pose in (
            ("first", part.first, part.in_first),
            ("second", part.second, part.in_second),
        ):
            end = named(frame)
            if pose is not IDENTITY:
                end = f"{name}/{k}/{suffix}" if k else f"{name}/{suffix}"
                yield AddFrame(end, Frame(named(frame), (pose,)))
            pairs[-1].append(end)
    (frame, to), *more = pairs
    # If nothing is said, the coordinates on the way to the first end come first, and so stay free.
    yield CloseLoop(
        name=name,
        frame=frame,
        to=to,
        more=tuple((one, other) for one, other in more),
        mask=AXES[:3] if closure.kind == "connect" else AXES,
        dependent=None if follow is None else tuple(symbol_name(named(joint), 0) for joint in follow),
        home=tuple(home),
    )


def _at_home(joint: Joint, named: Named) -> Iterator[tuple[str, float]]:
    """Yield the coordinates of a joint at home, where a loop that was written here is closed."""
    suffixes = SUFFIXES[joint.kind] or ("",)
    for suffix, value in zip(suffixes, joint.home, strict=False):  # what something holds has no home
        yield symbol_name(f"{named(joint.name)}/{suffix}".rstrip("/"), 0), value


def _rest(joint: Joint, named: Named) -> Iterator[tuple[str, float]]:
    """Yield the coordinates of a joint that are not zero at rest, where its equalities hold."""
    if joint.kind in ("ball", "free"):
        yield symbol_name(f"{named(joint.name)}/qw", 0), 1.0
    elif joint.reference:
        yield symbol_name(named(joint.name), 0), joint.reference
