"""Mutations and reductions of JSON and msgpack, value by value."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

import msgspec.msgpack

from . import bytes_mutation, values

MAX_VALUES = 4000
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 1 << 31, 1 << 63, 10**30, 10**400, 0.5, -0.0, 1e308, 5e-324, float("inf"),
    float("nan"), "inf", "-inf", "nan", [], {}, [[]], [0], [None], "", "world", "a",
)  # fmt: skip

_SIMPLEST: tuple[Any, ...] = (0, "a", [])


@dataclass(frozen=True)
class Notation:
    """Notation of values: a reader that returns None for invalid bytes, and a writer."""

    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes]


def mutator(vocabulary: tuple[str, ...], notation: Notation) -> Callable[[bytes, bytes, Random], bytes]:
    """Return the mutation function of a format in a notation."""

    def mutate(data: bytes, other: bytes, random: Random) -> bytes:
        tree = notation.read(data)
        if not isinstance(tree, (dict, list)) or random.random() < 0.1:
            return bytes_mutation.mutate(data, other, random)
        if isinstance(tree, dict) and random.random() < 0.95:
            tree.pop("sha256", None)  # a wrong hash would hide all other mutations
        donor = notation.read(other) if random.random() < 0.3 else tree
        try:
            for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
                _mutate(tree, donor, vocabulary, random)
        except RecursionError:  # deep values cannot be copied
            pass
        return notation.write(tree)

    return mutate


def _mutate(tree: Any, donor: Any, vocabulary: tuple[str, ...], random: Random) -> None:
    places = list(_places(tree))
    if not places or len(places) > MAX_VALUES:
        return
    owner, key = random.choice(places)
    value, kind = owner[key], random.randrange(9)
    if kind == 0:
        del owner[key]
    elif kind == 1 and isinstance(owner, list):
        owner[key:key] = [copy.deepcopy(value)] * random.choice((1, 1, 2, 30))
    elif kind == 2:
        other, place = random.choice(places)
        owner[key], other[place] = copy.deepcopy(other[place]), copy.deepcopy(value)
    elif kind == 3:
        found = list(_places(donor))
        if found:
            other, place = random.choice(found)
            owner[key] = copy.deepcopy(other[place])
    elif kind == 4:
        for _ in range(random.choice((1, 2, 500))):
            value = [value] if random.random() < 0.8 else {"expression": value}
        owner[key] = value
    elif kind == 5 and isinstance(owner, dict):
        owner[random.choice((*vocabulary, *values.NAMES))] = owner.pop(key)
    elif isinstance(value, str):
        owner[key] = random.choice((*vocabulary, *vocabulary, *values.NAMES, *_VALUES))
    elif type(value) is int and random.random() < 0.7:
        owner[key] = value + random.choice((-2, -1, 1, 2, 10))
    else:
        owner[key] = copy.deepcopy(random.choice(_VALUES))


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    ahead = [tree]
    while ahead:
        value = ahead.pop()
        items = (
            value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        )
        for key, inner in items:
            yield value, key
            if isinstance(inner, (dict, list)):
                ahead.append(inner)


def _parsed(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def _text(tree: Any) -> bytes:
    try:
        return json.dumps(tree, ensure_ascii=False).encode("utf-8", "surrogatepass")
    except (RecursionError, ValueError):
        return b""


def _unpacked(data: bytes) -> Any:
    try:
        return msgspec.msgpack.decode(data)
    except (ValueError, RecursionError):
        return None


def _packed(tree: Any) -> bytes:
    try:
        return msgspec.msgpack.encode(tree)
    except (RecursionError, ValueError, OverflowError):
        return b""


JSON = Notation(_parsed, _text)
MSGPACK = Notation(_unpacked, _packed)


def reducer(notation: Notation) -> Callable[[bytes], Iterator[bytes]]:
    """Return a function that yields inputs with one value removed or simplified."""

    def reductions(data: bytes) -> Iterator[bytes]:
        tree = notation.read(data)
        if not isinstance(tree, (dict, list)):
            return
        for owner, key in reversed(list(_places(tree))):
            value = owner[key]
            if isinstance(owner, list):
                del owner[key]
                yield notation.write(tree)
                owner.insert(key, value)
            else:
                items = list(owner.items())
                del owner[key]
                yield notation.write(tree)
                owner.clear()
                owner.update(items)
            for simpler in _SIMPLEST:
                if value != simpler and len(repr(simpler)) < len(repr(value)):
                    owner[key] = simpler
                    yield notation.write(tree)
            owner[key] = value

    return reductions
