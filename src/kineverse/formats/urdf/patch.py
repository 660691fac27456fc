"""Corrected origins and axes of joints, written into the text of their URDF.

Only the numbers that changed are replaced. All other bytes stay, and with them comments, order, line ends and
all that a model does not have.
"""

from __future__ import annotations

import codecs
import hashlib
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import numpy as np
from msgspec.structs import replace

from kineverse.articulations import Joint, OneAxisMotion
from kineverse.errors import FormatError, list_some
from kineverse.formats.description import WrittenFile
from kineverse.formats.files import read_file
from kineverse.formats.locate import locate_model
from kineverse.formats.poses import rpy_angles, unit_quaternion
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.root_folder import find_root
from kineverse.formats.xml_reader import StartTag, find_start_tags, quote, read_root_tag
from kineverse.formats.xml_values import parse_directions
from kineverse.lie import Array, normalize
from kineverse.model.body import Pose
from kineverse.model.operation import Operation
from kineverse.model.read_recorder import Read, differs
from kineverse.model.registry import FileContent, SourceFile

from .operations import assign_names, urdf_file_operations
from .reader import parse_urdf

_SAME = 5e-16  # difference of numbers that is rounding, for which no text is replaced
_SAME_POSE = 1e-12  # of the entries of a pose, between a file and the model that was loaded from it
_READ_BACK = 1e-14  # of the entries of a pose that was written and read again: roundings of its sines

_Edit: TypeAlias = "tuple[int, int, bytes]"  # bytes from, to, and what replaces them

_ATTRIBUTE = re.compile(rb"([^\s=/<>\"']+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_ENCODING = re.compile(rb"<\?xml[^>]*?\sencoding\s*=\s*[\"']([\w.-]+)[\"']")
_RELATIVE = re.compile(rb"<mesh\s[^>]*?filename\s*=\s*[\"'](?![A-Za-z]+:|/)")
_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))


def find_source(
    sources: Iterable[SourceFile],
    corrected: Iterable[str],
    given: str | os.PathLike[str] | None = None,
) -> FileContent | None:
    """Read the URDF that corrected operations are from, by their tags; None if none of the sources has them.

    ``given`` is the path or name of the file, if it is not to be looked for. A template, and a file that has
    changed since the model was loaded, are refused.
    """
    tags = set(corrected)
    if given is not None:
        return _read_given(given, tags, [*sources])
    found: list[FileContent] = []
    for source in sources:
        if source.path.name.endswith(".xacro"):
            _refuse_template(source.path)
        content = read_file(source.path) if source.path.name.endswith((".urdf", ".xml")) else b""
        if read_root_tag(content) != "robot":
            continue
        if hashlib.blake2b(content).digest() != source.digest:
            raise FormatError(
                f"{source.path} has changed since the model was loaded from it. Load the model again and "
                "calibrate that, or save to a document (.kv.json), which is written whole."
            )
        file = FileContent(source.path, content, source.prefix, source.root, False, source.shipped)
        if tags & dict(_quiet_operations(file)).keys():
            found.append(file)
    if len(found) > 1:
        names = ", ".join(str(file.path) for file in found)
        raise FormatError(
            f"The corrections are in several files: {names}. Write each of them, with source=, or save to a "
            "document (.kv.json), which has all."
        )
    return found[0] if found else None


def _refuse_template(path: Path) -> NoReturn:
    name = path.name
    expanded = name.removesuffix(".xacro") if name.endswith(".urdf.xacro") else f"{path.stem}.urdf"
    raise FormatError(
        f"{name} is a template: properties and macros make its numbers, so those of one joint cannot be "
        f"replaced in it. Expand it (xacro {name} > {expanded}), then load and calibrate {expanded}."
    )


def _read_given(given: str | os.PathLike[str], tags: set[str], sources: list[SourceFile]) -> FileContent:
    """Read a file, with the prefix that the corrected names have."""
    located = locate_model(given)
    if located.path.name.endswith(".xacro"):
        _refuse_template(located.path)
    content = read_file(located.path)
    if read_root_tag(content) != "robot":
        raise FormatError(f"{located.path} is no URDF, in which corrected numbers could be replaced.")
    names = [tag.partition(" ")[2].split("/") for tag in tags]
    prefixes = {None, located.shipped, *(s.prefix for s in sources)}
    prefixes |= {"/".join(parts[:k]) for parts in names for k in range(1, len(parts))}
    root = find_root(located.path.parent, None, located.folder)
    shipped = located.shipped
    options = [FileContent(located.path, content, prefix, root, False, shipped) for prefix in prefixes]
    counts = [len(tags & dict(_quiet_operations(file)).keys()) for file in options]
    return options[counts.index(max(counts))]


def patch_urdf(
    file: FileContent, before: Mapping[str, Operation], corrected: Mapping[str, Operation], folder: Path
) -> WrittenFile:
    """Return the bytes of a URDF with the corrected numbers of its joints.

    ``before`` and ``corrected`` are operations of the model by tag; those before have to be as in the file.
    What is corrected beside origins and axes of joints of the file is said in the remarks. ``folder`` is that
    of the new file.
    """
    text = _DecodedText.of(file)
    known = dict(_quiet_operations(file))
    elements = _joint_elements(file, text.utf8)
    edits: list[_Edit] = []
    written: dict[str, Joint] = {}
    remarks: list[str] = []
    for tag, operation in corrected.items():
        original = known.get(tag)
        if not isinstance(operation, Joint) or not isinstance(original, Joint) or tag not in elements:
            remarks.append(f"'{_subject(tag, operation)}' is not corrected: the file has no number for it")
            continue
        _check_origin(file, tag, before.get(tag), original)
        changed = [f for f in _changed_fields(original, operation) if f not in ("origin", "axis")]
        if changed:
            what = " and ".join(changed)
            remarks.append(f"the {what} of '{operation.name}' is not corrected: URDF has no number for it")
        edits += _joint_edits(text.utf8, elements[tag], original, operation)
        written[tag] = operation
    if corrected and not written:
        raise FormatError(f"{file.path.name}: {remarks[0]}. Save to a document (.kv.json), which has all.")
    if folder != file.path.absolute().parent and _RELATIVE.search(text.utf8):
        remarks.append(f"it names meshes relative to {file.path.absolute().parent}, where the file came from")
    content = text.encode(_apply_edits(text.utf8, edits))
    _check_read_back(file, content, known, written)
    return WrittenFile(content, tuple(remarks), {})


def _quiet_operations(file: FileContent) -> Iterator[tuple[str, Operation]]:
    with collect_warnings():  # they were given when the model was loaded
        operations = [*urdf_file_operations(file)]
    yield from operations


def _subject(tag: str, operation: Operation) -> str:
    return str(getattr(operation, "name", tag.partition(" ")[2] or tag))


def _changed_fields(a: Joint, b: Joint) -> list[str]:
    """Return the fields of a joint that differ from another one's; all of them if it is of another kind."""
    if type(a) is not type(b):
        return ["kind"]
    return [f.name for f in fields(a) if not _same_value(getattr(a, f.name), getattr(b, f.name))]


def _same_value(a: object, b: object) -> bool:
    return not differs(Read.VALUE, a, b)


def _is_same_operation(a: Any, b: Any) -> bool:
    return type(a) is type(b) and all(_same_value(getattr(a, f.name), getattr(b, f.name)) for f in fields(b))


def _origin(joint: Joint) -> Array:
    try:
        origin = joint.origin if isinstance(joint.origin, Pose) else Pose.from_matrix(joint.origin)
    except (ValueError, TypeError) as error:
        raise FormatError(f"The origin of '{joint.name}' cannot be written to a URDF. {error}") from None
    return origin.matrix


def _axis(joint: OneAxisMotion) -> tuple[float, ...]:
    return normalize(joint.axis) or (0.0, 0.0, 0.0)


def _difference_of_axes(a: Joint, b: Joint) -> float:
    """Return the largest difference of the numbers of two axes; 0 for joints without one."""
    if not isinstance(a, OneAxisMotion) or not isinstance(b, OneAxisMotion):
        return 0.0
    return max(abs(x - y) for x, y in zip(_axis(a), _axis(b), strict=True))


def _check_origin(file: FileContent, tag: str, before: Operation | None, original: Joint) -> None:
    """Check that a joint of the model is where its file has it."""
    before = before and (before.rebuild() or before)  # an operation of a document
    if not isinstance(before, Joint):
        raise FormatError(f"{file.path.name} is another file: the model lacks its joint '{original.name}'.")
    off = float(np.abs(_origin(before) - _origin(original)).max())
    off = max(off, _difference_of_axes(before, original))
    if off > _SAME_POSE:
        raise FormatError(
            f"{file.path.name}: the joint '{original.name}' differs by {off:.2g} from that of the model, so "
            "this is not its file, or the model was edited since. Save to a document (.kv.json)."
        )


# -- elements ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _JointElement:
    """Places of a joint in the text of a URDF."""

    start: StartTag
    origin: StartTag | None
    axis: StartTag | None
    reads_quaternion: bool  # True if quat_xyzw of the origin counts


def _joint_elements(file: FileContent, utf8: bytes) -> dict[str, _JointElement]:
    """Return the elements of the joints of a file, by the tags of their operations."""
    with collect_warnings():
        robot = parse_urdf(file.content, file.path.name, str(file.path.absolute().parent), file.root)
        _, names = assign_names(robot, file.prefix, strict=False)
    found: dict[tuple[int, str], list[tuple[StartTag, dict[str, StartTag]]]] = {}
    parts: dict[str, StartTag] | None = None
    start = root = find_start_tags(utf8)[0]
    for tag in find_start_tags(utf8):
        name = tag.element[0]
        if tag.depth == 2:
            parts = {} if name == "joint" else None
            start = tag
        elif tag.depth == 3 and parts is not None:
            parts.setdefault(name, tag)  # the first of several counts
            if name == "child" and parts["child"] is tag:
                found.setdefault((start.element[3], tag.element[1].get("link", "")), []).append(
                    (start, parts)
                )
    newer = root.element[1].get("version", "1.0") not in ("1.0", "1")
    elements: dict[str, _JointElement] = {}
    for joint in robot.joints:
        same = found.get((joint.line, joint.child), [])
        if len(same) != 1:
            raise FormatError(
                f"{file.path.name}, line {joint.line}: several joints on one line have the child "
                f"{quote(joint.child)}, so it is not clear which of them to correct. Leave one of them."
            )
        (start, parts), name = same[0], names[joint.name]
        tag_name = f"joint {file.prefix}/{name}" if file.prefix else f"joint {name}"
        origin = parts.get("origin")
        quaternion = newer and origin is not None and {"quat_xyzw"} <= {*origin.element[1]} - {"rpy"}
        quaternion = quaternion and origin is not None and "rpy" not in origin.element[1]
        elements[tag_name] = _JointElement(start, origin, parts.get("axis"), quaternion)
    return elements


def _joint_edits(utf8: bytes, element: _JointElement, original: Joint, corrected: Joint) -> list[_Edit]:
    """Return the replacements of numbers that make a joint of a file the corrected one."""
    edits: list[_Edit] = []
    wanted: dict[str, tuple[float, ...]] = {}
    old, new = _origin(original), _origin(corrected)
    if (np.abs(new[:3, 3] - old[:3, 3]) > _SAME).any():
        wanted["xyz"] = tuple(new[:3, 3].tolist())
    if (np.abs(new[:3, :3] - old[:3, :3]) > _SAME).any():
        if element.reads_quaternion:
            wanted["quat_xyzw"] = unit_quaternion(new)
        else:
            given = _attribute_numbers(element.origin, "rpy", 3) or (0.0, 0.0, 0.0)
            wanted["rpy"] = _nearest_rpy(new, given)
    inside = b""
    if element.origin is not None:
        edits += _attribute_edits(utf8, element.origin, wanted)
    elif wanted:
        inside += _new_element(utf8, element.start, "origin", wanted)
    if isinstance(corrected, OneAxisMotion) and _difference_of_axes(original, corrected) > _SAME:
        axis = _axis(corrected)
        if element.axis is not None:
            edits += _attribute_edits(utf8, element.axis, {"xyz": axis})
        else:
            inside += _new_element(utf8, element.start, "axis", {"xyz": axis})
    return [*edits, (element.start.end, element.start.end, inside)] if inside else edits


def _attribute_numbers(tag: StartTag | None, key: str, count: int) -> tuple[float, ...] | None:
    """Return the numbers of an attribute; None if there are none, or other ones."""
    try:
        return None if tag is None else parse_directions(tag.element[1].get(key, ""), count)
    except ValueError:
        return None


def _nearest_rpy(pose: Array, given: Sequence[float]) -> tuple[float, ...]:
    """Return the roll, pitch and yaw of a rotation that are the nearest to given ones.

    Two triples, and multiples of 2π, give the same rotation. At a pitch of ±π/2, of which only a sum of roll
    and yaw counts, yaw stays.
    """
    roll, pitch, yaw = rpy_angles(pose)
    if abs(pose[0, 0]) + abs(pose[1, 0]) <= 1e-12:  # as in lie.to_rpy
        sign = math.copysign(1.0, pitch)
        roll, yaw = roll + sign * given[2], given[2]
    triples = [(roll, pitch, yaw), (roll + math.pi, math.pi - pitch, yaw + math.pi)]
    turns = [
        tuple(a + math.tau * round((b - a) / math.tau) for a, b in zip(triple, given, strict=True))
        for triple in triples
    ]
    return min(turns, key=lambda triple: math.dist(triple, given))


def _attribute_edits(utf8: bytes, tag: StartTag, wanted: Mapping[str, tuple[float, ...]]) -> Iterator[_Edit]:
    """Yield the replacements that give attributes of a tag their numbers; missing attributes are added."""
    places = {m[1].decode(): m for m in _ATTRIBUTE.finditer(utf8, tag.begin, tag.end)}
    last = max((m.end() for m in places.values()), default=tag.begin + 1 + len(tag.element[0].encode()))
    added = b""
    for key, numbers in wanted.items():
        match = places.get(key)
        if match is None:
            mark = b"'" if places and all(m[2] is None for m in places.values()) else b'"'
            added += b" " + key.encode() + b"=" + mark + _format_numbers(numbers) + mark
            continue
        begin, end = match.span(2 if match[2] is not None else 3)
        old = _attribute_numbers(tag, key, len(numbers))
        words = [*re.finditer(rb"\S+", utf8[begin:end])]
        if old is None or len(words) != len(numbers) or b"&" in utf8[begin:end]:
            yield begin, end, _format_numbers(numbers)
            continue
        for word, was, number in zip(words, old, numbers, strict=True):
            if abs(number - was) > _SAME:
                yield begin + word.start(), begin + word.end(), _format_numbers([number])
    if added:
        yield last, last, added


def _new_element(utf8: bytes, start: StartTag, name: str, wanted: Mapping[str, tuple[float, ...]]) -> bytes:
    """Return an element, with the white space that the first child of its parent has before it."""
    space = re.compile(rb"\s*").match(utf8, start.end)
    attributes = b"".join(b' %s="%s"' % (k.encode(), _format_numbers(v)) for k, v in wanted.items())
    return (space[0] if space else b"") + b"<" + name.encode() + attributes + b"/>"


def _format_numbers(numbers: Sequence[float]) -> bytes:
    return " ".join(repr(n + 0.0).removesuffix(".0") for n in numbers).encode()


def _apply_edits(utf8: bytes, edits: Sequence[_Edit]) -> bytes:
    pieces: list[bytes] = []
    at = 0
    for begin, end, new in sorted(edits):
        pieces += [utf8[at:begin], new]
        at = end
    return b"".join([*pieces, utf8[at:]])


# -- bytes ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _DecodedText:
    """Text of a file in UTF-8, and its encoding."""

    utf8: bytes
    encoding: str
    mark: bytes  # byte order mark

    @classmethod
    def of(cls, file: FileContent) -> _DecodedText:
        """Decode a file; refuse one whose bytes the text does not determine."""
        mark, encoding = next((pair for pair in _MARKS if file.content.startswith(pair[0])), (b"", ""))
        rest = file.content[len(mark) :]
        if not encoding:
            said = _ENCODING.search(rest[:1024])
            encoding = said[1].decode() if said else "utf-8"
        try:
            text = rest.decode(encoding)
            same = text.encode(encoding) == rest
        except (UnicodeError, LookupError):
            same, text = False, ""
        if not same:
            raise FormatError(
                f"{file.path.name}: its bytes are not those of its text in {encoding}, so they cannot be "
                "kept. Save it as UTF-8."
            )
        return cls(text.encode("utf-8"), encoding, mark)

    def encode(self, utf8: bytes) -> bytes:
        """Return the bytes of a changed text."""
        return self.mark + utf8.decode("utf-8").encode(self.encoding)


def _check_read_back(
    file: FileContent, content: bytes, known: Mapping[str, Operation], written: Mapping[str, Joint]
) -> None:
    """Check that the new bytes are read as the corrected joints, and as the old operations else."""
    again = dict(_quiet_operations(replace(file, content=content)))
    others = [tag for tag in known if tag not in written]
    wrong = [tag for tag in others if not _is_same_operation(again.get(tag), known[tag])]
    for tag, joint in written.items():
        read = again.get(tag)
        size = max(1.0, float(np.abs(_origin(joint)).max()))
        off = np.inf if not isinstance(read, Joint) else float(np.abs(_origin(read) - _origin(joint)).max())
        if isinstance(read, Joint):
            off = max(off, _difference_of_axes(read, joint))
        if off > _READ_BACK * size:
            wrong.append(tag)
    if wrong or [*again] != [*known]:
        raise FormatError(
            f"{file.path.name} is not written: read back, it would differ at {list_some(wrong or again, 3)}. "
            "Save to a document (.kv.json)."
        )
