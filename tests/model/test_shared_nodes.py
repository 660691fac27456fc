"""A node met on many paths is the work of one: the number of paths doubles and triples with every level."""

from __future__ import annotations

import json

import numpy as np
import pytest

import kineverse as kv
from kineverse.formats.document import read_operations, to_json
from kineverse.model.rates import Rates, as_row, collect_symbols, to_plain

a, b = kv.position("a"), kv.position("b")
w = kv.velocity("w")
LEVELS = 40

NESTED = {
    "where": lambda e: kv.where(e < b, e + 1, e * 2),
    "extremum": lambda e: kv.maximum(np.sin(e), kv.minimum(e, b)),
    "norm": lambda e: kv.norm(kv.array([e, 2 * e, b])),
    "and": lambda e: (np.sin(e) < b) & (2 * e < b),
    "augment": lambda e: (b * e + e * e).augment({w: e}),
}


def nested(kind: str, levels: int = LEVELS) -> kv.Expression:
    e: kv.Expression = a
    for _ in range(levels):
        e = NESTED[kind](e)
    return e


@pytest.mark.parametrize("kind", NESTED)
def test_a_model_of_shared_nodes(kind):
    e, model = nested(kind), kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", "world", kv.translation(e, 0, 0))
        edit.constrain("c", 0, e, 1)
        edit.set_rate(a, {w: np.cos(a)})
    carried = model.fk("f")
    values = {"a": 0.25, "b": 0.5}
    assert to_plain(carried)(values)[0, 3] == e(values)
    assert collect_symbols(carried) == {a, b}
    assert w in carried.gradient()
    assert to_plain(carried.substitute({a: a + b}))(values)[0, 3] == e({"a": 0.75, "b": 0.5})
    assert model.constraints["c"].expression == carried[0, 3]
    assert read_operations(to_json(model))


def test_rates_of_shared_nodes():
    e = nested("where")
    rates = Rates({a: as_row(a, {w: e})})
    assert Rates({a: as_row(a, {w: rates.carry(e)})}) == rates
    assert rates.symbols == {a, b, w, w.position}


def test_a_small_document_is_read_at_once():
    nodes: list[list] = [["symbol", "a", 0, "dof"], ["constant", 1.0], ["constant", 0.0]]
    last = 0
    for _ in range(LEVELS):
        n = len(nodes)
        nodes += [["elementary", "add", [last, 1]], ["elementary", "twice", [last]]]
        nodes.append(["select", last, n, n + 1])
        last = n + 2
    writes = {"constraints": {"c": [2, last, 1]}}
    operations = [{"tag": "c", "kind": "Constrain", "nodes": nodes, "writes": writes}]
    text = json.dumps({"format": "kineverse", "version": 2, "operations": operations})
    model = kv.Model()
    with model.edit() as edit:
        for tag, operation in read_operations(text):
            edit.apply(operation, tag)
    assert model.violations({"a": -1.0}).unchecked == ()


def test_fifteen_hundred_levels_are_no_recursion():
    e: kv.Expression = a
    for _ in range(1500):
        e = (e + 1).augment({w: e})
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("c", 0, e, 1)
    assert model.constraints["c"].expression == e
    assert collect_symbols(e) == {a}
    assert to_plain(e) is e
