"""Functions for JAX: values, derivatives of every order, types, places, and what they hold."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from compiled_programs import arm
from differentiable import (
    CASES,
    SIZE,
    A,
    B,
    assert_holds_no_expressions,
    assert_same_operations,
    operations,
)

import kineverse as kv
from kineverse.compilation import c_library
from kineverse.compilation.backends import array_source as array_source_module
from kineverse.compilation.backends.array_source import array_source, load_operations
from kineverse.compilation.program import Program
from kineverse.errors import (
    CompileError,
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    MissingDependencyError,
    ShapeError,
    UnknownNameError,
)

jax = pytest.importorskip("jax")
jnp = jax.numpy

TIERS = [pytest.param("c", marks=pytest.mark.compiler), "operations"]
LONG = {name: [pytest.mark.long] for name in ("powers", "augmented", "four_bar", "folding_door", "robot_arm")}


@pytest.fixture(autouse=True)
def doubles() -> Iterator[None]:
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.mark.parametrize(
    ("name", "tier"),
    [
        *(pytest.param(name, "c", marks=[pytest.mark.compiler, *LONG.get(name, [])]) for name in CASES),
        *(
            pytest.param(name, "operations", marks=[] if name == "kinks" else pytest.mark.long)
            for name in CASES
        ),
    ],
)
def test_values_and_derivatives_are_those_of_the_library(name: str, tier: Any) -> None:
    case = CASES[name]()
    f = kv.to_jax(case.outputs, case.inputs, tier=tier)

    speeds = np.arange(1.0, case.points.shape[1] + 1)

    def both(x: Any) -> Any:
        return f(x), jax.jacrev(f)(x), jax.jvp(f, (x,), (speeds,))[1]

    values, slopes, rates = jax.jit(jax.vmap(both))(case.points)
    for found, slope, rate, wanted, wanted_slope in zip(
        values, slopes, rates, case.values(), case.slopes(), strict=True
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(slope, wanted_slope, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rate, wanted_slope @ speeds, rtol=1e-12, atol=1e-12)


@pytest.mark.compiler
def test_doubles_are_those_of_a_batch_for_any_leading_dimensions_and_number_of_threads() -> None:
    mechanism = arm()
    wanted = kv.compile([mechanism.pose, mechanism.jacobian], mechanism.symbols, tier="c")
    f = kv.to_jax([mechanism.pose, mechanism.jacobian], mechanism.symbols, tier="c")
    for count in (0, 7, 20_011):
        points = np.random.default_rng(count).uniform(-3, 3, (count, 7))
        for found, batch in zip(f(points), wanted.batch(points), strict=True):
            np.testing.assert_array_equal(found, batch)
    points = points[:24]
    pose, jacobian = f(points.reshape(2, 3, 4, 7))
    assert pose.shape == (2, 3, 4, 4, 4)
    assert jacobian.shape == (2, 3, 4, 6, 7)
    np.testing.assert_array_equal(np.reshape(pose, (24, 4, 4)), wanted.batch(points)[0])
    np.testing.assert_array_equal(f(points[5])[0], wanted.batch(points)[0][5])


def test_derivatives_agree_with_those_of_jax_where_smooth() -> None:
    """Three joints in a plane, written in JAX."""
    q, length = [kv.position(f"q{i}") for i in range(3)], kv.parameter("length", 0.5)
    pose = kv.rotation_z(q[0])
    for symbol in q[1:]:
        pose = pose @ kv.translation(length, 0, 0) @ kv.rotation_z(symbol)
    f = kv.to_jax(pose[:2, 3], [*q, length], tier="operations")

    def by_hand(x: Any) -> Any:
        angles = jnp.cumsum(x[:2])
        return x[3] * jnp.array([jnp.cos(angles).sum(), jnp.sin(angles).sum()])

    def derivatives(g: Any) -> Any:
        pull = jax.vjp(g, x)[1]
        return g(x), pull(np.array([2.0, -3.0])), jax.hessian(g)(x)

    x = np.array([0.3, -1.1, 0.4, 0.7])
    ours, theirs = jax.jit(lambda: [derivatives(g) for g in (f, by_hand)])()
    for one, two in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-14)


@pytest.mark.long
def test_derivatives_of_operations_agree_with_those_of_jax_where_smooth() -> None:
    """Automatic differentiation of the very program, without rules of its own."""
    case = CASES["robot_arm"]()
    case.outputs.pop()
    evaluate = load_operations(Program(case.outputs, case.inputs), [e.shape for e in case.outputs], m=jnp)(
        False
    )
    plain = jax.jit(jax.jacfwd(lambda x: evaluate(x, x.dtype.type)))
    ruled = jax.jit(jax.jacfwd(kv.to_jax(case.outputs, case.inputs, tier="operations")))
    for ours, theirs in zip(ruled(case.points[0]), plain(case.points[0]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-14)


def test_loops_are_differentiated_twice_by_the_implicit_function_theorem() -> None:
    case = CASES["four_bar"]()
    f = kv.to_jax(case.outputs[0], case.inputs)
    slope = case.outputs[0].jacobian(case.inputs).jacobian(case.inputs)
    wanted = kv.compile(slope, case.inputs, tier="interpreter").batch(case.points)
    found = jax.jit(jax.vmap(jax.hessian(f)))(case.points)
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    near = [f(case.points + step * 1e-4) for step in (-1, 0, 1)]
    np.testing.assert_allclose(found[..., 0, 0], (near[0] - 2 * near[1] + near[2]) / 1e-8, atol=1e-6)


@pytest.mark.parametrize("tier", TIERS)
def test_a_loop_that_does_not_close_is_nan(tier: Any) -> None:
    a, x = kv.position("a"), kv.position("x")
    root = kv.expressions.implicit.ImplicitFunction(
        "root", (x,), (a,), kv.array([x * x - a]), (0,), kv.array([1 + a]), 8
    ).apply([a])
    f = kv.to_jax(root, [a], tier=tier)
    single = f(np.array([[2.0], [-1.0]], dtype=np.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single[0], np.sqrt(2), rtol=1e-6)
    found = f([[2.0], [-1.0]])
    np.testing.assert_allclose(found[0], np.sqrt(2), rtol=1e-15)
    assert np.isnan(found[1]).all()


def test_facts_alone_are_a_gradient_of_the_users() -> None:
    logic = A < B
    facts = logic.with_gradient(logic.gradient(heuristic=False))
    f = kv.to_jax([logic, facts], [A, B], tier="operations")
    trend, fact = jax.jacrev(f)(np.array([0.2, 0.3]))
    assert np.asarray(fact).tolist() == [0, 0]
    assert trend[0] < 0 < trend[1]


def test_every_operation_has_the_value_of_the_interpreter() -> None:
    program, points = operations()
    evaluate = load_operations(program, [()] * len(program.sizes), m=jnp, erf=jax.lax.erf)(False)
    found = jax.jit(lambda x: jnp.stack(evaluate(x, x.dtype.type), axis=-1))(points)
    assert_same_operations(np.asarray(found), program, points)


@pytest.mark.parametrize("tier", [TIERS[0], pytest.param("operations", marks=pytest.mark.long)])
def test_results_have_the_type_of_the_argument(tier: Any) -> None:
    f = kv.to_jax([kv.rotation_z(A) * SIZE, A / 3, kv.array(0.1)], [A, SIZE], tier=tier)
    x = np.random.default_rng(0).normal(size=(150, 2))
    double, single = f(x), f(x.astype(np.float32))
    assert {r.dtype for r in double} == {jnp.dtype("float64")}
    assert {r.dtype for r in single} == {jnp.dtype("float32")}
    for one, two in zip(single, double, strict=True):
        np.testing.assert_allclose(one, two, atol=2e-6)
    slope = jax.make_jaxpr(jax.jacfwd(f))(x[0].astype(np.float32))
    assert {r.dtype for r in slope.out_avals} == {jnp.dtype("float32")}
    jax.config.update("jax_enable_x64", False)
    assert {r.dtype for r in f(x.astype(int))} == {jnp.dtype("float32")}
    jax.config.update("jax_enable_x64", True)
    assert {r.dtype for r in f(x.astype(int))} == {jnp.dtype("float64")}


@pytest.mark.compiler
def test_float_is_computed_in_double_on_the_cpu() -> None:
    f = kv.to_jax((A + 1e5) - 1e5, [A], tier="c")
    assert f(np.array([0.001], dtype=np.float32)) == pytest.approx(0.001, rel=1e-6)


def test_mapped_calls_are_one_call() -> None:
    mechanism = arm(joints=2)
    f = kv.to_jax(mechanism.pose, mechanism.symbols)
    calls = [
        equation.params["result_avals"]
        for equation in equations(jax.make_jaxpr(jax.vmap(jax.vmap(f)))(np.zeros((3, 5, 2))).jaxpr)
        if equation.primitive.name == "ffi_call"
    ]
    assert [[aval.shape for aval in avals] for avals in calls] == [[(3, 5, 4, 4)]]


def equations(jaxpr: Any) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda p: hasattr(p, "eqns")):
            if hasattr(inner, "eqns"):
                yield from equations(getattr(inner, "jaxpr", inner))


@pytest.mark.compiler
def test_each_device_has_its_program(monkeypatch: pytest.MonkeyPatch) -> None:
    f = kv.to_jax(kv.rotation_z(A), [A])
    here = jax.extend.backend.backends()
    monkeypatch.setattr(jax.extend.backend, "backends", lambda: {**here, "cuda": None})
    traced = jax.jit(jax.vmap(jax.grad(lambda x: f(x)[0, 1]))).trace(np.zeros((3, 1)))
    texts = {p: traced.lower(lowering_platforms=(p,)).as_text() for p in ("cpu", "cuda")}
    assert "custom_call @kineverse_" in texts["cpu"]
    assert "custom_call @kineverse_" not in texts["cuda"]
    assert "stablehlo.cosine" in texts["cuda"]
    assert "stablehlo.cosine" not in texts["cpu"]


def test_options_of_the_compiler_belong_to_the_users_jit() -> None:
    f = kv.to_jax(kv.rotation_z(A), [A], tier="operations")
    whole = jax.jit(lambda x: f(x).sum(), compiler_options={"xla_disable_hlo_passes": "fusion"})
    assert whole(jnp.array([0.5])) == pytest.approx(2 * np.cos(0.5) + 2)


@pytest.mark.compiler
def test_what_is_compiled_outlives_the_function() -> None:
    def loss(x: Any) -> Any:
        return kv.to_jax(np.sin(A * 1.25) + 0.125, [A], tier="c")(x)

    compiled = jax.jit(loss)
    first = compiled(jnp.array([0.25]))
    gc.collect()
    assert compiled(jnp.array([0.25])) == first == pytest.approx(np.sin(0.3125) + 0.125)


@pytest.mark.long
@pytest.mark.compiler
def test_large_arrays_on_one_core_do_not_wait_for_each_other() -> None:
    """As those of jax.pure_callback do, for ever."""
    program = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import jax, jax.numpy as jnp, kineverse as kv\n"
        "a, b = kv.position('a'), kv.position('b')\n"
        "f = kv.to_jax(kv.rotation_z(a) * b, [a, b], tier='c')\n"
        "g = jax.jit(lambda x: f(jnp.sin(f(x)[..., 0, :2])).sum())\n"
        "for i in range(5): total = g(jnp.full((150_000, 2), 0.1 * i))\n"
        "print(total)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, encoding="utf-8", timeout=300, check=True
    )
    assert np.isfinite(float(done.stdout))


@pytest.mark.parametrize("tier", TIERS)
def test_it_holds_no_expressions(tier: Any) -> None:
    case = CASES["four_bar"]()
    f = kv.to_jax(case.outputs, case.inputs, tier=tier)
    jax.make_jaxpr(jax.jacfwd(f))(case.points[0])
    assert_holds_no_expressions(f)


def test_without_a_compiler_it_consists_of_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(c_library, "toolchain", lambda: None)
    f = kv.to_jax(A * B, [A, B])
    assert jax.grad(f)(jnp.array([2.0, 3.0])).tolist() == [3, 2]
    with pytest.raises(CompileError, match="there is no C compiler"):
        kv.to_jax(A * B, [A, B], tier="c")


def test_missing_jax_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(MissingDependencyError, match=r"to_jax needs jax: .* install .*\[jax\]"):
        kv.to_jax(A, [A])


def test_wrong_use_is_told() -> None:
    f = kv.to_jax([A, kv.rotation_z(B)], [A, B], tier="operations")
    with pytest.raises(
        ShapeError,
        match=r"of shape \(\.\.\., 2\), with 'a', 'b' along its last axis, not one of shape \(3,\)",
    ):
        f(jnp.zeros(3))
    with pytest.raises(ShapeError, match=r"not one of shape \(\)"):
        jax.jit(f)(0.5)
    wrong: Any
    for wrong, said in (
        ({"a": 1.0, "b": 2.0}, "not a dict"),
        (np.ma.masked_array([1.0, 2.0], [False, True]), "not a MaskedArray"),
        ([[1.0, 2.0], [3.0]], "not a list of entries that form no array"),
    ):
        with pytest.raises(ShapeError, match=said):
            f(wrong)
    for wrong in (jnp.zeros(2, dtype=jnp.bfloat16), np.zeros(2, dtype=bool), np.zeros(2, dtype=complex)):
        with pytest.raises(InvalidValueError, match=r"float32 or float64, not (bfloat16|bool|complex128)"):
            f(wrong)
    with pytest.raises(UnknownNameError, match="not among the inputs: 'b'"):
        kv.to_jax(A * B, [A])
    with pytest.raises(UnknownNameError, match=r"gradients depend on .*: 'b'"):
        kv.to_jax(A.augment({A.derivative(): B}), [A])
    with pytest.raises(DuplicateNameError):
        kv.to_jax(A, [A, A])
    with pytest.raises(ExpressionError, match=r"swapped\? It is to_jax\(expressions, inputs\)"):
        kv.to_jax(A, "a")
    with pytest.raises(ExpressionError, match=r"inputs are missing: it is to_jax"):
        kv.to_jax(A, None)  # type: ignore[arg-type]
    with pytest.raises(ExpressionError, match="no inputs to differentiate by"):
        kv.to_jax(kv.array(1.0), [])
    with pytest.raises(CompileError, match="no expression"):
        kv.to_jax([], [A])
    with pytest.raises(ExpressionError):
        kv.to_jax("a", [A])  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="tiers are 'auto', 'c' and 'operations'"):
        kv.to_jax(A, [A], tier="interpreter")  # type: ignore[arg-type]


def test_operations_that_arrays_lack_are_named() -> None:
    assert "m.sinh" in array_source(Program([np.sinh(A)], [A]), [()])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(array_source_module, "_VALUES", {})
        with pytest.raises(CompileError, match="contains 'sinh', which is no operation on arrays"):
            array_source(Program([np.sinh(A)], [A]), [()])


def test_expressions_are_given_as_to_compile() -> None:
    x = jax.ShapeDtypeStruct((5, 3, 2), np.float64)

    def shapes(expressions: Any) -> Any:
        f = kv.to_jax(expressions, [A, B], tier="operations")
        return jax.tree.map(lambda r: r.shape, jax.eval_shape(f, x))

    given: list[Any] = [[A, B], [[A], [1.0]], (A,), 2.0, np.eye(3), A]
    wanted = tuple((5, 3, *shape) for shape in kv.compile(given, [A, B]).shapes)
    assert shapes(given) == shapes(tuple(given)) == wanted
    assert shapes(kv.array([A, B])) == (5, 3, 2)
    assert shapes(A) == (5, 3)
