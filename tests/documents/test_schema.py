"""The published JSON Schema: what is written follows it, it knows what the reader knows, and both refuse the same."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest
from document_models import rich_model
from jsonschema import Draft202012Validator

import kineverse as kv
from kineverse.formats.document import read_operations, schema, to_json
from kineverse.formats.document.node_types import BINARY, NODE_TYPES, UNARY
from kineverse.formats.document.parameters import TAGS
from kineverse.formats.document.values import GEOMETRIES
from kineverse.model.operation import KINDS
from kineverse.model.traces import trace_queries
from kineverse.symbols import ROLES

SCHEMA = schema()
DEFINITIONS = SCHEMA["$defs"]
VALID = Draft202012Validator(SCHEMA)
MODELS = {
    "rich": rich_model,
    **{
        name: lambda name=name: kv.load(name)
        for name in (
            "kitchen",
            "pr2",
            "articulations/four_bar",
            "articulations/latch",
            "articulations/gearbox",
            "articulations/ball",
        )
    },
}


def test_schema_is_valid_json_schema() -> None:
    Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.sampled(2)
def test_written_documents_follow_the_schema(name: str) -> None:
    error = next(VALID.iter_errors(json.loads(to_json(MODELS[name]()))), None)
    assert error is None, f"{error.json_path}: {error.message[:300]}"


def branches(what: str) -> list[str]:
    """Return the values of the first item between which a definition chooses."""
    definition = DEFINITIONS[what]
    firsts = [branch["if"]["prefixItems"][0]["const"] for branch in definition["allOf"]]
    assert firsts == definition["prefixItems"][0]["enum"]
    assert [branch["then"] for branch in definition["allOf"]] == [
        {"$ref": f"#/$defs/{what}_{first}"} for first in firsts
    ]
    return firsts


def test_schema_lists_the_names_of_the_reader() -> None:
    """Both ways: nothing is only here, nothing only there."""
    assert set(branches("node")) == set(NODE_TYPES)
    for kind in NODE_TYPES:
        shapes = DEFINITIONS[f"node_{kind}"]
        for shape in shapes.get("oneOf", [shapes]):
            assert shape["prefixItems"][0] == {"const": kind}
    one, two = (shape["prefixItems"][1]["enum"] for shape in DEFINITIONS["node_elementary"]["oneOf"])
    assert (set(one), set(two)) == (set(UNARY), set(BINARY))
    plain, parameter = (shape["prefixItems"][3] for shape in DEFINITIONS["node_symbol"]["oneOf"])
    assert {*plain["enum"], parameter["const"]} == set(ROLES)
    assert set(branches("question")) == set(trace_queries.QUERY_KINDS)
    for kind, asked in trace_queries.QUERY_KINDS.items():
        assert len(DEFINITIONS[f"question_{kind}"]["prefixItems"]) == 2 + asked.arguments
    assert DEFINITIONS["kind"]["enum"] == list(KINDS) == list(DEFINITIONS["writes"]["properties"])
    assert all(f"kind_{kind}" in DEFINITIONS for kind in KINDS)
    assert [next(iter(g["properties"])) for g in DEFINITIONS["geometry"]["oneOf"]] == list(GEOMETRIES)
    tags = {tag for branch in DEFINITIONS["parameter"]["then"]["oneOf"] for tag in branch["properties"]}
    assert tags == {*TAGS, "fields"}


NODE = '{"format": "kineverse", "version": 1, "nodes": [["symbol", "a", 0, "dof"], %s], "operations": []}'
OPERATION = (
    '{"format": "kineverse", "version": 1, "nodes": [["symbol", "a", 0, "dof"]], "operations": '
    '[{"tag": "t", "kind": "k", "reads": {}, "writes": {}%s}]}'
)
WRITES = OPERATION.replace('"writes": {}%s', '"writes": %s')


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"format": "kineverse", "version": 2, "nodes": [], "operations": []}',
        '{"format": "kineverse", "version": 1, "nodes": [], "operations": [], "more": 1}',
        '{"format": "kineverse", "version": 1, "nodes": [], "operations": [], "sha256": "abc"}',
        NODE % "[]",
        NODE % "7",
        NODE % '["surprise", 1]',
        NODE % '["constant"]',
        NODE % '["constant", 1, 2]',
        NODE % '["constant", "1"]',
        NODE % '["constant", true]',
        NODE % '["symbol", "a//b", 0, "dof"]',
        NODE % '["symbol", "a", -1, "dof"]',
        NODE % '["symbol", "a", 0, "king"]',
        NODE % '["symbol", "a", 0, "parameter"]',
        NODE % '["symbol", "a", 0, "dof", 1.0]',
        NODE % '["elementary", "eval", 0]',
        NODE % '["elementary", "sin", 0, 0]',
        NODE % '["elementary", "add", 0]',
        NODE % '["elementary", "add", 0, -1]',
        NODE % '["elementary", "add", 0, 0.5]',
        NODE % '["matrix", [-1], []]',
        NODE % '["matrix", [1], ["a"]]',
        NODE % '["less", 0, 0, 0]',
        NODE % '["not", 0, 0]',
        NODE % '["extremum", "mean", 0, 0]',
        NODE % '["extremum", "min", 0]',
        NODE % '["augment", 0, 1, false, []]',
        NODE % '["augment", 0, true, false, [[0]]]',
        NODE % '["piecewise", 0, false, [0, "inf"], [[1], [1], [1]]]',
        NODE % '["carried", 0, []]',
        NODE % '["read", 0, 0, [1], [[0, 1]]]',
        NODE % '["implicit", "a", [], [], 0, [], 0, 1, []]',
        NODE % '["implicit", "a", [1], [0], 0, [0], 0, 1, [0], [[0]]]',
        NODE % '["implicit", "a", [1], [0], 0, [0], 0, 1, [0], [[0, "one"]]]',
        OPERATION % ', "parameters": []',
        OPERATION % ', "parameters": {"a": {"b": 1}}',
        OPERATION % ', "parameters": {"a": {"pose": [1]}}',
        OPERATION % ', "parameters": {"a": {"integer": "0x1"}}',
        OPERATION % ', "parameters": {"a": {"float": "nan"}}',
        OPERATION % ', "trace": {}',
        OPERATION % ', "trace": {"questions": [["fk", 0, "a"]], "writes": {}}',
        OPERATION % ', "trace": {"questions": [["why", 0, "a"]], "writes": {}}',
        OPERATION % ', "trace": {"questions": [["fk", 3, "a", "b"]], "writes": {}}',
        OPERATION % ', "frozen": 1',
        WRITES % '{"souls": {}}',
        WRITES % '{"data": {"a//b": 1}}',
        WRITES % '{"frames": {"a": {"parent": "world"}}}',
        WRITES % '{"frames": {"a": {"parent": "world", "factors": [[1, 2]]}}}',
        WRITES % '{"constraints": {"a": [0, 0]}}',
        WRITES % '{"rates": {"a": [0, [[0]]]}}',
        WRITES % '{"bodies": {"a": {"visuals": [], "collisions": [{}]}}}',
        WRITES % '{"bodies": {"a": {"visuals": [{"geometry": {"egg": 1}, "origin": []}], "collisions": []}}}',
        WRITES % '{"articulations": {"a": {"kind": "k"}}}',
    ],
)
def test_schema_and_reader_refuse_alike(text: str) -> None:
    assert not VALID.is_valid(json.loads(text))
    with pytest.raises(kv.errors.FormatError):
        read_operations(text)


def test_a_parameter_is_no_schema_of_its_own() -> None:
    """What the two tests above build on is accepted by both."""
    for text in (
        NODE % '["constant", 1]',
        OPERATION % "",
        OPERATION % ', "parameters": {"a": [{"integer": "-12"}]}',
        WRITES % "{}",
    ):
        assert VALID.is_valid(json.loads(text))
        read_operations(text)


def test_schema_is_in_the_package() -> None:
    """Where others find it, without anything but the standard library."""
    script = (
        "from importlib.resources import files; import json;"
        "print(json.loads(files('kineverse.formats.document').joinpath('schema.json').read_text('utf-8'))['$id'])"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, text=True).stdout
    assert said == f"{SCHEMA['$id']}\n"


def test_every_definition_of_the_schema_is_used() -> None:
    text = json.dumps(SCHEMA)
    unused: list[Any] = [name for name in DEFINITIONS if f'"#/$defs/{name}"' not in text]
    assert unused == []
