"""Reading of pose tables in every form, and refusals that name the line."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kineverse.errors import FormatError, InvalidValueError, UnknownNameError
from kineverse.estimation.recordings import read_recording

ORIENTATIONS = {
    "qx,qy,qz,qw": lambda r: r.as_quat(),
    "roll,pitch,yaw": lambda r: r.as_euler("xyz"),
    "rx,ry,rz": lambda r: r.as_rotvec(),
    "roll [deg],pitch [deg],yaw (deg)": lambda r: r.as_euler("xyz", degrees=True),
}


def write_table(tmp_path, text, name="poses.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def random_poses(seed, count=6):
    rng, poses = np.random.default_rng(seed), np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return poses


def pose_columns(poses, form):
    return np.column_stack([poses[:, :3, 3], ORIENTATIONS[form](Rotation.from_matrix(poses[:, :3, :3]))])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    form=st.sampled_from(sorted(ORIENTATIONS)),
    separator=st.sampled_from([",", ";", "\t", ", ", ";  "]),
    ending=st.sampled_from(["\n", "\r\n"]),
    wide=st.booleans(),
    timed=st.booleans(),
)
def test_poses_are_read_in_every_form(tmp_path_factory, seed, form, separator, ending, wide, timed):
    truth = {"a/frame": random_poses(seed), "door": random_poses(seed + 1)}
    names = ["x", "y", "z", *form.split(",")]
    numbers = {part: pose_columns(poses, form).tolist() for part, poses in truth.items()}
    rows = []
    for k in range(6):
        time = [0.1 * k] if timed else []
        if wide:
            rows.append([*time, *numbers["a/frame"][k], *numbers["door"][k]])
        else:
            rows += [[*time, part, *numbers[part][k]] for part in truth]
    named = [f"{p}.{n}" for p in truth for n in names] if wide else ["part", *names]
    head = ["time", *named] if timed else named
    text = ending.join(separator.join(map(str, row)) for row in [head, *rows])
    recording = read_recording(write_table(tmp_path_factory.mktemp("table"), text))
    for part, poses in truth.items():
        np.testing.assert_allclose(recording.tracks[part].poses, poses, atol=1e-12)
    pair = recording.pair("a/frame", "door")
    np.testing.assert_allclose(pair.parent_poses, truth["a/frame"], atol=1e-12)
    np.testing.assert_allclose(pair.child_poses, truth["door"], atol=1e-12)
    assert pair.unpaired == 0


def test_table_without_head_has_positions_or_poses(tmp_path):
    pair = read_recording(write_table(tmp_path, "1 2 3\n4 5 6\n\n")).pair()
    assert (pair.parent, pair.child, pair.parent_poses) == ("world", "part", None)
    np.testing.assert_array_equal(pair.child_poses, [[1, 2, 3], [4, 5, 6]])
    turned = read_recording(write_table(tmp_path, "# a half turn\n1,2,3,0,0,1,0\n")).tracks[""]
    np.testing.assert_allclose(turned.poses[0, :3, :3], np.diag([-1, -1, 1]), atol=1e-15)
    np.testing.assert_array_equal(turned.lines, [2])


def test_columns_argument_replaces_the_head(tmp_path):
    table = write_table(tmp_path, "0.1\t 1 2 3  77\n0.2\t 4 5 6  78\n")
    track = read_recording(table, "time [ms],x [mm],y [cm],z,-").tracks[""]
    np.testing.assert_allclose(track.poses, [[0.001, 0.02, 3], [0.004, 0.05, 6]])
    np.testing.assert_allclose(track.times, [1e-4, 2e-4])
    headed = read_recording(write_table(tmp_path, "a;b;c\n1;2;3\n"), ["z", "y", "x"])
    np.testing.assert_array_equal(headed.tracks[""].poses, [[3, 2, 1]])


def test_missing_parts_are_left_out_and_counted(tmp_path):
    table = write_table(tmp_path, "time,A.x,A.y,A.z,A.rx,A.ry,A.rz,B.x,B.y,B.z\n" + "0,1,2,3,0,0,0,,,\n"
                    "1,1,2,3,0,0,0,4,5,6\n2,,,,,,,4,5,6\n")  # fmt: skip
    recording = read_recording(table)
    assert [len(recording.tracks[part]) for part in "AB"] == [2, 2]
    pair = recording.pair("A", "B")
    assert (len(pair.child_poses), pair.unpaired, pair.lines.tolist()) == (1, 2, [3])
    assert len(recording.pair(child="B").child_poses) == 2


def test_rows_without_times_pair_in_order(tmp_path):
    rows = "\n".join(f"{part},{k},0,0,0,0,0,1" for k in range(3) for part in ("A", "B"))
    pair = read_recording(write_table(tmp_path, "part,x,y,z,qx,qy,qz,qw\n" + rows)).pair("A", "B")
    np.testing.assert_array_equal(pair.parent_poses, pair.child_poses)
    assert len(pair.parent_poses) == 3


def test_single_part_takes_any_name(tmp_path):
    assert read_recording(write_table(tmp_path, "1 2 3\n4 5 7\n")).pair(child="door").child == "door"


@pytest.mark.parametrize("column", ["part", "name", "link", "body", "object", "frame", "child_frame_id"])
def test_part_column_has_synonyms(column, tmp_path):
    recording = read_recording(write_table(tmp_path, f"t,{column},x,y,z\n0,wall,1,0,0\n0,door,2,0,0\n"))
    assert recording.ignored == ()
    assert set(recording.tracks) == {"wall", "door"}


def test_part_named_world_is_a_part(tmp_path):
    recording = read_recording(
        write_table(tmp_path, "part,x,y,z,rx,ry,rz\nworld,1,0,0,0,0,0\ndoor,2,0,0,0,0,0\n")
    )
    assert recording.pair(child="door").parent_poses[0, 0, 3] == 1


def test_unknown_columns_are_listed(tmp_path):
    assert read_recording(write_table(tmp_path, "x,y,z,confidence\n1,2,3,0.5\n")).ignored == ("confidence",)


def test_quaternions_of_two_digits_are_accepted(tmp_path):
    track = read_recording(write_table(tmp_path, "0 0 0 0 0 0.71 0.71\n")).tracks[""]
    np.testing.assert_allclose(track.poses[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


LONG = "time,part,x,y,z\n"
BAD = {
    "no file": (None, "there is no such file"),
    "empty": ("", "the file is empty"),
    "only comments": ("# nothing\n\n", "the file is empty"),
    "only a head": ("x,y,z\n", "no row below"),
    "binary": (bytes(range(256)), "this is no text"),
    "a picture": (b"\x89PNG\r\n\x1a\n" + b"\xff" * 20, "line 1: this is no text"),
    "UTF-16": ("x,y,z\n1,2,3\n".encode("utf-16"), "not in UTF-8"),
    "mixed": ("1 2 3\n1 2 3 0 0 0 1\n", "line 2: 7 cells, where line 1 has 3"),
    "mixed below a head": ("x,y,z\n\n1,2,3\n1,2\n", "line 4: 2 cells, where line 1 has 3"),
    "nine columns": ("1 2 3 4 5 6 7 8 9\n", "9 columns without names"),
    "NaN": ("x,y,z\n1,2,3\n1,nan,3\n", "line 3: y is 'nan'.*All cells of a part that was not observed are empty"),
    "infinity": ("1 2 -inf\n", "line 1: z is '-inf'"),
    "huge": ("1 2 1e300\n", "line 1: z is '1e300'"),
    "words": ("x,y,z\n1,two,3\n", "line 2: y is 'two'"),
    "words in a table without names": ("1 2 3\n1 x 3\n", "line 2: y is 'x'"),
    "decimal comma": ("x;y;z\n1,5;2;3\n", "line 2: x is '1,5'.*A decimal point"),
    "underscores": ("1 2 3\n1_0 2 3\n", "line 2: x is '1_0'"),
    "a missing cell": ("x,y,z\n1,,3\n", "line 2: y is missing"),
    "no length": ("0 0 0 0 0 0 1\n0 0 0 0.1 0 0 1.1\n", r"line 2.* length 1\.105, .*off by 0\.1; 1 of 2"),
    "zero": ("0 0 0 0 0 0 0\n", r"line 1.* length 0,.*off by 1;"),
    "out of order": (LONG + "0.2,A,1,2,3\n0.2,B,1,2,3\n0.1,A,1,2,3\n", r"line 4: 0\.1 s is earlier than line 2"),
    "twice": (LONG + "0.2,A,1,2,3\n0.2,A,1,2,3\n", r"line 3: 0\.2 s is the same time as line 2"),
    "no name": (LONG + "0,,1,2,3\n", "line 2: the name of the part is missing"),
    "nothing observed": ("A.x,A.y,A.z\n,,\n", "nothing was observed"),
    "no position": ("qx,qy,qz,qw\n0,0,0,1\n", "an orientation, but no position"),
    "nothing known": ("speed,force\n1,2\n", "no column is a position"),
    "a lacking column": ("x,y,z,q_x,qy,qz,qw\n1,2,3,0,0,0,1\n", "no column qx. Not understood: 'q_x'"),
    "a part lacks z": ("A.x,A.y,B.x,B.y,B.z\n1,2,3,4,5\n", "line 1: the part 'A' has no column z"),
    "two orientations": ("x,y,z,rx,ry,rz,roll,pitch,yaw\n1,2,3,4,5,6,7,8,9\n", "orientation twice"),
    "a column twice": ("x,y,z,x\n1,2,3,4\n", "two columns 'x'"),
    "an odd unit": ("x [inch],y,z\n1,2,3\n", "the unit 'inch'. Known are m, cm, mm"),
    "parts and none": ("x,y,z,B.x,B.y,B.z\n1,2,3,4,5,6\n", "'B'.*others such as 'x' to none"),
    "parts twice": ("part,B.x,B.y,B.z\nA,1,2,3\n", "parts are named in rows and in"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_malformed_table_is_refused_with_its_line(case, tmp_path):
    text, says = BAD[case]
    path = tmp_path / "poses.csv" if text is None else write_table(tmp_path, text)
    with pytest.raises(FormatError, match=says) as caught:
        read_recording(path)
    assert "poses.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "says"),
    [("x,y", "there are 2 names"), ("x,y,y", "two columns 'y'"), ("x,y,time", "has no column z")],
)
def test_invalid_column_names_are_refused(columns, says, tmp_path):
    with pytest.raises(FormatError, match=says):
        read_recording(write_table(tmp_path, "1 2 3\n"), columns)


def test_unknown_parts_are_refused(tmp_path):
    rows = "0,table,1,2,3\n1,door,1,2,3\n2,lid,1,2,3\n"
    recording = read_recording(write_table(tmp_path, LONG + rows))
    with pytest.raises(UnknownNameError, match="Did you mean 'door'"):
        recording.pair(child="dor")
    with pytest.raises(UnknownNameError, match=r"has no part 'tabel'\. Did you mean 'table'"):
        recording.pair("tabel", "door")
    with pytest.raises(UnknownNameError, match=r"which part moves.*'table', 'door', 'lid'"):
        recording.pair()
    with pytest.raises(UnknownNameError, match="both 'door'"):
        recording.pair("door", "door")
    with pytest.raises(FormatError, match="only positions of the parent 'table'"):
        recording.pair("table", "door")


def test_parts_never_observed_together_are_refused(tmp_path):
    rows = "0,table,1,2,3,0,0,0\n1,door,1,2,3,0,0,0\n"
    recording = read_recording(write_table(tmp_path, "time,part,x,y,z,rx,ry,rz\n" + rows))
    with pytest.raises(FormatError, match="never observed at the same time"):
        recording.pair("table", "door")


def test_table_without_names_is_one_part_in_the_world(tmp_path):
    with pytest.raises(UnknownNameError, match=r"names no parts.*no 'table'"):
        read_recording(write_table(tmp_path, "1 2 3\n4 5 7\n")).pair("table", "door")


def test_relative_poses_are_in_the_parent_frame(tmp_path):
    a, b = random_poses(1), random_poses(2)
    rows = [[*x, *y] for x, y in zip(pose_columns(a, "rx,ry,rz"), pose_columns(b, "rx,ry,rz"), strict=True)]
    head = ",".join(f"{part}.{name}" for part in "AB" for name in ("x", "y", "z", "rx", "ry", "rz"))
    text = "\n".join([head, *(",".join(map(str, row)) for row in rows)])
    recording = read_recording(write_table(tmp_path, text))
    np.testing.assert_allclose(recording.pair("A", "B").relative, np.linalg.inv(a) @ b, atol=1e-12)
    positions = read_recording(
        write_table(tmp_path, text), ",".join([*head.split(",")[:9], "-", "-", "-"])
    ).pair("A", "B")
    np.testing.assert_allclose(positions.relative, (np.linalg.inv(a) @ b)[:, :3, 3], atol=1e-12)


def test_thin_keeps_both_ends_and_pairs(tmp_path):
    pair = read_recording(write_table(tmp_path, "\n".join(f"{k} 0 0" for k in range(100)))).pair()
    few = pair.thin(5)
    np.testing.assert_array_equal(few.child_poses[:, 0], [0, 25, 50, 74, 99])
    np.testing.assert_array_equal(few.lines, [1, 26, 51, 75, 100])
    assert len(pair.thin(1000).child_poses) == 100
    with pytest.raises(InvalidValueError, match="at least two"):
        pair.thin(1)


def test_rotation_vector_of_any_length_is_read(tmp_path):
    for angle in (0.0, 1e-12, math.pi, 7.0):
        table = write_table(tmp_path, f"x,y,z,rx,ry,rz\n0,0,0,0,{angle},0\n")
        expected = Rotation.from_rotvec([0, angle, 0]).as_matrix()
        np.testing.assert_allclose(read_recording(table).tracks[""].poses[0, :3, :3], expected, atol=1e-12)
