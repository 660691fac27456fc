"""Names with special characters in every role are the same when they are read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from round_trip import assert_same_motion

import kineverse as kv
from kineverse.model.body import Body, Box, Inertia, Mesh, Shape

NAMES = [
    "obj:joint",
    "a:velocity",
    "robot0:slide/x:y",
    "50%",
    "%3A",
    "a/b/c",
    "ünï 码",
    "two  words",
    "quo\"te's <&> --",
    "world2",
    "-1",
]


def named(name: str, formats: str) -> kv.Model:
    """Return a model in which all elements have a name, or a name below it."""
    q = kv.position(f"{name}/own")
    body = Body((Shape(Box((1, 1, 1)), name=name),), (Shape(Box((1, 2, 1))),), Inertia(1, (1, 0, 0, 1, 0, 1)))
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name=name, parent="world", child=name, lower=0.5, upper=1, velocity=2))
        edit.add_frame(f"{name}/shape", parent=name, transform=kv.translation(0.1, 0, 0), body=body)
        edit.apply(kv.Prismatic(name=f"{name}/two", parent=name, child=f"{name}/two", position=2 * q))
        follows = 0.5 * kv.position(name) - 0.2
        edit.apply(kv.Revolute(name=f"{name}/m", parent="world", child=f"{name}/m", position=follows))
        edit.add_frame(f"{name}/several", parent="world", transform=[kv.rotation_x(q), kv.rotation_y(2 * q)])
        edit.constrain(f"{name}/range", -0.5, q, 0.75)
        edit.apply(kv.Floating(name=f"{name}/free", parent="world", child=f"{name}/free"))
        edit.apply(kv.Planar(name=f"{name}/flat", parent=name, child=f"{name}/flat"))
        if formats == "mjcf":
            edit.apply(kv.articulations.Ball(name=f"{name}/ball", parent=name, child=f"{name}/ball"))
            edit.apply(kv.Floating(name=f"{name}/held", parent=f"{name}/ball", child=f"{name}/held"))
            edit.constrain(f"{name}/sum", -1, q + kv.position(name), 1.5)
            edit.constrain(f"{name}/speed", -2, q.derivative(), 3)
    return model


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("ending", ["urdf", "xml"])
@pytest.mark.sampled(2)
def test_names_are_kept_in_every_role(name: str, ending: str, tmp_path: Path) -> None:
    if ending == "xml":
        pytest.importorskip("mujoco")
    model = named(name, "mjcf" if ending == "xml" else "urdf")
    model.save(tmp_path / f"m.{ending}")
    again = kv.load(tmp_path / f"m.{ending}")
    assert_same_motion(model, again)
    assert again.bodies[f"{name}/shape"].visuals[0].name == name
    home = again.default_state()
    if ending == "xml":
        assert {s: home[s] for s in model.degrees_of_freedom} == dict(model.default_state())
        values = {str(s): v for s, v in home.items()} | {str(kv.position(name)): 0.9}
        values[str(kv.position(f"{name}/own"))] = 0.7  # their sum is more than 1.5
        assert len(again.violations(values)) == len(model.violations(values)) == 1
        speed = {str(kv.velocity(f"{name}/own")): 2.5, str(kv.position(f"{name}/own")): 0.0}
        assert not again.violations({**{str(s): v for s, v in home.items()}, **speed})


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("obj:joint", marks=pytest.mark.long),
        pytest.param("50%", marks=pytest.mark.long),
        "ü:ï% 码",
    ],
)
def test_names_of_loops_are_kept_below_prefixes(name: str, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    model = kv.load("articulations/four_bar", prefix=name)
    model.save(tmp_path / "m.xml")
    again = kv.load(tmp_path / "m.xml")
    assert list(map(str, again.rates.dependent)) == list(map(str, model.rates.dependent))
    assert_same_motion(model, again, tolerance=1e-10)


@pytest.mark.parametrize("name", ["obj:joint", "robot0:slide"])
@pytest.mark.parametrize("kind", ["hinge", "slide", "ball", "free", "mocap"])
def test_home_positions_of_names_with_colons_are_kept(name: str, kind: str, tmp_path: Path) -> None:
    """Such names are common in MuJoCo's own models."""
    pytest.importorskip("mujoco")
    inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    joint = {"free": f'<freejoint name="{name}"/>', "mocap": ""}.get(
        kind, f'<joint name="{name}" type="{kind}" axis="0 0 1"/>'
    )
    qpos = {"hinge": "0.7", "slide": "0.7", "ball": "0.6 0 0.8 0", "free": "1 2 3 0.6 0 0.8 0"}.get(kind)
    key = f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>' if qpos else ""
    mocap = ' mocap="true" pos="1 0 0" quat="0.6 0 0.8 0"' if kind == "mocap" else ""
    text = f'<mujoco><worldbody><body name="{name}"{mocap}>{joint}{inertia}</body></worldbody>{key}</mujoco>'
    (tmp_path / "in.xml").write_text(text)
    model = kv.load(tmp_path / "in.xml")
    model.save(tmp_path / "out.xml")
    again, expected = kv.load(tmp_path / "out.xml"), model.default_state()
    assert again.degrees_of_freedom == model.degrees_of_freedom
    found = again.default_state()
    for symbol in model.degrees_of_freedom:
        assert found[symbol] == pytest.approx(expected[symbol], abs=1e-15)
    poses = [m.fk(name)(m.default_state()) for m in (model, again)]
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-12)


def test_text_invalid_in_xml_is_refused_with_its_element(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("bell\a", parent="world", transform=kv.rotation_z(kv.position("q")))
    for ending in ("urdf", "xml"):
        with pytest.raises(
            kv.errors.FormatError, match=r"XML cannot carry '\\x07', which is part of 'bell\\x07'"
        ):
            model.save(tmp_path / f"m.{ending}")
    assert not list(tmp_path.iterdir())


def test_mesh_paths_with_special_characters_are_kept(tmp_path: Path) -> None:
    """Also for paths that are no address: with spaces, percents, umlauts."""
    folder = tmp_path / "möbel 50% & co"
    folder.mkdir()
    (folder / "cup's.stl").write_bytes(b"\0" * 84)
    model = kv.Model()
    with model.edit() as edit:
        shape = Shape(Mesh("cup's.stl", folder=str(folder)))
        edit.add_frame("cup", parent="world", transform=kv.rotation_z(kv.position("q")), body=Body((shape,)))
    model.save(tmp_path / "m.urdf")
    (again,) = kv.load(tmp_path / "m.urdf").bodies["cup"].visuals
    assert Path(again.geometry.folder, again.geometry.uri).resolve() == folder / "cup's.stl"  # type: ignore[union-attr]
