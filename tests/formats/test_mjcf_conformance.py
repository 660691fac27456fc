from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from mujoco_oracle import Pair, mujoco

import kineverse as kv

_TABLE = """
articulated_objects/robosuite_mit/objects/door.xml | 11 1
articulated_objects/robosuite_mit/objects/door_lock.xml | 11 2
furniture_sim/furniture_sim/boxcabinet/boxcabinet_assets.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/boxcabinet/boxcabinet_body.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/boxcabinet.xml | 5 1
furniture_sim/furniture_sim/dishwasher/dishwasher_asset.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/dishwasher/dishwasher_body.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/dishwasher.xml | 5 2
furniture_sim/furniture_sim/hingecabinet/hingecabinet_asset.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/hingecabinet/hingecabinet_body.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/hingecabinet.xml | 7 2
furniture_sim/furniture_sim/microwave/microwave_asset.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/microwave/microwave_body0.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/microwave/microwave_body1.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/microwave/microwave_body2.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/microwave/microwave_body3.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/microwave.xml | 5 1
furniture_sim/furniture_sim/oven/oven_asset.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/oven/oven_body.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/oven.xml | 20 5
furniture_sim/furniture_sim/slidecabinet/slidecabinet_asset.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/slidecabinet/slidecabinet_body.xml | line 1, <mujocoinclude>: is not <mujoco>
furniture_sim/furniture_sim/slidecabinet.xml | 5 1
"""

OUTCOMES: dict[str, str] = dict(line.split(" | ", 1) for line in _TABLE.strip().splitlines())  # type: ignore[misc]
"""Every published MJCF has its frames and degrees of freedom, or is refused for its reason."""

LOADED = [file for file, outcome in OUTCOMES.items() if outcome[0].isdecimal()]


@pytest.mark.parametrize("file", OUTCOMES)
def test_dofs_or_errors_of_all_files(file: str, published: Callable[..., Path]):
    path, expected = published(file), OUTCOMES[file]
    if file in LOADED:
        model = kv.load(path, prefix="p")
        assert f"{len(model.frames)} {len(model.degrees_of_freedom)}" == expected
        return
    with pytest.raises(kv.errors.FormatError) as info:
        kv.load(path, prefix="p")
    assert str(info.value).startswith(f"{path.name}, {expected}")


def test_no_file_is_left_out(published: Callable[..., Path]):
    folders = [
        published(name) for name in ("furniture_sim", "articulated_objects", "kineverse_shelf_objects")
    ]
    files = {path.relative_to(published()).as_posix() for folder in folders for path in folder.rglob("*.xml")}
    files = {file for file in files if b"<mujoco" in published(file).read_bytes()}
    assert files == set(OUTCOMES)


@pytest.mark.parametrize("file", LOADED)
def test_poses_and_jacobians_are_those_of_mujoco(file: str, published: Callable[..., Path]):
    Pair.of_file(published(file)).compare()


def test_models_that_come_with_mujoco():
    files = sorted((Path(mujoco.__path__[0]) / "testdata").glob("*.xml"))
    if not files:
        pytest.skip("this MuJoCo comes without models")
    for path in files:
        Pair.of_file(path).compare(samples=2)
