"""Kinematic graph: rigid bodies, joints between them, and its maximum spanning tree."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from kineverse._rich_display import TableDisplay, html_table
from kineverse.articulations import Fixed, Floating
from kineverse.errors import DuplicateNameError, InvalidValueError, ModelError
from kineverse.estimation.identification.curve import CURVE
from kineverse.estimation.identification.families import Family
from kineverse.estimation.identification.joint_identification import family_weights
from kineverse.estimation.identification.joint_operations import rigid_pose
from kineverse.estimation.identification.model_check import without_curve
from kineverse.estimation.identification.model_selection import (
    prepare_data,
    solve_with_inliers,
    weigh_families,
)
from kineverse.estimation.identification.observations import (
    Observations,
    PosesLike,
    PoseTrack,
    check_tracks,
    exact_track,
    pair_tracks,
)
from kineverse.estimation.identification.result import SURE, Fit, IdentificationResult
from kineverse.estimation.linear_algebra import singularity_named, squared_errors
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array, inverse, skew
from kineverse.model.display import count_values
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .loop_closures import LoopClosure, ObservedLoop, close_loops, closes_loop

FamilyChoice = Iterable[str] | Mapping[str, float] | None

_LOG_ROTATION = -math.log(8.0 * math.pi**2)

LOG_ANYWHERE = _LOG_ROTATION - 3.0 * math.log(2.0)
"""Log density of a uniform pose within 2 m [1/m³]. The volume of all rotations is 8π²."""

# Log density of a uniform position within a room of 10 m.
_LOG_ROOM = -3.0 * math.log(10.0)
_TINY = 1e-300

SURPRISE_DEVIATIONS = 4.0  # largest deviation of χ² from its mean that noise explains, in standard deviations


@dataclass(frozen=True)
class PartPair:
    """Joint identified between two parts that were observed together."""

    parent: str
    child: str
    result: IdentificationResult
    times: npt.NDArray[np.int_]  # indices of the observations of both parts
    gain: float  # log evidence of a connection against none
    is_consistent: bool  # True if the residuals are as large as the noise

    @property
    def log_odds_rigid(self) -> float:
        """Log odds of one rigid body against the most probable other family."""
        probabilities = self.result.probabilities
        rigid = probabilities.pop("rigid", 0.0)
        return math.log(max(rigid, _TINY)) - math.log(max(max(probabilities.values(), default=0.0), _TINY))


def identify_pair(
    tracks: Mapping[str, PoseTrack], parent: str, child: str, families: FamilyChoice
) -> PartPair | None:
    """Identify the joint between two parts, a point as the child; None without two common observations."""
    if tracks[parent].is_point:
        parent, child = child, parent
    a, b = tracks[parent], tracks[child]
    if a.is_point:
        return None
    times = np.flatnonzero(a.observed & b.observed)
    if len(times) < 2:
        return None
    observations = pair_tracks(a, b, times)
    result = identify_observations(observations, families)
    weights = {str(getattr(f, "name", f)): w for f, w in _joint_weights(families).items()}
    best = result.best
    log = best.log_evidence + math.log(weights[best.family] / best.probability / sum(weights.values()))
    relative, of_child = _relative_covariances(observations, best)
    squares = float(squared_errors(best.residuals, relative).sum())
    expected = max(best.residuals.size - best.joint_values.size - len(best.covariance), 1)
    explained = abs(squares - expected) < SURPRISE_DEVIATIONS * math.sqrt(2.0 * expected)
    if explained:
        # The realised size of the noise must not favour another connection.
        log += 0.5 * (squares - expected)
    if a.covariances is not None:
        # The noise of the parent must not favour a connection to the world, which is exact.
        log += _log_volume(relative, best) - _log_volume(of_child, best)
    rotation = 0.0 if b.is_point else _LOG_ROTATION
    log += LOG_ANYWHERE - _LOG_ROTATION + rotation - len(times) * (_LOG_ROOM + rotation)
    return PartPair(parent, child, result, times, log, explained)


def _relative_covariances(observations: Observations, fit: Fit) -> tuple[Array, Array]:
    """Return the covariances of observed relative and of child's poses, in the parent's axes, (N, m, m)."""
    rows, turn = observations.rows, np.zeros((len(observations), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(observations.parent[:, :3, :3], 1, 2)
    of_child = turn[:, :rows, :rows]
    child = of_child @ observations.child_covariance @ np.swapaxes(of_child, 1, 2)
    if observations.parent_covariance is None:
        return child, child
    lever = np.tile(np.eye(6), (len(observations), 1, 1))
    lever[:, :3, 3:] = -skew(fit.poses[:, :3, 3])
    carried = lever[:, :rows] @ turn
    return child + carried @ observations.parent_covariance @ np.swapaxes(carried, 1, 2), child


def _log_volume(covariance: Array, fit: Fit) -> float:
    """Return the log volume of the noise across a motion, ½ log |S| |Jᵀ S⁻¹ J|, up to a constant."""
    by_joints = fit.motion.linearise(fit.joint_values).by_joints
    along = np.swapaxes(by_joints, 1, 2) @ np.linalg.solve(covariance, by_joints)
    return 0.5 * float(np.sum(np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(along)[1]))


def identify_observations(
    observations: Observations, families: FamilyChoice, outliers: Outliers | None = None
) -> IdentificationResult:
    """Identify the joint between two parts by its evidence under one stated noise, without a check."""
    if observations.parent_covariance is None:
        identities = np.tile(np.eye(4), (len(observations), 1, 1))
        observations = Observations(identities, observations.relative, None, observations.child_covariance)
    weights = _joint_weights(families)
    data = prepare_data(observations, True, outliers, False)
    return weigh_families(data, solve_with_inliers(data, weights), weights)


def _joint_weights(families: FamilyChoice) -> dict[str | Family, float]:
    weights = family_weights(families)
    if families is not None and CURVE in weights:
        raise InvalidValueError(
            f"Pairs of parts are compared by their joints, and {CURVE!r} is none. kv.estimation.identify "
            "takes it for a single pair."
        )
    return without_curve(weights)


NodeT = TypeVar("NodeT", bound=Hashable)


def spanning_tree(
    nodes: Iterable[NodeT], gains: Mapping[frozenset[NodeT], float], leaves: Collection[NodeT] = ()
) -> list[frozenset[NodeT]]:
    """Return the spanning forest of largest gain (Chow and Liu 1968); leaves have one connection."""
    group = {node: {node} for node in nodes}
    chosen = []
    for connection in sorted(gains, key=lambda c: -gains[c]):
        a, b = connection
        if group[a] is group[b] or any(len(group[leaf]) > 1 for leaf in connection if leaf in leaves):
            continue
        chosen.append(connection)
        group[a] |= group[b]
        for node in group[b]:
            group[node] = group[a]
    return chosen


def split_tree(
    connection: frozenset[NodeT], tree: Iterable[frozenset[NodeT]]
) -> tuple[frozenset[NodeT], ...]:
    """Return the nodes on either side of a connection of a tree."""
    rest = [c for c in tree if c != connection]
    sides = [{node} for node in connection]
    for reached in sides:
        while new := {n for c in rest if c & reached for n in c} - reached:
            reached |= new
    return tuple(map(frozenset, sides))


def edge_probabilities(
    nodes: Iterable[NodeT], gains: Mapping[frozenset[NodeT], float], leaves: Collection[NodeT] = ()
) -> dict[frozenset[NodeT], float]:
    """Return the probability of each connection over all maximal spanning forests.

    The probability of a tree is proportional to exp(Σ gains of its connections), with a uniform prior over
    trees. By the matrix-tree theorem (Kirchhoff 1847) a connection ij of weight w is in a tree with
    probability w / c. Here c is the conductance between i and j in a network with these weights. It is
    computed by eliminating all other nodes one by one (star-mesh transform). This only adds and multiplies
    positive numbers, so logarithms lose no digits for gains that differ by orders of magnitude.

    Leaves have one connection at most, so each leaf is independent. The probabilities add up to the number of
    connections of a tree.
    """
    order = {node: k for k, node in enumerate(node for node in nodes if node not in leaves)}
    logs = np.full((len(order), len(order)), -np.inf)
    of_leaf: dict[NodeT, float] = {}
    for connection, gain in gains.items():
        for leaf in connection & {*leaves}:
            of_leaf[leaf] = float(np.logaddexp(of_leaf.get(leaf, -np.inf), gain))
        if connection <= order.keys():
            i, j = (order[node] for node in connection)
            logs[i, j] = logs[j, i] = gain
    result = {}
    for connection, gain in gains.items():
        if connection <= order.keys():
            i, j = (order[node] for node in connection)
            total = _log_conductance(logs, i, j)
        else:
            (leaf,) = connection & {*leaves}
            total = of_leaf[leaf]
        result[connection] = math.exp(min(0.0, gain - total))
    return result


def replacement_probabilities(
    connection: frozenset[NodeT],
    tree: Iterable[frozenset[NodeT]],
    gains: Mapping[frozenset[NodeT], float],
    leaves: Collection[NodeT] = (),
) -> dict[frozenset[NodeT], float]:
    """Return the probabilities of the connections that replace one, the largest first."""
    one, other = split_tree(connection, tree)
    around = {c: gain for c, gain in gains.items() if c <= one | other}
    missing = 1.0 - edge_probabilities(one | other, around, leaves)[connection]
    likely = edge_probabilities(one | other, {c: around[c] for c in around if c != connection}, leaves)
    fixed = {*leaves} - connection
    across = {c: missing * p for c, p in likely.items() if c & one and c & other and not c & fixed}
    return dict(sorted(across.items(), key=lambda pair: -pair[1]))


def _log_conductance(logs: Array, start: int, end: int) -> float:
    order = [*(k for k in range(len(logs)) if k not in (start, end)), start, end]
    left = logs[np.ix_(order, order)]
    for _ in order[2:]:
        spokes, left = left[0, 1:], left[1:, 1:]
        total = np.logaddexp.reduce(spokes)
        if total > -np.inf:
            left = np.logaddexp(left, spokes[:, None] + spokes - total)
    return float(left[0, 1])


def orient_tree(
    first: Iterable[NodeT], nodes: Sequence[NodeT], tree: Iterable[frozenset[NodeT]]
) -> tuple[tuple[NodeT, ...], list[tuple[NodeT, NodeT]]]:
    """Return the roots, the first node of each component in ``first``, and the connections away from them."""
    connections, directed = set(tree), []
    roots: list[NodeT] = []
    reached: set[NodeT] = set()
    for root in first:
        if root in reached:
            continue
        roots.append(root)
        waiting = [root]
        reached.add(root)
        while waiting:
            parent = waiting.pop(0)
            children = [n for n in nodes if n not in reached and frozenset((parent, n)) in connections]
            directed += [(parent, child) for child in children]
            waiting += children
            reached.update(children)
    return tuple(roots), directed


def tree_path(directed: Iterable[tuple[NodeT, NodeT]], start: NodeT, end: NodeT) -> list[NodeT]:
    """Return the nodes on the path between two nodes of a tree; an empty list if they are not connected."""
    parents = {child: parent for parent, child in directed}
    up, down = [start], [end]
    for way in (up, down):
        while way[-1] in parents:
            way.append(parents[way[-1]])
    if up[-1] != down[-1]:
        return []
    while len(up) > 1 < len(down) and up[-2] == down[-2]:
        up.pop()
        down.pop()
    return up + down[-2::-1]


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

    See Also
    --------
    kineverse.estimation.identify_graph
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
        if sum(p.log_odds_rigid for p in across) <= 0.0:
            continue
        least = min(joined.result["rigid"].probability, surest[a[0]], surest[b[0]])
        for name in (*a, *b):
            group[name], surest[name] = (*a, *b), least
    result = []
    for parts in dict.fromkeys(group.values()):
        # The world represents its body, else the part that was observed most often, points last.
        often = {p: (p == WORLD, not tracks[p].is_point, int(tracks[p].observed.sum())) for p in parts}
        ordered = sorted(parts, key=lambda p: (*(-n for n in often[p]), list(tracks).index(p)))
        places = _poses_in_first(ordered, pairs, {p for p in parts if tracks[p].is_point})
        result.append(RigidBody(tuple(ordered), places, surest[parts[0]]))
    return tuple(result)


def _poses_in_first(
    parts: list[str], pairs: Mapping[frozenset[str], PartPair], points: set[str]
) -> dict[str, Array]:
    """Return the poses of parts in the first, along the pairs with the largest odds of being rigid."""
    places = {parts[0]: np.eye(4)}
    tree = spanning_tree(parts, {c: p.log_odds_rigid for c, p in pairs.items() if c <= set(parts)}, points)
    for a, b in orient_tree(parts[:1], parts, tree)[1]:
        known = pairs[frozenset((a, b))]
        reference = np.asarray(known.result["rigid"].parameters["reference"])
        places[b] = places[a] @ (reference if known.parent == a else inverse(reference))
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

    See Also
    --------
    kineverse.estimation.identify_graph
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
class KinematicGraph(TableDisplay):
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

    See Also
    --------
    kineverse.estimation.identify_graph
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
        for first in [*self.roots, *placed]:
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
                    "that cannot depend on others, as those of a ball, or would be closed by a screw. Say "
                    "close=False for a model in which it is open."
                )
            yield from loop.closure.operations(name)

    def model(self, prefix: str | None = None, close: bool = True) -> Model:
        """Build a model with a frame for each part; see :meth:`operations` for the parameters.

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

    def _repr_html_(self) -> str:
        rows = [
            (edge.parent, edge.child, str(edge.result), f"{edge.probability:.1%}", "loop" if closes else "")
            for edges, closes in ((self.edges, False), (self.loops, True))
            for edge in edges
        ]
        kinds = {"bodies": self.bodies, "joints": self.edges, "loops": self.loops}
        caption = ", ".join(count_values(len(parts), kind) for kind, parts in kinds.items())
        return html_table(caption, ("parent", "child", "joint", "connection", ""), rows)


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
        Default covariance, (6, 6), see :mod:`kineverse.estimation.noise`.
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

    Examples
    --------
    >>> q = np.linspace(0, 1, 12)
    >>> door = np.stack([(kv.rotation_z(a) @ kv.translation(0.5, 0, 0))() for a in q])
    >>> drawer = np.stack([kv.translation(1 + 0.3 * a, 0, 0)() for a in q])
    >>> graph = kv.estimation.identify_graph({"door": door, "drawer": drawer}, noise=(0.001, 0.01))
    >>> [(edge.parent, edge.child, edge.fit.family) for edge in graph.edges]
    [('world', 'door', 'revolute'), ('world', 'drawer', 'prismatic')]
    >>> graph.model()
    <Model: 4 frames, 1 DoF, 2 constraints (version 1)>
    """
    tracks = check_tracks(poses, noise, points=True)
    if world:
        if WORLD in tracks:
            raise DuplicateNameError("The world is a part already; rename the part, or say world=False.")
        tracks = {WORLD: exact_track(max((len(t.poses) for t in tracks.values()), default=0)), **tracks}
    if len(tracks) < 2:
        raise InvalidValueError("A kinematic graph takes at least two parts, or one and the world.")
    if all(track.is_point for track in tracks.values()):
        raise InvalidValueError(
            "Only positions were observed, of all parts. The parent of a part has to be observed as a pose, "
            "(N, 4, 4); the world is one, unless world=False."
        )
    names, report = list(combinations(tracks, 2)), progress or (lambda done, count: None)
    pairs: dict[frozenset[str], PartPair] = {}
    for done, (a, b) in enumerate(names):
        report(done, len(names))
        if (pair := identify_pair(tracks, a, b, families)) is not None:
            pairs[frozenset((a, b))] = pair
    report(len(names), len(names))
    bodies = find_rigid_bodies(tracks, pairs)
    firsts = [body.parts[0] for body in bodies]
    between = {c: p for c, p in pairs.items() if c <= set(firsts)}
    points = {name for name, track in tracks.items() if track.is_point}
    tree = spanning_tree(firsts, {c: p.gain for c, p in between.items()}, points)
    # The root is the world, else the part with the most connections, and never a point.
    first = sorted(firsts, key=lambda n: (n != WORLD, n in points, -sum(n in c for c in tree)))
    roots, directed = orient_tree(first, firsts, tree)
    joints = []
    for parent, child in directed:
        joint = between[frozenset((parent, child))]
        if joint.parent != parent:
            # Identified again in the other direction.
            joint = identify_pair(tracks, parent, child, families) or joint
        joints.append(joint)
    loops = _find_loops({c: p for c, p in between.items() if not c & points}, joints)
    # A joint that closes a loop is no alternative to a joint of the tree.
    gains = {c: p.gain for c, p in between.items() if c not in loops}
    likely = edge_probabilities(firsts, gains, points)
    edges = []
    for joint in joints:
        connection = frozenset((joint.parent, joint.child))
        others = {}
        if likely[connection] < SURE:
            instead = replacement_probabilities(connection, tree, gains, points)
            others = {(between[c].parent, between[c].child): p for c, p in instead.items() if p > 1.0 - SURE}
        ends = joint.parent, joint.child
        edges.append(KinematicEdge(*ends, joint.result, joint.times, likely[connection], others))
    ordered = sorted(likely.items(), key=lambda pair: -pair[1])
    connections = {(between[c].parent, between[c].child): p for c, p in ordered}
    of_points = tuple(name for name in tracks if name in points)
    return KinematicGraph(bodies, tuple(edges), tuple(loops.values()), roots, connections, of_points)


def _find_loops(
    between: Mapping[frozenset[str], PartPair], joints: Sequence[PartPair]
) -> dict[frozenset[str], KinematicEdge]:
    tree = {frozenset((joint.parent, joint.child)): joint for joint in joints}
    directed, candidates = [(joint.parent, joint.child) for joint in joints], []
    for connection, pair in between.items():
        path = [tree[frozenset(ends)] for ends in pairwise(tree_path(directed, pair.parent, pair.child))]
        if connection not in tree and path and closes_loop(pair, path):
            candidates.append(ObservedLoop(pair, path))
    loops = {}
    for (joint, _), closure in close_loops(candidates, joints):
        edge = KinematicEdge(joint.parent, joint.child, joint.result, joint.times, closure=closure)
        loops[frozenset((joint.parent, joint.child))] = edge
    return loops
