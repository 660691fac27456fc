"""Rigid bodies, joints between them, and identification of the kinematic graph.

Every pair of parts is identified. Parts without relative motion form a rigid body. Bodies are connected by
the spanning tree of largest evidence. The density of all poses is a product over the connections of the tree:
that of the child in the parent, as if the parent's pose were known. So the connections are independent given
the tree, and the probability of each is its share in the sum over all trees. A pair outside the tree closes a
loop if its mobility is lower than that of the path in the tree.
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
from kineverse.estimation.linear_algebra import singularity_named
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
    """Set of parts without relative motion.

    Attributes
    ----------
    parts
        Names of the parts. The first represents the body in edges.
    poses
        Poses of the parts in the first, (4, 4), by name.
    probability
        Probability that the parts form one body.
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
    """Return the rigid bodies, merged while the sum of log odds over all pairs across is positive."""
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
        # The world represents its body, else the part that was observed most often, points last.
        often = {p: (p == WORLD, not tracks[p].is_point, int(tracks[p].seen.sum())) for p in parts}
        ordered = sorted(parts, key=lambda p: (*(-n for n in often[p]), list(tracks).index(p)))
        places = _poses_in_first(ordered, pairs, {p for p in parts if tracks[p].is_point})
        result.append(RigidBody(tuple(ordered), places, surest[parts[0]]))
    return tuple(result)


def _poses_in_first(
    parts: list[str], pairs: Mapping[frozenset[str], PartPair], points: set[str]
) -> dict[str, Array]:
    """Return the poses of parts in the first, along the pairs with the largest odds of being rigid."""
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
    """Joint between two parts.

    Attributes
    ----------
    parent, child
        Names of the parts.
    result
        Identification result, see :class:`~kineverse.estimation.IdentificationResult`.
    times
        Indices of the observations of both parts, which are those of the joint values.
    probability
        Probability of this connection over all trees; 1 for a joint that closes a loop.
    alternatives
        Pairs that may be connected instead, with probabilities that are not negligible.
    closure
        Closure of a loop in a model. None for the joints of the tree, and for a loop that cannot be closed,
        such as one with dependent coordinates of a ball.
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
        """Most probable joint, with its covariance and the observed range."""
        return self.result.best

    def __str__(self) -> str:
        words = f"{self.parent} -> {self.child}: {self.result}"
        for (a, b), probability in self.alternatives.items():
            words += f"; or {a} -> {b} ({probability:.0%})"
        return words


@dataclass(frozen=True)
class KinematicGraph:
    """Rigid bodies and the joints between them.

    Attributes
    ----------
    bodies
        Rigid bodies. Each part is in one of them.
    edges
        Joints of the spanning tree, parents first.
    loops
        Joints outside the tree that close loops.
    roots
        Roots of the tree: the world if it is a part, and one for each group of parts that was never observed
        together with the others.
    connections
        Probability of a joint between two bodies, over all trees, the largest first. Pairs that close a loop
        or were never observed together are left out.
    points
        Parts that were observed as points.
    """

    bodies: tuple[RigidBody, ...]
    edges: tuple[KinematicEdge, ...]
    loops: tuple[KinematicEdge, ...]
    roots: tuple[str, ...]
    connections: Mapping[tuple[str, str], float] = field(default_factory=dict)
    points: tuple[str, ...] = ()

    def operations(self, prefix: str | None = None, close: bool = True) -> Iterator[Operation]:
        """Yield the operations that build the model, parents first. Joints are named like their child.

        A loop between ``a`` and ``b`` has the frames ``b/a/seat`` on a, ``b/a/pin`` on b, and the name
        ``b/a/loop``.

        Parameters
        ----------
        prefix
            Prefix of all names except ``world``, separated by a slash.
        close
            True to close loops; False for the tree alone.

        Raises
        ------
        ModelError
            For a loop that cannot be closed, such as one with a ball in its tree.
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
        """Build a model with a frame for each part.

        Parameters
        ----------
        prefix
            Prefix of all names except ``world``, separated by a slash.
        close
            True to close loops; False for the tree alone.

        Raises
        ------
        ModelError, NoSolutionError
            For a loop that cannot be closed, does not close, or is singular at the observed configurations.
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


@singularity_named()
def identify_graph(
    poses: Mapping[str, PosesLike],
    *,
    noise: npt.ArrayLike | None = None,
    world: bool = True,
    families: FamilyChoice = None,
    progress: Callable[[int, int], object] | None = None,
) -> KinematicGraph:
    """Identify the kinematic graph of several parts from noisy poses (Sturm et al. 2011).

    N parts have N (N - 1) / 2 pairs, or N (N + 1) / 2 with the world. Each pair is identified.

    Parameters
    ----------
    poses
        Poses over time by name of the part, all in one frame: (N, 4, 4), or pairs of poses and covariance,
        (6, 6) or (N, 6, 6). A pose of NaN only is a gap. For a part observed as a point, positions (N, 3)
        with (3, 3) or (N, 3, 3).
    noise
        Covariance, (6, 6), of parts that have none of their own, see :mod:`kineverse.estimation.noise`.
    world
        True if the frame of the poses is the world. The world is then a part, too, with an exact pose. False
        for a moving observer.
    families
        Families to compare for each pair, see :func:`~kineverse.estimation.identify`.
    progress
        Callback with the number of finished pairs and the number of all pairs.

    Raises
    ------
    ShapeError, InvalidValueError
        For invalid poses or covariances, fewer than two parts, points only, and a part without covariance.
    DuplicateNameError
        For a part named ``world`` in addition to the world.
    UnknownNameError
        For an unknown family.
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
    # The root is the world, else the part with the most connections, and never a point.
    first = sorted(firsts, key=lambda n: (n != WORLD, n in points, -sum(n in c for c in tree)))
    roots, directed = orient_tree(first, firsts, tree)
    joints = [_orient_pair(between[frozenset(ends)], ends[0], tracks, families) for ends in directed]
    loops = _find_loops({c: p for c, p in between.items() if not c & points}, joints)
    # A joint that closes a loop is no alternative to a joint of the tree.
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
    """Return a pair with the given parent, identified again in the other direction if necessary."""
    if known.parent == parent:
        return known
    turned = identify_pair(tracks, known.child, known.parent, families)
    return known if turned is None else turned


def _find_loops(
    between: Mapping[frozenset[str], PartPair], joints: Sequence[PartPair]
) -> dict[frozenset[str], KinematicEdge]:
    """Return the joints that close loops of a tree, by their two parts."""
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
