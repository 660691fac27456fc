"""Free bodies attached to the links that hold them by a weld or connect equality.

Closing a loop through a free joint would make a quaternion follow. But such a body has no place of its own:
it hangs below what holds it, and nothing is to be solved.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from kineverse.formats.poses import IDENTITY, compose_poses, invert_pose
from kineverse.formats.tree import DisjointSets
from kineverse.model.body import Pose

from .description import WORLD, MjcfClosure, MjcfLink, MjcfScene


def attach_held_bodies(scene: MjcfScene) -> MjcfScene:
    """Return a description in which free bodies hang below what an equality ties them to.

    Only where the end of the equality is rigidly connected to the free body, no other holds it already, and
    the file does not say itself who follows. The links are in the order from the world outwards again.
    """
    if not scene.closures:
        return scene
    holding = _HeldBodies(scene)
    closures = tuple(c for c in scene.closures if c.dependent is not None or not holding.take(c))
    return replace(scene, links=_outwards(holding.links.values()), closures=closures)


def compute_rest_poses(links: Iterable[MjcfLink]) -> dict[str, Pose]:
    """Return where all bodies are in the world while no joint has moved."""
    poses: dict[str, Pose] = {}
    for link in links:
        poses[link.name] = compose_poses(poses[link.parent], link.pose) if link.name != WORLD else IDENTITY
    return poses


class _HeldBodies:
    def __init__(self, scene: MjcfScene) -> None:
        self.links = {link.name: link for link in scene.links}
        self._sites = {site.name: site for site in scene.sites}
        self._rest = compute_rest_poses(scene.links)
        self._together = DisjointSets()
        self._tops: dict[str, str] = {WORLD: WORLD}
        for link in scene.links:
            if link.name != WORLD:
                free = link.parent == WORLD and _is_free(link)
                self._tops[link.name] = link.name if free else self._tops[link.parent]

    def take(self, closure: MjcfClosure) -> bool:
        """Hang a free body below what an equality ties it to; return whether that is possible."""
        first = self._on_link(closure.first, closure.in_first)
        second = self._on_link(closure.second, closure.in_second)
        return self._hang(closure, first, second) or self._hang(closure, second, first)

    def _on_link(self, frame: str, inside: Pose) -> tuple[str, Pose]:
        site = self._sites.get(frame)
        return (frame, inside) if site is None else (site.parent, compose_poses(site.pose, inside))

    def _hang(self, closure: MjcfClosure, holder: tuple[str, Pose], held: tuple[str, Pose]) -> bool:
        name, end = held
        while not self.links[name].joints and name != WORLD:
            end, name = compose_poses(self.links[name].pose, end), self.links[name].parent
        link, (by, at) = self.links[name], holder
        if not _is_free(link) or not self._together.union(self._tops[by], name):
            return False
        if closure.kind == "weld":
            self.links[name] = replace(link, parent=by, pose=compose_poses(at, invert_pose(end)), joints=())
            return True
        # At rest it is turned as in the file, and its end is where the other one is.
        rows = compose_poses(invert_pose(self._rest[by]), self._rest[name]).rows
        turn = Pose((*rows[:3], 0.0, *rows[4:7], 0.0, *rows[8:11], 0.0))
        x, y, z = (p - q for p, q in zip(at.rows[3::4], compose_poses(turn, end).rows[3::4], strict=True))
        anchor = end.rows[3], end.rows[7], end.rows[11]
        ball = replace(link.joints[0], kind="ball", anchor=anchor, home=())
        moved = compose_poses(Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z)), turn)
        self.links[name] = replace(link, parent=by, pose=moved, joints=(ball,))
        return True


def _is_free(link: MjcfLink) -> bool:
    return any(joint.kind == "free" for joint in link.joints)


def _outwards(links: Iterable[MjcfLink]) -> tuple[MjcfLink, ...]:
    below: dict[str, list[MjcfLink]] = {}
    world = []
    for link in links:
        if link.name == WORLD:
            world.append(link)
        else:
            below.setdefault(link.parent, []).append(link)
    ordered: list[MjcfLink] = []
    ahead = world
    while ahead:
        link = ahead.pop()
        ordered.append(link)
        ahead.extend(reversed(below.get(link.name, ())))
    return tuple(ordered)
