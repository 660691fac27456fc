"""The examples of ``docs/urdf.md`` run, and the messages it shows are the ones that are given."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.formats.urdf import parse_urdf

TEXT = (Path(__file__).parents[2] / "docs" / "urdf.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, flags=re.DOTALL)


def test_examples_run():
    assert blocks("python")
    for code in blocks("python"):
        exec(compile(code, "docs/urdf.md", "exec"), {})


def test_documented_messages_are_those_of_the_reader():
    (lamp,) = re.findall(r'parse_urdf\("""(.*?)"""\)', blocks("python")[0], flags=re.DOTALL)
    (messages,) = blocks("text")
    mistakes = [
        lamp.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', 1),
        lamp.replace('<mimic joint="shoulder"', '<mimic joint="sholder"'),
    ]
    for text, message in zip(mistakes, messages.splitlines(), strict=True):
        with pytest.raises(kv.errors.FormatError) as info:
            parse_urdf(text, source="lamp.urdf", strict=True)
        assert str(info.value) == message
