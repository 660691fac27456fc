"""Every articulation that can be opened by name: it loads, shows something, and all of it moves within its limits."""

import json
import re
from functools import cache

import numpy as np
import pytest

import kineverse as kv
from kineverse import gallery
from kineverse.cli import main
from kineverse.errors import UnknownNameError
from kineverse.view.poses import FramePoses, complete
from kineverse.view.sliders import Ranges, choose_slider_range

NAMES = gallery.names()
SAMPLES = 41

every = pytest.mark.parametrize("name", NAMES)


@cache
def opened(name):
    return kv.load(f"articulations/{name}")


def shown(model):
    """The poses of what has a body."""
    return FramePoses(model, [frame for frame in model.frames if frame in model.bodies])


def paths(model):
    """Each degree of freedom with values over all of its range, as a slider offers them, and what the others are.

    They are where they are at first, and then where nothing holds a door shut any more.
    """
    ranges, first = Ranges(model), complete(model)
    opened = {name: high for name, (_, high) in ranges.limits_at(first).items() if np.isfinite(high)}
    for values in (first, {**first, **opened}):
        for name, limits in ranges.limits_at(values).items():
            path = np.clip(np.linspace(*choose_slider_range(limits, values[name], "rad"), SAMPLES), *limits)
            # A quaternion that turns over by one of its elements would be none half-way.
            yield name, path if not name.endswith("qw") else np.linspace(0.1, 1.0, SAMPLES), values


@every
@pytest.mark.sampled(2)
def test_scene_has_bodies_and_violates_no_constraint_at_the_default_state(name):
    model = opened(name)
    assert model.bodies
    assert all(body.visuals for body in model.bodies.values())
    assert not model.violations(model.default_state())
    assert gallery.summary(name)


@pytest.mark.sampled(2)
@every
def test_scene_moves_over_the_whole_range_of_every_slider(name):
    model = opened(name)
    poses, moved = shown(model), dict.fromkeys(map(str, model.degrees_of_freedom), 0.0)
    for freedom, path, values in paths(model):
        rows = np.tile([values[symbol] for symbol in poses.inputs], (len(path), 1))
        if freedom in poses.inputs:
            rows[:, poses.inputs.index(freedom)] = path
        for pose in poses.batch(rows):
            assert np.isfinite(pose).all()
            rotation, identity = pose[:, :3, :3], np.tile(np.eye(3), (len(path), 1, 1))
            np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), identity, atol=1e-9)
            moved[freedom] = max(moved[freedom], float(np.abs(pose - pose[0]).max()))
    # One element of a quaternion is its length only.
    assert [f for f, most in moved.items() if most < 1e-3 and not f.endswith("/qw")] == []


@every
def test_scene_loops_stay_closed_during_motion(name):
    model = opened(name)
    loops = [record for record in model.articulations.values() if record.kind == "closedloop"]
    for record in loops:
        gap = kv.compile(model.fk(record.child, record.parent)[:3, 3])
        inputs = [str(symbol) for symbol in gap.inputs]
        for freedom, path, values in paths(model):
            for value in path[::8] if freedom in inputs else ():
                at = [value if symbol == freedom else values[symbol] for symbol in inputs]
                # Flat loops are closed in their plane; out of it nothing is apart anyway.
                assert np.abs(gap(np.array(at))).max() < 1e-10


@every
@pytest.mark.sampled(3)
def test_commands_take_the_name_of_a_scene(name, capsys):
    model = opened(name)
    assert main(["info", f"articulations/{name}", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["counts"]["dof"] == len(model.degrees_of_freedom)
    assert told["counts"]["shapes"] == sum(len(body.visuals) for body in model.bodies.values())
    assert main(["fk", f"articulations/{name}", next(iter(model.bodies)), "--json"]) == 0
    assert np.shape(json.loads(capsys.readouterr().out)["transform"]) == (4, 4)


@every
@pytest.mark.sampled(2)
def test_scene_names_are_below_a_prefix_and_it_can_be_included_twice(name):
    model = kv.Model()
    model.include(f"articulations/{name}", prefix="left")
    model.include(f"articulations/{name}", prefix="right")
    single, bare = opened(name), kv.load(f"articulations/{name}", prefix="")
    for what in ("frames", "bodies", "articulations", "constraints"):
        names = list(getattr(single, what))
        assert all(n.startswith(f"{name}/") for n in names)
        below = [n.removeprefix(f"{name}/") for n in names]
        assert list(getattr(bare, what)) == below
        assert sorted(getattr(model, what)) == sorted(
            f"{side}/{n}" for side in ("left", "right") for n in below
        )
    below = [str(s).removeprefix(f"{name}/") for s in single.degrees_of_freedom]
    assert sorted(map(str, model.degrees_of_freedom)) == sorted(
        f"{s}/{n}" for s in ("left", "right") for n in below
    )


def test_loaded_scene_is_cached():
    first, second = kv.load("articulations/jansen_leg"), kv.load("articulations/jansen_leg")
    assert first is not second
    assert first.snapshot() == second.snapshot()
    assert first.frames["jansen_leg/crank"] is second.frames["jansen_leg/crank"]


def test_every_articulation_has_a_scene():
    from kineverse import articulations

    abstract = {
        "Base",
        "OneAxisMotion",
        "OneDofJoint",
        "Transmission",
        "HingedDoor",
        "Joint",
        "Mechanism",
        "Part",
        "Limits",
    }
    kinds = {kind.lower() for kind in articulations.__all__ if kind not in abstract and kind[0].isupper()}
    found = {record.kind for name in NAMES for record in opened(name).articulations.values()}
    assert kinds - found == set()


def test_unknown_scene_error_suggests_names():
    for name, meant in {
        "articulations/skrew": "articulations/screw",
        "articulations/foldng_door": "articulations/folding_door",
        "articulations/door": "articulations/folding_door",
        "foldng_door": "articulations/folding_door",
        "folding_door": "articulations/folding_door",
        "Folding Door": "articulations/folding_door",
        "mecanum": "articulations/mecanum",
        "articulations/kitchen": "kitchen",
    }.items():
        with pytest.raises(UnknownNameError, match=f"Did you mean .*'{meant}'") as caught:
            kv.load(name)
        for one in re.findall("'([^']*)'", str(caught.value).split("Did you mean")[1].split("?")[0]):
            kv.load(one)  # each can be typed as it is told
    with pytest.raises(UnknownNameError, match=r"no model 'articulations/zzz'\. Available: .*jansen_leg"):
        kv.load("articulations/zzz")
    for name in ("articulations", "articulations/"):
        with pytest.raises(UnknownNameError, match=r"one for each articulation: fixed, .*jansen_leg"):
            kv.load(name)
    with pytest.raises(UnknownNameError, match="gallery"):
        gallery.find_document("nothing")


def test_file_in_a_folder_articulations_is_not_hidden_by_the_gallery(tmp_path, monkeypatch):
    folder = tmp_path / "articulations"
    folder.mkdir()
    (folder / "arm.urdf").write_text('<robot name="arm"><link name="base"/></robot>')
    monkeypatch.chdir(tmp_path)
    assert list(kv.load("articulations/arm.urdf").frames) == ["base"]


@pytest.mark.parametrize("command", ["info", "view"])
def test_list_of_scenes(command, capsys):
    assert main([command, "articulations"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in NAMES:
        (line,) = [line for line in lines if line.split(" ")[0] == f"articulations/{name}"]
        assert line.endswith(gallery.summary(name))
    assert main(["info", "articulations", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["models"]) == len(NAMES)


def test_gallery_is_imported_lazily():
    import subprocess
    import sys

    program = "import sys, kineverse as kv; kv.load('kitchen'); print('kineverse.gallery' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
