"""The fuzzer of tools/fuzz itself: a short pass over every reader, and that it sees what is wrong."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from itertools import islice
from pathlib import Path
from random import Random

import pytest

import kineverse as kv

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

from fuzz.inputs import inputs  # noqa: E402  - it is no part of the package
from fuzz.law import Tally, check  # noqa: E402
from fuzz.minimise import minimise  # noqa: E402
from fuzz.records import Records  # noqa: E402
from fuzz.targets import TARGETS, Target  # noqa: E402
from fuzz.ways import way_of  # noqa: E402
from fuzz.worker import place  # noqa: E402

COUNTS = {"urdf": 300, "sdf": 100, "mjcf": 60, "document": 300}


@pytest.fixture
def folder(tmp_path) -> Path:
    return place(tmp_path)


@pytest.mark.parametrize("name", TARGETS)
def test_the_law_holds_for_a_while(name, folder):
    target, tally = TARGETS[name], Tally()
    count = COUNTS.get(name, 100)
    for data in islice(inputs(target, target.own_seeds(), Random(7)), count):
        way = way_of(data)
        assert check(target, data, folder, tally, way) is None, (way, data)
    # Neither all good nor all bad, or the grammars would test nothing.
    assert tally.models > count / 20
    assert tally.errors > count / 20


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_models(name, folder):
    target, tally = TARGETS[name], Tally()
    seeds = target.own_seeds()
    assert seeds
    for data in seeds:
        assert check(target, data, folder, tally) is None
    assert tally == Tally(models=len(seeds))


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_repeat(name):
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
    raise kv.FormatError("input.urdf: " + "x" * 2000)


def half_a_pair(text, folder):
    raise kv.FormatError("input.urdf: \ud800")


def no_message(text, folder):
    raise kv.FormatError("")


def another_kind(text, folder):
    raise kv.UnknownNameError("x")


def nowhere(text, folder):
    raise kv.FormatError("something is wrong")


def opens_files(text, folder):
    Path("/etc/hostname").exists()
    with open(Path(__file__), "rb"):
        return ()


def opens_files_beside(text, folder):
    (folder / "part" / "model.sdf").read_bytes()
    return ()


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
        (opens_files_beside, None),
    ],
)
def test_what_breaks_the_law_is_seen(read, signature, folder):
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
def test_inputs_are_made_small(name, text, part):
    small = minimise(text.encode(), TARGETS[name], lambda data: part in data)
    assert part in small
    assert len(small) < 20


def test_the_smallest_input_is_kept(tmp_path, folder):
    records = Records(tmp_path / "findings")
    finding = check(broken(other_error), b"", folder)
    assert records.add(finding, b"long")
    assert not records.add(finding, b"short")
    assert not records.add(finding, b"s")
    ((signature, path),) = records.all()
    assert signature == finding.signature
    assert path.read_bytes() == b"s"
