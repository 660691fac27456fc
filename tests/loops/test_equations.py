"""Steps of Newton's method, against the singular value decomposition of LAPACK."""

import numpy as np
import pytest

from kineverse.loops.equations import least_squares


@pytest.mark.parametrize("smallest", [1.0, 1e-4, 1e-8, 0.0])
@pytest.mark.parametrize("shape", [(3, 3), (6, 4), (4, 6)])
def test_least_squares_is_the_shortest_of_the_best(shape, smallest):
    random = np.random.default_rng(3)
    left, right = (np.linalg.qr(random.normal(size=(n, n)))[0] for n in shape)
    sizes = np.zeros(shape)
    np.fill_diagonal(sizes, [1.0] * (min(shape) - 1) + [smallest])
    J, r = left @ sizes @ right.T, random.normal(size=shape[0])
    wanted = np.linalg.lstsq(J, r, rcond=1e-9)[0]
    assert np.abs(least_squares(J, r) - wanted).max() < 1e-6 * np.abs(wanted).max()
