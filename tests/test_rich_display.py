"""Displays of results in notebooks: HTML that a parser finds whole, whatever the names are."""

from __future__ import annotations

import html.parser
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse._rich_display import CELL, ROWS, draw_curves, element, folded, html_table
from kineverse.estimation import Calibration, Tracker, identify, identify_graph, pose_covariance
from kineverse.geometry.motion_checks.report import CoordinateReport, MotionFinding, MotionReport
from kineverse.model import compare_models
from kineverse.model.comparison import ModelComparison
from kineverse.planning import Path, Trajectory

HOSTILE = "</td><script>alert(1)</script><img src=x onerror='alert(1)'>\"&amp;$"
EMPTY = ("img", "br")
TEXT = st.text(st.one_of(st.sampled_from("<>&\"'/=a"), st.characters(codec="utf-8")), max_size=30)


class Parser(html.parser.HTMLParser):
    """Reader of HTML that notes the elements, and fails where one is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.cells: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}
        if tag not in EMPTY:
            self.open.append(tag)
        if tag in ("td", "th", "caption", "summary", "p"):
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.cells[-1:] = [self.cells[-1] + data] if self.cells else []


HARMLESS = {
    "table",
    "caption",
    "thead",
    "tbody",
    "tr",
    "th",
    "td",
    "div",
    "p",
    "b",
    "details",
    "summary",
    "img",
}


def check(shown: str) -> Parser:
    parser = Parser(shown)
    assert parser.tags <= HARMLESS
    assert parser.attributes <= {"style", "colspan", "src", "alt"}
    return parser


def model_with(name: str) -> kv.Model:
    q = kv.position(name)
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame(name, "world", kv.translation(0, 0, q), body=kv.model.Body())
        edit.constrain(name, 0, q, 1)
        edit.write(name, name)
        edit.set_rate(q, {kv.velocity("wheel"): 1.0})
    return model


def hinge(angles: Any) -> Any:
    turned = kv.rotation_z(kv.position("q")) @ kv.translation(0.5, 0, 0)
    poses = np.stack([turned({"q": q}) for q in angles])
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.001, (len(angles), 3))
    return poses


def displays() -> dict[str, Callable[[], str]]:
    model, s = model_with(HOSTILE), kv.position(HOSTILE)
    poses = {HOSTILE: np.tile(np.eye(4), (20, 1, 1)), "door": hinge(np.linspace(0, 1, 20))}
    found = MotionFinding("crossed_limits", "finding", HOSTILE), MotionFinding("no_limits", "suspect", "none")
    report = MotionReport((CoordinateReport(HOSTILE, found),), CoordinateReport(""))
    trajectory = Trajectory((s,), [0.0, 1.0, 2.0], [[0.0], [1.0], [0.5]], [[0.0], [1.0], [0.0]])
    return {
        "model": model._repr_html_,
        "state": kv.State({HOSTILE: 1.0}, source=HOSTILE)._repr_html_,
        "violations": model.violations({HOSTILE: 2.0})._repr_html_,
        "function": kv.compile(2 * s)._repr_html_,
        "diff": compare_models(kv.Model(), model)._repr_html_,
        "graph": identify_graph(poses, world=False, noise=pose_covariance(0.001, 0.01))._repr_html_,
        "trajectory": trajectory._repr_html_,
        "path": Path(
            True, (s,), np.array([[0.0], [1.0]]), "", 0.1, 0.1, 1, kv.State({s: 0}), None
        )._repr_html_,
        "no path": Path(False, (s,), np.zeros((0, 1)), HOSTILE, 0.1, 0.1, 1, kv.State({}), None)._repr_html_,
        "comparison": ModelComparison(kv.Model(), model, 1e-6)._repr_html_,
        "report": report._repr_html_,
        "estimate": Tracker(model, [HOSTILE]).update({HOSTILE: np.eye(4)}, at=3.0)._repr_html_,
        "calibration": calibration()._repr_html_,
    }


def calibration() -> Calibration:
    """Return a calibration with a parameter that the looks tell, and one that they do not."""
    numbers = {HOSTILE: 0.01, "unseen": math.inf}
    state = kv.State({kv.parameter(HOSTILE, 0.0): 0.25, kv.parameter("unseen", 0.0): 0.0})
    return Calibration(
        state, np.eye(2), numbers, ({"unseen": 1.0},), {"position": 0.002}, (), {"position": 0.1}, {}, 12,
        {HOSTILE: "m", "unseen": "rad"}, {}, kv.Model(), (),
    )  # fmt: skip


def test_hostile_names_stay_text() -> None:
    for name, display in displays().items():
        shown = display()
        check(shown)
        assert "&lt;script&gt;" in shown, name


def test_results_say_what_was_found() -> None:
    cells = {name: check(display()).cells for name, display in displays().items()}
    assert cells["report"][0] == "1 finding, 1 suspect"
    assert cells["report"][6:11] == [HOSTILE, "finding", "crossed_limits", HOSTILE, "Swap the limits."]
    assert cells["report"][12:14] == ["suspect", "no_limits"]
    assert cells["estimate"][0] == "estimate at 3 s"
    assert abs(float(cells["estimate"][cells["estimate"].index(HOSTILE) + 1])) < 0.001
    assert cells["path"][0] == "path of 2 points, length 1, found in 100 ms"
    assert cells["path"][-4:] == ["0", "1", "0", "1"]
    assert HOSTILE in cells["no path"][0]
    found = cells["calibration"]
    assert found[0] == "Calibration of 2 parameters from 12 looks"
    assert found[3:5] == [HOSTILE, "+250 ± 10 mm"]
    assert found[-2:] == ["position: noise 2 mm, off by 100 mm before", "not told by the data: unseen"]
    comparison = cells["comparison"]
    assert comparison[0] == "5 differences beyond 1e-06"
    assert comparison[comparison.index(f"frames/{HOSTILE}") - 1] == "+"


def test_operations_that_differ_alone_are_in_the_comparison() -> None:
    one, other = model_with("q"), model_with("q")
    with one.edit() as edit:
        edit.add_frame("twin", "world")
    with other.edit() as edit:
        edit.add_frame("twin", "world", tag="other")
    comparison = ModelComparison(one, other, 1e-6, "yes")
    assert not comparison.equal
    cells = check(comparison._repr_html_()).cells
    assert cells[0] == "0 differences beyond 1e-06"
    assert "operation other" in cells


def test_a_live_model_shows_where_it_is_kept_and_whether_it_is_there(sockets: object) -> None:
    pytest.importorskip("zenoh")
    with kv.exchange.serve(model_with(HOSTILE), name="display"):
        model = kv.load("live:display")
        shown = check(model._repr_html_())
        assert shown.cells[0] == f"{model.exchange.address}: revision {model.version}, online"
        assert "1 DoF" in shown.cells
        model.close()
        assert check(model._repr_html_()).cells[0].endswith(", closed")


@settings(max_examples=attempts(100))
@given(TEXT, st.lists(st.tuples(TEXT, TEXT), max_size=4))
def test_a_table_has_the_texts_that_it_was_made_of(title: str, rows: list[tuple[str, str]]) -> None:
    parser = check(folded(title, html_table(title, ("a", "b"), rows)))
    found = [cell.replace("\r", "\n") for cell in parser.cells]
    wanted = [title, title, "a", "b", *(text for row in rows for text in row)]
    assert found == [text.replace("\r", "\n") for text in wanted]


def test_long_tables_are_cut_and_counted() -> None:
    parser = check(html_table("", ("a",), [(f"{i}",) for i in range(ROWS + 7)]))
    assert parser.cells[-2:] == [f"{ROWS - 1}", "… 7 more"]
    assert check(html_table("", ("a",), [("x" * CELL,), ("x" * (CELL + 1),)])).cells[2:] == [
        "x" * CELL,
        "x" * (CELL - 1) + "…",
    ]
    assert "more" not in html_table("", ("a",), [("x",)] * ROWS)


def test_a_model_shows_freedoms_with_units_frames_as_a_tree_and_constraints() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", lower=-1, upper=2, velocity=3))
        edit.apply(kv.Prismatic(name="slide", parent="door", child="slide", lower=0, upper=0.4))
    cells = check(model._repr_html_()).cells
    for row in (["door", "rad", "-1", "2", "0", "3"], ["slide", "m", "0", "0.4", "0", "-"]):
        at = cells.index(row[0])
        assert cells[at : at + 6] == row
    assert cells[cells.index("in world, moved by door") - 1 :][:4] == [
        "door",
        "in world, moved by door",
        "\u2003slide",
        "in door, moved by slide",
    ]
    assert {"2 DoF", "2 frames", "3 constraints", "2 articulations"} <= set(cells)
    assert "1 frame" in check(model_with("q")._repr_html_()).cells


def test_an_identification_shows_families_and_parameters() -> None:
    found = identify(
        np.tile(np.eye(4), (30, 1, 1)), hinge(np.linspace(0, 1, 30)), noise=pose_covariance(0.001, 0.01)
    )
    bundle = found._repr_mimebundle_()
    assert bundle["text/plain"] == str(found)
    cells = check(bundle["text/html"]).cells
    assert cells[cells.index("revolute") + 1] == f"{found.best.probability:.2%}"
    (spread,) = [cell for cell in cells if cell.startswith("axis.x: ")]
    assert f"{found.best.deviation('axis.y'):.2g} rad" in spread
    assert set(found.best.parameters) <= set(cells)


def test_curves_are_drawn_if_matplotlib_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    x, names = np.linspace(0, 1, 20), ["_hidden", "$x$", "$", HOSTILE, *map(str, range(8))]
    drawn = draw_curves(x, np.outer(x, np.arange(12)), names)
    assert drawn is not None
    assert drawn.startswith(b"\x89PNG")
    assert drawn == draw_curves(x, np.outer(x, np.arange(12)), names)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert draw_curves(x, np.outer(x, np.arange(12)), names) is None
    assert "<img" not in displays()["trajectory"]()


def test_attributes_are_escaped() -> None:
    assert element("p", "<", title='">') == '<p title="&quot;&gt;">&lt;</p>'
