"""Comparison of a model with the one read back: frames, coordinates, poses and limits are the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from urdf_outcomes import expected_outcome

import kineverse as kv
from kineverse import gallery
from kineverse.formats.locate import shipped_models
from kineverse.formats.resource_paths import locate_resource
from published_data import published_files

EXACT = 1e-12
SCENES = [f"articulations/{name}" for name in gallery.names()]
SHIPPED = list(shipped_models())
CURVES = ("cam", "mimic", "ackermann", "garage_door_as_published", "folding_door", "piston", "pedal_bin")
"""Scenes with motions by curves, which SDF and UsdPhysics do not have."""


def readable_urdf_files() -> list[Path | None]:
    """Return the published URDF files that can be read; None alone if there are none."""
    # To read them all would take every worker seconds before its first test.
    files = published_files(".urdf")
    return [
        f for f in files if "urdf_conformance" not in f.parts or isinstance(expected_outcome(f), int)
    ] or [None]


@cache
def load_cached(name: str) -> kv.Model:
    """Return a shipped model or a scene, loaded once since some take seconds; not to be changed."""
    return kv.load(name)


def compile_poses(model: kv.Model, frames: list[str]) -> Callable[[dict[str, float]], list[np.ndarray]]:
    """Return a function from values of coordinates to the poses of frames."""
    symbols = model.degrees_of_freedom
    parameters = [s for s in model.symbols if not s.has_derivative]
    f = kv.compile([model.fk(name) for name in frames], [*symbols, *parameters], tier="interpreter")
    given = [s.value for s in parameters]
    return lambda values: list(f(np.array([values[str(s)] for s in symbols] + given)))


def poses(model: kv.Model, frames: list[str], values: dict[str, float]) -> list[np.ndarray]:
    return compile_poses(model, frames)(values)


def random_values(model: kv.Model, rng: np.random.Generator) -> dict[str, float]:
    """Return a random value for each coordinate, within its limits."""
    values = {}
    for s in model.degrees_of_freedom:
        low, high = model.limits(s)
        low, high = max(low, -2.0), min(high, 2.0)
        values[str(s)] = rng.uniform(low, high) if low < high else low
    return values


def assert_same_motion(written: kv.Model, read: kv.Model, tolerance: float = EXACT, count: int = 2) -> None:
    """Compare frames, coordinates, poses and limits; the model read back may have more frames."""
    frames = list(written.frames)
    assert set(frames) <= set(read.frames)
    assert written.degrees_of_freedom == read.degrees_of_freedom
    rng = np.random.default_rng(len(frames))
    ours, theirs = compile_poses(written, frames), compile_poses(read, frames)
    for _ in range(count):
        values = random_values(written, rng)
        for name, a, b in zip(frames, ours(values), theirs(values), strict=True):
            size = max(1.0, np.abs(a).max())
            np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * size, err_msg=name)
    for s in written.degrees_of_freedom:
        np.testing.assert_allclose(read.limits(s), written.limits(s), rtol=EXACT, atol=EXACT, err_msg=str(s))


def assert_same_bodies(written: kv.Model, read: kv.Model) -> None:
    """Compare shapes, colours and inertia of all frames."""
    assert set(written.bodies) == set(read.bodies)
    for name, body in written.bodies.items():
        other = read.bodies[name]
        for shapes, others in ((body.visuals, other.visuals), (body.collisions, other.collisions)):
            assert [(s.name, s.color, s.texture) for s in shapes] == [
                (s.name, s.color, s.texture) for s in others
            ]
            for a, b in zip(shapes, others, strict=True):
                assert _form(a) == _form(b)
                np.testing.assert_allclose(a.origin.matrix, b.origin.matrix, rtol=0, atol=EXACT)
        assert (body.inertia is None) == (other.inertia is None)
        if body.inertia is not None and other.inertia is not None:
            assert body.inertia.mass == other.inertia.mass
            assert body.inertia.tensor == other.inertia.tensor
            np.testing.assert_allclose(
                body.inertia.origin.matrix, other.inertia.origin.matrix, rtol=0, atol=EXACT
            )


def _form(shape: object) -> object:
    """Return the geometry of a shape, a mesh by its file, since references depend on the folder."""
    geometry = shape.geometry  # type: ignore[attr-defined]
    if not hasattr(geometry, "uri"):
        return geometry
    try:
        file = Path(locate_resource(geometry.uri, geometry.folder)).resolve()
    except kv.errors.FormatError:  # it is not there, and is called what it was called
        return Path(geometry.uri).name, geometry.scale
    return file, geometry.scale
