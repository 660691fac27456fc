"""SDF files and text to a checked description.

Specification: http://sdformat.org/spec, and its pages on poses, frames and the composition of models;
``docs/sdf.md`` lists what is read how.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from kineverse.formats.chains import Following, resolve_chains
from kineverse.formats.files import read_file
from kineverse.formats.markup import Element, quote
from kineverse.formats.roots import text_root

from .bodies import body_of
from .description import WORLD, Frame, Joint, Link, Scene
from .gears import couple
from .joints import read_joint
from .nodes import Document, Node, Scope
from .placing import carriers, relation
from .reading import Parts, Reader, open_document, root_scope
from .resolving import resolve
from .tree import span


def read_sdf(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, strict: bool = False
) -> Scene:
    """Read an SDF file, and the files that it includes; see :func:`parse_sdf`.

    Raises
    ------
    FormatError
        If a file cannot be read or is not a valid SDF; the message names file, line, element and reason.
    """
    path = Path(path)
    return parse_sdf(read_file(path), path.name, str(path.absolute().parent), root, strict)


def parse_sdf(
    text: str | bytes,
    source: str = "<sdf>",
    folder: str = "",
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
) -> Scene:
    """Read an SDF from text.

    Parameters
    ----------
    text
        The document.
    source
        Its name in error messages.
    folder
        The folder from which meshes and included models are found.
    root
        The folder that they do not leave; None for that which :func:`kineverse.formats.roots.root_of` finds.
    strict
        Whether mistakes that others read past are refused, rather than remarked on.

    Raises
    ------
    FormatError
        If it is not a valid SDF; the message names source, line, element and reason.
    """
    remarks: list[str] = []
    below = text_root(folder, root)
    document, top = open_document(text, source, folder, remarks, below, strict)
    parts = Parts()
    scope = root_scope(document, top)
    standing = _read(document, top, Reader(parts, remarks, below, strict), scope)
    resolve(parts)
    over = carriers(parts.nodes, scope.model)
    return _scene(parts, over, standing, document, remarks)


def _read(document: Document, root: Element, reader: Reader, scope: Scope) -> list[Node]:
    """Read everything into nodes; return the models that stand where they are although nothing holds them."""
    worlds = [element for element in root[2] if element[0] == "world"]
    models = [element for element in root[2] if element[0] in ("model", "include")]
    for element in root[2]:
        if element[0].startswith("xacro:"):
            document.refuse(
                element, "is xacro that was not expanded; expand it first: xacro in.sdf > out.sdf"
            )
        if element[0] not in ("world", "model", "include"):
            document.remarks.add(element, "is left out.")
    if worlds:
        for element in (*worlds[1:], *models):
            document.remarks.add(element, "is left out: the first world of the file is the one that is read.")
        reader.world(worlds[0], scope)
        return []
    if not models:
        document.refuse(root, "has neither a model nor a world.")
    for element in models:
        if element[0] == "include":
            reader.included(element, scope)
        else:
            reader.model(element, scope, alone=len(models) == 1)
    return scope.models


def _scene(
    parts: Parts,
    over: dict[Node, Node],
    standing: Sequence[Node],
    document: Document,
    remarks: list[str],
) -> Scene:
    links = tuple(_link(node) for node in parts.of("link"))
    hinges = couple([read_joint(node, over) for node in parts.of("joint")], over)
    nodes = {hinge.joint.name: hinge.node for hinge in hinges}

    def note(joint: Joint, text: str) -> None:
        node = nodes[joint.name]
        node.document.remarks.add(node.element, text)

    joints = _followed([hinge.joint for hinge in hinges], nodes)
    roots, ordered, loops = span(links, joints, [over[model].path for model in standing], note)
    _check_leaders((*ordered, *loops), nodes)
    frames = tuple(
        Frame(
            node.path,
            over[node].path or WORLD,
            relation(over[node], node),
            node.element[3],
            node.document.source,
        )
        for node in parts.nodes
        if node.shown and node.sort in ("frame", "model")
    )
    return Scene(links, frames, roots, ordered, loops, document.source, tuple(remarks))


def _check_leaders(joints: Sequence[Joint], nodes: dict[str, Node]) -> None:
    """Look whether what joints follow is there: not among those that were left out."""
    moving = {joint.name + axis.suffix for joint in joints for axis in joint.axes}
    for joint in joints:
        for following in (joint.gear, *(axis.following for axis in joint.axes)):
            if following is not None and following.leader not in moving:
                nodes[joint.name].refuse(
                    f"it follows {quote(following.leader)}, which cannot move: the links that it connects "
                    "are held together anyway."
                )


def _link(node: Node) -> Link:
    assert node.place is not None
    static, document = node.scope.static, node.document
    return Link(node.path, body_of(node), node.place, static, node.element[3], document.source)


def _followed(joints: list[Joint], nodes: dict[str, Node]) -> list[Joint]:
    """Return the joints with what they follow at the ends of the chains."""
    following: dict[str, Following[str]] = {}
    owner: dict[str, str] = {}
    for joint in joints:
        for axis in joint.axes:
            owner[joint.name + axis.suffix] = joint.name
            if axis.following is not None:
                following[joint.name + axis.suffix] = axis.following
        if joint.gear is not None:
            following[joint.name] = joint.gear
    if not following:
        return joints

    def refuse(coordinate: str, reason: str) -> NoReturn:
        node = nodes[owner[coordinate]]
        node.refuse(reason)

    ends = resolve_chains(following, refuse)
    result = []
    for joint in joints:
        if any(joint.name + axis.suffix in following for axis in joint.axes):
            axes = tuple(replace(axis, following=ends.get(joint.name + axis.suffix)) for axis in joint.axes)
            gear = joint.gear and ends[joint.name]
            joint = replace(joint, axes=axes, gear=gear)
        result.append(joint)
    return result
