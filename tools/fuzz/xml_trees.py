"""Mutations and reductions of XML, element by element and attribute by attribute."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from xml.etree import ElementTree

from . import bytes_mutation, values

Element = ElementTree.Element
MAX_ELEMENTS = 1500


@dataclass(frozen=True)
class Vocabulary:
    """Names of elements and attributes of a format, and words with a meaning in it."""

    tags: tuple[str, ...]
    attributes: tuple[str, ...]
    words: tuple[str, ...]


def mutator(vocabulary: Vocabulary) -> Callable[[bytes, bytes, Random], bytes]:
    """Return the mutation function of an XML format."""

    def mutate(data: bytes, other: bytes, random: Random) -> bytes:
        root = _parsed(data)
        if root is None or random.random() < 0.15:
            return bytes_mutation.mutate(data, other, random)
        donor = _parsed(other) if random.random() < 0.3 else None
        try:
            for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
                _mutate(root, donor if donor is not None else root, vocabulary, random)
        except RecursionError:  # deep elements cannot be copied
            pass
        return _text(root)

    return mutate


def _mutate(root: Element, donor: Element, vocabulary: Vocabulary, random: Random) -> None:
    pairs = [(parent, child) for parent in root.iter() for child in parent]
    if not pairs or len(pairs) > MAX_ELEMENTS:
        return
    parent, element = random.choice(pairs)
    kind = random.randrange(12)
    if kind == 0:
        parent.remove(element)
    elif kind == 1:
        for _ in range(random.choice((1, 1, 2, 30))):
            parent.append(copy.deepcopy(element))
    elif kind == 2:
        _, element_2 = random.choice(pairs)
        one, two = copy.deepcopy(element), copy.deepcopy(element_2)
        _become(element, two)
        _become(element_2, one)
    elif kind == 3:
        new = copy.deepcopy(random.choice(list(donor.iter())))
        parent.insert(random.randint(0, len(parent)), new)
    elif kind == 4:
        _become(element, copy.deepcopy(random.choice(list(donor.iter()))))
    elif kind == 5:
        for _ in range(random.choice((1, 1, 3, 220))):
            inner = copy.copy(element)
            _become(element, Element(random.choice((element.tag, "model", "a"))))
            element.append(inner)
    elif kind == 6:
        element.tag = random.choice(vocabulary.tags)
    elif kind == 7:
        ElementTree.SubElement(element, random.choice(vocabulary.tags)).text = _value(
            "", root, vocabulary, random
        )
    elif kind == 8:
        key = random.choice(vocabulary.attributes)
        element.set(key, _value("", root, vocabulary, random))
    else:
        _mutate_value(random.choice(pairs)[1] if random.random() < 0.9 else root, root, vocabulary, random)


def _mutate_value(element: Element, root: Element, vocabulary: Vocabulary, random: Random) -> None:
    keys = [*element.attrib, *([None] if (element.text or "").strip() else [])]
    if not keys:
        return
    key = random.choice(keys)
    if key is None:
        element.text = _value(element.text or "", root, vocabulary, random)
    elif random.random() < 0.1:
        del element.attrib[key]
    else:
        element.set(key, _value(element.attrib[key], root, vocabulary, random))


def _value(old: str, root: Element, vocabulary: Vocabulary, random: Random) -> str:
    kind = random.randrange(6)
    words = old.split()
    if kind <= 1 and words:
        words[random.randrange(len(words))] = random.choice(random.choice((values.EXTREME, values.NUMBERS)))
        return " ".join(words)
    if kind == 2:
        return values.numbers(random, random.choice((1, 3, 4, 6, 7)))
    if kind == 3:
        found = [v for e in root.iter() for v in (*e.attrib.values(), (e.text or "").strip())]
        return random.choice(found)
    if kind == 4:
        return random.choice(values.NAMES)
    return random.choice(vocabulary.words)


def _become(element: Element, other: Element) -> None:
    element.tag, element.text = other.tag, other.text
    element.attrib.clear()
    element.attrib.update(other.attrib)
    element[:] = other[:]


def _parsed(data: bytes) -> Element | None:
    if b"<!" in data:  # comments and document types are left to mutations of bytes
        return None
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError):
        return None


def _text(root: Element) -> bytes:
    try:
        return ElementTree.tostring(root, encoding="unicode").encode("utf-8", "surrogatepass")
    except RecursionError:
        return b""


def reductions(data: bytes) -> Iterator[bytes]:
    """Yield inputs with one element, attribute or text removed or simplified."""
    root = _parsed(data)
    if root is None:
        return
    for parent in list(root.iter()):
        for at, child in reversed(list(enumerate(parent))):
            parent.remove(child)
            yield _text(root)
            parent[at:at] = child[:]
            yield _text(root)
            parent[at : at + len(child)] = [child]
    for element in list(root.iter()):
        element.tail = None
        for key, value in list(element.attrib.items()):
            del element.attrib[key]
            yield _text(root)
            for shorter in _shorter(value):
                element.set(key, shorter)
                yield _text(root)
            element.set(key, value)
        value = element.text or ""
        for shorter in ("", *_shorter(value)) if value else ():
            element.text = shorter
            yield _text(root)
        element.text = value


def _shorter(value: str) -> tuple[str, ...]:
    words = value.split()
    zeros = [
        " ".join([*words[:i], "0", *words[i + 1 :]])
        for i, w in enumerate(words)
        if w != "0" and len(words) < 8
    ]
    return tuple(
        s
        for s in ("a", value.strip(), value[: len(value) // 2], *zeros)
        if s != value and len(s) <= len(value)
    )
