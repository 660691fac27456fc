"""Written files are read back before they are saved; small and flat inertia is written as MuJoCo reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from round_trip import assert_same_motion, load_cached

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.mjcf import mujoco_api
from kineverse.formats.mjcf import writer as mjcf_writing
from kineverse.formats.urdf import writer as urdf_writing
from kineverse.model.body import Body, Inertia


def moving(mass: float, moments: tuple[float, ...], turn: kv.Expression | None = None) -> kv.Model:
    """Return a hinge with a body of principal moments, in axes that are turned."""
    r = np.eye(3) if turn is None else np.asarray(turn({}))[:3, :3]
    t = r @ np.diag(moments) @ r.T
    inertia = Inertia(mass, (t[0, 0], t[0, 1], t[0, 2], t[1, 1], t[1, 2], t[2, 2]))
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame(
            "f", parent="world", transform=kv.rotation_z(kv.position("q")), body=Body(inertia=inertia)
        )
    return model


def in_mujoco(model: kv.Model, folder: Path) -> tuple[float, np.ndarray, tuple[str, ...]]:
    """Return mass, tensor in axes of the frame, and remarks of what MuJoCo reads."""
    mujoco, saved = pytest.importorskip("mujoco"), model.save(folder / "m.xml")
    read = mujoco.MjModel.from_xml_path(str(folder / "m.xml"))
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, read.body_iquat[1])
    r = turn.reshape(3, 3)
    return float(read.body_mass[1]), r @ np.diag(read.body_inertia[1]) @ r.T, saved.remarks


SMALL = [
    (1.0, (1.1e-15, 0.3, 0.3)),
    (1.0, (0.0, 0.3, 0.3)),
    (1e-14, (1e-15, 1e-15, 1e-15)),
    (1e-20, (1.0, 1.0, 1.0)),
    (1.0, (0.0, 0.0, 0.0)),
    (1.0, (1e-16, 1e-16, 1e-16)),
    (1e3, (1e-11, 1e3, 1e3)),
    (0.0, (0.0, 0.0, 0.0)),
    (1.0, (-1e-17, 0.2, 0.2)),
]


@pytest.mark.parametrize(
    "turn", [None, kv.rpy(0.3, -1.1, 2.0), kv.rotation_x(1e-9)], ids=["plain", "turned", "nearly"]
)
@pytest.mark.parametrize(("mass", "moments"), SMALL)
def test_small_inertia_is_loaded_by_mujoco(
    mass: float, moments: tuple[float, ...], turn: kv.Expression | None, tmp_path: Path
) -> None:
    found, tensor, remarks = in_mujoco(moving(mass, moments, turn), tmp_path)
    assert found == pytest.approx(mass, abs=1e-3)
    r = np.eye(3) if turn is None else np.asarray(turn({}))[:3, :3]
    np.testing.assert_allclose(tensor, r @ np.diag(moments) @ r.T, rtol=0, atol=1.1e-6 + 1e-9 * max(moments))
    if min(moments) < 1e-12 < max(moments):
        assert any("has a moment of as good as nothing" in r for r in remarks)
    kv.load(tmp_path / "m.xml")


@settings(max_examples=attempts(30), deadline=None)
@given(
    mass=st.floats(-20, 3).map(lambda x: 10.0**x),
    moments=st.tuples(*[st.floats(-20, 3).map(lambda x: 10.0**x)] * 3),
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
)
def test_any_inertia_is_loaded_by_mujoco(
    mass: float,
    moments: tuple[float, float, float],
    angles: tuple[float, float, float],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("inertia")
    in_mujoco(moving(mass, moments, kv.rpy(*angles)), folder)


def test_ordinary_inertia_is_written_unchanged(tmp_path: Path) -> None:
    for turn in (None, kv.rpy(0.3, -1.1, 2.0)):
        model = moving(2.0, (1e-6, 2e-6, 2.5e-6), turn)
        mass, tensor, remarks = in_mujoco(model, tmp_path)
        t = model.bodies["f"].inertia.tensor  # type: ignore[union-attr]
        expected = [[t[0], t[1], t[2]], [t[1], t[3], t[4]], [t[2], t[4], t[5]]]
        assert mass == 2.0
        np.testing.assert_allclose(tensor, expected, rtol=0, atol=1e-20)
        assert not remarks


def test_mjcf_that_mujoco_refuses_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(mjcf_writing, "_unless_zero", lambda point: (float(point[0]), 1.0))
    (tmp_path / "m.xml").write_text("precious")
    with pytest.raises(
        kv.errors.FormatError,
        match=r"^m\.xml is not written\. MuJoCo does not open what would be written: .*'pos'",
    ):
        moving(1.0, (1, 1, 1)).save(tmp_path / "m.xml")
    assert (tmp_path / "m.xml").read_text() == "precious"
    assert [p.name for p in tmp_path.iterdir()] == ["m.xml"]


def test_mjcf_is_written_without_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise kv.errors.MissingDependencyError("no MuJoCo")

    monkeypatch.setattr(mujoco_api, "mujoco", missing)
    moving(1.0, (1, 1, 1)).save(tmp_path / "m.xml")
    assert (tmp_path / "m.xml").is_file()


def test_urdf_that_cannot_be_read_back_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The writer is broken on purpose: all links have one name."""
    model = moving(1.0, (1, 1, 1))
    with model.edit() as edit:
        edit.apply(kv.articulations.Universal(name="p", parent="f", child="p"))
    monkeypatch.setattr(urdf_writing.TakenNames, "take", lambda self, *wishes: "f")
    with pytest.raises(
        kv.errors.FormatError,
        match=r"^m\.urdf is not written\. What would be written cannot be read again: .*has the name",
    ):
        model.save(tmp_path / "m.urdf")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ["urdf", "xml"])
def test_unsupported_constraints_are_left_out_and_motions_refused(ending: str, tmp_path: Path) -> None:
    q, bolt = kv.position("q"), kv.position("bolt")
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="door", lower=0, upper=1))
        edit.apply(kv.Prismatic(name="bolt", parent="door", child="bolt", lower=0, upper=1))
        edit.constrain("lock", -(bolt > 0.5), q.derivative(), bolt > 0.5)
        edit.constrain("jerky", -1, q.derivative().derivative(), 1)
        edit.constrain("curved", -1, q * bolt, 1)
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="drive", parent="world", child="base", radius=0.1, track=0.5
            )
        )
    saved = model.save(tmp_path / f"m.{ending}")
    assert set(saved.left_out) >= {"lock", "jerky", "curved", "drive"}
    name = ending.replace("xml", "mjcf").upper()
    assert f"'jerky' is left out, which {name} cannot express: it limits accelerations" in saved.remarks
    assert any(r.startswith("that 'drive' moves by speeds that are not its own") for r in saved.remarks)
    again = kv.load(tmp_path / f"m.{ending}")
    assert again.degrees_of_freedom == model.degrees_of_freedom
    at = kv.State({str(s): 0.3 for s in model.degrees_of_freedom})
    for frame in model.frames:
        np.testing.assert_allclose(again.fk(frame)(at), model.fk(frame)(at), atol=1e-12)
    with pytest.raises(kv.errors.FormatError, match=r"'lock' .* all of them without strict=True"):
        model.save(tmp_path / f"strict.{ending}", strict=True)
    assert not (tmp_path / f"strict.{ending}").exists()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="odd", parent="door", child="odd", position=np.sin(3 * q)))
    with pytest.raises(
        kv.errors.FormatError, match=r"cannot express one thing of this model\. 'odd' turns by no"
    ):
        model.save(tmp_path / f"motion.{ending}")
    assert not (tmp_path / f"motion.{ending}").exists()


LOCKED = ("garage_door", "door_with_handle", "ratchet", "ball")
DRIVEN = ("omni_base", "differential_drive", "mecanum")


@pytest.mark.parametrize("ending", ["urdf", "xml"])
@pytest.mark.parametrize("name", [*LOCKED, *DRIVEN])
def test_scenes_with_locks_and_wheels_move_alike_when_read_back(
    name: str, ending: str, tmp_path: Path
) -> None:
    model = load_cached(f"articulations/{name}")
    if (name, ending) == ("ball", "urdf"):
        with pytest.raises(kv.errors.FormatError, match="turns by a quaternion"):
            model.save(tmp_path / "m.urdf")
        return
    saved = model.save(tmp_path / f"m.{ending}")
    assert saved.left_out
    for left in saved.left_out:
        assert left in model.constraints or left in model.articulations
    assert_same_motion(model, kv.load(tmp_path / f"m.{ending}"))


@pytest.mark.parametrize("name", ["m.world", "m", "m.xml.txt"])
def test_unknown_endings_are_refused_before_conversion(name: str, tmp_path: Path) -> None:
    with pytest.raises(kv.errors.FormatError, match=r"a model is saved to a name that ends in \.kv\.json"):
        kv.load("shelf_door").save(tmp_path / name)


def test_save_to_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.urdf").mkdir()
    with pytest.raises(kv.errors.FormatError, match=r"m\.urdf is a folder; name a file in it"):
        kv.load("shelf_door").save(tmp_path / "m.urdf")
