"""Every file of ``urdf_conformance`` has its degrees of freedom or is refused for its reason."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest
from urdf_outcomes import COUNT, expected_outcome

import kineverse as kv
from kineverse.formats.reader_warnings import Fault, collect_warnings
from kineverse.formats.urdf import parse_urdf, read_urdf
from published_data import published_files, published_path, relative_name

pytestmark = pytest.mark.data

FOLDER = "urdf_conformance"
FILES = [relative_name(path) for path in published_files(".urdf", FOLDER)] or [f"{FOLDER}/none.urdf"]
DOCS = Path(__file__).parents[2] / "docs" / "urdf.md"


@pytest.mark.parametrize("strict", [False, True], ids=["", "strict"])
@pytest.mark.parametrize("name", FILES)
@pytest.mark.sampled(2)
def test_dofs_or_errors_of_all_files(name: str, strict: bool):
    path, file = published_path(name), Path(name)
    expected = expected_outcome(file, strict)
    if isinstance(expected, str):
        with pytest.raises(kv.errors.FormatError) as info:
            kv.load(path, strict=strict)
        assert str(info.value).startswith(f"{file.name}, {expected}")
    else:
        with collect_warnings() as remarks:
            model = kv.load(path, prefix="p", strict=strict)
        refused = isinstance(expected_outcome(file, strict=True), str)
        assert any(isinstance(remark, Fault) for remark in remarks) == refused
        assert sum(len(record.speeds) for record in model.articulations.values()) == expected
        assert len(model.frames) == len(read_urdf(path).links)


def parsers() -> dict[str, list[str]]:
    """Return what five parsers say of each file: ``ok``, ``fail:...``, ``nv=...``, ``dof=...``."""
    with published_path(FOLDER, "verdicts.tsv").open() as table:
        return {row[0]: row[1:6] for row in list(csv.reader(table, delimiter="\t"))[1:]}


def test_no_file_is_left_out():
    assert len(parsers()) == len(FILES) == COUNT


def test_files_on_which_all_parsers_agree_are_read_alike():
    for file, said in parsers().items():
        failures = sum(text.startswith("fail") for text in said)
        loaded = isinstance(expected_outcome(Path(file)), int)
        if failures == 0:
            assert loaded, file
        if failures == 5:
            assert isinstance(expected_outcome(Path(file), strict=True), str), file


def test_files_that_pinocchio_reads_are_read():
    """The second of the five is pinocchio."""
    for file, said in parsers().items():
        assert said[1].startswith("fail") or isinstance(expected_outcome(Path(file)), int), file


def test_degrees_of_freedom_are_those_of_the_other_parsers():
    for file, said in parsers().items():
        expected = expected_outcome(Path(file))
        counts = {int(text.partition("=")[2]) for text in said if text.startswith(("nv=", "dof="))}
        if isinstance(expected, int) and counts:
            # A planar joint has two coordinates in yourdfpy.
            planar = sum(joint.kind == "planar" for joint in read_urdf(published_path(file)).joints)
            assert {expected, expected - planar} & counts, file


def test_documentation_lists_every_disagreement():
    text = DOCS.read_text()
    disagreed = [
        Path(file).name
        for file, said in parsers().items()
        if 0 < sum(answer.startswith("fail") for answer in said) < 5
    ]
    assert len(disagreed) == 41
    # Long names are listed by their last part.
    assert [name for name in disagreed if name not in text and name.rpartition("__")[2] not in text] == []


TEXT = (Path(__file__).parents[2] / "docs" / "urdf.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, flags=re.DOTALL)


def test_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert blocks("python")
    for code in blocks("python"):
        exec(compile(code, "docs/urdf.md", "exec"), {})


def test_documented_messages_are_those_of_the_reader():
    (lamp,) = re.findall(r'parse_urdf\("""(.*?)"""\)', blocks("python")[0], flags=re.DOTALL)
    messages = blocks("text")[-1]
    mistakes = [
        lamp.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', 1),
        lamp.replace('<mimic joint="shoulder"', '<mimic joint="sholder"'),
    ]
    for text, message in zip(mistakes, messages.splitlines(), strict=True):
        with pytest.raises(kv.errors.FormatError) as info:
            parse_urdf(text, source="lamp.urdf", strict=True)
        assert str(info.value) == message
