"""Collision filter: the pairs of bodies that are checked.

Pairs that are rigidly connected, joined by one articulation, or excepted by a rule are not checked. The
result is known elsewhere as an allowed collision matrix. Rules are data: a model keeps them under the name
:data:`RULES`, and every scene of the model uses them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._names import is_pattern, matches_pattern, no_match_error
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.loops.loop_records import find_loops
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model_view import ModelView

from .broadphase import Flags

RULES = "geometry/rules"
"""Name of the data entry that holds a model's rules; an included model has its entry below its prefix."""

_FREE_SPEEDS = 6


class Rule(NamedTuple):
    """Rule of the collision filter; the last rule that applies to a pair decides.

    Attributes
    ----------
    a, b
        Names of bodies, or patterns in which ``*`` is any text, also across slashes.
    check
        Whether such pairs are checked. True includes pairs that are adjacent or excepted by an earlier rule.
    why
        Reason, for readers.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> touching = kv.geometry.Rule("fetch/*_finger_link", "fetch/gripper_link", why="they slide")
    >>> scene = kv.geometry.Scene(model, rules=[touching])
    >>> scene.checks_pair("fetch/l_gripper_finger_link", "fetch/gripper_link")
    False
    """

    a: str
    b: str = "*"
    check: bool = False
    why: str = ""


def parse_rules(entries: Any) -> tuple[Rule, ...]:
    """Return rules from their data in a model or document."""
    if isinstance(entries, str | Rule) or not isinstance(entries, Iterable):
        raise InvalidValueError(f"Rules are a sequence of kv.geometry.Rule, not {entries!r}.")
    rules = []
    for entry in entries:
        try:
            rule = Rule(*entry)
        except TypeError:
            rule = Rule("")
        texts = all(isinstance(x, str) for x in (rule.a, rule.b, rule.why))
        if not (rule.a and texts and isinstance(rule.check, bool | np.bool_)):
            raise InvalidValueError(f"A rule is (a, b, check, why), as kv.geometry.Rule, not {entry!r}.")
        rules.append(Rule(rule.a, rule.b, bool(rule.check), rule.why))
    return tuple(rules)


def parse_known_rules(entries: Any, model: ModelView) -> tuple[Rule, ...]:
    """Return rules from their data as :func:`parse_rules` does, after checking their names."""
    rules = parse_rules(entries)
    check_frame_names("A rule is about", (name for rule in rules for name in rule[:2]), model)
    return rules


def read_rules(model: ModelView) -> tuple[Rule, ...]:
    """Return the rules of a model: first those of included models, below their prefix, then others."""
    result: list[Rule] = []
    for name, entries in model.data.items():
        if name.endswith(f"/{RULES}"):
            prefix = name.removesuffix(RULES)
            result += [rule._replace(a=prefix + rule.a, b=prefix + rule.b) for rule in parse_rules(entries)]
    return (*result, *parse_rules(model.data.get(RULES, ())))


def rules_as_data(rules: Iterable[Rule]) -> tuple[tuple[str, str, bool, str], ...]:
    """Return rules as data for a model: ``edit.write(RULES, rules_as_data(rules))``.

    Examples
    --------
    >>> rule = kv.geometry.Rule("kitchen/fridge*", "kitchen/oven*", why="far apart")
    >>> model = kv.load("kitchen")
    >>> with model.edit() as edit:
    ...     edit.write(kv.geometry.RULES, kv.geometry.rules_as_data([rule]))
    'data geometry/rules'
    """
    return tuple((rule.a, rule.b, rule.check, rule.why) for rule in parse_rules(rules))


def check_frame_names(what: str, names: Iterable[str], model: ModelView) -> None:
    """Raise UnknownNameError for a name, no pattern, that no frame has; ``what`` begins the message."""
    frames = model.frames
    for name in dict.fromkeys(names):
        if not is_pattern(name) and name not in frames and name != WORLD:
            raise UnknownNameError(f"{what} '{name}', which is not a frame. {suggest(name, frames, 'frame')}")


def check_body_patterns(argument: str, patterns: Iterable[str], model: ModelView) -> None:
    """Raise UnknownNameError for a pattern that no frame matches; ``*`` may stand for none."""
    frames = [*model.frames, WORLD]
    for pattern in {*patterns} - {"*"}:
        if is_pattern(pattern) and not any(matches_pattern(frame, (pattern,)) for frame in frames):
            raise no_match_error(pattern, frames, "body", argument)


def allowed_pairs(model: ModelView, bodies: Sequence[str], rules: Sequence[Rule]) -> Flags:
    """Return (B, B) flags, 1 for pairs that are checked."""
    return apply_rules(1 - adjacent_pairs(model, bodies), bodies, rules)


def apply_rules(flags: Flags, bodies: Sequence[str], rules: Sequence[Rule]) -> Flags:
    """Return (B, B) flags of checked pairs, changed by rules."""
    table = flags.copy()
    index = {name: k for k, name in enumerate(bodies)}
    matches: dict[str, list[int]] = {}
    for rule in rules:
        ones, others = (_matching_bodies(name, index, matches) for name in (rule.a, rule.b))
        if len(ones) == len(others) == 1:  # fast, as there may be one such rule for each pair
            table[ones[0], others[0]] = table[others[0], ones[0]] = rule.check
        else:
            table[np.ix_(ones, others)] = table[np.ix_(others, ones)] = rule.check
    np.fill_diagonal(table, 0)
    return np.ascontiguousarray(table)


def _matching_bodies(name: str, index: Mapping[str, int], matches: dict[str, list[int]]) -> list[int]:
    if name not in matches:
        candidates = index if is_pattern(name) else (name,) if name in index else ()
        matches[name] = [index[body] for body in candidates if matches_pattern(body, (name,))]
    return matches[name]


def adjacent_pairs(model: ModelView, bodies: Sequence[str]) -> Flags:
    """Return (B, B) flags, 1 for pairs that are rigidly connected or joined by one articulation.

    A link whose parent never moves is joined only to the body that carries it: a door to its cupboard, and
    not to the wall. A freely moving link, with six speeds, is joined to nothing. The ends of a closed loop
    are joined to each other.
    """
    frames = dict(model.frames)
    groups = {name: rigid_group(name, frames) for name in bodies}
    numbers = {group: k for k, group in enumerate(dict.fromkeys(groups.values()))}
    number = np.array([numbers[groups[name]] for name in bodies], dtype=int)
    table: Flags = (number[:, None] == number[None, :]).astype(np.uint8)
    index = {name: k for k, name in enumerate(bodies)}

    def bodies_at(frame: str) -> npt.NDArray[np.bool_]:
        group = rigid_group(frame, frames)
        if group == WORLD:
            return np.asarray(np.arange(len(bodies)) == _supporting_body(frame, frames, index))
        return np.asarray(number == numbers.get(group, -1))

    for one, other in _joined_frames(model, frames, numbers):
        members, joined = bodies_at(one), bodies_at(other)
        table[np.outer(members, joined) | np.outer(joined, members)] = 1
    return table


def _joined_frames(
    model: ModelView, frames: Mapping[str, Frame], groups: Iterable[str]
) -> Iterator[tuple[str, str]]:
    """Yield pairs of frames joined by an articulation: rigid groups and their parents, and ends of loops."""
    for group in groups:
        if group != WORLD and len(model.speeds_of(group, frames[group].parent)) < _FREE_SPEEDS:
            yield group, frames[group].parent
    for loop in find_loops(model):
        yield from loop.ends


def rigid_group(name: str, frames: Mapping[str, Frame]) -> str:
    """Return the root of a frame's rigid group: its frame that moves in its parent, or the world."""
    while name != WORLD and all(isinstance(factor, Pose) for factor in frames[name].factors):
        name = frames[name].parent
    return name


def _supporting_body(name: str, frames: Mapping[str, Frame], index: Mapping[str, int]) -> int:
    """Return the index of the nearest body at or above a frame that never moves; -1 for none."""
    while name not in index and name != WORLD:
        name = frames[name].parent
    return index.get(name, -1)
