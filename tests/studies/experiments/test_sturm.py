"""Recordings of doors and drawers: labels, classification, figure."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kineverse.cli import main
from kineverse.errors import FormatError
from kineverse.estimation.identification.solver import solver
from kineverse.estimation.recordings import RecordedPair
from kineverse_studies.experiments import Options, reproduce
from kineverse_studies.experiments.sturm import (
    POSITION,
    STATEMENTS,
    THINNED,
    LabelledRecording,
    answer_statements,
    classify_recording,
    draw_recordings,
    figure_size,
    read_labelled_recordings,
    report_recordings,
    statement_numbers,
    statement_table,
)

RNG = np.random.default_rng(0)


def arc(radius, angle, count=60):
    angles = np.linspace(0, angle, count)
    points = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, 0.3)])
    return points + 0.002 * RNG.standard_normal(points.shape)


def line(travel, count=60):
    points = np.linspace(0, travel, count)[:, None] * [0.6, 0.0, 0.8] + [1, 2, 3]
    return points + 0.002 * RNG.standard_normal(points.shape)


@pytest.fixture(autouse=True, scope="module")
def _compiled():
    solver.prepare(wait=True)


@pytest.fixture
def folder(tmp_path):
    for name, points in {"cabinet_one/001": arc(0.4, 1.5), "drawer_one/001": line(0.45)}.items():
        file = tmp_path / "tracks" / f"{name}.log"
        file.parent.mkdir(parents=True)
        np.savetxt(file, points)
    rows = [[*arc(0.4, 1.5)[k], 0, 0, np.sin(k / 80), np.cos(k / 80), 0.5, 0.6] for k in range(60)]
    (tmp_path / "tracks" / "models_data").mkdir()
    np.savetxt(tmp_path / "tracks" / "models_data" / "door.txt", rows)
    return tmp_path / "tracks"


def test_recordings_are_known_by_their_names(folder):
    found = list(read_labelled_recordings(folder))
    assert [(r.name, r.label, r.poses.shape) for r in found] == [
        ("cabinet_one/001", "revolute", (THINNED, 3)),
        ("drawer_one/001", "prismatic", (THINNED, 3)),
        ("models_data/door", "revolute", (THINNED, 4, 4)),
    ]
    assert [r.covariance.shape for r in found] == [(3, 3), (3, 3), (6, 6)]
    np.testing.assert_array_equal(found[0].covariance, POSITION**2 * np.eye(3))


def test_further_columns_of_recordings_are_ignored(folder):
    door = list(read_labelled_recordings(folder))[-1]
    np.testing.assert_allclose(door.poses[-1, :2, 0], [np.cos(59 / 40), np.sin(59 / 40)])


def test_arcs_are_revolute_and_lines_prismatic():
    assert classify_recording(LabelledRecording("an arc", "revolute", arc(0.4, 1.5, 20))).is_correct
    assert classify_recording(LabelledRecording("a line", "prismatic", line(0.45, 20))).is_correct


def test_misclassified_recordings_are_named_and_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    judged = [
        classify_recording(LabelledRecording("kitchen/door", "revolute", arc(0.4, 1.5, 20))),
        classify_recording(LabelledRecording("kitchen/no drawer", "prismatic", arc(0.4, 1.5, 20))),
    ]
    found = report_recordings(judged)
    assert found.numbers["missed"] == ["kitchen/no drawer"]
    assert found.numbers["right"] == 0.5
    assert json.loads(json.dumps(found.numbers, allow_nan=False)) == found.numbers
    assert found.tables[2].rows[0][0] == "kitchen/no drawer"
    all_right = figure_size(judged[:1])
    assert figure_size(judged)[1] > all_right[1] + 3
    found.figure.save(tmp_path / "missed.png")
    assert (tmp_path / "missed.png").stat().st_size > 20_000


def test_misclassified_recording_is_drawn_with_both_families():
    figure = pytest.importorskip("matplotlib.figure").Figure(layout="constrained")
    draw_recordings(
        figure, [classify_recording(LabelledRecording("no drawer", "prismatic", arc(0.4, 1.5, 20)))]
    )
    below = figure.subfigs[1]
    titles = " ".join(axes.get_title() for axes in below.axes)
    assert "missed: no drawer" in below.get_suptitle()
    assert "prismatic" in titles
    assert "revolute" in titles


def test_missing_recordings_are_an_error_with_their_place(tmp_path, monkeypatch):
    with pytest.raises(FormatError, match=r"nowhere: there is no such folder.*cabinet_one/001\.log.*--data"):
        read_labelled_recordings(tmp_path / "nowhere")
    with pytest.raises(FormatError, match="none of them is there"):
        read_labelled_recordings(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FormatError, match=r"^This experiment is about .*Say where they are: --data"):
        reproduce("sturm")


def test_the_command_takes_the_folder(folder, capsys):
    assert main(["reproduce", "sturm", "--data", str(folder), "--quick", "--json", "--no-figure"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [r["name"] for r in answer["recordings"]] == [
        "cabinet_one/001",
        "drawer_one/001",
        "models_data/door",
    ]
    assert answer["recordings"][0]["radius"] == pytest.approx(0.4, abs=0.02)
    assert "all_poses" not in answer


@pytest.mark.long
def test_all_poses_are_judged_under_each_statement_of_the_noise():
    points = arc(0.4, 1.5, 25)
    pair = RecordedPair("world", "door", None, points, np.arange(len(points)))
    answers = answer_statements("an arc", "revolute", pair)
    assert [one.statement for one in answers] == [*STATEMENTS]
    assert not [one for one in answers if one.verdict == "wrong"]
    table = statement_table(answers)
    assert table.rows[1] == ("stated, as large as the residuals of the labelled joint", 1.0, 0.0, 0.0)
    wrong = [replace(one, family="prismatic", is_sure=True) for one in answers]
    assert statement_numbers(wrong)["half"]["not_right"] == {"an arc": "prismatic, wrong"}


def test_every_tenth_of_the_published_recordings_is_right(published):
    found = list(read_labelled_recordings(published("sturm_tracks")))
    assert {recording.label for recording in found[::10]} == {"revolute", "prismatic"}
    assert all(classify_recording(recording).is_correct for recording in found[::10])


@pytest.mark.long
def test_at_least_95_percent_of_the_published_recordings_are_right(published):
    found = reproduce("sturm", options=Options(quick=True, data=published("sturm_tracks")))
    assert len(found.numbers["recordings"]) == 60
    assert found.numbers["right"] >= 0.95
