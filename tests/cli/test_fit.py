"""``kineverse fit``: joints from tables of poses, as text, JSON, picture and model."""

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.cli import main
from kineverse.estimation import recordings

DOOR = ("--parent", "cupboard", "--child", "door")
# All families take seconds: they are tried where the choice among them is the subject.
TWO = ("--families", "prismatic,revolute")
AXIS, POINT = np.array([0.0, 0.6, 0.8]), np.array([0.5, 0.1, -0.2])


def turned(vectors):
    return Rotation.from_rotvec(vectors).as_matrix()


def pose(rotation=None, position=(0.0, 0.0, 0.0)):
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = np.eye(3) if rotation is None else rotation, position
    return made


def hinge(angles):
    """Return poses of a door of 0.5 m width in its cupboard, with an arbitrary orientation of its frame."""
    rotations = turned(np.outer(angles, AXIS))
    moved = [pose(r, POINT - r @ POINT) for r in rotations]
    return np.array(moved) @ pose(turned([0.3, 0.2, 0.1]), POINT + np.cross(AXIS, [0.5, 0, 0]))


def slider(ways):
    return np.array([pose(turned([0.3, 0.2, 0.1]), way * AXIS + POINT) for way in ways])


def noisy(poses, rng, position=0.002, orientation=0.009):
    seen = poses.copy()
    seen[:, :3, 3] += position * rng.standard_normal((len(poses), 3))
    seen[:, :3, :3] = turned(orientation * rng.standard_normal((len(poses), 3))) @ seen[:, :3, :3]
    return seen


def write(path, parts, positions_only=()):
    """Write a table with a part in each row."""
    lines = ["time,part,x,y,z,qx,qy,qz,qw"]
    for k in range(len(next(iter(parts.values())))):
        for name, poses in parts.items():
            numbers = [*poses[k, :3, 3], *Rotation.from_matrix(poses[k, :3, :3]).as_quat()]
            lines.append(",".join(map(str, [0.1 * k, name, *numbers])))
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    """Return a recording of a door and a cupboard by a moving camera."""
    rng, angles = np.random.default_rng(1), np.linspace(0.0, math.radians(80), 30)
    cupboard = np.array([pose(turned(rng.normal(size=3)), rng.normal(size=3)) for _ in angles])
    parts = {"cupboard": noisy(cupboard, rng), "door": noisy(cupboard @ hinge(angles), rng)}
    return write(tmp_path_factory.mktemp("door") / "poses.csv", parts)


def answer(words, capsys, status=0):
    assert main(["fit", *words, "--json"]) in ((0, 1) if status is None else (status,))
    return json.loads(capsys.readouterr().out)


def test_a_door_is_a_hinge_with_its_axis(door, capsys):
    found = answer([door, *DOOR, "--noise", "2mm,0.5deg"], capsys)
    assert (found["family"], found["told"], found["count"]) == ("revolute", True, 30)
    best = found["fits"][0]
    axis, point = (np.array(best["parameters"][name]) for name in ("axis", "point"))
    assert abs(axis @ AXIS) == pytest.approx(1, abs=1e-3)
    assert np.linalg.norm(np.cross(point - POINT, AXIS)) < 0.01
    assert 0 < best["deviations"]["axis.x"] < math.radians(1)
    (seen,) = best["ranges"]
    assert seen["upper"] - seen["lower"] == pytest.approx(math.radians(80), abs=0.03)
    assert seen["unit"] == "rad"
    assert sum(fit["probability"] for fit in found["fits"]) == pytest.approx(1)


def test_fit_prints_the_joint(door, capsys):
    assert main(["fit", door, *DOOR, "--noise", "2mm,0.5deg", "--families", "prismatic,revolute,screw"]) == 0
    out = capsys.readouterr().out
    assert "door in cupboard: 30 poses" in out
    assert "noise: 2 mm and 0.5 deg, as given" in out
    assert "revolute, 9" in out
    for part in ("axis ", "point ", "seen ", "left over"):
        assert any(line.strip().startswith(part) for line in out.splitlines())
    assert "probability" in out
    assert "not: " in out


def test_the_noise_is_estimated_if_it_is_not_given(door, capsys):
    noise = answer([door, *DOOR, *TWO], capsys)["noise"]
    assert noise["given"] is False
    # Of 2 mm and .5 deg: the two are estimated together, at a ratio of 5 mm to 1 deg.
    assert noise["position"] == pytest.approx(0.0025, rel=0.3)
    assert noise["orientation"] == pytest.approx(math.radians(0.5), rel=0.3)


def test_the_document_is_the_joint(door, tmp_path, capsys):
    file = str(tmp_path / "door.kv.json")
    found = answer([door, *DOOR, *TWO, "--noise", "2mm,0.5deg", "--document", file], capsys)
    assert found["document"] == file
    model = kv.load(file)
    assert list(map(str, model.symbols)) == ["door"]
    limits = model.constraints["door/position"]
    low, high = found["fits"][0]["ranges"][0]["lower"], found["fits"][0]["ranges"][0]["upper"]
    assert (float(limits.lower), float(limits.upper)) == pytest.approx((low, high))
    # From one end to the other it moves as the door did.
    first, last = (model.fk("door", "cupboard")({"door": q}) for q in (low, high))
    way, truth = np.linalg.inv(first) @ last, hinge(np.radians([0, 80]))
    there = np.linalg.inv(truth[0]) @ truth[1]
    back = np.linalg.inv(there)
    assert min(np.abs(way - there).max(), np.abs(way - back).max()) < 0.03
    assert main(["view", file, "--picture", str(tmp_path / "door.png")]) == 0
    assert (tmp_path / "door.png").stat().st_size > 10_000


def test_an_outlier_is_named(tmp_path, capsys):
    rng = np.random.default_rng(7)
    seen = noisy(hinge(np.linspace(0.0, 1.2, 40)), rng)
    seen[17, :3, :3] = turned([0.0, 0.4, 0.0]) @ seen[17, :3, :3]
    table = write(tmp_path / "poses.csv", {"door": seen})
    words = [table, "--noise", "2mm,0.5deg", "--families", "revolute"]
    assert answer(words, capsys)["outliers"] == [17]
    assert main(["fit", *words]) == 0
    assert "1 of 40 poses does not fit: 17 (counted from 0)" in capsys.readouterr().out
    assert answer([*words, "--thin", "9"], capsys)["outliers"] == []


def test_correlated_neighbours_count_once(tmp_path, capsys):
    rng = np.random.default_rng(5)
    seen = noisy(hinge(np.linspace(0.0, 1.2, 200)), rng)
    seen[:, 0, 3] += 0.006 * np.sin(np.linspace(0, 12, 200))
    words = [write(tmp_path / "poses.csv", {"door": seen}), *TWO]
    found = answer(words, capsys)
    assert (found["count"], found["family"]) == (200, "revolute")
    assert found["judged"] < 60
    assert found["judged"] == round(200 / found["correlation_time"])
    everything = answer([*words, "--thin", "200"], capsys)
    assert everything["judged"] == 200
    # Who counts the same error ten times is too sure.
    sure, surer = (one["fits"][0]["deviations"]["axis.x"] for one in (found, everything))
    assert surer < 0.7 * sure
    assert main(["fit", *words]) == 0
    assert f"are worth {found['judged']} independent ones" in capsys.readouterr().out


def test_the_picture_is_drawn(door, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    file = tmp_path / "door.svg"  # a drawer has a PNG below
    words = [door, *DOOR, *TWO, "--noise", "2mm,0.5deg", "--picture", str(file)]
    assert main(["fit", *words]) == 0
    assert f"picture: {file}" in capsys.readouterr().out
    assert file.stat().st_size > 20_000


def test_a_drawer_is_identified_from_positions(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(2)
    table, picture, document = (tmp_path / name for name in ("handle.log", "handle.png", "handle.kv.json"))
    points = noisy(slider(np.linspace(0, 0.4, 25)), rng)[:, :3, 3]
    np.savetxt(table, points)
    words = [str(table), *TWO, "--noise", "2mm", "--picture", str(picture), "--document", str(document)]
    found = answer(words, capsys)
    assert found["family"] == "prismatic"
    assert found["noise"]["orientation"] is None
    model = kv.load(document)
    low, high = (found["fits"][0]["ranges"][0][end] for end in ("lower", "upper"))
    ends = np.array([model.fk("part")({"part": q}) for q in (low, high)])
    # There is no orientation to be known: the part's axes are those of the world.
    np.testing.assert_allclose(ends[:, :3, :3], [np.eye(3)] * 2, atol=1e-9)
    expected = points[[0, -1]] if np.linalg.norm(ends[0, :3, 3] - points[0]) < 0.1 else points[[-1, 0]]
    np.testing.assert_allclose(ends[:, :3, 3], expected, atol=0.01)


def test_a_hinge_is_located_from_positions(tmp_path, capsys):
    rng = np.random.default_rng(3)
    table, document = tmp_path / "handle.log", tmp_path / "handle.kv.json"
    points = noisy(hinge(np.radians(np.linspace(0, 80, 30))), rng)[:, :3, 3]
    np.savetxt(table, points)
    words = [str(table), "--child", "door", "--noise", "2mm", "--document", str(document)]
    found = answer(words, capsys, status=1)  # positions cannot tell it from a screw
    assert found["family"] == "revolute"
    model = kv.load(document)
    values = [found["fits"][0]["ranges"][0][end] for end in ("lower", "upper")]
    ends = np.array([model.fk("door")({"door": q})[:3, 3] for q in values])
    assert min(np.abs(ends - points[[0, -1]]).max(), np.abs(ends - points[[-1, 0]]).max()) < 0.01
    np.testing.assert_allclose(model.fk("door")({"door": 0.0})[:3, :3], np.eye(3), atol=1e-9)


def test_only_the_requested_families_are_tried(door, capsys):
    found = answer([door, *DOOR, "--families", "rigid, prismatic"], capsys)
    assert {fit["family"] for fit in found["fits"]} == {"rigid", "prismatic"}


def test_fit_status_matches_the_printed_ambiguity(tmp_path, capsys):
    rng = np.random.default_rng(4)
    still = noisy(np.tile(hinge([0.0]), (3, 1, 1)), rng, 0.05, 0.3)
    words = [write(tmp_path / "still.csv", {"lid": still}), "--noise", "5cm,0.3"]
    assert main(["fit", *words]) in (0, 1)  # as identify says, and the status goes with the words
    out = capsys.readouterr().out
    found = answer(words, capsys, status=0 if "cannot tell" not in out else 1)
    assert found["told"] == ("cannot tell" not in out)


def test_fit_notes_options_without_effect(tmp_path, capsys):
    points = noisy(slider(np.linspace(0, 0.4, 10)), np.random.default_rng(5))[:, :3, 3]
    table = tmp_path / "handle.csv"
    table.write_text("x,y,z,force\n" + "\n".join(",".join(map(str, [*p, 1.0])) for p in points))
    main(["fit", str(table), *TWO, "--noise", "2mm"])
    assert "columns that mean nothing here: force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("head", "scale", "order", "note"),
    [
        ("time,x,y,z,roll,pitch,yaw", 1.0, "deg", "assumed: angles in deg"),
        ("time,x,y,z,roll,pitch,yaw", 1000.0, "deg", "assumed: lengths in mm; angles in deg"),
        ("", 1.0, "wxyz", "assumed: columns time,x,y,z,qw,qx,qy,qz"),
        ("time,pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,"
         "pose.orientation.z,pose.orientation.w", 1.0, "xyzw", ""),
    ],
)  # fmt: skip
def test_fit_says_what_it_assumes(head, scale, order, note, tmp_path, capsys):
    seen = noisy(hinge(np.linspace(0.0, 1.2, 30)), np.random.default_rng(1))
    rotations = Rotation.from_matrix(seen[:, :3, :3])
    w_first = np.roll(rotations.as_quat(), 1, axis=1)
    numbers = {"deg": rotations.as_euler("xyz", degrees=True), "xyzw": rotations.as_quat(), "wxyz": w_first}
    table = np.column_stack([0.1 * np.arange(30), scale * seen[:, :3, 3], numbers[order]])
    np.savetxt(tmp_path / "door.csv", table, header=head, comments="", delimiter=",")
    assert main(["fit", str(tmp_path / "door.csv"), *TWO, "--noise", "2mm,0.5deg", "--json"]) == 0
    printed = capsys.readouterr()
    assert note in printed.err
    found = json.loads(printed.out)
    assert found["family"] == "revolute"
    assert "; ".join(found["assumptions"]) == note.removeprefix("assumed: ")
    point = np.array(found["fits"][0]["parameters"]["point"])
    assert np.linalg.norm(np.cross(point - POINT, AXIS)) < 0.01


def test_thin_reduces_the_number_of_poses(door, capsys):
    assert answer([door, *DOOR, *TWO, "--noise", "2mm,0.5deg", "--thin", "10"], capsys)["count"] == 10


@pytest.mark.parametrize(
    ("rows", "words", "says"),
    [
        ("", [], "the file is empty"),
        ("0 0 0\n", [], "one pose"),
        ("0 0 0\n0 nan 0\n", [], "line 2: y is missing"),
        (
            "pose.orientation.x,pose.orientation.y,pose.orientation.z\n0,0,1\n",
            [],
            "no positions x, y, z, and no qw",
        ),
        ("0 0 0\n0 40 0\n", [], "Say --units m or --units mm"),
        ("0 0 0\n0 40 0\n", ["--units", "inch"], "'inch' is no unit"),
        ("1 2 3\n1 2 3\n1 2 3\n", [], "All 3 poses are the same in every digit"),
        ("0 0 0 0 0 0 2\n", [], "line 1: the quaternion has the length 2, which is off by 1"),
        ("0 0 0\n0 0 1\n", ["--noise", "3deg"], "write two positive numbers"),
        ("0 0 0\n0 0 1\n", ["--noise", "3mm,2cm"], "write two positive numbers"),
        ("0 0 0\n0 0 1\n", ["--noise", "0"], "write two positive numbers"),
        (
            "0 0 0 0 0 0 1\n0 0 1 0 0 0 1\n",
            ["--noise", "3mm", "--columns", "x,y,z,qx,qy,qz,qw"],
            "poses has two values",
        ),
        ("0 0 0\n0 0 1\n", ["--families", "hinge"], "There is no family 'hinge'"),
        ("0 0 0\n0 0 1\n", ["--parent", "cupboard"], "names no parts"),
        ("0 0 0\n0 0 1\n", ["--thin", "1"], "takes at least two"),
        ("part,x,y,z\na,0,0,0\nb,0,0,1\n", [], "which part moves?"),
        ("part,x,y,z\na,0,0,0\nb,0,0,1\n", ["--child", "c"], "has no part 'c'"),
        ("0 0 0\n0 0 1\n", ["--columns", "x,y"], "there are 2 names"),
        ("0 0 0\n0 0 1\n", ["--document", "a.urdf"], "whose name ends in .kv.json"),
    ],
)
def test_fit_refuses_invalid_input_in_one_line(rows, words, says, tmp_path, capsys):
    table = tmp_path / "poses.csv"
    table.write_text(rows)
    assert main(["fit", str(table), *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("count", "told"), [(150, True), (12, False)])
def test_revolutions_are_counted_in_timed_recordings(tmp_path, capsys, count, told):
    """The rows of a wheel with correlated errors are dense enough to count its five revolutions."""
    rng = np.random.default_rng(5)
    seen = noisy(hinge(np.linspace(0.0, 10 * math.pi, count)), rng)
    seen[:, 0, 3] += 0.006 * np.sin(np.linspace(0, 4, count))
    words = [write(tmp_path / "poses.csv", {"wheel": seen}), "--families", "prismatic,revolute,screw"]
    main(["fit", *words, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["family"] == "revolute"
    (ends,) = found["fits"][0]["ranges"]
    main(["fit", *words])
    assert ("it may be more turns, or fewer" in capsys.readouterr().out) is not told
    if told:
        assert ends["upper"] - ends["lower"] == pytest.approx(10 * math.pi, abs=0.2)
        assert found["judged"] < 60


def test_an_axis_is_as_uncertain_as_its_correlated_errors_make_it(tmp_path, capsys):
    """The squared error of the axis, relative to its variance, is about 1 over several recordings."""
    squares = []
    for seed in range(6):
        errors = np.random.default_rng(seed).standard_normal((200, 3))
        for k in range(1, 200):
            errors[k] = 0.9 * errors[k - 1] + math.sqrt(1.0 - 0.81) * errors[k]
        np.savetxt(tmp_path / "handle.log", hinge(np.linspace(0.0, 1.4, 200))[:, :3, 3] + 0.003 * errors)
        words = [str(tmp_path / "handle.log"), "--noise", "3mm", "--families", "revolute"]
        best = answer(words, capsys)["fits"][0]
        axis = np.array(best["parameters"]["axis"])
        variance = best["deviations"]["axis.x"] ** 2 + best["deviations"]["axis.y"] ** 2
        squares.append(float(np.sum(np.cross(axis, AXIS) ** 2)) / variance)
    assert 0.2 < np.mean(squares) < 2.0


def test_an_answer_that_depends_on_the_noise_is_ambiguous(tmp_path, capsys):
    """A wavy line is a hinge or a drawer, as its errors are small or large."""
    along = np.linspace(0.0, 0.4, 60)
    points = np.column_stack([along, 0.012 * (along / 0.4) ** 2, np.zeros(60)])
    points += 0.004 * np.random.default_rng(1).standard_normal(points.shape)
    np.savetxt(tmp_path / "handle.log", points)
    words = [str(tmp_path / "handle.log"), *TWO]
    truth = answer([*words, "--noise", "4mm"], capsys, status=None)
    small = answer([*words, "--noise", "1mm"], capsys, status=None)
    assert truth["family"] == "revolute" or not truth["told"]
    assert small["family"] == "revolute" or not small["told"]


def test_a_noise_that_the_residuals_refute_gives_no_sure_answer(tmp_path, capsys):
    """Noise along the axis looks like the motion of a cylindrical joint, if the stated one is too small."""
    rng = np.random.default_rng(3)
    seen = noisy(hinge(np.linspace(0.0, 1.2, 120)), rng, 0.001, 0.005)
    seen[:, :3, 3] += 0.006 * rng.standard_normal((120, 1)) * AXIS
    table = write(tmp_path / "poses.csv", {"door": seen})
    words = [table, "--noise", "1mm,0.3deg", "--families", "revolute,cylindrical"]
    found = answer(words, capsys, status=1)
    assert found["family"] == "cylindrical"
    assert found["says"].startswith("cannot tell: cylindrical if the noise is 1 mm and 0.3 deg, revolute if")
    assert {one["family"] for one in found["objections"]} == {"revolute"}
    assert main(["fit", *words]) == 1
    assert found["says"] in capsys.readouterr().out


def test_rows_that_repeat_do_not_count(tmp_path, capsys):
    """A camera at 10 Hz that is logged at 30 Hz tells no more than at 10 Hz."""
    rng = np.random.default_rng(2)
    points = noisy(hinge(np.linspace(0.0, 1.2, 30)), rng)[:, :3, 3]
    answers = []
    for times in (1, 3):
        np.savetxt(tmp_path / "handle.log", np.repeat(points, times, axis=0))
        answers.append(answer([str(tmp_path / "handle.log"), *TWO, "--noise", "2mm"], capsys))
    once, thrice = answers
    assert (once["repeated"], thrice["repeated"]) == (0, 60)
    assert thrice["fits"][0]["deviations"] == pytest.approx(once["fits"][0]["deviations"])
    main(["fit", str(tmp_path / "handle.log"), *TWO, "--noise", "2mm"])
    assert "60 rows repeat the one before in every digit" in capsys.readouterr().out


def test_poses_anywhere_are_no_joint(tmp_path, capsys):
    rng = np.random.default_rng(4)
    anywhere = np.array([pose(turned(rng.normal(size=3)), rng.uniform(-1, 1, 3)) for _ in range(12)])
    table = write(tmp_path / "poses.csv", {"door": anywhere})
    found = answer([table, "--noise", "2mm,0.5deg"], capsys, status=1)
    assert found["says"].startswith("no joint explains these poses")
    assert found["told"] is False
    assert answer([table, *TWO], capsys, status=1)["told"] is False


def test_correlated_errors_do_not_make_a_screw(capsys, published):
    """Deviations of a hand from a circle are correlated over seconds, and count by effective sample size."""
    main(["fit", str(published("sturm_tracks", "microwave", "microwave1.log")), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["judged"] < 20
    assert found["family"] == "revolute"


def test_the_model_of_a_joint_is_made_from_python_too(door):
    recorded = recordings.read_recording(door).pair("cupboard", "door")
    noise = recordings.ObservationNoise(0.002, 0.01, True)
    learned = recordings.identify_recorded_joint(recorded, noise, ["revolute"])
    model = recordings.make_joint_model(recorded, learned.fit)
    assert [str(s) for s in model.degrees_of_freedom] == ["door"]
    assert model.articulations["door"].parent == "cupboard"


def test_poses_in_the_plane_take_a_stated_noise(tmp_path, capsys):
    """Without noise in z, roll and pitch, a planar joint would explain any motion in the plane exactly."""
    rng, angles = np.random.default_rng(0), np.linspace(0.0, 1.3, 40)
    places = 0.5 * np.column_stack([np.cos(angles), np.sin(angles)]) + 0.003 * rng.standard_normal((40, 2))
    rows = np.column_stack([places, angles + 0.01 * rng.standard_normal(40)])
    table, words = tmp_path / "slam.csv", ("--families", "prismatic,revolute,planar")
    table.write_text("\n".join(["x,y,yaw [rad]", *(",".join(map(str, row)) for row in rows)]))
    assert main(["fit", str(table), *words]) == 2
    said = capsys.readouterr().err
    assert "z = roll = pitch = 0" in said
    assert "--noise 3mm,1deg" in said
    assert answer([str(table), *words, "--noise", "0.003,0.01"], capsys)["family"] == "revolute"
    table.write_text("\n".join(["x,y,z", *(f"{x},{y},0" for x, y in places)]))
    assert main(["fit", str(table), *words]) == 2
    assert "the same z" in capsys.readouterr().err
    assert answer([str(table), *words, "--noise", "0.003"], capsys)["family"] == "revolute"
