"""Free bodies attached to the links that hold them by a weld or connect equality.

A loop through a free joint would have a dependent quaternion. But a held body has no position of its own: as
a child of the link that holds it, it needs no loop equations.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from kineverse.formats.description import DisjointSets
from kineverse.formats.poses import IDENTITY, compose_poses, invert_pose, pose_from_rpy
from kineverse.model.body import Pose

from .description import WORLD, MjcfClosure, MjcfLink, MjcfScene


def attach_held_bodies(scene: MjcfScene) -> MjcfScene:
    """Return a description with held free bodies as children of the links that hold them.

    A body is attached if the end of the equality is rigidly connected to it, if no other equality holds it,
    and if the file does not state the dependent joints itself. The links are ordered from the world outwards.
    """
    if not scene.closures:
        return scene
    held_bodies = _HeldBodies(scene)
    closures = tuple(c for c in scene.closures if c.dependent is not None or not held_bodies.attach(c))
    return replace(scene, links=_outwards(held_bodies.links.values()), closures=closures)


def compute_rest_poses(links: Iterable[MjcfLink]) -> dict[str, Pose]:
    """Return the poses of all bodies in the world while all joints are at their references."""
    poses: dict[str, Pose] = {}
    for link in links:
        poses[link.name] = compose_poses(poses[link.parent], link.pose) if link.name != WORLD else IDENTITY
    return poses


class _HeldBodies:
    """Links of a description, of which free ones are attached to others one by one."""

    def __init__(self, scene: MjcfScene) -> None:
        self.links = {link.name: link for link in scene.links}
        self._sites = {site.name: site for site in scene.sites}
        self._rest = compute_rest_poses(scene.links)
        self._groups = DisjointSets()
        self._tops: dict[str, str] = {WORLD: WORLD}
        for link in scene.links:
            if link.name != WORLD:
                free = link.parent == WORLD and _is_free(link)
                self._tops[link.name] = link.name if free else self._tops[link.parent]

    def attach(self, closure: MjcfClosure) -> bool:
        """Attach a free body at one end of an equality to the other end; return False if there is none."""
        first = self._on_link(closure.first, closure.in_first)
        second = self._on_link(closure.second, closure.in_second)
        return self._attach_to(closure, first, second) or self._attach_to(closure, second, first)

    def _on_link(self, frame: str, pose: Pose) -> tuple[str, Pose]:
        site = self._sites.get(frame)
        return (frame, pose) if site is None else (site.parent, compose_poses(site.pose, pose))

    def _attach_to(self, closure: MjcfClosure, holder: tuple[str, Pose], held: tuple[str, Pose]) -> bool:
        name, end = held
        while not self.links[name].joints and name != WORLD:
            end, name = compose_poses(self.links[name].pose, end), self.links[name].parent
        link, (parent, parent_end) = self.links[name], holder
        if not _is_free(link) or not self._groups.union(self._tops[parent], name):
            return False
        if closure.kind == "weld":
            pose = compose_poses(parent_end, invert_pose(end))
            self.links[name] = replace(link, parent=parent, pose=pose, joints=())
            return True
        # At rest, the body has its orientation in the file, and the two ends coincide.
        rows = compose_poses(invert_pose(self._rest[parent]), self._rest[name]).rows
        rotation = Pose((*rows[:3], 0.0, *rows[4:7], 0.0, *rows[8:11], 0.0))
        rotated_end = compose_poses(rotation, end)
        x, y, z = (p - q for p, q in zip(parent_end.rows[3::4], rotated_end.rows[3::4], strict=True))
        anchor = end.rows[3], end.rows[7], end.rows[11]
        ball = replace(link.joints[0], kind="ball", anchor=anchor, home=())
        pose = compose_poses(pose_from_rpy((x, y, z), (0.0, 0.0, 0.0)), rotation)
        self.links[name] = replace(link, parent=parent, pose=pose, joints=(ball,))
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
    stack = world
    while stack:
        link = stack.pop()
        ordered.append(link)
        stack.extend(reversed(below.get(link.name, ())))
    return tuple(ordered)
