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


def hinge(count=30):
    """Return positions, quaternions (x, y, z, w) and the poses of a door with an arbitrary axis."""
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 1.4, count), [0, 0.6, 0.8]))
    positions, rotations = turns.apply([0.4, 0.3, -0.2]), turns * Rotation.from_rotvec([3, 2, 1])
    positions += [0.5, 0.1, 0.2]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), positions
    return positions, rotations.as_quat(), poses


P, Q, POSES = hinge()
TIMES = 1_600_000_000_250_000_000 + 100_000_000 * np.arange(len(P))  # [ns]
ROS = "pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w"
TF = ROS.replace("pose.position", "transform.translation").replace("pose.orientation", "transform.rotation")
MOTIVE = (
    "Format Version,1.23,Take Name,door,Export Frame Rate,10,Rotation Type,Quaternion,Length Units,Millimeters\n\n"
    ",Type"
    + 8 * ",Rigid Body"
    + 3 * ",Rigid Body Marker"
    + "\n,Name"
    + 8 * ",door"
    + 3 * ",door:Marker1"
    + "\n"
    ",ID,1,1,1,1,1,1,1,1,2,2,2\n,,"
    + 4 * "Rotation,"
    + 3 * "Position,"
    + "Mean Marker Error"
    + 3 * ",Position"
    + "\n"
    "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z"
)
VICON = "Segments\n10\n,,door:door,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,deg,deg,deg,mm,mm,mm"
EUROC = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]"
)
W_FIRST, ANGLES = np.roll(Q, 1, axis=1), Rotation.from_quat(Q).as_euler("xyz", degrees=True)
VECTORS = Rotation.from_quat(Q).as_rotvec(degrees=True)
SECONDS, NANOSECONDS = np.divmod(TIMES, 1_000_000_000)
EXPORTS = {  # name: head, columns, name of the part, assumptions
    "bag": (f"Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,{ROS}", [7, 7, SECONDS, NANOSECONDS, "map", P, Q], "", ()),
    "bag with dots": (f"time,.header.stamp.sec,.header.stamp.nanosec,.{ROS.replace(',', ',.')}", [7, SECONDS, NANOSECONDS, P, Q], "", ()),
    "odometry": (f"Time,child_frame_id,pose.{ROS.replace(',', ',pose.')},pose.covariance,twist.twist.linear.x,twist.twist.linear.y,twist.twist.linear.z", [TIMES / 1e9, "door", P, Q, '"(0, 0)"', 1, 2, 3], "door", ()),
    "transforms": (f"Time,header.frame_id,child_frame_id,{TF}", [TIMES / 1e9, "map", "door", P, Q], "door", ()),
    "transforms in columns": ("Time,transforms[0]." + TF.replace(",", ",transforms[0]."), [TIMES / 1e9, P, Q], "transforms[0]", ()),
    "rostopic": (f"%time,field.header.seq,field.header.stamp,field.header.frame_id,field.{ROS.replace(',', ',field.')}", [TIMES, 1, TIMES, "map", P, Q], "", ("times in ns",)),
    "ros2 topic": ("", [SECONDS, NANOSECONDS, "map", P, Q], "", ("columns stamp.sec,stamp.nanosec,frame_id,x,y,z,qx,qy,qz,qw",)),
    "PlotJuggler": ("__time,/door/" + ROS.replace(".", "/").replace(",", ",/door/") + ",/door/pose/orientation/roll_deg", [TIMES / 1e9, P, Q, 1], "door", ()),
    "TUM": ("# timestamp tx ty tz qx qy qz qw", [TIMES / 1e9, P, Q], "", ()),
    "TUM without a head": ("", [TIMES / 1e9, P, Q], "", ("columns time,x,y,z,qx,qy,qz,qw",)),
    "w first": ("", [P, W_FIRST], "", ("columns x,y,z,qw,qx,qy,qz",)),
    "EuRoC": (EUROC, [TIMES, P, W_FIRST, 1, 2, 3, 4], "", ()),
    "KITTI": ("", [POSES[:, :3].reshape(-1, 12)], "", ("columns r11,r12,r13,x,r21,r22,r23,y,r31,r32,r33,z",)),
    "matrices": ("", [POSES.reshape(-1, 16)], "", ("columns r11,r12,r13,x,r21,r22,r23,y,r31,r32,r33,z,-,-,-,-",)),
    "Motive": (MOTIVE, [np.arange(30), 0.1 * np.arange(30), Q, 1000 * P, 0.1, 1, 2, 3], "door", ()),
    "Vicon": (VICON, [1 + np.arange(30), 0, VECTORS, 1000 * P], "door", ()),
    "Vicon with quaternions": (VICON.replace("RZ", "RZ,RW").replace("deg,deg,deg", ",,,"), [1 + np.arange(30), 0, Q, 1000 * P], "door", ()),
    "headset": ("head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w", [P, Q], "head", ()),
    "units": ("x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw (deg)", [1000 * P, ANGLES], "", ()),
    "no units": ("x,y,z,roll,pitch,yaw", [1000 * P, ANGLES], "", ("lengths in mm", "angles in deg")),
    "radians": ("x,y,z,roll,pitch,yaw", [P, np.radians(ANGLES)], "", ("angles in rad",)),
    "dates": ("timestamp,tx,ty,tz,q0,q1,q2,q3", [TIMES.astype("datetime64[ns]"), P, W_FIRST], "", ()),
}  # fmt: skip


def export(head, columns, separator=","):
    columns = [
        np.broadcast_to(np.array(column).T, (1, 30)) if np.ndim(column) < 2 else column.T
        for column in columns
    ]
    rows = zip(*([str(cell) for cell in row] for column in columns for row in column), strict=True)
    return "\n".join([*([head] if head else []), *(separator.join(row) for row in rows)]) + "\n"


@pytest.mark.parametrize("case", EXPORTS)
def test_exports_of_other_programs_are_read(case, tmp_path):
    head, columns, part, assumed = EXPORTS[case]
    recording = read_recording(write_table(tmp_path, export(head, columns, " " if "TUM" in case else ",")))
    assert [*recording.tracks] == [part]
    track = recording.tracks[part]
    np.testing.assert_allclose(track.poses, POSES, atol=1e-9)
    if track.times is not None:
        np.testing.assert_allclose(track.times - track.times[0], 0.1 * np.arange(30), atol=1e-5)
    assert recording.assumptions == assumed


@pytest.mark.parametrize(
    ("head", "separator", "assumed"),
    [
        ("x_mm;y_mm;z_mm;yaw (deg)", ";", ("roll = pitch = 0",)),
        ("x,y,theta", ",", ("z = roll = pitch = 0", "angles in rad")),
        ("t;door.x;door.y;door.heading_deg", ";", ("z = roll = pitch = 0",)),
    ],
)
def test_poses_in_the_plane_are_read(head, separator, assumed, tmp_path):
    turns = np.linspace(0, 1.4, 30)
    truth = 0.3 * np.column_stack([np.cos(turns), np.sin(turns), 0 * turns])
    lengths, angle = (1000 if "mm" in head else 1), (180 / np.pi if "deg" in head else 1)
    columns = [lengths * truth[:, : 3 if "z_mm" in head else 2], angle * turns[:, None]]
    columns = [0.1 * np.arange(30)] * head.startswith("t") + columns
    recording = read_recording(write_table(tmp_path, export(head, columns, separator)))
    (track,) = recording.tracks.values()
    np.testing.assert_allclose(track.poses[:, :3, 3], truth, atol=1e-12)
    turned = Rotation.from_rotvec(turns[:, None] * [0, 0, 1]).as_matrix()
    np.testing.assert_allclose(track.poses[:, :3, :3], turned, atol=1e-12)
    assert recording.assumptions == assumed


def test_decimal_commas_are_read(tmp_path):
    for separator in (";", " ", "\t"):
        text = export("", [P, Q], separator).replace(".", ",")
        recording = read_recording(write_table(tmp_path, text))
        np.testing.assert_allclose(recording.tracks[""].poses, POSES, atol=1e-9)
        assert recording.assumptions[0] == "decimal commas"


def test_rows_of_nan_are_gaps(tmp_path):
    text = export("x,y,z,qx,qy,qz,qw", [P, Q]) + "nan,nan,nan,NaN,NaN,NaN,NaN\n"
    recording = read_recording(write_table(tmp_path, text))
    assert len(recording.tracks[""]) == 30
    assert recording.assumptions == ("1 rows of NaN are gaps",)


class Frame:
    """Stand-in for a data frame of pandas."""

    def __init__(self, columns):
        self.data, self.columns = columns, [*columns]

    def __getitem__(self, name):
        return self.data[name]


def test_frames_and_arrays_are_read():
    names = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    table = np.column_stack([0.1 * np.arange(30), P, Q])
    of_parts = {("door", name): column for name, column in zip(names[1:], table.T[1:], strict=True)}
    records = np.rec.fromarrays(table.T, names=names)
    for data in (Frame(dict(zip(names, table.T, strict=True))), records, table, Frame(of_parts)):
        (track,) = read_recording(data).tracks.values()
        np.testing.assert_allclose(track.poses, POSES, atol=1e-12)
    with pytest.raises(FormatError, match="one number or text in each cell"):
        read_recording(np.zeros(3, dtype=[("x", float, (3,))]))


LINE = np.linspace(0, 1, 30)[:, None] * [1.0, 0.5, 0.2]
AMBIGUOUS = {  # name: head, columns, message
    "only an orientation": (",".join(ROS.split(",")[3:]), [Q], "an orientation, but no position"),
    "three numbers of an orientation": (",".join(ROS.split(",")[3:6]), [Q[:, :3]], "no positions x, y, z, and no qw, the fourth number"),
    "a quaternion without w": (ROS.rpartition(",")[0], [P, Q[:, :3]], "no column qw. Three angles are called roll"),
    "metres or millimetres": ("x,y,z", [40 * LINE], "metres or millimetres.*--units m or --units mm"),
    "far away": ("x,y,z", [LINE + 431733], "no room holds this"),
    "millimetres in ROS": (ROS, [1000 * P, Q], "no room holds.*--units mm"),
    "an order that does not show": ("", [LINE, Rotation.random(30, rng=1).as_quat()], "--columns x,y,z,qx,qy,qz,qw or --columns x,y,z,qw,qx"),
    "several frames": ("frame_id,x,y,z", [np.array(15 * ["a", "b"]), P], "line 3: .* in the frames 'a' and 'b'"),
    "five columns": ("", [P, Q[:, :2]], "5 columns without names"),
}  # fmt: skip


@pytest.mark.parametrize("case", AMBIGUOUS)
def test_ambiguous_tables_are_asked_about(case, tmp_path):
    head, columns, says = AMBIGUOUS[case]
    with pytest.raises(FormatError, match=says):
        read_recording(write_table(tmp_path, export(head, columns)))


def test_units_and_columns_answer_what_is_asked(tmp_path):
    table = write_table(tmp_path, export("x,y,z", [40 * LINE]))
    for unit, size in {"m": 40.0, "mm": 0.04}.items():
        positions = read_recording(table, units=unit).tracks[""].poses
        np.testing.assert_allclose(positions, size * LINE, atol=1e-12)
    in_ros = write_table(tmp_path, export(ROS, [1000 * P, Q]))
    np.testing.assert_allclose(read_recording(in_ros, units="mm").tracks[""].poses, POSES, atol=1e-9)
    angles = write_table(tmp_path, export("x,y,z,roll,pitch,yaw", [P, ANGLES]))
    np.testing.assert_allclose(read_recording(angles, units="m,deg").tracks[""].poses, POSES, atol=1e-9)
    with pytest.raises(FormatError, match="'inch' is no unit"):
        read_recording(table, units="inch")


def test_a_hinge_shows_the_unit_of_its_angles(tmp_path):
    """Angles of a wheel beyond one revolution are no degrees, and those of a slow door may be less than 6."""
    turns = np.linspace(0, 9, 30)
    positions = 0.3 * np.column_stack([np.cos(turns), np.sin(turns), 0 * turns])
    for unit, scale in {"rad": 1.0, "deg": 180 / np.pi}.items():
        yaw = np.column_stack([0 * turns, 0 * turns, turns]) * scale
        recording = read_recording(write_table(tmp_path, export("x,y,z,roll,pitch,yaw", [positions, yaw])))
        assert recording.assumptions == (f"angles in {unit}",)


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
    "NaN": ("x,y,z\n1,2,3\n1,nan,3\n", "line 3: y is missing; all cells of a part that was not observed are empty or NaN"),
    "infinity": ("1 2 -inf\n", "line 1: z is '-inf'"),
    "huge": ("1 2 1e300\n", "line 1: z is '1e300'"),
    "words": ("x,y,z\n1,two,3\n", "line 2: y is 'two'"),
    "words in a table without names": ("1 2 3\n1 x 3\n", "line 2: y is 'x'"),
    "decimal commas and points": ("x;y;z\n1,5;2.0;3\n", "line 2: x is '1,5'.*A decimal point"),
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
    "a lacking column": ("x,y,z,quart,qy,qz,qw\n1,2,3,0,0,0,1\n", "no column qx. Not understood: 'quart'"),
    "x and y alone": ("x,y\n1,2\n", "no column z"),
    "roll without pitch": ("x,y,z,roll,yaw,\n1,2,0,0,0,\n", "no column pitch"),
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


def test_parts_in_different_frames_are_refused(tmp_path):
    """Transforms have a frame each; poses in two frames say nothing of each other."""
    head, columns, *_ = EXPORTS["transforms"]
    lines = export(head, columns)
    lines += export("", [*columns[:2], "wall", *columns[3:]]).replace("map", "odom")
    recording = read_recording(write_table(tmp_path, lines))
    with pytest.raises(FormatError, match="'wall' was observed in the frame 'odom', and 'door' in 'map'"):
        recording.pair("wall", "door")


def test_the_last_name_of_a_topic_is_enough(tmp_path):
    head = "a/door.x,a/door.y,a/door.z,b/lid.x,b/lid.y,b/lid.z"
    recording = read_recording(write_table(tmp_path, head + "\n1,2,3,4,5,6\n"))
    np.testing.assert_array_equal(recording.pair(child="lid").child_poses, [[4, 5, 6]])


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
    pair = read_recording(write_table(tmp_path, "\n".join(f"{k / 100} 0 0" for k in range(100)))).pair()
    few = pair.thin(5)
    np.testing.assert_array_equal(few.child_poses[:, 0], [0, 0.25, 0.5, 0.74, 0.99])
    np.testing.assert_array_equal(few.lines, [1, 26, 51, 75, 100])
    assert len(pair.thin(1000).child_poses) == 100
    with pytest.raises(InvalidValueError, match="at least two"):
        pair.thin(1)


def test_rotation_vector_of_any_length_is_read(tmp_path):
    for angle in (0.0, 1e-12, math.pi, 7.0):
        table = write_table(tmp_path, f"x,y,z,rx [rad],ry [rad],rz [rad]\n0,0,0,0,{angle},0\n")
        expected = Rotation.from_rotvec([0, angle, 0]).as_matrix()
        np.testing.assert_allclose(read_recording(table).tracks[""].poses[0, :3, :3], expected, atol=1e-12)
