"""The published JSON Schema: what is written follows it, it knows what the reader knows, and both refuse the same."""

from __future__ import annotations

import json

import pytest
from document_models import rich_model
from jsonschema import Draft202012Validator

import kineverse as kv
from kineverse.formats.document import read_operations, schema, to_json
from kineverse.formats.document.structs import NODES
from kineverse.model.operation import KINDS

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


def test_schema_lists_the_names_of_the_reader() -> None:
    """Both ways: nothing is only here, nothing only there."""
    operation = DEFINITIONS["OperationValue"]["properties"]
    nodes = [DEFINITIONS[one["$ref"].rpartition("/")[2]] for one in operation["nodes"]["items"]["anyOf"]]
    assert {node["prefixItems"][0]["enum"][0] for node in nodes} == set(NODES)
    assert list(DEFINITIONS["WritesValue"]["properties"]) == list(KINDS)
    assert set(DEFINITIONS["Mesh"]["properties"]) == {"kind", "uri", "scale"}


OPERATION = '{"format": "kineverse", "version": 2, "operations": [{"tag": "t", "kind": "k", "writes": {}%s}]}'
NODE = OPERATION % ', "nodes": [["symbol", "a", 0, "dof"], %s]'
WRITES = OPERATION.replace('"writes": {}%s', '"writes": %s')


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"format": "kineverse", "version": 1, "operations": []}',
        '{"format": "kineverse", "version": 2, "operations": [], "more": 1}',
        '{"format": "kineverse", "version": 2, "operations": [], "sha256": "abc"}',
        NODE % "[]",
        NODE % "7",
        NODE % '["surprise", 1]',
        NODE % '["constant"]',
        NODE % '["constant", "1"]',
        NODE % '["symbol", "a", -1, "dof"]',
        NODE % '["symbol", "a", 0, "king"]',
        NODE % '["elementary", "add", [0, 0.5]]',
        NODE % '["matrix", [-1], []]',
        NODE % '["extremum", "min", [0]]',
        NODE % '["augment", 0, 1, false, []]',
        NODE % '["augment", 0, true, false, [[0]]]',
        NODE % '["read", 0, 0, [1], [[0, 1]]]',
        OPERATION % ', "parameters": []',
        OPERATION % ', "trace": {}',
        OPERATION % ', "frozen": 1',
        WRITES % '{"souls": {}}',
        WRITES % '{"frames": {"a": {"parent": "world"}}}',
        WRITES % '{"frames": {"a": {"parent": "world", "factors": [[[1, 2]]]}}}',
        WRITES % '{"constraints": {"a": [0, 0]}}',
        WRITES % '{"rates": {"a": [0, [[0]]]}}',
        WRITES % '{"bodies": {"a": {"collisions": [{}]}}}',
        WRITES % '{"bodies": {"a": {"visuals": [{"geometry": {"kind": "egg"}}]}}}',
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
        OPERATION % ', "parameters": {"a": [{"integer": "-9223372036854775808"}]}',
        WRITES % "{}",
    ):
        assert VALID.is_valid(json.loads(text))
        read_operations(text)
