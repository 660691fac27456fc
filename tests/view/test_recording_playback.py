"""Recorded runs on the page and in pictures: the truth, the belief as a ghost, arrows, and plots."""

from types import SimpleNamespace

import numpy as np
import pytest

import kineverse as kv
from cupboards import cupboard, state
from kineverse.cli import main
from kineverse.errors import UnknownNameError
from kineverse.planning import Trajectory
from kineverse.view import Camera, view
from kineverse.view.run_overlay import LONGEST_ARROW, RecordedScene
from kineverse.worlds import Contact, Recorder, read_run_recording

pytest.importorskip("mcap", reason="recordings need the extra 'recording'")

DOOR = kv.position("cupboard/door")
X, UP = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run from .1 s to 1 s: the door opens to 1 rad, and is believed .2 rad further from .5 s on."""
    model, path = cupboard(), tmp_path_factory.mktemp("runs") / "run.mcap"
    touch = Contact("robot/neck", "cupboard/panel", X, X, 0.0, 7.0)
    with Recorder(path, model) as recorder:
        for k in range(1, 11):
            time = 0.1 * k
            recorder.write_state(time, state(model, cupboard__door=time))
            recorder.write_command(time, {kv.velocity("robot/base/x"): 0.1, kv.velocity("robot/pan"): 0.0})
            if k >= 5:
                recorder.write_belief(time, state(model, cupboard__door=time + 0.2))
                recorder.write_contacts(time, [touch])
                recorder.write_vectors(time, {"p": (X, 2 * UP), "n": (X, 100 * X), "zero": (X, 0 * X)})
        moved = kv.compile(model.fk("cupboard/drawer"))(model.default_state())
        moved[:3, 3] += (0, 0, 0.5)
        recorder.write_belief(1.0, state(model, cupboard__door=1.0), {"cupboard/drawer": moved})
        recorder.write_phase(0.2, "pull")
        recorder.write_outcome({"done": False, "reason": "the <door> is stuck"})
    return path


@pytest.fixture(scope="module")
def scene(run):
    return RecordedScene(read_run_recording(run))


def test_the_trajectory_has_the_times_and_values_of_the_run(scene):
    assert scene.trajectory.duration == 1.0
    times = np.array([0.0, 0.05, 0.1, 0.33, 1.0])
    column = scene.trajectory.symbols.index(DOOR)
    doors = scene.trajectory.positions_at(times)[:, column]
    np.testing.assert_allclose(doors, [0.1, 0.1, 0.1, 0.33, 1.0], atol=2e-2)
    np.testing.assert_allclose(doors[[2, 4]], [0.1, 1.0], atol=1e-12)


def test_ghosts_are_the_bodies_that_are_believed_elsewhere(scene):
    assert scene.at(0.45).ghosts == {}  # nothing was believed yet
    ghosts = scene.at(0.7).ghosts
    assert set(ghosts) == {"cupboard/panel"}
    model = scene.recording.model
    expected = kv.compile(model.fk("cupboard/panel"))(state(model, cupboard__door=0.9))
    np.testing.assert_allclose(ghosts["cupboard/panel"], expected, atol=1e-9)
    # At the end the door is where it is believed; the drawer is drawn as its recorded pose says.
    (drawer,) = scene.at(1.0).ghosts.items()
    assert drawer[0] == "cupboard/drawer"
    np.testing.assert_allclose(drawer[1][:3, 3], [2.3, 0, 1.5])
    assert len(scene.drawing.draw_ghosts(scene.at(1.0))) == 1


def test_arrows_have_the_direction_of_vectors_and_a_bounded_length(scene):
    assert scene.at(0.3).arrows == {}
    arrows = scene.at(0.6).arrows
    assert set(arrows) == {"p", "n"}
    np.testing.assert_allclose(arrows["p"], [X, X + 0.5 * UP])
    np.testing.assert_allclose(arrows["n"], [X, X + LONGEST_ARROW * X])
    assert scene.drawing.color("p") != scene.drawing.color("n")


def test_a_recording_is_played_on_the_page(scene):
    pytest.importorskip("viser", reason="the page needs the extra 'view'")
    from kineverse.view.run_overlay import play_recording

    with view(scene.recording.model, port=0) as page:
        play_recording(page, scene.recording, time=0.7)
        assert page.settled()
        assert page.values["cupboard/door"] == pytest.approx(0.7)
        layer = page._playback._layer
        (ghost,) = layer._ghosts.values()
        np.testing.assert_allclose(ghost.position, page.pose("cupboard/panel")[:3, 3])
        assert ghost.visible
        assert len(layer._arrows) == 3  # the arrows, and two names
        assert "phase: pull" in layer._text.content
        page._seek(0.3)
        assert page.settled()
        assert (ghost.visible, layer._arrows) == (False, [])
        page._seek(1.0)
        assert page.settled()
        assert "not done: the &lt;door&gt; is stuck" in layer._text.content
        page.play(Trajectory((DOOR,), [0, 1], [[0], [1]], np.zeros((2, 1))), at=0.0)
        assert page._playback._layer is None
        assert page.settled()
        with pytest.raises(UnknownNameError, match="cupboard/door"):
            page.play(Trajectory((kv.position("cupboard/dor"),), [0], [[0]], [[0]]))


def test_a_run_without_a_known_truth_shows_the_belief(tmp_path):
    model, path = cupboard(), tmp_path / "run.mcap"
    with Recorder(path, model) as recorder:
        for time in (0.5, 1.0):
            recorder.write_belief(time, state(model, cupboard__door=time))
    scene = RecordedScene(read_run_recording(path))
    assert scene.trajectory.duration == 1.0
    assert scene.values_at(1.0)["cupboard/door"] == 1.0
    assert scene.at(1.0).ghosts == {}


def test_a_run_is_shown_while_it_happens(scene):
    pytest.importorskip("viser", reason="the page needs the extra 'view'")
    from kineverse.view.run_overlay import LiveRun

    model = scene.recording.model
    touch = Contact("robot/neck", "cupboard/panel", X, X, 0.0, np.nan)
    with view(model, port=0) as page:
        world = SimpleNamespace(contacts=lambda: [touch] * 6)
        live = LiveRun(page, world, speed=0.0)
        for time in (0.0, 1.0):
            world.state = state(model, cupboard__door=time)
            believed = world.state.updated({"cupboard/door": 0.5})
            live._drawn = -1.0
            live(SimpleNamespace(time=time, state=believed, phase="push", vectors={"p": (X, UP)}))
        assert page.settled()
        assert page.values["cupboard/door"] == 1.0
        (ghost,) = live._layer._ghosts.values()
        expected = kv.compile(model.fk("cupboard/panel"))(state(model, cupboard__door=0.5))
        assert ghost.visible
        np.testing.assert_allclose(ghost.position, expected[:3, 3])
        for line in ("1.0 s", "phase: push", "robot/neck and cupboard/panel", "and 2 more contacts"):
            assert line in live._layer._text.content
        assert len(live._layer._arrows) == 2
        live.remove()
        unseen = LiveRun(page, speed=0.0)  # nobody knows the truth
        unseen(SimpleNamespace(time=2.0, state=believed, phase="", vectors={}))
        assert page.settled()
        assert page.values["cupboard/door"] == 0.5
        assert not unseen._layer._ghosts
        assert "contact" not in unseen._layer._text.content


def test_commands_draw_a_recording_and_a_trajectory(run, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="plots need the extra 'figures'")
    whole, late = tmp_path / "a.png", tmp_path / "b.png"
    for time, path in (("0.1", whole), ("0.9", late)):
        assert main(["view", str(run), "--time", time, "--picture", str(path)]) == 0
    assert whole.read_bytes() != late.read_bytes()
    plot = tmp_path / "plot.svg"
    assert main(["view", str(run), "--plot", str(plot)]) == 0
    text = plot.read_text()
    for shown in ("cupboard/door", "robot/base/x", "robot/neck – cupboard/panel", "pull"):
        assert f"<!-- {shown}" in text.replace("<!--  ", "<!-- ")
    assert "<!-- robot/pan -->" not in text  # its speed is 0
    cupboard().save(tmp_path / "model.kv.json")
    Trajectory((DOOR,), [0, 1], [[0], [1.5]], np.zeros((2, 1))).save(tmp_path / "way.json")
    words = ["view", str(tmp_path / "model.kv.json"), "--play", str(tmp_path / "way.json")]
    assert main([*words, "--picture", str(whole)]) == 0
    assert main([*words, "--picture", str(late), "--time", "0"]) == 0
    assert whole.read_bytes() != late.read_bytes()
    capsys.readouterr()
    for wrong, says in (
        ([*words, "--plot", "a.png"], "recordings"),
        (["view", str(run), "--set", "cupboard/door=1"], "its own motion"),
        (["view", "shelf_door", "--play", str(tmp_path / "way.json")], "cupboard/door"),
        (["view", "shelf_door", "--play", str(run)], "not JSON"),
        (["view", str(tmp_path / "way.json")], "--play"),
        (["view", str(tmp_path / "no.mcap")], "no such file"),
        (["view", "shelf_door", "--time", "1"], "recordings"),
        (["view", str(run), "--time", "nan"], "from 0 s"),
    ):
        assert main(wrong) == 2
        assert says in capsys.readouterr().err


def test_a_recording_has_the_ground_and_the_light_of_its_model(scene):
    from kineverse.view import picture
    from kineverse.view.run_overlay import play_recording

    def surroundings(page):
        nodes = page.server.scene._handle_from_node_name
        return {
            name: (type(node).__name__, repr(node._impl.props))
            for name, node in nodes.items()
            if name.startswith(("/floor", "/light"))
        }

    recording, moment = scene.recording, scene.at(0.7)
    with view(recording.model, port=0) as page:
        plain = surroundings(page)
        assert plain.keys() >= {"/floor", "/light/key", "/light/sky", "/light/fill"}
        play_recording(page, recording, time=0.7)
        assert page.settled()
        assert surroundings(page) == plain
    options = {"size": (96, 72), "camera": Camera((8.0, -6.0, 6.0), (1.0, 0.0, 0.5))}
    state = scene.values_at(0.7)
    bare = picture(recording.model, state, **options)
    ghosts, arrows = scene.drawing.draw_ghosts(moment), scene.drawing.draw_arrows(moment)
    drawn = picture(recording.model, state, overlay=ghosts, over=arrows, **options)
    assert (bare != drawn).any()
    rim = np.ones(bare.shape[:2], dtype=bool)
    rim[3:-3, 3:-3] = False
    assert np.abs(bare[rim].astype(int) - drawn[rim]).max() <= 8
    assert drawn[rim].min() > 120  # nothing is black
