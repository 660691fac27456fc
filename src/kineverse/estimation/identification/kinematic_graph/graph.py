"""Rigid bodies, joints between them, and identification of the kinematic graph.

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
from kineverse.errors import DuplicateNameError, InvalidValueError, ModelError
from kineverse.estimation.identification.found_operations import rigid_pose
from kineverse.estimation.identification.observations import PosesLike, PoseTrack, check_tracks, exact_track
from kineverse.estimation.identification.result import SURE, Fit, IdentificationResult
from kineverse.lie import Array, inverse
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .loop_closures import LoopClosure, ObservedLoop, close_loops
from .loop_mobility import closes_loop
from .pairwise import FamilyChoice, PartPair, identify_pair, identify_pairs
from .spanning_trees import (
    edge_probabilities,
    orient_tree,
    replacement_probabilities,
    spanning_tree,
    tree_path,
)


@dataclass(frozen=True)
class RigidBody:
    """Parts that do not move against each other.

    Attributes
    ----------
    parts
        The first stands for all of them in edges.
    places
        Their poses in the first, (4, 4), by name.
    probability
        That they are one.
    """

    parts: tuple[str, ...]
    poses: Mapping[str, Array]
    probability: float = 1.0

    def __str__(self) -> str:
        words = " = ".join(self.parts)
        return words if self.probability >= SURE else f"{words} ({self.probability:.0%})"


def find_rigid_bodies(
    tracks: Mapping[str, PoseTrack], pairs: Mapping[frozenset[str], PartPair]
) -> tuple[RigidBody, ...]:
    """Return rigid bodies: parts join while more speaks for it than against it over all pairs."""
    group: dict[str, tuple[str, ...]] = {name: (name,) for name in tracks}
    surest = dict.fromkeys(tracks, 1.0)
    for joined in sorted(pairs.values(), key=lambda p: -p.log_odds_rigid):
        a, b = group[joined.parent], group[joined.child]
        if a == b or joined.log_odds_rigid <= 0.0:
            continue
        across = [pairs[frozenset((x, y))] for x in a for y in b if frozenset((x, y)) in pairs]
        odds = sum(p.log_odds_rigid for p in across)
        if odds <= 0.0:
            continue
        least = min(joined.result["rigid"].probability, surest[a[0]], surest[b[0]])
        for name in (*a, *b):
            group[name], surest[name] = (*a, *b), least
    result = []
    for parts in dict.fromkeys(group.values()):
        # What was seen most often stands for all, unless it is a point, and the world before everything.
        often = {p: (p == WORLD, not tracks[p].is_point, int(tracks[p].seen.sum())) for p in parts}
        ordered = sorted(parts, key=lambda p: (*(-n for n in often[p]), list(tracks).index(p)))
        places = _poses_in_first(ordered, pairs, {p for p in parts if tracks[p].is_point})
        result.append(RigidBody(tuple(ordered), places, surest[parts[0]]))
    return tuple(result)


def _poses_in_first(
    parts: list[str], pairs: Mapping[frozenset[str], PartPair], points: set[str]
) -> dict[str, Array]:
    """Return the poses of parts in the first, along the pairs that are surest to be rigid."""
    places = {parts[0]: np.eye(4)}
    rigid = {c: p.log_odds_rigid for c, p in pairs.items() if c <= set(parts)}
    tree = spanning_tree(parts, rigid, points)
    for part in parts[1:]:
        place = np.eye(4)
        for a, b in pairwise(tree_path(tree, parts[0], part)):
            known = pairs[frozenset((a, b))]
            reference = np.asarray(known.result["rigid"].parameters["reference"])
            place = place @ (reference if known.parent == a else inverse(reference))
        places[part] = place
    return places


@dataclass(frozen=True)
class KinematicEdge:
    """A joint between two parts.

    Attributes
    ----------
    parent, child
        The parts.
    found
        What was identified between them, see :class:`~kineverse.estimation.IdentificationResult`.
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
    result: IdentificationResult
    times: npt.NDArray[np.int_]
    probability: float = 1.0
    alternatives: Mapping[tuple[str, str], float] = field(default_factory=dict)
    closure: LoopClosure | None = None

    @property
    def fit(self) -> Fit:
        """The most probable joint, with its covariance and the range that was seen."""
        return self.result.best

    def __str__(self) -> str:
        words = f"{self.parent} -> {self.child}: {self.result}"
        for (a, b), probability in self.alternatives.items():
            words += f"; or {a} -> {b} ({probability:.0%})"
        return words


@dataclass(frozen=True)
class KinematicGraph:
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
    edges: tuple[KinematicEdge, ...]
    loops: tuple[KinematicEdge, ...]
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
                origin = rigid_pose(body.poses[part])
                yield Fixed(name=name(part), parent=name(first), child=name(part), origin=origin)
        for loop in self.loops if close else ():
            if loop.closure is None:
                raise ModelError(
                    f"The loop of '{loop.parent}' and '{loop.child}' cannot be closed: it has coordinates "
                    "that cannot follow others, as those of a ball, or it is a screw that would close it. "
                    "Say close=False for a model in which it is open."
                )
            yield from loop.closure.operations(name)

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
        ModelError, NoSolutionError
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
    poses: Mapping[str, PosesLike],
    *,
    noise: npt.ArrayLike | None = None,
    world: bool = True,
    families: FamilyChoice = None,
    progress: Callable[[int, int], object] | None = None,
) -> KinematicGraph:
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
    ShapeError, InvalidValueError
        For poses or covariances that are none, less than two parts, if all of them are points, and if it is
        not known how well a part is seen.
    DuplicateNameError
        For a part that is called ``world`` beside the world.
    UnknownNameError
        For a family that does not exist.
    """
    tracks = check_tracks(poses, noise, points=True)
    if world:
        if WORLD in tracks:
            raise DuplicateNameError(
                "The world is a part already; call the part otherwise, or say world=False."
            )
        tracks = {WORLD: exact_track(max((len(t.poses) for t in tracks.values()), default=0)), **tracks}
    if len(tracks) < 2:
        raise InvalidValueError("How parts are connected takes at least two of them, or one and the world.")
    if all(track.is_point for track in tracks.values()):
        raise InvalidValueError(
            "Only positions were seen, of all parts. What a part hangs on has to be seen as a pose, "
            "(N, 4, 4); the world is one, unless world=False."
        )
    pairs = identify_pairs(tracks, families, progress)
    bodies = find_rigid_bodies(tracks, pairs)
    firsts = [body.parts[0] for body in bodies]
    between = {c: p for c, p in pairs.items() if c <= set(firsts)}
    points = {name for name, track in tracks.items() if track.is_point}
    tree = spanning_tree(firsts, {c: p.gain for c, p in between.items()}, points)
    # From the world, or from what most parts hang on, but never from a point.
    first = sorted(firsts, key=lambda n: (n != WORLD, n in points, -sum(n in c for c in tree)))
    roots, directed = orient_tree(first, firsts, tree)
    joints = [_orient_pair(between[frozenset(ends)], ends[0], tracks, families) for ends in directed]
    loops = _find_loops({c: p for c, p in between.items() if not c & points}, joints)
    # What closes a loop is there beside the tree, not in place of a part of it.
    gains = {c: p.gain for c, p in between.items() if c not in loops}
    likely = edge_probabilities(firsts, gains, points)
    edges = []
    for joint in joints:
        connection = frozenset((joint.parent, joint.child))
        others = {}
        if likely[connection] < SURE:
            found = replacement_probabilities(connection, tree, gains, points)
            others = {(between[c].parent, between[c].child): p for c, p in found.items() if p > 1.0 - SURE}
        edges.append(
            KinematicEdge(joint.parent, joint.child, joint.result, joint.times, likely[connection], others)
        )
    ordered = sorted(likely.items(), key=lambda pair: -pair[1])
    connections = {(between[c].parent, between[c].child): p for c, p in ordered}
    of_points = tuple(name for name in tracks if name in points)
    return KinematicGraph(bodies, tuple(edges), tuple(loops.values()), roots, connections, of_points)


def _orient_pair(
    known: PartPair, parent: str, tracks: Mapping[str, PoseTrack], families: FamilyChoice
) -> PartPair:
    """Return a pair seen from its other end, if need be."""
    if known.parent == parent:
        return known
    turned = identify_pair(tracks, known.child, known.parent, families)
    return known if turned is None else turned


def _find_loops(
    between: Mapping[frozenset[str], PartPair], joints: Sequence[PartPair]
) -> dict[frozenset[str], KinematicEdge]:
    """Return what closes loops of a tree, by its ends."""
    tree = {frozenset((joint.parent, joint.child)): joint for joint in joints}
    candidates = []
    for connection, known in between.items():
        way = [tree[frozenset(ends)] for ends in pairwise(tree_path(tree, known.parent, known.child))]
        if connection not in tree and way and closes_loop(known, way):
            candidates.append(ObservedLoop(known, way))
    found = {}
    for (joint, _), closure in close_loops(candidates, joints):
        edge = KinematicEdge(joint.parent, joint.child, joint.result, joint.times, closure=closure)
        found[frozenset((joint.parent, joint.child))] = edge
    return found
