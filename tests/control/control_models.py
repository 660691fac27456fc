"""Small models for the tests of controllers."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

import kineverse as kv
from kineverse.control import Command, Controller

DT = 0.02


def planar_arm(links: int = 3, velocity: float | None = 1.0) -> kv.Model:
    """A planar arm of links of 1 m; joints ``joint1`` …, frames ``link1`` … and ``tip``."""
    model = kv.Model()
    with model.edit() as edit:
        for k in range(links):
            edit.apply(
                kv.Revolute(
                    name=f"joint{k + 1}",
                    parent=f"link{k}" if k else "world",
                    child=f"link{k + 1}",
                    origin=kv.translation(1.0 if k else 0.0, 0, 0),
                    axis=(0, 0, 1),
                    lower=-2.0,
                    upper=2.0,
                    velocity=velocity,
                )
            )
        edit.add_frame("tip", parent=f"link{links}", transform=kv.translation(1, 0, 0))
    return model


def garage() -> kv.Model:
    """The garage door of the README, whose pose is singular at a = 2, with its lock."""
    model = kv.Model()
    a, b = kv.position("door"), kv.position("bolt")
    with model.edit() as edit:
        edit.add_frame(
            "door", parent="world", transform=kv.translation(0, 0, 2 - a) @ kv.rotation_y(np.arccos(a / 2))
        )
        edit.constrain("range", 0, a, 2)
        edit.constrain("speed", -1, a.derivative(), 1)
        edit.constrain("bolt/range", 0, b, 1)
        unlocked = ~((b < 0.3) & (a > 1.99))
        edit.constrain("lock", -unlocked, a.derivative(), unlocked)
    return model


def follow(controller: Controller, state: kv.State, seconds: float) -> tuple[kv.State, list[Command]]:
    """Apply commands for some seconds; return the last state and all commands."""
    commands = []
    for _ in range(round(seconds / controller.dt)):
        commands.append(controller.step(state))
        state = controller.model.integrate(state, commands[-1].speeds, controller.dt)
    return state, commands


def solve_by_osqp(problem: Any, soft: Any, weight: float) -> tuple[Any, Any]:
    """Return minimiser and multipliers of a quadratic program; penalties of soft rows are of slacks."""
    import osqp

    (H, f, A, lower, upper), rows = problem, np.flatnonzero(soft)
    n, m, k = len(f), len(A), len(rows)
    # The unknowns are [x; above; below], the rows [[x; A x] - above + below; above; below].
    C = np.zeros((n + m + 2 * k, n + 2 * k))
    C[: n + m, :n] = np.vstack([np.eye(n), A])
    C[rows, n + np.arange(k)], C[rows, n + k + np.arange(k)] = -1.0, 1.0
    C[n + m :, n:] = np.eye(2 * k)
    cost = scipy.linalg.block_diag(H, weight * np.eye(2 * k))
    solver = osqp.OSQP()
    solver.setup(
        scipy.sparse.csc_matrix(np.triu(cost)),
        np.concatenate([f, np.zeros(2 * k)]),
        scipy.sparse.csc_matrix(C),
        np.concatenate([lower, np.zeros(2 * k)]),
        np.concatenate([upper, np.full(2 * k, np.inf)]),
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=100_000,
        polishing=True,
    )
    found = solver.solve(raise_error=True)
    return found.x[:n], found.y[: n + m]
