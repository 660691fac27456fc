"""Which part hangs on which: the kinematic graph of parts whose poses were seen (Sturm et al. 2011).

Every pair of parts is identified. Parts that do not move against each other are one rigid body. Bodies are
connected by the tree of largest evidence, where the density of all poses is the product over the tree's
connections of how the child was seen in the parent, as if the latter's place were known. So given the tree,
connections are independent, and the probability of each is its share in the sum over all trees. A pair beside
the tree that moves in fewer ways than the tree lets it closes a loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from kineverse.articulations import Fixed, Floating
from kineverse.errors import ModelError, NameTakenError, ValueRejectedError
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .bodies import RigidBody, rigid_bodies
from .fit import SURE, Fit, Found
from .linkages import Closing, Loop, closed
from .loops import closes_loop
from .operations import rigid_pose
from .pairs import Families, Pair, all_pairs, pair
from .spanning import edge_probabilities, instead, outwards, path, spanning_tree
from .tracks import Poses, Track, exactly, tracks


@dataclass(frozen=True)
class Edge:
    """A joint between two parts.

    Attributes
    ----------
    parent, child
        The parts.
    found
        What was identified between them, see :class:`~kineverse.estimation.Found`.
    times
        The numbers of the observations in which both were seen, those of the joint values.
    probability
        That this joint is there, over all trees of joints; 1 for one that closes a loop.
    others
        The pairs that may be connected while these are not, with their probabilities, if these are not
        negligible.
    closing
        How a loop is closed in a model; None for the joints of the tree, and for a loop that cannot be
        closed, as where coordinates of a ball would have to follow others.
    """

    parent: str
    child: str
    found: Found
    times: npt.NDArray[np.int_]
    probability: float = 1.0
    others: Mapping[tuple[str, str], float] = field(default_factory=dict)
    closing: Closing | None = None

    @property
    def fit(self) -> Fit:
        """The most probable joint, with its covariance and the range that was seen."""
        return self.found.best

    def __str__(self) -> str:
        words = f"{self.parent} -> {self.child}: {self.found}"
        for (a, b), probability in self.others.items():
            words += f"; or {a} -> {b} ({probability:.0%})"
        return words


@dataclass(frozen=True)
class Graph:
    """Bodies and the joints between them.

    Attributes
    ----------
    bodies
        Rigid bodies, each part in one of them.
    edges
        The joints, from the roots outwards: parents first.
    loops
        Pairs beside these that move in fewer ways against each other than the joints between them allow.
    connections
        The probability that there is a joint between two bodies, over all trees, for all pairs that were seen
        together and close no loop, the likeliest first.
    roots
        The parts from which edges go outwards: the world if it was one, and one for every group of parts that
        was never seen together with others.
    """

    bodies: tuple[RigidBody, ...]
    edges: tuple[Edge, ...]
    loops: tuple[Edge, ...]
    roots: tuple[str, ...]
    connections: Mapping[tuple[str, str], float] = field(default_factory=dict)
    points: tuple[str, ...] = ()

    def operations(self, prefix: str | None = None, close: bool = True) -> Iterator[Operation]:
        """Yield what builds the model, parents first: joints are called like their child.

        A loop between ``a`` and ``b`` has the frames ``b/a/seat``, on a, and ``b/a/pin``, on b, and is called
        ``b/a/loop``.

        Parameters
        ----------
        prefix
            Put in front of all names but the world's, with a slash.
        close
            Whether loops are closed; else their tree is all there is.

        Raises
        ------
        ModelError
            For a loop whose coordinates cannot follow others, as those of a ball in its tree.
        """

        def name(part: str) -> str:
            return part if prefix is None or part == WORLD else f"{prefix}/{part}"

        for root in self.roots:
            if root != WORLD:
                yield Floating(name=name(root), parent=WORLD, child=name(root))
        placed = {edge.child: edge for edge in self.edges}
        ordered = [*self.roots, *placed]
        for first in ordered:
            if first in placed:
                edge = placed[first]
                yield edge.fit.operation(name(first), name(edge.parent), as_point=first in self.points)
            body = next(b for b in self.bodies if b.parts[0] == first)
            for part in body.parts[1:]:
                origin = rigid_pose(body.places[part])
                yield Fixed(name=name(part), parent=name(first), child=name(part), origin=origin)
        for loop in self.loops if close else ():
            if loop.closing is None:
                raise ModelError(
                    f"The loop of '{loop.parent}' and '{loop.child}' cannot be closed: it has coordinates "
                    "that cannot follow others, as those of a ball, or it is a screw that would close it. "
                    "Say close=False for a model in which it is open."
                )
            yield from loop.closing.operations(name)

    def model(self, prefix: str | None = None, close: bool = True) -> Model:
        """Return a model with a frame for each part.

        Parameters
        ----------
        prefix
            Put in front of all names but the world's, with a slash.
        close
            Whether loops are closed; else their tree is all there is.

        Raises
        ------
        ModelError, UnsolvedError
            For a loop whose coordinates cannot follow others, and for one that does not close or is singular
            where it was seen.
        """
        model = Model()
        with model.edit() as edit:
            for operation in self.operations(prefix, close):
                edit.apply(operation)
        return model

    def __str__(self) -> str:
        lines = [f"rigid: {body}" for body in self.bodies if len(body.parts) > 1]
        lines += [str(edge) for edge in self.edges]
        lines += [f"loop: {edge}" for edge in self.loops]
        lines += [f"{root} is connected to nothing" for root in self.roots[1:]]
        return "\n".join(lines)


def identify_graph(
    poses: Mapping[str, Poses],
    *,
    noise: npt.ArrayLike | None = None,
    world: bool = True,
    families: Families = None,
    progress: Callable[[int, int], object] | None = None,
) -> Graph:
    """Return which part hangs on which, and how.

    N parts have N (N - 1) / 2 pairs, or N (N + 1) / 2 with the world, and each is identified.

    Parameters
    ----------
    poses
        From names of parts to their poses over time, all in one frame: (N, 4, 4), or pairs of poses and
        covariance, (6, 6) or (N, 6, 6). A pose that was not seen is NaN throughout. Of a part that was only
        seen as a point, positions, (N, 3), with (3, 3) or (N, 3, 3).
    noise
        The covariance, (6, 6), of those that come with none, see :mod:`kineverse.estimation.noise`.
    world
        Whether the frame of the poses is the world: then it is a part as well, which is exactly known. False
        for an observer that moves.
    families
        What is tried for each pair, see :func:`~kineverse.estimation.identify`.
    progress
        Called with the number of pairs that are done and that of all.

    Raises
    ------
    ShapeError, ValueRejectedError
        For poses or covariances that are none, less than two parts, if all of them are points, and if it is
        not known how well a part is seen.
    NameTakenError
        For a part that is called ``world`` beside the world.
    UnknownNameError
        For a family that does not exist.
    """
    seen = tracks(poses, noise, points=True)
    if world:
        if WORLD in seen:
            raise NameTakenError("The world is a part already; call the part otherwise, or say world=False.")
        seen = {WORLD: exactly(max((len(t.poses) for t in seen.values()), default=0)), **seen}
    if len(seen) < 2:
        raise ValueRejectedError("How parts are connected takes at least two of them, or one and the world.")
    if all(track.is_point for track in seen.values()):
        raise ValueRejectedError(
            "Only positions were seen, of all parts. What a part hangs on has to be seen as a pose, "
            "(N, 4, 4); the world is one, unless world=False."
        )
    pairs = all_pairs(seen, families, progress)
    bodies = rigid_bodies(seen, pairs)
    firsts = [body.parts[0] for body in bodies]
    between = {c: p for c, p in pairs.items() if c <= set(firsts)}
    points = {name for name, track in seen.items() if track.is_point}
    tree = spanning_tree(firsts, {c: p.gain for c, p in between.items()}, points)
    # From the world, or from what most parts hang on, but never from a point.
    first = sorted(firsts, key=lambda n: (n != WORLD, n in points, -sum(n in c for c in tree)))
    roots, directed = outwards(first, firsts, tree)
    joints = [_towards(between[frozenset(ends)], ends[0], seen, families) for ends in directed]
    loops = _loops({c: p for c, p in between.items() if not c & points}, joints)
    # What closes a loop is there beside the tree, not in place of a part of it.
    gains = {c: p.gain for c, p in between.items() if c not in loops}
    likely = edge_probabilities(firsts, gains, points)
    edges = []
    for joint in joints:
        connection = frozenset((joint.parent, joint.child))
        others = {}
        if likely[connection] < SURE:
            found = instead(connection, tree, gains, points)
            others = {(between[c].parent, between[c].child): p for c, p in found.items() if p > 1.0 - SURE}
        edges.append(Edge(joint.parent, joint.child, joint.found, joint.times, likely[connection], others))
    ordered = sorted(likely.items(), key=lambda pair: -pair[1])
    connections = {(between[c].parent, between[c].child): p for c, p in ordered}
    of_points = tuple(name for name in seen if name in points)
    return Graph(bodies, tuple(edges), tuple(loops.values()), roots, connections, of_points)


def _towards(known: Pair, parent: str, seen: Mapping[str, Track], families: Families) -> Pair:
    """Return a pair seen from its other end, if need be."""
    if known.parent == parent:
        return known
    turned = pair(seen, known.child, known.parent, families)
    return known if turned is None else turned


def _loops(between: Mapping[frozenset[str], Pair], joints: Sequence[Pair]) -> dict[frozenset[str], Edge]:
    """Return what closes loops of a tree, by its ends."""
    tree = {frozenset((joint.parent, joint.child)): joint for joint in joints}
    candidates = []
    for connection, known in between.items():
        way = [tree[frozenset(ends)] for ends in pairwise(path(tree, known.parent, known.child))]
        if connection not in tree and way and closes_loop(known, way):
            candidates.append(Loop(known, way))
    found = {}
    for (joint, _), closing in closed(candidates, joints):
        edge = Edge(joint.parent, joint.child, joint.found, joint.times, closing=closing)
        found[frozenset((joint.parent, joint.child))] = edge
    return found
