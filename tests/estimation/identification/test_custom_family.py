"""Custom families: model selection and estimated parameters."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_recordings import noisy

import kineverse as kv
from kineverse.estimation import Family, FamilyParameter, IdentificationResult, identify, pose_covariance

LENGTH = 1.4


def garage() -> Family:
    """A door that slides up along one edge and in along the other, of a length nobody has measured."""
    a, length = kv.position("a"), kv.parameter("length", 2.0)
    door = kv.translation(0, 0, length * np.cos(a)) @ kv.rotation_y(a)
    return Family("garage", door, {a: (0.0, 1.5)}, {length: FamilyParameter(2.0, 0.5, 0.5, 4.0)})


def seen_doors(count: int, position: float, orientation: float) -> tuple[np.ndarray, np.ndarray]:
    family = garage()
    (a,), (length,) = family.joints, family.parameters
    random = np.random.default_rng(0)
    values = np.linspace(0.05, 1.2, count)
    poses = np.stack([family.transform({a: v, length: LENGTH}) for v in values])
    return values, noisy(poses, position, orientation, random)


@pytest.fixture(scope="module")
def found() -> IdentificationResult:
    _, poses = seen_doors(20, 0.01, 0.02)
    return identify(None, poses, noise=pose_covariance(0.01, 0.02), families=["revolute", "planar", garage()])


def test_identify_selects_a_custom_family_over_a_hinge(found: IdentificationResult) -> None:
    assert found.best.family == "garage"
    assert not found.is_ambiguous
    assert found.best.is_determined


def test_a_custom_familys_parameter_is_estimated(found: IdentificationResult) -> None:
    fit = found["garage"]
    deviation = fit.deviation("length")
    assert 0.001 < deviation < 0.01
    assert abs(fit.parameters["length"] - LENGTH) < 4 * deviation


def test_joint_values_and_limits_of_a_custom_family_are_the_observed_ones(
    found: IdentificationResult,
) -> None:
    values, _ = seen_doors(20, 0.01, 0.02)
    np.testing.assert_allclose(found["garage"].joint_values[:, 0], values, atol=0.05)


def test_operation_of_a_custom_family_moves_as_its_fit(found: IdentificationResult) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(found.best.operation("door", "world", "panel"), tag="learned")
    pose = model.fk("panel")({"door": 0.5})
    expected = found.best.motion.linearise(np.array([[0.5]])).pose[0]
    np.testing.assert_allclose(pose, expected, atol=1e-12)
    assert model.violations({"door": 3.0})
    copy = kv.formats.from_bytes(kv.formats.to_bytes(model))
    np.testing.assert_allclose(copy.fk("panel")({"door": 0.5}), expected, atol=1e-12)


def test_an_invalid_family_is_refused() -> None:
    a, b = kv.position("a"), kv.position("b")
    with pytest.raises(kv.errors.UnknownNameError, match="depends on b"):
        Family("odd", kv.translation(a, b, 0), {a: (0, 1)})
    with pytest.raises(kv.errors.InvalidValueError, match="empty"):
        Family("odd", kv.translation(a, 0, 0), {a: (1, 1)})
    with pytest.raises(kv.errors.InvalidValueError, match="positive deviation"):
        Family("odd", kv.translation(a, b, 0), {a: (0, 1)}, {b: (0.0, 0.0)})
    with pytest.raises(kv.errors.ShapeError, match="4×4"):
        Family("odd", a, {a: (0, 1)})
