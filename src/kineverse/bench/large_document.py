"""A document of as many nodes as wanted, and how long it takes to write and to read it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from kineverse.collection import no_collection
from kineverse.formats.document import document_of, from_bytes, operations_from, to_bytes
from kineverse.model.model import Model
from kineverse.symbols import position

NODES_OF_ONE = 9
"""Nodes that one constraint adds to a document."""


@dataclass(frozen=True, slots=True)
class Growth:
    """What one document takes.

    Attributes
    ----------
    nodes
        How many nodes it has.
    written, read, packed, unpacked
        Times [s]: from a model to text, from text to a model, and both for msgpack.
    """

    nodes: int
    written: float
    read: float
    packed: float
    unpacked: float


def room(nodes: int) -> Model:
    """Return a model of constraints between two coordinates each, about so many nodes as a document."""
    model = Model()
    with model.edit() as edit, no_collection():
        for i in range(max(nodes // NODES_OF_ONE, 1)):
            a, b = position(f"door{i}/hinge"), position(f"door{i}/handle")
            edit.constrain(f"door{i}/lock", -1.0, np.sin(a) * b + np.cos(b) * (0.1 + i) * a, 1.0)
    return model


def read(text: str) -> Model:
    """Return the model that a document says, with all of its operations applied."""
    model = Model()
    with model.edit() as edit, no_collection():
        for tag, operation in operations_from(text):
            edit.apply(operation, tag)
    return model


def grown(nodes: int) -> Growth:
    """Return what a document of about so many nodes takes, once each."""
    model = room(nodes)
    with no_collection():
        times = [perf_counter()]
        text = document_of(model)
        times.append(perf_counter())
        read(text)
        times.append(perf_counter())
        data = to_bytes(model)
        times.append(perf_counter())
        from_bytes(data)
        times.append(perf_counter())
    return Growth(text.count("\n[") - 1, *(after - before for before, after in itertools.pairwise(times)))
