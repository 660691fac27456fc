"""Standard streams that are closed, full, in other encodings; names that would steer a terminal."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from kineverse.cli import output
from kineverse.cli.output import escape_controls, format_table, safe_streams

NAME = "a\u009b31m\u202eb"
ROBOT = f"""<robot name="r"><link name="base"/><link name="{NAME}"/>
<joint name="{NAME}j" type="continuous"><parent link="base"/><child link="{NAME}"/></joint></robot>"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "robot.urdf"
    path.write_text(ROBOT, "utf-8")
    return path


def kineverse(*words: object, shell: str = '"$@"', **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run the command by a line of the shell, in which ``"$@"`` is the command."""
    command = ["/bin/sh", "-c", shell, "sh", sys.executable, "-m", "kineverse", *map(str, words)]
    return subprocess.run(
        command, capture_output=True, timeout=120, env={**os.environ, **environment}, check=False
    )


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred", "\\x1b[31mred"),
        ("\x9b31m\x7f\x00", "\\x9b31m\\x7f\\x00"),
        ("\u202ecod.exe\u2066", "\\u202ecod.exe\\u2066"),
        ("тело → 机\t\n", "тело → 机\t\n"),
    ],
)
def test_escape_controls_leaves_no_control_and_all_letters(text: str, shown: str) -> None:
    assert escape_controls(text) == shown


def test_only_colours_and_ends_of_lines_of_our_own_reach_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdout", screen := Terminal())
    with safe_streams():
        print("\033[32mgreen\033[0m \r\033[K \033[2J \033]0;title\a \u202e")
    assert screen.getvalue() == "\033[32mgreen\033[0m \r\033[K \\x1b[2J \\x1b]0;title\\x07 \\u202e\n"
    assert sys.stdout is screen


@pytest.mark.parametrize(
    ("encoding", "written"),
    [("ascii", b"-> +- deg e ? ?"), ("latin-1", b"-> \xb1 \xb0 \xe9 ? ?"), ("utf-8", None)],
)
def test_characters_that_an_encoding_lacks_are_replaced(
    monkeypatch: pytest.MonkeyPatch, encoding: str, written: bytes | None
) -> None:
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw := io.BytesIO(), encoding, errors="strict"))
    with safe_streams():
        print("→ ± ° é 机 \udce9", end="", flush=True)
    assert raw.getvalue() == (written or "→ ± ° é 机 ?".encode())
    assert sys.stdout.errors == "strict"


def test_a_cell_of_a_table_is_one_line() -> None:
    assert len(format_table(("name",), [("a\nb\tc\r",)]).splitlines()) == 3


def test_names_from_files_do_not_steer_the_terminal(run, file: Path) -> None:
    for words in (
        ["info", file, "--frames", "--constraints"],
        ["fk", file, NAME],
        ["fk", file, "\x1b]0;x\x07"],
    ):
        _, out, err = run(*words)
        assert not set(out + err) & {chr(n) for n in (*range(9), *range(11, 32), *range(127, 160), 0x202E)}


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_output_in_any_encoding_is_written(file: Path, encoding: str) -> None:
    done = kineverse("convert", file, file.with_name("m.kv.json"), PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b" -> " in done.stdout


def test_files_are_read_in_a_locale_without_utf_8(file: Path) -> None:
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = kineverse("info", file, "--json", **plain)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("shell", "status", "says"),
    [
        ('"$@" >&-', 2, b"kineverse: Standard output is closed. Redirect it"),
        ('"$@" 2>&-', 0, b""),
        ('"$@" > /dev/full', 2, b"kineverse: standard output: No space left on device"),
        ('"$@" 2> /dev/full', 0, b""),
        ('("$@"; echo $? >&2) | true', 0, b""),
    ],
)
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_streams_that_cannot_be_written_end_with_one_line(
    file: Path, shell: str, status: int, says: bytes
) -> None:
    done = kineverse("info", file, shell=shell)
    assert done.returncode == status
    assert done.stderr.startswith(says)
    assert done.stderr.count(b"\n") <= 1


@pytest.mark.skipif(os.name != "posix", reason="there is no SIGTERM")
def test_sigterm_ends_a_command_like_an_exception(tmp_path: Path) -> None:
    program = f"""
import atexit, os, pathlib, signal, sys
from kineverse.cli import main, info
atexit.register(pathlib.Path({str(tmp_path / "left")!r}).touch)
info.run = lambda arguments: os.kill(os.getpid(), signal.SIGTERM)
sys.argv = ["kineverse", "info", "kitchen"]
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", program], timeout=60, check=False)
    assert done.returncode == 128 + signal.SIGTERM
    assert (tmp_path / "left").exists()


def test_unwrap_stream_returns_what_commands_were_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", own := io.StringIO())
    with safe_streams():
        assert output.unwrap_stream(sys.stderr) is own
    assert output.unwrap_stream(own) is own
