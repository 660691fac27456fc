"""Every published SDF has its frames and degrees of freedom, or is refused for its reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sdf_outcomes import OUTCOMES

import kineverse as kv

# Poses by Drake 1.51.1 (with sdformat inside): world poses of all bodies at random positions of all joints with
# one or two axes. It refuses, or does not know, what is missing in there.
DRAKE = json.loads((Path(__file__).parent / "sdf_poses_of_drake.json").read_text())


@pytest.mark.parametrize("file", OUTCOMES)
@pytest.mark.sampled(2)
def test_frames_and_dofs_or_errors_of_all_files(file: str, published: Callable[..., Path]):
    path, expected = published(file), OUTCOMES[file]
    if expected[0].isdecimal():
        model = kv.load(path, prefix="p")
        assert f"{len(model.frames)} {len(model.degrees_of_freedom)}" == expected
    else:
        with pytest.raises(kv.errors.FormatError) as info:
            kv.load(path, prefix="p")
        assert expected in str(info.value)
        assert str(info.value).startswith(path.name)


def test_no_file_is_left_out(published: Callable[..., Path]):
    folders = [published("sdf_joint_types"), published("articulated_objects")]
    files = {path.relative_to(published()).as_posix() for folder in folders for path in folder.rglob("*.sdf")}
    assert files == set(OUTCOMES)


def known(name: str, names: object) -> str:
    """Return the name of Drake's ``model::name``; a model alone in its file has no prefix."""
    parts = name.split("::")
    return next(n for n in ("/".join(parts[k:]) for k in range(len(parts))) if n in names)  # type: ignore[operator]


@pytest.mark.parametrize("file", DRAKE)
@pytest.mark.sampled(2)
def test_poses_are_those_of_drake(file: str, published: Callable[..., Path]):
    model = kv.load(published(file))
    state = dict(model.default_state())
    for name, values in DRAKE[file]["q"].items():
        at = known(name, {n.removesuffix("/first") for n in model.articulations})
        names = [at] if len(values) == 1 else [f"{at}/first", f"{at}/second"]
        state |= {kv.position(n): value for n, value in zip(names, values, strict=True)}
    for body, rows in DRAKE[file]["poses"].items():
        pose = model.fk(known(body, model.frames))
        got = pose({s: state[s] for s in pose.symbols})
        np.testing.assert_allclose(got[:3], np.reshape(rows, (3, 4)), atol=1e-11, err_msg=body)
