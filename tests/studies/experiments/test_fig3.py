"""Fig. 3 of the 2022 paper: path of the garage door, and its lock."""

import json
import sys

import numpy as np
import pytest

from kineverse.cli import main
from kineverse.errors import MissingDependencyError, UnknownNameError
from kineverse_studies.experiments import EXPERIMENTS, reproduce


@pytest.fixture(scope="module")
def fig3():
    return reproduce("fig3")


def test_door_paths_follow_equation_12(fig3):
    a = np.linspace(0, 2, 20)
    assert fig3.numbers["a"] == pytest.approx(a)
    angle = np.arccos(a / 2)
    for name, part in (("A", 0.0), ("25 %", 0.25), ("50 %", 0.5), ("75 %", 0.75), ("B", 1.0)):
        expected = np.column_stack([2 * part * np.sin(angle), 2 - a + 2 * part * np.cos(angle)])
        np.testing.assert_allclose(fig3.numbers["paths"][name], expected, atol=1e-12)


def test_door_is_closed_at_l_and_open_at_0(fig3):
    paths = fig3.numbers["paths"]
    np.testing.assert_allclose([paths["A"][-1], paths["B"][-1]], [[0, 0], [0, 2]], atol=1e-12)
    np.testing.assert_allclose([paths["A"][0], paths["B"][0]], [[0, 2], [2, 2]], atol=1e-12)


def test_lock_bound_of_equation_13_steps_at_the_closed_door(fig3):
    b = np.linspace(0, 0.6, 50)
    assert fig3.numbers["unlocked"]["a=1"] == pytest.approx(np.ones(50))
    assert fig3.numbers["unlocked"]["a=2"] == pytest.approx(np.where(b > 0.3, 1.0, 0.0))


def test_both_forms_have_equal_paths(fig3):
    assert fig3.numbers["forms_apart"] < 1e-12


def test_regular_form_has_a_finite_slope_at_the_closed_door(fig3):
    before = np.array(fig3.numbers["before_closed"])
    # The derivative of 2 sin(arccos(a/2)) by a.
    assert fig3.numbers["slope_published"] == pytest.approx(
        (2 - before) / np.sqrt(before * (4 - before)), rel=1e-6
    )
    assert fig3.numbers["slope_regular"] == pytest.approx(2 - before, rel=1e-6)
    assert fig3.numbers["slope_regular_closed"] == pytest.approx(2)


@pytest.mark.parametrize(
    "suffix", ["pdf", *(pytest.param(suffix, marks=pytest.mark.long) for suffix in ("png", "svg"))]
)
def test_the_figure_is_drawn(fig3, tmp_path, suffix):
    pytest.importorskip("matplotlib")
    file = tmp_path / f"door.{suffix}"
    fig3.figure.save(file)
    content = file.read_bytes()
    assert len(content) > 5000
    assert content.startswith({"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix])


def test_without_matplotlib_the_extra_is_named(fig3, tmp_path, monkeypatch):
    for module in ("matplotlib", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=r"pip install -e '.*\[figures\]'"):
        fig3.figure.save(tmp_path / "door.png")


def test_numbers_are_json_data(fig3):
    assert json.loads(json.dumps(dict(fig3.numbers), allow_nan=False)) == fig3.numbers


def test_unknown_experiments_are_refused():
    with pytest.raises(UnknownNameError, match="Did you mean 'fig3'"):
        reproduce("fig33")


def test_the_command_prints_tables_and_writes_the_figure(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3"]) == 0
    out = capsys.readouterr().out
    assert "no bound" in out
    assert "fig3.png" in out
    assert (tmp_path / "fig3.png").stat().st_size > 5000
    assert (tmp_path / "fig3.png").read_bytes().startswith(b"\x89PNG")


def test_reproduce_as_json_is_one_object(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["figure"] is None
    assert answer["length"] == 2
    assert not list(tmp_path.iterdir())


def test_the_lock_opens_at_the_threshold_of_the_paper(fig3):
    """Equation 13 has b < .3; at a = 1 the door is never locked."""
    table = next(table for table in fig3.tables if "unlocked from b =" in table.head)
    assert {row[0]: row[-1] for row in table.rows} == {1.0: 0.0, 2.0: pytest.approx(0.3, abs=1e-9)}


def test_reproduce_in_markdown_prints_tables_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3", "--markdown"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("# The garage door")
    assert "## Ends of the door at some openings\n\n| a [m] | A: x [m] |" in out
    assert "\n| 2 | 0 | 0 | 1 | 1 | 0.3 |\n" in out
    assert not list(tmp_path.iterdir())


def test_reproduce_as_json_writes_a_requested_figure(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3", "--json", "--figure", "door.svg"]) == 0
    assert json.loads(capsys.readouterr().out)["figure"] == "door.svg"
    assert [file.name for file in tmp_path.iterdir()] == ["door.svg"]
    assert (tmp_path / "door.svg").read_bytes().startswith(b"<?xml")


def test_without_a_figure_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3", "--no-figure"]) == 0
    assert "The figure" not in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["reproduce"], "There are: fig3"),
        (["reproduce", "fig"], "Did you mean 'fig4' or 'fig3'"),
        (["reproduce", "fig3", "--quick"], "'fig3' takes no --quick. It takes no options."),
        (["reproduce", "fig3", "--figure", "nowhere/door.png"], "nowhere/door.png cannot be written"),
        (["reproduce", "fig3", "--figure", "door.what"], "cannot be written to 'door.what'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_invalid_arguments_are_errors_of_one_line(words, says, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_all_experiments_are_listed(capsys):
    assert main(["reproduce", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == dict(EXPERIMENTS)


@pytest.fixture
def no_matplotlib(monkeypatch):
    for module in ("matplotlib", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, module, None)


def test_reproduce_without_matplotlib_prints_tables_and_a_note(tmp_path, monkeypatch, capsys, no_matplotlib):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "no bound" in out
    last = out.splitlines()[-1]
    assert last.startswith("There is no figure. Figures need matplotlib: ")
    assert last.endswith("[figures]'")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_requested_figure_without_matplotlib_is_refused_at_once(
    options, monkeypatch, capsys, no_matplotlib
):
    monkeypatch.setattr("kineverse_studies.experiments.reproduce", lambda *_: pytest.fail("computed in vain"))
    assert main(["reproduce", "fig3", "--figure", "door.svg", *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "[figures]" in err


def test_an_unwritable_figure_is_reported_after_the_tables(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    (tmp_path / "fig3.png").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "fig3"]) == 2
    out, err = capsys.readouterr()
    assert "no bound" in out
    assert "fig3.png cannot be written" in err
