"""The fuzzer of tools/fuzz: a short run over every reader, and its detection of violations."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import replace
from itertools import islice
from pathlib import Path
from random import Random

import pytest

import kineverse as kv
from kineverse.formats.document import read_operations, to_json
from kineverse.formats.document.structs import NODES
from kineverse.model.traces.trace_queries import QUERY_KINDS as QUESTIONS

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

from fuzz import programs  # noqa: E402  - it is no part of the package
from fuzz.check_options import CheckOptions, choose_options  # noqa: E402
from fuzz.edits import ATTEMPTS, apply_random_edits  # noqa: E402
from fuzz.findings import FindingStore  # noqa: E402
from fuzz.grammars import document  # noqa: E402
from fuzz.inputs import inputs  # noqa: E402
from fuzz.invariants import OutcomeCounts, check  # noqa: E402
from fuzz.minimise import minimise  # noqa: E402
from fuzz.targets import TARGETS, Target  # noqa: E402
from fuzz.worker import make_input_folder  # noqa: E402

COUNTS = {"urdf": 40, "sdf": 40, "mjcf": 12, "document": 50}


@pytest.fixture
def folder(tmp_path) -> Path:
    return make_input_folder(tmp_path)


@pytest.mark.parametrize("name", TARGETS)
def test_fuzzing_finds_no_violation(name, folder):
    target, counts = TARGETS[name], OutcomeCounts()
    count = COUNTS.get(name, 40)
    for data in islice(inputs(target, target.own_seeds(), Random(7)), count):
        options = choose_options(data)
        found = check(target, data, folder, counts, options)
        assert found is None, (found, options, data)
    # Neither all good nor all bad, or the grammars would test nothing.
    assert counts.models > count / 20
    assert counts.errors > count / 20


@pytest.mark.parametrize("name", TARGETS)
def test_all_seeds_load(name, folder):
    target, counts = TARGETS[name], OutcomeCounts()
    seeds = target.own_seeds()
    assert seeds
    for data in seeds:
        assert check(target, data, folder, counts) is None
    assert counts == OutcomeCounts(models=len(seeds))


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_are_reproducible(name):
    target = TARGETS[name]
    once, again = (list(islice(inputs(target, target.own_seeds(), Random(3)), 20)) for _ in range(2))
    assert once == again


def broken(read) -> Target:
    return replace(TARGETS["urdf"], operations=lambda data, folder, prefix: read(data.decode(), folder))


def other_error(text, folder):
    raise KeyError(text)


def warning(text, folder):
    warnings.warn("careful", stacklevel=1)
    return ()


def long_message(text, folder):
    raise kv.errors.FormatError("input.urdf: " + "x" * 2000)


def half_a_pair(text, folder):
    raise kv.errors.FormatError("input.urdf: \ud800")


def no_message(text, folder):
    raise kv.errors.FormatError("")


def another_kind(text, folder):
    raise kv.errors.UnknownNameError("x")


def nowhere(text, folder):
    raise kv.errors.FormatError("something is wrong")


def opens_files(text, folder):
    Path("/etc/hostname").exists()
    with open(Path(__file__), "rb"):
        return ()


def opens_files_beside(text, folder):
    (folder / "part" / "model.sdf").read_bytes()
    return ()


def taken_twice(text, folder):
    return [(None, kv.Fixed(name="j", parent="world", child="l")) for _ in range(2)]


def far_away(text, folder):
    far = {"axis": (1, 0, 0), "lower": 1e308, "upper": 1.1e308}
    return [
        (None, kv.Prismatic(name="j", parent="world", child="l", **far)),
        (None, kv.Prismatic(name="k", parent="l", child="m", **far)),
    ]


@pytest.mark.parametrize(
    ("read", "signature"),
    [
        (other_error, "KeyError at"),
        (warning, "UserWarning at"),
        (long_message, "long message of FormatError"),
        (half_a_pair, "message of FormatError"),
        (no_message, "no message of FormatError"),
        (opens_files, "reaches out: open"),
        (far_away, "broken: a pose is not finite"),
        (another_kind, "broken: an error of another kind, at"),
        (nowhere, "broken: an error without place, at"),
        (taken_twice, "broken: what was read cannot be applied, at"),
        (opens_files_beside, None),
    ],
)
def test_violations_are_detected(read, signature, folder):
    finding = check(broken(read), b"", folder)
    assert (finding and finding.signature[: len(signature or "")]) == signature


@pytest.mark.parametrize(
    ("name", "text", "part"),
    [
        ("urdf", '<robot name="r"><link name="a"><bad x="1"/></link><link name="b"/></robot>', b"<bad"),
        ("document", '{"nodes": [1, [2, {"bad": [3, 4]}]], "operations": {}}', b'"bad"'),
        ("sdf", "no <tree at all, and bad all the same", b"bad"),
    ],
)
def test_failing_inputs_are_minimised(name, text, part):
    small = minimise(text.encode(), TARGETS[name], lambda data: part in data)
    assert part in small
    assert len(small) < 20


def test_names_without_the_prefix_are_detected(folder):
    target = TARGETS["urdf"]
    ignores = replace(target, operations=lambda data, folder, prefix: target.operations(data, folder, None))
    data = b'<robot name="r"><link name="a"/></robot>'
    assert check(target, data, folder, options=CheckOptions(prefix="p")) is None
    finding = check(ignores, data, folder, options=CheckOptions(prefix="p"))
    assert finding is not None
    assert finding.signature == "broken: a name without the prefix"


def test_grammar_documents_have_all_node_types_and_conditions():
    nodes, questions = set(), set()
    for seed in range(150):
        tree = json.loads(document.generate(Random(seed)))
        nodes |= {node[0] for one in tree["operations"] for node in one.get("nodes", [])}
        traces = [operation["trace"] for operation in tree["operations"] if "trace" in operation]
        questions |= {question[0] for trace in traces for question in trace["questions"]}
    assert nodes >= set(NODES)
    assert questions >= set(QUESTIONS)


def test_edits_are_applied_and_undone():
    """Some edits are followed by operations without code, some are refused, and all are undone."""
    taken = 0
    for seed in range(12):
        model = kv.Model()
        with model.edit() as edit:
            for tag, operation in read_operations(programs.document(Random(seed))):
                edit.apply(operation, tag)
        before = to_json(model)

        def changed(model: kv.Model = model, before: str = before) -> None:
            nonlocal taken
            taken += to_json(model) != before

        apply_random_edits(model, seed, changed)
        assert to_json(model) == before
    assert 3 < taken < 12 * ATTEMPTS


def test_the_smallest_input_is_kept(tmp_path, folder):
    records = FindingStore(tmp_path / "findings")
    finding = check(broken(other_error), b"", folder)
    assert records.add(finding, b"long")
    assert not records.add(finding, b"short")
    assert not records.add(finding, b"s")
    ((signature, path),) = records.all()
    assert signature == finding.signature
    assert path.read_bytes() == b"s"
