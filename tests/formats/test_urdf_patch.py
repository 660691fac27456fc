"""Corrected URDF files: other numbers where joints were corrected, and the same bytes everywhere else."""

from __future__ import annotations

import codecs
import dataclasses
import difflib
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse import lie
from kineverse.articulations import Joint, OneAxisMotion
from kineverse.errors import FormatError
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.saver import save_corrections
from kineverse.model.operation import Operation
from published_data import published_files, published_path, relative_name

ARM = """<?xml version="1.0"?>
<!-- an arm, by hand: <joint name="fake"><origin xyz="9 9 9"/></joint> -->
<robot name="arm" version="1.1">
  <material name="grey"><color rgba=".5 .5 .5 1"/></material>
  <link name="base"/>
  <link name="upper"/>
  <link name="lower"/><link name="tip"/>
  <link name="finger"/>
  <joint name='shoulder' type='revolute'>
    <!-- measured on Monday -->
    <origin rpy='0 0   0.25' xyz='0.10	2e-1 0.300'/>
    <parent link='base'/> <child link='upper'/>
    <axis xyz='0 0 2'/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/>
    <calibration rising="0.1"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower"/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/>
  </joint>
  <joint name="wrist" type="fixed"><origin xyz="0 0 1"/><parent link="lower"/><child link="tip"/></joint>
  <joint name="grip" type="prismatic">
    <parent link="tip"/>
    <child link="finger"/>
    <origin   quat_xyzw="0 0 0 1" />
    <axis xyz="1 0 0"></axis>
    <mimic joint="elbow" multiplier="0.01"/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/>
  </joint>
  <transmission name="t"><joint name="shoulder"><origin xyz="7 7 7"/></joint></transmission>
  <gazebo><joint name="elbow"><origin xyz="8 8 8"/></joint></gazebo>
</robot>
"""


def corrected(
    model: kv.Model, moves: Mapping[str, np.ndarray], axes: Mapping[str, tuple[float, ...]] | None = None
) -> tuple[dict[str, Operation], dict[str, Operation]]:
    """Replace the origins of joints by origin · move; return the operations before and after."""
    before: dict[str, Operation] = {}
    after: dict[str, Operation] = {}
    for name in {*moves, *(axes or {})}:
        tag = f"joint {name}"
        operation = model.history.entry(tag).operation
        assert isinstance(operation, Joint)
        before[tag] = operation
        if name in moves:
            operation = dataclasses.replace(operation, origin=operation.origin.matrix @ moves[name])
        if axes and name in axes:
            operation = dataclasses.replace(operation, axis=axes[name])
        after[tag] = operation
    with model.edit() as edit:
        for tag, operation in after.items():
            edit.replace(tag, operation)
    return before, after


def move(rng: np.random.Generator, angle: float = 0.02, length: float = 0.005) -> np.ndarray:
    return lie.transform(lie.exp_so3(angle * rng.normal(size=3)), length * rng.normal(size=3))


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def check_equal(one: kv.Model, other: kv.Model, tolerance: float) -> None:
    for tag in one.history.tags:
        a, b = (m.history.entry(tag).operation for m in (one, other))
        if isinstance(a, Joint) and isinstance(b, Joint):
            assert np.abs(a.origin.matrix - b.origin.matrix).max() <= tolerance, tag
            if isinstance(a, OneAxisMotion):
                axes = [np.array(x.axis) / np.linalg.norm(x.axis) for x in (a, b)]
                assert np.abs(axes[0] - axes[1]).max() <= tolerance, tag


def test_only_the_numbers_that_changed_are_replaced(tmp_path: Path) -> None:
    model = kv.load(write(tmp_path / "arm.urdf", ARM))
    shift = lie.translation(lie.rotation_z(np.array(-0.25)) @ np.array([0.0, 0.125, 0.0]))
    before, after = corrected(model, {"shoulder": shift, "wrist": lie.translation(np.array([0, 0, 0.5]))})
    saved = save_corrections(model, before, after, tmp_path / "new.urdf")
    expected = ARM.replace("xyz='0.10	2e-1 0.300'", "xyz='0.10	0.325 0.300'")
    expected = expected.replace('<origin xyz="0 0 1"/>', '<origin xyz="0 0 1.5"/>')
    assert (tmp_path / "new.urdf").read_text() == expected
    assert saved.remarks == ()


def test_missing_elements_and_attributes_are_added(tmp_path: Path) -> None:
    model = kv.load(write(tmp_path / "arm.urdf", ARM))
    turn = np.eye(4)
    turn[:3, :3] = lie.rotation_x(np.array(0.5))
    moves = {"elbow": lie.translation(np.array([0.0, 0.25, 0.0])), "wrist": turn, "grip": turn}
    before, after = corrected(model, moves, {"elbow": (0.0, 0.0, 2.0)})
    save_corrections(model, before, after, tmp_path / "new.urdf")
    lines = [*difflib.ndiff(ARM.splitlines(), (tmp_path / "new.urdf").read_text().splitlines())]
    q = lie.to_quaternion(turn[:3, :3]).tolist()
    assert [line for line in lines if line[0] in "+-"] == [
        '+     <origin xyz="0 0.25 0"/>',
        '+     <axis xyz="0 0 1"/>',
        '-   <joint name="wrist" type="fixed"><origin xyz="0 0 1"/><parent link="lower"/>'
        '<child link="tip"/></joint>',
        '+   <joint name="wrist" type="fixed"><origin xyz="0 0 1" rpy="0.5 0 0"/><parent link="lower"/>'
        '<child link="tip"/></joint>',
        '-     <origin   quat_xyzw="0 0 0 1" />',
        f'+     <origin   quat_xyzw="{q[0]!r} 0 0 {q[3]!r}" />',
    ]
    check_equal(kv.load(tmp_path / "new.urdf"), model, 4e-16)


ENCODINGS = {
    "lf": ARM.encode(),
    "crlf": ARM.replace("\n", "\r\n").encode(),
    "cr": ARM.replace("\n", "\r").encode(),
    "mark": codecs.BOM_UTF8 + ARM.encode(),
    "latin": ARM.replace('"1.0"?>', '"1.0" encoding="iso-8859-1"?>').replace("Monday", "Dienstag früh")
    .encode("iso-8859-1"),
    "utf-8": ARM.replace("Monday", "月曜日").replace('"tip"', '"tüp"').encode(),
    "utf-16": codecs.BOM_UTF16_LE + ARM.replace('"1.0"?>', '"1.0" encoding="utf-16"?>').encode("utf-16-le"),
    "late declaration": b"\n" + ARM.encode(),
    "bad comment": ARM.replace("measured on", "measured -- on").encode(),
    "references": ARM.replace("0.25'", "0.2&#53;'").replace('"wrist"', '"wri&#115;t"').encode(),
    "no indent": " ".join(ARM.split()).encode(),
    "namespace": ARM.replace("<robot", '<robot xmlns:x="urn:x"').replace("<origin rpy", "<origin x:a='>' rpy")
    .encode(),
}  # fmt: skip


@pytest.mark.parametrize("kind", ENCODINGS)
def test_all_other_bytes_stay(tmp_path: Path, kind: str) -> None:
    content, rng = ENCODINGS[kind], np.random.default_rng(1)
    model = kv.load(write(tmp_path / "arm.urdf", content))
    moves = {name: move(rng) for name in ("shoulder", "wrist")}
    before, after = corrected(model, moves, {"shoulder": (0.0, 0.01, 1.0)})
    save_corrections(model, before, after, tmp_path / "new.urdf")
    new = (tmp_path / "new.urdf").read_bytes()
    check_equal(kv.load(tmp_path / "new.urdf"), model, 1e-15)
    # Without the origins and axes of these joints, the bytes are the same.
    step = 2 if kind == "utf-16" else 1
    blocks = difflib.SequenceMatcher(None, content, new, autojunk=False).get_matching_blocks()
    kept = b"".join(content[b.a : b.a + b.size] for b in blocks)
    old_numbers = (0.0, 0.1, 0.2, 0.25, 0.3, 1.0, 2.0)
    lost = len(content) - len(kept)
    assert 0 < lost <= step * sum(len(f"{n:g}") + 4 for n in old_numbers) + 8
    # And back: the first numbers again give the first bytes, where the text of a number is the shortest.
    again = kv.load(tmp_path / "new.urdf")
    undo = {tag: model.history.entry(tag).operation for tag in before}
    with again.edit() as edit:
        for tag, operation in before.items():
            edit.replace(tag, operation)
    save_corrections(again, undo, before, tmp_path / "back.urdf")
    check_equal(kv.load(tmp_path / "back.urdf"), kv.load(tmp_path / "arm.urdf"), 1e-15)


@pytest.mark.parametrize(
    "rpy", ["0 0 0", "3 1.2 -3", "0 1.5707963267948966 0.7", "0.3 -1.5707963267948966 0.7", "0 1.5708 0",
            "3.141592653589793 0 3.141592653589793", "0.1 2.5 7"],
)  # fmt: skip
def test_rotations_are_read_back_to_the_last_bits(tmp_path: Path, rpy: str) -> None:
    rng = np.random.default_rng(2)
    text = ARM.replace("rpy='0 0   0.25'", f"rpy='{rpy}'")
    given = np.array(rpy.split(), dtype=float)
    for turn in (lie.rotation_x, lie.rotation_y, lie.rotation_z, None):
        model = kv.load(write(tmp_path / "arm.urdf", text))
        change = move(rng)
        if turn is not None:
            change = lie.transform(turn(np.array(0.01 * rng.normal())), np.zeros(3))
        before, after = corrected(model, {"shoulder": change})
        save_corrections(model, before, after, tmp_path / "new.urdf")
        found = kv.load(tmp_path / "new.urdf").history.entry("joint shoulder").operation
        assert isinstance(found, Joint)
        wanted = after["joint shoulder"]
        assert isinstance(wanted, Joint)
        assert np.abs(found.origin.matrix - wanted.origin.matrix).max() <= 2e-15
        content = (tmp_path / "new.urdf").read_text()
        written = np.array(content.partition("rpy='")[2].partition("'")[0].split(), dtype=float)
        # An independent reading, and angles near the given ones where they are far from a pitch of π/2.
        oracle = Rotation.from_euler("xyz", written).as_matrix()
        assert np.abs(oracle - wanted.origin.matrix[:3, :3]).max() < 2e-15
        if abs(math.cos(given[1])) > 0.3:
            assert np.abs(written - given).max() < 0.3


@pytest.mark.parametrize("name", ["pr2", "fetch", "hsr", "kitchen"])
def test_shipped_robots_move_as_corrected_in_pinocchio(tmp_path: Path, name: str) -> None:
    from pinocchio_oracle import PinocchioReference

    rng = np.random.default_rng(3)
    model = kv.load(name)
    joints = [t.partition(" ")[2] for t in model.history.tags if t.startswith("joint ")]
    base = {"pr2": "pr2/base", "fetch": "fetch/base", "hsr": "hsr/base"}.get(name)
    chosen = [str(j) for j in rng.choice([j for j in joints if j != base], 8, replace=False)]
    before, after = corrected(model, {joint: move(rng) for joint in chosen})
    save_corrections(model, before, after, tmp_path / "new.urdf")
    new = (tmp_path / "new.urdf").read_text()
    old = model.sources[0].path.read_text()
    changed = [k for k, (a, b) in enumerate(zip(old.splitlines(), new.splitlines(), strict=False)) if a != b]
    if len(old.splitlines()) == len(new.splitlines()):
        assert len(changed) <= len(chosen)
    other = kv.load(tmp_path / "new.urdf", prefix=name)
    reference = PinocchioReference(new)
    values = reference.random_values(rng)
    reference.place(values)
    state = {f"{name}/{k}": v for k, v in values.items()}
    root = model.frames[f"{name}/{reference.model.frames[1].name}"].parent
    for frame in reference.model.frames:
        full = f"{name}/{frame.name}"
        if frame.type.name == "BODY" and full in model.frames:
            a_T_b = model.fk(full, relative_to=root)
            expected = reference.data.oMf[reference.model.getBodyId(frame.name)].homogeneous
            assert (
                np.abs(a_T_b({**dict.fromkeys(a_T_b.symbols, 0.0), **_known(a_T_b, state)}) - expected).max()
                < 1e-12
            )
            b_T = other.fk(full)
            assert np.abs(b_T(_known(b_T, state)) - expected).max() < 1e-12


def _known(e: kv.Expression, state: Mapping[str, float]) -> dict[kv.Symbol, float]:
    return {symbol: state[str(symbol)] for symbol in e.symbols if str(symbol) in state}


def test_a_file_that_is_not_that_of_the_model_is_refused(tmp_path: Path) -> None:
    path, new = write(tmp_path / "arm.urdf", ARM), tmp_path / "new.urdf"
    shift = {"shoulder": lie.translation(np.array([0.0, 0.1, 0.0]))}
    model = kv.load(path)
    before, after = corrected(model, shift)
    write(path, ARM.replace("Monday", "Sunday"))
    with pytest.raises(FormatError, match=r"has changed since the model was loaded.*Load the model again"):
        save_corrections(model, before, after, new)
    save_corrections(model, before, after, new, source=path)
    assert "Sunday" in new.read_text()
    assert "xyz='0.10	2e-1" not in new.read_text()
    write(path, ARM.replace("2e-1", "0.21"))
    with pytest.raises(FormatError, match=r"'shoulder' differs by 0\.01 from that of the model"):
        save_corrections(model, before, after, new, source=path)
    write(tmp_path / "other.urdf", ARM.replace("'shoulder'", "'hip'"))
    with pytest.raises(FormatError, match="'shoulder' is not corrected: the file has no number for it"):
        save_corrections(model, before, after, new, source=tmp_path / "other.urdf")
    with pytest.raises(FormatError, match=r"no URDF"):
        save_corrections(model, before, after, new, source=write(tmp_path / "a.xml", "<mujoco/>"))
    with pytest.raises(FormatError, match=r"Leave source= out"):
        save_corrections(model, before, after, tmp_path / "new.kv.json", source=path)


def test_a_template_is_refused_with_what_to_do(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    text = ARM.replace('<robot name="arm"', '<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro"')
    model = kv.load(write(tmp_path / "arm.urdf.xacro", text))
    before, after = corrected(model, {"shoulder": lie.translation(np.array([0.0, 0.1, 0.0]))})
    with pytest.raises(FormatError, match=r"xacro arm\.urdf\.xacro > arm\.urdf.*calibrate arm\.urdf"):
        save_corrections(model, before, after, tmp_path / "new.urdf")
    saved = save_corrections(model, before, after, tmp_path / "new.kv.json")
    check_equal(kv.load(saved.path), model, 0.0)


def test_prefixes_copies_edits_and_several_files(tmp_path: Path) -> None:
    path = write(tmp_path / "arm.urdf", ARM)
    model = kv.Model()
    model.include(path, prefix="left")
    model.include(path, prefix="right")
    assert [s.prefix for s in model.sources] == ["left", "right"]
    with model.edit() as edit:
        edit.add_frame("marker", parent="left/tip")
    model = model.snapshot().model().copy()
    shift = lie.translation(np.array([0.0, 0.1, 0.0]))
    before, after = corrected(model, {"right/shoulder": shift})
    save_corrections(model, before, after, tmp_path / "right.urdf")
    assert (tmp_path / "right.urdf").read_text() != ARM
    check_equal(
        kv.load(tmp_path / "right.urdf", prefix="right"), kv.load(tmp_path / "right.urdf", "right"), 0.0
    )
    marker = model.history.entry(model.history.writers("frames/marker")[0])
    both = {**before, marker.tag: marker.operation}
    saved = save_corrections(model, both, {**after, marker.tag: marker.operation}, tmp_path / "right.urdf")
    assert saved.remarks == ("'marker' is not corrected: the file has no number for it",)
    more_before, more_after = corrected(model, {"left/shoulder": shift})
    with pytest.raises(FormatError, match="several files"):
        save_corrections(model, before | more_before, after | more_after, tmp_path / "x.urdf")
    given = save_corrections(model, before | more_before, more_after, tmp_path / "left.urdf", source=path)
    assert (tmp_path / "left.urdf").read_text() != ARM
    assert given.remarks == ()


def test_a_base_has_no_number_in_a_urdf(tmp_path: Path) -> None:
    model = kv.load("fetch")
    base = model.history.entry("joint fetch/base").operation
    assert isinstance(base, kv.articulations.DifferentialDrive)
    new = {"joint fetch/base": dataclasses.replace(base, radius=0.06)}
    with pytest.raises(FormatError, match=r"'fetch/base' is not corrected: the file has no number.*kv\.json"):
        save_corrections(model, {"joint fetch/base": base}, new, tmp_path / "fetch.urdf")


def test_joints_that_the_reader_renames(tmp_path: Path) -> None:
    text = ARM.replace("<joint name='shoulder'", "<joint name='/shoulder'").replace(
        'name="wrist"', 'name="elbow"'
    )
    path = write(tmp_path / "arm.urdf", text)
    with collect_warnings():
        model = kv.load(path)
        fixed = next(t for t in model.history.tags if t.startswith("joint elbow") and t != "joint elbow")
        shift = lie.translation(np.array([0.0, 0.125, 0.5]))
        before, after = corrected(model, {fixed.partition(" ")[2]: shift, "shoulder": np.eye(4)})
        save_corrections(model, before, after, tmp_path / "new.urdf")
    assert (tmp_path / "new.urdf").read_text() == text.replace(
        '<origin xyz="0 0 1"/>', '<origin xyz="0 0.125 1.5"/>'
    )


def test_meshes_named_relative_to_the_file_are_remarked(tmp_path: Path) -> None:
    mesh = '<link name="base"><visual><geometry><mesh filename="meshes/a.stl"/></geometry></visual></link>'
    (tmp_path / "other").mkdir()
    with collect_warnings():
        model = kv.load(write(tmp_path / "arm.urdf", ARM.replace('<link name="base"/>', mesh)))
        before, after = corrected(model, {"shoulder": lie.translation(np.array([0.0, 0.1, 0.0]))})
        saved = save_corrections(model, before, after, tmp_path / "other" / "arm.urdf")
        assert [r for r in saved.remarks if "relative" in r] == [*saved.remarks] != []
        assert save_corrections(model, before, after, tmp_path / "b.urdf").remarks == ()


def test_a_model_from_no_urdf_is_written_whole(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Fixed(name="a", parent="world", child="b"))
    before, after = corrected(model, {"a": lie.translation(np.array([0.0, 0.1, 0.0]))})
    saved = save_corrections(model, before, after, tmp_path / "new.urdf")
    assert saved.remarks[0] == "written whole, as no URDF is known that the model was loaded from"
    assert np.abs(kv.load(saved.path).fk("b")({}) - model.fk("b")({})).max() < 1e-15


@pytest.mark.data
@pytest.mark.parametrize("path", published_files(".urdf") or [None], ids=relative_name)
def test_published_robots_keep_all_that_is_not_corrected(tmp_path: Path, path: Path | None) -> None:
    rng = np.random.default_rng(4)
    path = path or published_path("pr2")
    with collect_warnings():
        try:
            model = kv.load(path)
        except FormatError:
            pytest.skip("a file that is refused")
        joints = [t.partition(" ")[2] for t in model.history.tags if t.startswith("joint ")]
        if not joints:
            pytest.skip("no joints")
        chosen = [str(j) for j in rng.choice(joints, min(5, len(joints)), replace=False)]
        before, after = corrected(model, {joint: move(rng) for joint in chosen})
        save_corrections(model, before, after, tmp_path / "new.urdf")
        old, new = (p.read_bytes() for p in (path, tmp_path / "new.urdf"))
        for word in (b"<transmission", b"<gazebo", b"<calibration", b"<material", b"<mesh", b"<!--", b"\r"):
            assert old.count(word) == new.count(word)
        check_equal(kv.load(tmp_path / "new.urdf"), model, 1e-14)
