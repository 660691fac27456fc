"""Commands of other distributions, which are found by entry points; what is broken is one line and status 2."""

import subprocess
import sys

import pytest

from kineverse.cli import command_line
from kineverse.cli.command_line import COMMANDS, find_added_commands, load_command

GREETING = """HELP = "greet somebody"
def add_arguments(parser):
    parser.add_argument("name")
def run(arguments):
    print("Hello", arguments.name)
    return 3
"""


@pytest.fixture
def add_command(tmp_path, monkeypatch):
    """Return a function that installs a distribution ``other`` with a command and the text of its module."""

    def add(name, text, module="other_command"):
        about = tmp_path / "other-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n", "utf-8")
        (about / "entry_points.txt").write_text(f"[kineverse.commands]\n{name} = {module}\n", "utf-8")
        if text is not None:
            (tmp_path / f"{module}.py").write_text(text, encoding="utf-8")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, module, raising=False)

    return add


@pytest.fixture
def without_added_commands(monkeypatch):
    """Have no distribution add a command."""
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: ())


def test_command_of_another_distribution_runs(run, add_command):
    add_command("greet", GREETING)
    assert run("greet", "Ada") == (3, "Hello Ada\n", "")
    status, out, err = run("greet", "--help")
    assert (status, err) == (0, "")
    assert "greet somebody" in out
    status, _, err = run("gret", "Ada")
    assert status == 2
    assert "'greet'" in err


def test_command_of_others_may_have_an_option_v(run, add_command):
    add_command("greet", GREETING.replace('"name"', '"-v", dest="name"'))
    assert run("greet", "-v", "Ada", "--verbose") == (3, "Hello Ada\n", "")


def test_damaged_entry_points_of_others_leave_the_help(run, add_command, tmp_path):
    add_command("greet", GREETING)
    next(tmp_path.glob("*/entry_points.txt")).write_text("[kineverse.commands]\nno sign here\n", "utf-8")
    status, out, err = run("--help")
    assert status == 0
    assert "info" in out
    assert len(err.splitlines()) == 1
    assert "entry points" in err


def test_help_lists_commands_of_others_without_importing_them(run, add_command):
    add_command("greet", "raise SystemExit('imported')")
    for words in (["--help"], []):
        status, out, err = run(*words)
        assert (status, err) == (0, "")
        assert "greet" in out
        assert "command of other" in out


@pytest.mark.parametrize(
    "text",
    [
        *("raise OSError('broken\\ntwice')", "import nowhere_at_all", "=", None, "HELP = 'x'"),
        *("raise SystemExit('imported')", GREETING.replace('"greet somebody"', "None")),
    ],
)
def test_broken_command_of_others_is_one_line_and_breaks_no_other(run, add_command, text):
    add_command("greet", text)
    status, out, err = run("greet", "Ada")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("kineverse: 'kineverse greet' is a command of other, and other_command ")
    assert run("info")[0] == 2  # for its missing argument
    assert run("info", "kitchen")[0] == 0
    assert run("--help")[0] == 0


def test_command_of_this_package_is_not_replaced(run, add_command):
    add_command("info", "raise SystemExit('imported')")
    assert run("info", "kitchen")[0] == 0
    assert "info" not in find_added_commands()


def test_entry_points_are_looked_up_for_unknown_names_and_for_help_only(run, monkeypatch):
    looked_up = []
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: looked_up.append(group) or ())
    assert run("info", "kitchen")[0] == 0
    assert run("fk", "--help")[0] == 0
    assert looked_up == []
    assert run("--help")[0] == 0
    assert run("kitchen")[0] == 2
    assert looked_up == ["kineverse.commands"] * 2


@pytest.mark.parametrize("words", [["bench"], ["bench", "--json"], ["reproduce", "fig4"], ["ros", "kitchen"]])
def test_command_of_a_distribution_that_is_not_installed_says_how(run, without_added_commands, words):
    status, out, err = run(*words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    distribution = "kineverse_ros" if words[0] == "ros" else "kineverse-studies"
    assert f"'kineverse {words[0]}' is a command of {distribution}, which is not installed: " in err
    assert " install " in err
    assert run("bnech")[2].count("'bench'") == 1
    assert "bench" in run("--help")[1]


def test_studies_are_found_where_they_are_installed():
    added = find_added_commands()
    assert {"bench", "reproduce", "ros"} <= added.keys()
    assert not added.keys() & COMMANDS.keys()
    assert load_command("bench").HELP.startswith("measure")


def test_package_does_not_import_its_studies():
    code = (
        "import sys; from kineverse.cli import main; main(['info', 'kitchen']); main(['--help'])\n"
        "print([name for name in sys.modules if name.startswith('kineverse_studies')], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n"


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (
            ImportError("no libqp.so", name="daqp.daqp"),
            "The extra 'control' is not installed completely (no libqp.so): ",
        ),
        (
            ModuleNotFoundError("No module named 'lxml'", name="lxml"),
            "No module named 'lxml'. 'pip check' says",
        ),
    ],
)
def test_half_installed_extra_is_one_line(run, monkeypatch, error, expected):
    def fail(arguments):
        raise error

    monkeypatch.setattr(load_command("info"), "run", fail)
    status, out, err = run("info", "kitchen")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert expected in err


def test_extra_whose_requirement_is_missing_is_named(run, tmp_path, monkeypatch):
    (tmp_path / "daqp.py").write_text("import nowhere_at_all\n", encoding="utf-8")
    monkeypatch.delitem(sys.modules, "daqp", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(load_command("info"), "run", lambda arguments: __import__("daqp"))
    status, _, err = run("info", "kitchen")
    assert (status, err.count("\n")) == (2, 1)
    assert "The extra 'control' is not installed completely (No module named 'nowhere_at_all')" in err


def test_import_error_of_this_package_is_no_message(monkeypatch):
    def fail(arguments):
        raise ImportError("cannot import name", name="kineverse.model")

    monkeypatch.setattr(load_command("info"), "run", fail)
    with pytest.raises(ImportError):
        command_line.main(["info", "kitchen"])
