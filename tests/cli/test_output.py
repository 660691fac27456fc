import argparse
import io
import math
import sys

import pytest

from kineverse.cli.command_line import make_parser
from kineverse.cli.output import format_table, name_options, shorten_text, show_progress
from kineverse.expressions.printing import format_number


def test_format_table_aligns_columns():
    text = format_table(("name", "value"), [("a", "1"), ("longer", "10")], "<>")
    assert text.splitlines() == ["name    value", "------  -----", "a           1", "longer     10"]


def test_format_table_cuts_the_first_column_in_its_middle():
    text = format_table(("name", "value"), [("kitchen/a_very_long_name_of_a_frame", "1")], "<>", width=30)
    assert all(len(line) <= 30 for line in text.splitlines())
    assert "kitchen/a" in text
    assert "of_a_frame" in text
    assert "..." in text


def test_format_table_without_rows_has_a_head():
    assert format_table(("a",), []).splitlines() == ["a", "-"]
    assert shorten_text("short", 10) == "short"


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (-0.0, "0"), (math.inf, "-"), (-math.inf, "-"), (1.23456, "1.235")]
)
def test_format_number_rounds_to_significant_digits(value, text):
    assert format_number(value) == text


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_is_shown_on_a_terminal_and_not_in_a_pipe(monkeypatch):
    pipe, terminal = io.StringIO(), Terminal()
    monkeypatch.setattr(sys, "stderr", pipe)
    assert list(show_progress([1, 2, 3], "working")) == [1, 2, 3]
    assert pipe.getvalue() == ""
    monkeypatch.setattr(sys, "stderr", terminal)
    assert list(show_progress([1, 2, 3], "working", "steps")) == [1, 2, 3]
    assert "working" in terminal.getvalue()


def test_table_on_a_terminal_is_drawn_and_its_cells_are_escaped(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.delenv("NO_COLOR", raising=False)
    rows = [("a\x1b]0;title\x07", "1"), ("b", "a reason of many words, which goes on below")]
    text = format_table(("name", "value"), rows)
    assert "\x1b[1m" in text
    assert "───" in text
    assert "\\x1b]0;title\\x07" in text
    assert "which goes" in text
    assert len(text.splitlines()) > 4
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b" not in format_table(("name", "value"), [("a", "1")])
    assert format_table(("name",), [("a",)]).splitlines()[1] == "----"


def test_messages_name_options_in_place_of_arguments():
    arguments = argparse.Namespace(command=make_parser("plan")._subparsers._group_actions[0].choices["plan"])
    text = "The time is up. Give more seconds=, or margin=. logic= is 'and'; leave_out='a', a=3."
    assert name_options(text, arguments) == (
        "The time is up. Give more --seconds, or --margin. logic= is 'and'; leave_out='a', a=3."
    )
