"""``kineverse calibrate``: tables of looks, what they leave open, the report, and the corrected file."""

import csv
import json
import math
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.estimation import read_looks

ARM = """<?xml version="1.0"?>
<robot name="arm">
  <!-- measured by hand -->
  <link name="base"/><link name="upper"/><link name="fore"/><link name="hand"/><link name="slide"/><link name="tip"/>
  <joint name="pan" type="continuous">
    <origin xyz="0 0 0.5"/><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit effort="1" velocity="1"/>
  </joint>
  <joint name="lift" type="revolute">
    <origin xyz="0.1 0 0.1"/><parent link="upper"/><child link="fore"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <joint name="roll" type="revolute">
    <origin xyz="0.4 0 0"/><parent link="fore"/><child link="hand"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="reach" type="prismatic">
    <origin xyz="0.1 0 0"/><parent link="hand"/><child link="slide"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.3" effort="1" velocity="1"/>
  </joint>
  <joint name="wrist" type="revolute">
    <origin xyz="0.05 0 0"/><parent link="slide"/><child link="tip"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <transmission name="t1"><joint name="pan"/></transmission>
</robot>
"""
JOINTS = ("pan", "lift", "roll", "reach", "wrist")
OFFSETS = np.array([0.03, -0.02, 0.05, 0.004, 0.025])
CAMERA = (np.array([2.0, 0.2, 1.2]), Rotation.from_euler("xyz", [-1.9, 0.1, 1.7]))
FREE = ("--free", "offsets *", "--free", "mount camera", "--attach", "camera=world")
SEEN = ("--observed", "tip", "--in", "camera")


def homogeneous(rotation, position):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def tip(q):
    """Return the pose of the tip by the numbers of the file."""
    about = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}

    def step(xyz, axis="", angle=0.0):
        return homogeneous(Rotation.from_rotvec(angle * np.array(about.get(axis, [0, 0, 0]))), xyz)

    pan, lift, roll, reach, wrist = q
    return (
        step([0, 0, 0.5], "z", pan)
        @ step([0.1, 0, 0.1], "y", lift)
        @ step([0.4, 0, 0], "x", roll)
        @ step([0.1 + reach, 0, 0])
        @ step([0.05, 0, 0], "y", wrist)
    )


def make_looks(count=25, seed=0, noise=1.0, gross=(), offsets=OFFSETS):
    """Return joint values (N, 5) and poses of the tip in the camera (N, 4, 4)."""
    rng = np.random.default_rng(seed)
    values = rng.uniform([-1.5, -1, -2, 0, -1.5], [1.5, 1, 2, 0.3, 1.5], (count, 5))
    camera = np.linalg.inv(homogeneous(CAMERA[1], CAMERA[0]))
    poses = np.array([camera @ tip(q + offsets) for q in values])
    poses[:, :3, 3] += 0.002 * noise * rng.normal(size=(count, 3))
    turned = Rotation.from_rotvec(math.radians(0.3) * noise * rng.normal(size=(count, 3))).as_matrix()
    poses[:, :3, :3] = turned @ poses[:, :3, :3]
    for k in gross:
        poses[k, :3, 3] += rng.normal(size=3)
    return values, poses


def write(
    path,
    values,
    poses,
    names=JOINTS,
    head=("x", "y", "z", "qx", "qy", "qz", "qw"),
    order=(0, 1, 2, 3),
    mm=1.0,
):
    with open(path, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*names, *head])
        for row, pose in zip(values, poses, strict=True):
            q = Rotation.from_matrix(pose[:3, :3]).as_quat()
            table.writerow([*row, *(mm * pose[:3, 3]), *q[list(order)]][: len(names) + len(head)])
    return str(path)


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return str(path)


def offsets_of(answer, joints=JOINTS):
    return np.array([answer["state"][f"{name}/offset"] for name in joints])


def test_offsets_and_camera_and_the_corrected_file(run, arm, tmp_path):
    values, poses = make_looks(gross=(3, 11))
    table, out = write(tmp_path / "looks.csv", values, poses), tmp_path / "new.urdf"
    # With an unknown camera, the offset of the first joint is one of its angles.
    status, text, notes = run("calibrate", arm, table, *FREE, *SEEN, "--output", out)
    assert status == 1
    assert notes == ""
    assert "gross errors, left out: 2, in lines 5, 13" in text
    assert re.search(r"not told by these looks, and as before:\n  .*pan/offset -?0\.\d\d", text)
    assert re.search(r"roll/offset +2\.\d+ +± 0\.\d+ +deg", text)
    assert re.search(r"off now, in looks left out +\d\.\d+ mm", text)
    assert "'camera' is not corrected: the file has no number for it" in text
    # Between what was told, the new file says how the arm moves: poses of the tip relative to each other.
    model = kv.load(out)
    fk = model.fk("tip")
    found = np.array([fk(dict(zip(map(kv.position, JOINTS), q, strict=True))) for q in values])
    true = np.array([tip(q + OFFSETS) for q in values])
    world = true[0] @ np.linalg.inv(found[0])
    assert np.abs(world @ found - true).max() < 0.02
    old, new = (ARM.splitlines(), out.read_text().splitlines())
    assert [a for a, b in zip(old, new, strict=False) if a != b and "origin" not in b] == [] or len(
        new
    ) > len(old)
    assert "<transmission" in out.read_text()
    assert "<!-- measured by hand -->" in out.read_text()


def test_json_with_a_known_camera(run, arm, tmp_path):
    values, poses = make_looks()
    world = np.array([homogeneous(CAMERA[1], CAMERA[0]) @ pose for pose in poses])
    table = write(tmp_path / "looks.csv", values, world)
    status, text, _ = run("calibrate", arm, table, "--free", "offsets *", "--observed", "tip", "--json")
    answer = json.loads(text)
    assert status == 0
    assert np.abs(offsets_of(answer) - OFFSETS).max() < 0.004
    assert answer["unobservable"] == []
    assert answer["looks"] == 25
    assert answer["noise"]["position"] == pytest.approx(0.002, rel=0.3)
    assert answer["held_out"]["position"] == pytest.approx(math.sqrt(3) * 0.002, rel=0.4)
    assert answer["units"] == {"pan/offset": "rad", "lift/offset": "rad", "roll/offset": "rad",
                               "reach/offset": "m", "wrist/offset": "rad"}  # fmt: skip
    deviations = np.array([answer["deviations"][f"{n}/offset"] for n in JOINTS])
    assert (np.abs(offsets_of(answer) - OFFSETS) < 4 * deviations).all()
    assert np.shape(answer["covariance"]) == (5, 5)


@pytest.mark.parametrize(
    ("change", "noted"),
    [
        ({"names": ("pan [deg]", "lift [deg]", "roll [deg]", "reach [mm]", "wrist [deg]"), "scale": "both"}, ()),
        ({"scale": "deg"}, ("joint values in deg",)),
        ({"mm": 1000.0}, ("lengths in mm",)),
        ({"head": ("x", "y", "z", "qw", "qx", "qy", "qz"), "order": (3, 0, 1, 2)}, ()),
        ({"head": ("x", "y", "z", "q1", "q2", "q3", "q4"), "order": (3, 0, 1, 2)}, ("qw,qx,qy,qz",)),
        ({"head": ("x", "y", "z", "q1", "q2", "q3", "q4")}, ("qx,qy,qz,qw",)),
        ({"head": ("tip.x", "tip.y", "tip.z", "tip.qx", "tip.qy", "tip.qz", "tip.qw")}, ()),
        ({"names": ("joint_states/pan/position", "lift.position", "roll", "reach", "wrist")}, ()),
    ],
)  # fmt: skip
def test_forms_of_a_table(arm, tmp_path, change, noted):
    values, poses = make_looks(12)
    scale = change.pop("scale", "")
    factors = np.array([math.degrees(1), math.degrees(1), math.degrees(1), 1.0, math.degrees(1)])
    given = values * (factors if scale else 1.0) * ([1, 1, 1, 1000, 1] if scale == "both" else 1.0)
    path = write(tmp_path / "looks.csv", given, poses, **change)
    model = kv.load(arm)
    with model.edit() as edit:
        edit.add_frame("camera", parent="world")
    table = read_looks(path, model, observed="tip", relative_to="camera")
    assert len(table.looks) == 12
    assert table.lines == tuple(range(2, 14))
    assert table.remarks == table.ignored == ()
    assert len(table.assumptions) == len(noted)
    assert all(text in " ".join(table.assumptions) for text in noted)
    for look, q, pose in zip(table.looks, values, poses, strict=True):
        state = {str(k): v for k, v in look.state.items()}
        assert [state[name] for name in JOINTS] == pytest.approx(q)
        ((key, seen),) = look.observations
        assert key == ("tip", "camera")
        assert np.abs(seen - pose).max() < 1e-9


def test_several_frames_positions_and_gaps(arm, tmp_path):
    values, poses = make_looks(4)
    rows = [[*q, *pose[:3, 3], *([""] * 3 if k == 1 else pose[:3, 3] + 1)]
            for k, (q, pose) in enumerate(zip(values, poses, strict=True))]  # fmt: skip
    rows[3][0] = ""
    path = tmp_path / "looks.csv"
    head = [*JOINTS, "tip.x", "tip.y", "tip.z", "hand.x", "hand.y", "hand.z"]
    path.write_text("\n".join(",".join(map(str, row)) for row in [head, *rows]))
    table = read_looks(path, kv.load(arm))
    assert [len(look.observations) for look in table.looks] == [2, 1, 2]
    assert table.assumptions == ("1 rows without all joint values are left out",)
    observed = {key.frame: np.asarray(seen) for key, seen in table.looks[0].observations}
    assert observed["tip"] == pytest.approx(poses[0, :3, 3])
    assert observed["hand"] == pytest.approx(poses[0, :3, 3] + 1)


def test_pixels_and_intrinsics(run, arm, tmp_path):
    values, poses = make_looks(40, noise=0.0)
    points = poses[:, :3, 3]
    good = points[:, 2] > 0.3
    pixels = np.array([610, 605]) * points[good, :2] / points[good, 2:] + [325, 242]
    rows = np.concatenate([values[good], pixels], axis=1)
    path = tmp_path / "corners.csv"
    path.write_text(
        "\n".join([",".join([*JOINTS, "u [px]", "v"]), *(",".join(map(repr, row)) for row in rows.tolist())])
    )
    rpy = " ".join(map(repr, CAMERA[1].as_euler("xyz").tolist()))
    joint = (
        f"<joint name='camera_mount' type='fixed'><origin xyz='2.01 0.19 1.21' rpy='{rpy}'/>"
        "<parent link='base'/><child link='camera'/></joint>"
    )
    file = tmp_path / "seen.urdf"
    file.write_text(ARM.replace("</robot>", f"<link name='camera'/>{joint}</robot>"))
    status, text, notes = run(
        "calibrate", file, path, *SEEN, "--free", "intrinsics", "--free", "mount camera_mount",
        "--free", "offsets lift", "--free", "offsets reach", "--intrinsics", "600,600,320,240", "--json",
    )  # fmt: skip
    answer = json.loads(text)
    assert status == 0, notes
    state = answer["state"]
    assert [state[f"camera/{n}"] for n in ("fx", "fy", "cx", "cy")] == pytest.approx(
        [610, 605, 325, 242], abs=0.5
    )


def wrong(arm, tmp_path, **change):
    values, poses = make_looks(20)
    return arm, write(tmp_path / "looks.csv", values, poses, **change)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((*SEEN, "--attach", "camera=world"), "Nothing is free"),
        (("--free", "nonsense", *SEEN), "Nothing is free|'nonsense' does not say"),
        (("--free", "offset", *SEEN), "says nothing of where"),
        (("--free", "offsets elbow", *SEEN), "joint 'elbow'.*roll"),
        (("--free", "mount camra", "--attach", "camera=world", *SEEN), "'camra'.*'camera'"),
        (("--free", "offsets *"), "does not say which frame was seen.*--observed"),
        (("--free", "offsets *", "--observed", "tp"), "'tp' is no frame of the model.*'tip'"),
        (("--free", "offsets *", "--observed", "tip", "--in", "camera"), "--in 'camera' is no frame"),
        (("--free", "offsets *", "--observed", "tip", "--set", "pan=1"), "'pan' has a column, so --set"),
        (("--free", "offsets *", "--observed", "tip", "--attach", "tip=hand"), "a frame 'tip' already"),
        (("--free", "offsets *", "--observed", "tip", "--noise", "x"), "--noise 'x'"),
        (("--free", "offsets *", "--observed", "tip", "--attach", "a"), "write NAME=PARENT"),
        (("--free", "offsets *", "--observed", "tip", "--attach", "a=b"), "no frame 'b'"),
        (("--free", "offsets *", "--observed", "tip", "--set", "elbow=1"), "--set elbow"),
        (("--free", "intrinsics", "--observed", "tip"), "needs their present values"),
        (("--free", "offsets *", "--intrinsics", "1,2", "--observed", "tip"), "four numbers"),
        (("--free", "offsets *", "--observed", "tip", "--units", "ells"), "'ells' is no unit"),
        (("--free", "offsets *", "--observed", "tip", "--output", "x.nonsense"), "x.nonsense"),
        (("--free", "offsets *", "--observed", "tip", "--columns", "a,b"), "there are 2 names"),
    ],
)
def test_wrong_options(run, arm, tmp_path, words, said):
    status, text, notes = run("calibrate", *wrong(arm, tmp_path), *words)
    assert (status, text) == (2, "")
    assert re.search(said, notes), notes
    assert notes.count("\n") == 1


def test_wrong_tables(run, arm, tmp_path):
    words = ("--free", "offsets *", "--free", "mount camera", "--attach", "camera=world", *SEEN)
    values, poses = make_looks(20)

    def said(values, poses, **change):
        status, text, notes = run(
            "calibrate", arm, write(tmp_path / "looks.csv", values, poses, **change), *words
        )
        assert (status, text) == (2, ""), text
        return notes

    assert re.search("Too few looks: 11 free parameters.*1 look has 6", said(values[:1], poses[:1]))
    names = ("pan", "lift", "rolll", "reach", "wrist")
    assert re.search(
        "'tip' as seen in 'camera' depends on roll, which no column has.*--set",
        said(values, poses, names=names),
    )
    assert "no column is a joint of the model" in said(values, poses, names=("a", "b", "c", "d", "e"))
    notes = said(values, poses, order=(3, 0, 1, 2))
    assert re.search("turns as the joints do if its quaternions are w, x, y, z.*--columns", notes)
    notes = said(values, poses, names=("pan", "lift", "roll", "reach", "pan"))
    assert "are both values of 'pan'" in notes
    assert "unit 'mm', but 'pan' is in rad or deg" in said(values, poses, names=("pan [mm]", *JOINTS[1:]))
    names = (*JOINTS[:3], "reach [deg]", "wrist")
    assert "unit 'deg', but 'reach' is in m, cm or mm" in said(values, poses, names=names)
    values = values.astype(object)
    values[2, 1] = "up"
    assert re.search("line 4: lift is 'up', which is no number", said(values, poses))
    empty = tmp_path / "empty.csv"
    empty.write_text("pan,lift\n")
    assert run("calibrate", arm, empty, *words)[0] == 2
    assert run("calibrate", arm, tmp_path / "none.csv", *words)[0] == 2


def test_an_output_that_exists_is_kept(run, arm, tmp_path):
    out = tmp_path / "new.kv.json"
    out.write_text("mine")
    words = (
        "calibrate",
        *wrong(arm, tmp_path),
        "--free",
        "offsets *",
        *FREE[4:],
        "--free",
        "mount camera",
        *SEEN,
    )
    status, _, notes = run(*words, "--output", out)
    assert status == 2
    assert "--force replaces it" in notes
    assert out.read_text() == "mine"
    assert run(*words, "--output", arm, "--force")[0] == 2  # the input
    assert run(*words, "--output", out, "--force")[0] == 1
    assert kv.load(out).history.entry("frame camera").operation is not None


def test_a_value_that_stays_the_same_may_be_given(run, arm, tmp_path):
    values, poses = make_looks(15, offsets=np.zeros(5))
    values[:, 3] = 0.1
    camera = np.linalg.inv(homogeneous(CAMERA[1], CAMERA[0]))
    poses = np.array([camera @ tip(q) for q in values])
    table = write(
        tmp_path / "looks.csv", values[:, [0, 1, 2, 4]], poses, names=("pan", "lift", "roll", "wrist")
    )
    status, text, _ = run("calibrate", arm, table, "--set", "reach=10cm", "--free", "mount camera",
                          "--attach", "camera=world", *SEEN, "--json")  # fmt: skip
    assert status == 0
    state = json.loads(text)["state"]
    assert [state[f"camera/d{c}"] for c in "xyz"] == pytest.approx(CAMERA[0].tolist(), abs=1e-6)
