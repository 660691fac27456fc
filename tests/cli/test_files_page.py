"""What ``docs/files.md`` shows of the command line is what one sees."""

from __future__ import annotations

import re
import shlex

from examples import ROOT, agree, examples, run
from kineverse.cli import main

PAGE = ROOT / "docs" / "files.md"


def test_the_commands_print_what_the_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(PAGE)  # writes the files
    shown = 0
    for example in examples(PAGE, "console"):
        for command, output in re.findall(
            r"^\$ kineverse (.*)\n((?:(?!\$ ).*\n)*)", example.code, re.MULTILINE
        ):
            main(shlex.split(command))
            captured = capsys.readouterr()
            assert captured.err == "", command
            assert agree(output, captured.out), f"{command} prints\n{captured.out}"
            shown += 1
    assert shown == PAGE.read_text(encoding="utf-8").count("\n$ kineverse ")
