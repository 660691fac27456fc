"""Rows of near pairs of bodies in a quadratic program, in C and in numpy.

With the normal n from a to b, the nearest points p, and the twists (v, ω) of both bodies over the columns, a
row is ``n·(v_b + ω_b × p_b) - n·(v_a + ω_a × p_a)``: the rate at which the distance grows. A pair within its
margin adds ``½ weight (row·x - rate)²`` to the costs.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compile.c_library import SourceLibrary
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array

from .velocity_program import INWARDS

_SOURCE = r"""
#include <stdint.h>

typedef struct {
  int64_t n, width, bodies, used; /* speeds, all variables, bodies, rows */
  const int64_t *group;           /* of each body, among the twists */
  const double *twists, *margins; /* (groups, 6, n), (bodies, bodies) */
  double *H, *f, *A, *lower;
  const double *distances, *witnesses;
  const int32_t *owners;
  double gain, recovery, weight, inwards;
} Rows;

static void add(double *row, const double *twist, int64_t n, const double *p, const double *m, double sign) {
  const double wrench[6] = {m[0], m[1], m[2], p[1] * m[2] - p[2] * m[1], p[2] * m[0] - p[0] * m[2],
                            p[0] * m[1] - p[1] * m[0]};
  for (int i = 0; i < 6; i++)
    for (int64_t j = 0; j < n; j++) row[j] += sign * wrench[i] * twist[i * n + j];
}

__attribute__((visibility("default"))) void write_rows(const Rows *r) {
  const int64_t n = r->n;
  for (int64_t k = 0; k < r->used; k++) {
    const int32_t a = r->owners[2 * k], b = r->owners[2 * k + 1];
    const double *witness = r->witnesses + 9 * k, gap = r->distances[k] - r->margins[r->bodies * a + b];
    double *row = r->A + r->width * k;
    for (int64_t j = 0; j < n; j++) row[j] = 0.0;
    add(row, r->twists + 6 * n * r->group[b], n, witness + 3, witness + 6, 1.0);
    add(row, r->twists + 6 * n * r->group[a], n, witness, witness + 6, -1.0);
    r->lower[k] = gap > 0.0 ? -r->gain * gap : 0.0;
    if (!(gap < 0.0)) continue;
    const double rate = r->recovery * (r->inwards - gap);
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++) r->H[r->width * i + j] += r->weight * row[i] * row[j];
      r->f[i] -= r->weight * rate * row[i];
    }
  }
}
"""


class _Struct(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("n", "width", "bodies", "used")),
        *((name, ctypes.c_void_p) for name in ("group", "twists", "margins", "H", "f", "A", "lower")),
        *((name, ctypes.c_void_p) for name in ("distances", "witnesses", "owners")),
        *((name, ctypes.c_double) for name in ("gain", "recovery", "weight", "inwards")),
    )


def _declare(code: Any) -> None:
    code.write_rows.argtypes, code.write_rows.restype = (ctypes.c_void_p,), None


row_library = SourceLibrary(_SOURCE, _declare)


class ContactRows:
    """Writer of the rows of near pairs into the arrays of a quadratic program, which it keeps."""

    def __init__(
        self,
        group: npt.NDArray[np.intp],
        twists: Array,
        margins: Array,
        H: Array,
        f: Array,
        A: Array,
        lower: Array,
    ) -> None:
        self._group, self._twists, self._margins = group.astype(np.int64), twists, margins
        self._H, self._f, self._A, self._lower = H, f, A, lower
        self._struct = struct = _Struct(n=twists.shape[2], width=A.shape[1], bodies=len(group))
        struct.inwards = INWARDS
        arrays = {"group": self._group, "twists": twists, "margins": margins}
        for name, array in (arrays | {"H": H, "f": f, "A": A, "lower": lower}).items():
            setattr(struct, name, array.ctypes.data)
        self._address = ctypes.addressof(struct)
        row_library.prepare(wait=True)  # now, so that numbers never change

    def write(
        self, found: DistanceResults, used: int, *, gain: float, recovery: float, weight: float
    ) -> None:
        """Write the rows of the first pairs, and add those within their margins to the costs."""
        if row_library.code is None:
            self._write_by_numpy(found, used, gain, recovery, weight)
            return
        struct = self._struct
        struct.used, struct.gain, struct.recovery, struct.weight = used, gain, recovery, weight
        struct.owners = _address(found.body_indices)
        struct.distances, struct.witnesses = _address(found.distances), _address(found.witnesses)
        row_library.code.write_rows(self._address)

    def _write_by_numpy(
        self, found: DistanceResults, used: int, gain: float, recovery: float, weight: float
    ) -> None:
        n = self._twists.shape[2]
        owners, normals = found.body_indices[:used], found.normals[:used]
        ends = ((owners[:, 1], found.points_b[:used]), (owners[:, 0], found.points_a[:used]))
        grows, shrinks = (
            np.einsum(
                "ki,kij->kj", np.hstack([normals, np.cross(p, normals)]), self._twists[self._group[owner]]
            )
            for owner, p in ends
        )
        rows = self._A[:used, :n] = grows - shrinks
        gap = found.distances[:used] - self._margins[owners[:, 0], owners[:, 1]]
        self._lower[:used] = -gain * np.maximum(gap, 0.0)
        near = gap < 0.0
        inside = rows[near]
        self._H[:n, :n] += weight * (inside.T @ inside)
        self._f[:n] -= weight * recovery * ((INWARDS - gap[near]) @ inside)


def _address(array: npt.NDArray[Any]) -> int:
    """Return the address of an array that is not empty, in a third of the time of ``array.ctypes.data``."""
    return ctypes.addressof(ctypes.c_char.from_buffer(array.data))
