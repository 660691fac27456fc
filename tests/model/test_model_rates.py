"""Motion belongs to coordinates: along q̇ = R(q) u, expressions move as their gradients say."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from random_models import random_speeds, random_state, random_tree
from scipy.integrate import solve_ivp

import kineverse as kv
from kineverse.model.rates import Rates, as_row, to_plain

x, y, z = (kv.position(n) for n in "xyz")
u, v, w = (kv.velocity(n) for n in "uvw")


def based(base: kv.Operation) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(base, "base")
        edit.apply(kv.Revolute(name="arm", parent="base", child="hand", axis=(1, 2, 3)))
    return model


OMNI = kv.articulations.OmniBase(name="base", parent="world", child="base")
WHEELS = kv.articulations.DifferentialDrive(
    name="base", parent="world", child="base", radius=0.1, track=0.4, wheel_speed=5
)


def random_expression(rng: np.random.Generator, symbols: list[kv.Symbol], depth: int = 4) -> kv.Expression:
    if depth == 0 or rng.random() < 0.1:
        return (
            symbols[rng.integers(len(symbols))] if rng.random() < 0.8 else kv.Expression(float(rng.normal()))
        )
    a, b = (random_expression(rng, symbols, depth - 1) for _ in range(2))
    return (
        lambda: a + b,
        lambda: a * b,
        lambda: np.sin(a) - b,
        lambda: a / (2 + b * b),
        lambda: np.exp(-a * a) * b,
    )[rng.integers(5)]()


def path_of(model: kv.Model, start: dict[kv.Symbol, float], speeds: dict[kv.Symbol, float]) -> Any:
    """Return a function from time to values, by somebody else's integrator."""
    symbols, rates = model.degrees_of_freedom, model.rates
    rows = kv.array(
        [
            sum((g * s for s, g in rates[c].items()), kv.Expression(0.0)) if c in rates else c.derivative()
            for c in symbols
        ]
    )
    flow = kv.compile([to_plain(rows)], [*symbols, *model.speeds], tier="interpreter")
    constant = [speeds[s] for s in model.speeds]

    def rate(_: float, q: np.ndarray) -> np.ndarray:
        result = flow(np.concatenate([q, constant]))
        return result[0] if isinstance(result, tuple) else result

    q0 = [start[s] for s in symbols]
    ends = [solve_ivp(rate, (0, t), q0, rtol=3e-13, atol=1e-13, dense_output=True).sol for t in (-0.05, 0.05)]
    return lambda t: {**start, **speeds, **dict(zip(symbols, ends[t > 0](t), strict=True))}


def assert_motion_law(model: kv.Model, expressions: list[kv.Expression], seed: int) -> None:
    speeds = random_speeds(model, seed)
    at = path_of(model, random_state(model, seed), speeds)
    h = 2e-3
    weights = np.array([1 / 12, -2 / 3, 0, 2 / 3, -1 / 12]) / h
    points = [at(k * h) for k in (-2, -1, 0, 1, 2)]
    for e in expressions:
        first = kv.expressions.total_derivative(e)
        second = sum(
            (entry * key for key, entry in first.gradient(heuristic=False).items() if key.order == 1),
            kv.Expression(np.zeros(e.shape)),
        )
        for below, above in ((e, first), (first, second)):
            values = np.array([below(p) for p in points])
            np.testing.assert_allclose(
                np.tensordot(weights, values, 1), above(points[2]), atol=2e-8, rtol=1e-6
            )


@pytest.mark.parametrize("seed", range(3))
def test_poses_move_as_their_gradients_say_and_so_do_their_rates(seed: int) -> None:
    model = random_tree(seed, 9)
    names = list(model.frames)
    assert_motion_law(model, [model.fk(names[-1])[:3, :], model.fk(names[2], names[-1])[:3, 3]], seed)


@pytest.mark.parametrize("seed", range(4))
def test_random_expressions_move_as_their_gradients_say(seed: int) -> None:
    rng, model = np.random.default_rng(seed), random_tree(seed + 10, 9)
    symbols = list(model.degrees_of_freedom)
    expressions = [model.rates.carry(random_expression(rng, symbols)) for _ in range(6)]
    given = expressions[0].augment({})
    assert_motion_law(model, [*(e for e in expressions if e.symbols), given * expressions[1]], seed)


def test_rows_that_are_about_each_other_obey_the_law() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.set_rate(x, {u: np.cos(y), w: x})
        edit.set_rate(y, {v: 2.0, u: x * z})
        edit.set_rate(z, {x.derivative(): y, w: 1.0})  # through the row of x
        edit.add_frame(
            "f", "world", [kv.rotation_z(x * y), kv.translation(z, np.sin(x), kv.position("free"))]
        )
    assert model.speeds == (kv.velocity("free"), u, v, w)
    assert set(model.fk("f").gradient()) == set(model.speeds)
    for seed in range(3):
        assert_motion_law(model, [model.fk("f")[:3, :]], seed)


def test_wheels_as_in_the_paper() -> None:
    model = based(WHEELS)
    left, right = kv.velocity("base/left_wheel"), kv.velocity("base/right_wheel")
    gradient = model.fk("base").gradient()
    assert set(gradient) == {left, right}
    for angle in (0.0, 0.7, 2.5):
        at = kv.State({"base/x": 1, "base/y": 2, "base/angle": angle})
        for speed, sign in ((left, -1), (right, 1)):
            expected = [0.05 * np.cos(angle), 0.05 * np.sin(angle)]
            np.testing.assert_allclose(gradient[speed](at)[:2, 3], expected, atol=1e-15)
            turning = sign * 0.25
            np.testing.assert_allclose(
                gradient[speed](at)[0, :2], [-turning * np.sin(angle), -turning * np.cos(angle)], atol=1e-15
            )


def test_the_heading_turns_inside_the_rows() -> None:
    """ẍ of a base that drives a circle; with a plain heading in the row it would be wrong."""
    model = based(WHEELS)
    speeds = {"base/left_wheel:velocity": 1.0, "base/right_wheel:velocity": 3.0}
    rate = kv.expressions.total_derivative(model.fk("base")[0, 3])
    acceleration = sum(e * k for k, e in rate.gradient().items() if k.order == 1)
    forward, turn = 0.05 * 4, 0.25 * 2
    at = kv.State({"base/x": 0, "base/y": 0, "base/angle": 0.3, **speeds})
    assert acceleration(at) == pytest.approx(-forward * turn * np.sin(0.3))


def test_replacing_the_base_changes_the_gradients_of_frames_from_before() -> None:
    model = based(OMNI)
    hand, kept = model.fk("hand"), model.snapshot()
    free = {f"base/{c}:velocity" for c in ("x", "y", "angle")} | {"arm:velocity"}
    wheels = {"base/left_wheel:velocity", "base/right_wheel:velocity", "arm:velocity"}
    assert {str(s) for s in hand.gradient()} == {str(s) for s in model.speeds_of("hand")} == free
    with model.edit() as edit:
        edit.replace("base", WHEELS)
    for keys in (model.fk("hand").gradient(), model.speeds_of("hand"), model.speeds):
        assert {str(s) for s in keys} == wheels
    assert model.symbols == kept.symbols
    at = {str(s): 0.3 for s in model.symbols}
    np.testing.assert_array_equal(model.fk("hand")(at), hand(at))
    assert {str(s) for s in kept.fk("hand").gradient()} == {str(s) for s in hand.gradient()} == free
    assert "base/left_wheel_speed" in model.constraints_for(model.fk("hand"))
    with model.edit() as edit:
        edit.replace("base", OMNI)
    assert model.fk("hand") == hand
    assert model.snapshot() == kept


def test_constraints_are_handed_out_in_coordinates_that_are_carried() -> None:
    model = based(WHEELS)
    with model.edit() as edit:
        edit.constrain("x", -1, kv.position("base/x"), 1)
        edit.constrain("hand", -1, model.fk("hand")[0, 3], 1)
    for name in ("x", "hand"):
        gradient = model.constraints[name].expression.gradient()
        assert {"base/left_wheel:velocity", "base/right_wheel:velocity"} <= {str(k) for k in gradient}
    assert model.constraints["hand"].expression == model.fk("hand")[0, 3]
    with model.edit() as edit:
        edit.replace("base", OMNI)  # what was made from wheels is not about wheels any more
    assert model.constraints["x"].expression is kv.position("base/x")
    assert model.constraints["hand"].expression == model.fk("hand")[0, 3]
    assert not any("wheel" in str(k) for k in model.constraints["hand"].expression.gradient())


# -- the table itself ----------------------------------------------------------------------------------


def table(**rows: dict[kv.Symbol, Any]) -> Rates:
    return Rates({kv.position(n): as_row(kv.position(n), row) for n, row in rows.items()})


def test_carried_twice_is_carried_once() -> None:
    rates = table(x={u: np.cos(y)}, y={v: x})
    e = x * np.sin(y) + z.augment({u: y})
    once = rates.carry(e)
    assert rates.carry(once) == once
    assert to_plain(rates.carry(x * np.sin(y))) == x * np.sin(y)
    composed = once.substitute({x: 2 * y + z})
    assert to_plain(composed) == to_plain(to_plain(composed))
    again = rates.carry(composed)
    assert rates.carry(again) == again
    assert to_plain(x * 2) == x * 2


def test_composition_with_carried_coordinates_is_the_chain_rule() -> None:
    rates = table(x={u: np.cos(y), v: x}, y={v: 1.0})
    b, c = kv.position("b"), kv.position("c")
    e = rates.carry(x * y + np.sin(x) * z)
    at = kv.State({"b": 0.3, "c": -0.4, "y": 0.7, "z": 1.1, "x": 0.2})
    for substitution in (
        {z: b * c},
        {x: 2 * b + c},
        {y: b * b},
        {x: b, z: b},
        {x: y},
        {y: kv.Expression(0.5)},
    ):
        composed = e.substitute(substitution)
        plainly = (x * y + np.sin(x) * z).substitute(substitution)
        assert composed(at) == pytest.approx(plainly(at))
        expected: dict[kv.Symbol, float] = {}
        for key, entry in e.gradient().items():
            factor = float(entry.substitute(substitution)(at))
            inner = substitution.get(key.position)
            for k, g in ((key, 1.0),) if inner is None else tuple(kv.Expression(inner).gradient().items()):
                expected[k] = expected.get(k, 0.0) + factor * (g if isinstance(g, float) else float(g(at)))
        got = {k: float(g(at)) for k, g in composed.gradient().items()}
        assert {k: v for k, v in got.items() if v} == pytest.approx({k: v for k, v in expected.items() if v})


def test_rows_are_resolved_through_other_rows() -> None:
    rates = table(x={v: 2.0, y.derivative(): z}, y={u: 3.0, v: 1.0}, z={x.derivative(): 5.0})
    assert {k: e({"z": 4.0}) for k, e in rates[x].items()} == {v: 6.0, u: 12.0}
    assert {k: e({"z": 4.0}) for k, e in rates[z].items()} == {v: 30.0, u: 60.0}


def test_a_long_chain_of_rows() -> None:
    n = 1500
    rows = {f"q{i}": {kv.velocity(f"q{i + 1}"): 1.0} for i in range(n)}
    rates = table(**rows)
    assert all(list(rates[kv.position(f"q{i}")]) == [kv.velocity(f"q{n}")] for i in range(n))
    with pytest.raises(kv.errors.ModelError, match="Cyclic rates"):
        table(**rows, **{f"q{n}": {kv.velocity("q0"): 1.0}})


def test_one_coordinate_among_many_is_carried_without_the_others() -> None:
    rates = table(**{f"q{i}": {kv.velocity(f"v{i}"): np.cos(kv.position(f"q{i}"))} for i in range(50)})
    carried = rates.carry(kv.position("q7") * 2)
    assert list(rates._carried) == [kv.position("q7")]
    assert list(carried.gradient()) == [kv.velocity("v7")]


@pytest.mark.parametrize(
    "rows",
    [
        {"x": {x.derivative(): 1.0}},
        {"x": {y.derivative(): 1.0}, "y": {x.derivative(): 1.0}},
        {"x": {y.derivative(): 1.0}, "y": {z.derivative(): 2.0, u: 1.0}, "z": {x.derivative(): y}},
    ],
)
def test_cyclic_rates_are_refused_and_the_edit_undone(rows: dict[str, Any]) -> None:
    with pytest.raises(kv.errors.ModelError, match="Cyclic rates"):
        table(**rows)
    model = based(WHEELS)
    before = model.snapshot()
    with pytest.raises(kv.errors.ModelError, match=r"Cyclic rates.*x"), model.edit() as edit:
        for name, row in rows.items():
            edit.set_rate(kv.position(name), row)
    assert model.snapshot() == before
    assert {str(k) for k in model.fk("base").gradient()} == {
        "base/left_wheel:velocity",
        "base/right_wheel:velocity",
    }
    with model.edit() as edit:
        edit.set_rate(x, {u: 1.0})
    assert x in model.rates


def test_a_circle_of_rates_closed_by_different_edits() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.set_rate(x, {y.derivative(): 1.0})
    with pytest.raises(kv.errors.ModelError, match="Cyclic rates"), model.edit() as edit:
        edit.set_rate(y, {x.derivative(): 1.0})
    with model.edit() as edit:
        edit.set_rate(y, {u: 2.0})
    assert list(model.rates[x]) == [u]


@pytest.mark.parametrize(
    ("coordinate", "row"),
    [
        (x.derivative(), {u: 1.0}),
        (kv.parameter("p", 1.0), {u: 1.0}),
        (x, {y: 1.0}),
        (x, {u.derivative(): 1.0}),
        (x, {"u": 1.0}),
        (x, {u: np.ones(3)}),
        (x, {u: float("nan")}),
        (x, 3),
        ("x", {u: 1.0}),
    ],
)
def test_wrong_rows(coordinate: Any, row: Any) -> None:
    model = kv.Model()
    with pytest.raises(kv.KineverseError), model.edit() as edit:
        edit.set_rate(coordinate, row)
    assert not model.rates


def test_left_over_rates_are_eliminated() -> None:
    rates = table(x={u: np.cos(y), v: 2.0})
    e = 3 * x.derivative() + z.derivative() * x
    result = rates.eliminate(e)
    at = kv.State({"x": 2.0, "y": 0.4, "u": 0, "z:velocity": 0.5, "u:velocity": 1.5, "v:velocity": -1.0})
    assert result(at) == pytest.approx(3 * (np.cos(0.4) * 1.5 - 2.0) + 0.5 * 2)
    assert x.derivative() not in result.symbols
    assert rates.eliminate(x * y) == x * y
    row = result.gradient()
    assert {k.order for k in row} == {1, 2}


def test_speeds_and_coordinates_may_differ_in_number() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="free", parent="world", child="free"))
    assert len(model.degrees_of_freedom) == 7
    assert len(model.speeds) == len(model.speeds_of("free")) == model.jacobian("free").shape[1] == 6


def test_parameters_and_coordinates_of_rows_belong_to_the_model() -> None:
    radius, heading = kv.parameter("radius", 0.1), kv.position("heading")
    model = kv.Model()
    with model.edit() as edit:
        edit.set_rate(x, {u: radius * np.cos(heading)})
    assert model.symbols == (heading, radius, x)
    assert model.default_state() == kv.State({heading: 0, radius: 0.1, x: 0}, source="default")


def test_an_operation_reads_carried_expressions() -> None:
    class Kept(kv.Operation):
        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            entry = z.augment({u: x})
            return kv.model.Writes(data={"pose": model.fk("f")[0, 3], "entry": model.carry(entry)})

    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", "world", kv.translation(x, 0, 0))
        edit.set_rate(x, {v: 2.0})
        edit.apply(Kept(), "kept")
    assert model.data["pose"].gradient() == {v: kv.Expression(2.0)}
    assert v in model.data["entry"].gradient()[u].gradient()
    assert model.history.readers("rates/x") == ["kept"]


def test_tables_survive_pickling() -> None:
    rates = table(x={u: np.cos(y)}, y={v: x})
    other = pickle.loads(pickle.dumps(rates))
    assert other.key == rates.key
    assert other.carry(x * y) == rates.carry(x * y)
