"""Functions for PyTorch: values, derivatives of every order, types, transforms, and what they hold."""

from __future__ import annotations

import sys
import warnings
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
from kineverse.compilation.backends.array_source import load_operations
from kineverse.compilation.program import Program
from kineverse.errors import (
    CompileError,
    ExpressionError,
    InvalidValueError,
    MissingDependencyError,
    ShapeError,
)
from markdown_examples import ROOT, examples

pytestmark = pytest.mark.filterwarnings(
    "ignore:`torch.jit.script` is deprecated:FutureWarning"
)  # used by torch


def test_missing_torch_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependencyError, match=r"to_torch needs torch: .* install .*\[torch\]"):
        kv.to_torch(A, [A])


@pytest.fixture
def torch() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries that it imports
        return pytest.importorskip("torch")


TIERS = ["auto", "operations"]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("tier", TIERS)
def test_values_and_derivatives_are_those_of_the_library(torch: Any, name: str, tier: Any) -> None:
    case = CASES[name]()
    f = kv.to_torch(case.outputs, case.inputs, tier=tier)
    x = torch.tensor(case.points)
    values = f(x)
    forward = torch.func.vmap(torch.func.jacfwd(f))(x)
    backward = torch.func.vmap(torch.func.jacrev(f))(x)
    for found, one, two, wanted, slope in zip(
        values, forward, backward, case.values(), case.slopes(), strict=True
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(one, slope, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(two, slope, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("tier", TIERS)
def test_autograd_differentiates_twice(torch: Any, tier: Any) -> None:
    case = CASES["four_bar"]()
    f = kv.to_torch(case.outputs[0], case.inputs, tier=tier)
    x = torch.tensor(case.points, requires_grad=True)
    assert f(x).requires_grad
    assert not f(x.detach()).requires_grad
    assert torch.autograd.gradcheck(f, (x,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(f, (x,))
    wanted = kv.compile(case.outputs[0].jacobian(case.inputs).jacobian(case.inputs)[0, 1], case.inputs)
    found = torch.func.vmap(torch.func.hessian(lambda x: f(x)[0, 1]))(x.detach())
    np.testing.assert_allclose(found, wanted.batch(case.points), rtol=1e-12, atol=1e-12)


def test_derivatives_of_operations_agree_with_those_of_autograd_where_smooth(torch: Any) -> None:
    """Automatic differentiation of the very program, without rules of its own."""
    case = CASES["robot_arm"]()
    evaluate = load_operations(Program(case.outputs, case.inputs), [e.shape for e in case.outputs], m=torch)(
        False
    )
    x = torch.tensor(case.points[0])
    plain = torch.func.jacfwd(lambda x: evaluate(x, lambda n: torch.full((), n, dtype=torch.float64)))(x)
    for ours, theirs in zip(torch.func.jacfwd(kv.to_torch(case.outputs, case.inputs))(x), plain, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-14)


def test_every_operation_has_the_value_of_the_interpreter(torch: Any) -> None:
    program, points = operations()
    evaluate = load_operations(program, [()] * len(program.sizes), m=torch, erf=torch.erf)(False)
    results = evaluate(torch.tensor(points), lambda n: torch.full((), n, dtype=torch.float64))
    assert_same_operations(torch.stack(results, -1).numpy(), program, points)


@pytest.mark.compiler
def test_doubles_are_those_of_a_batch_for_any_leading_dimensions(torch: Any) -> None:
    mechanism = arm()
    wanted = kv.compile(mechanism.pose, mechanism.symbols, tier="c")
    f = kv.to_torch(mechanism.pose, mechanism.symbols, tier="c")
    for shape in ((7,), (0, 7), (24, 7), (2, 3, 4, 7)):
        points = torch.rand(shape, dtype=torch.float64)
        found = f(points)
        assert found.shape == (*shape[:-1], 4, 4)
        np.testing.assert_array_equal(found.reshape(-1, 4, 4), wanted.batch(points.reshape(-1, 7)))
    strided = torch.rand((7, 24), dtype=torch.float64).T
    np.testing.assert_array_equal(f(strided), wanted.batch(strided.numpy()))
    np.testing.assert_array_equal(f(torch._neg_view(strided)), wanted.batch(-strided.numpy()))
    with pytest.raises(InvalidValueError, match="The tensor is on meta, and tier 'c' is for the CPU"):
        f(points.to("meta"))


@pytest.mark.parametrize("tier", TIERS)
def test_results_have_the_type_of_the_argument(torch: Any, tier: Any) -> None:
    f = kv.to_torch([kv.rotation_z(A) * SIZE, A / 3, kv.array(0.1)], [A, SIZE], tier=tier)
    x = torch.rand((5, 2), dtype=torch.float64)
    double, single = f(x), f(x.float())
    assert {r.dtype for r in double} == {torch.float64}
    assert {r.dtype for r in single} == {torch.float32}
    for one, two in zip(single, double, strict=True):
        np.testing.assert_allclose(one, two, atol=2e-6)
    assert {r.dtype for r in torch.func.jacrev(f)(x[0].float())} == {torch.float32}
    assert {r.dtype for r in f([1, 2])} == {torch.get_default_dtype()}
    assert {r.dtype for r in f(torch.ones(2, dtype=torch.uint16))} == {torch.get_default_dtype()}


@pytest.mark.parametrize("tier", TIERS)
def test_derivatives_have_all_digits_with_autocast(torch: Any, tier: Any) -> None:
    f = kv.to_torch(kv.rotation_z(A) * SIZE, [A, SIZE], tier=tier)
    x, v = torch.rand((2, 5, 2))

    def derivatives() -> list[Any]:
        values, pull = torch.func.vjp(f, x)
        return [values, *pull(torch.ones_like(values)), *torch.func.jvp(f, (x,), (v,))]

    plain = derivatives()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for one, two in zip(derivatives(), plain, strict=True):
            assert torch.equal(one, two)


def test_operations_run_where_the_tensor_is(torch: Any) -> None:
    """The device ``meta`` has shapes and no numbers, and no processor either."""
    f = kv.to_torch([kv.rotation_z(A) * abs(SIZE), kv.array(2.0)], [A, SIZE])
    x = torch.zeros((5, 2), device="meta", requires_grad=True)
    turned, two = f(x)
    assert turned.device.type == two.device.type == "meta"
    assert turned.shape == (5, 4, 4)
    turned.sum().backward()
    assert x.grad.device.type == "meta"


@pytest.mark.parametrize("tier", TIERS)
def test_compiled_models_call_it_as_it_is(torch: Any, tier: Any) -> None:
    f = kv.to_torch(kv.rotation_z(A) * SIZE, [A, SIZE], tier=tier)

    def loss(x: Any) -> Any:
        return (f(2 * x) ** 2).sum()

    x = torch.rand((3, 2), dtype=torch.float64)
    plain, compiled = x.clone().requires_grad_(), x.clone().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the compiler
        torch.compile(loss, backend="aot_eager")(compiled).backward()
    loss(plain).backward()
    np.testing.assert_allclose(compiled.grad, plain.grad, rtol=1e-14)


@pytest.mark.parametrize("tier", TIERS)
def test_it_holds_no_expressions(torch: Any, tier: Any) -> None:
    case = CASES["four_bar"]()
    f = kv.to_torch(case.outputs, case.inputs, tier=tier)
    torch.func.jacrev(f)(torch.tensor(case.points[0]))
    assert_holds_no_expressions(f)


def test_without_a_compiler_it_is_interpreted(torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(c_library, "toolchain", lambda: None)
    f = kv.to_torch(A * B, [A, B])
    assert torch.func.grad(f)(torch.tensor([2.0, 3.0])).tolist() == [3, 2]
    with pytest.raises(CompileError, match="there is no C compiler"):
        kv.to_torch(A * B, [A, B], tier="c")


def test_wrong_use_is_told(torch: Any) -> None:
    f = kv.to_torch([A, kv.rotation_z(B)], [A, B])
    with pytest.raises(ShapeError, match=r"of shape \(\.\.\., 2\), with 'a', 'b' along its last axis"):
        f(torch.zeros(3))
    x = torch.ones(2)
    wrong: Any
    for wrong, said in (
        ({"a": 1.0, "b": 2.0}, "not a dict"),
        (np.ma.masked_array([1.0, 2.0], [False, True]), "not a MaskedArray"),
        ([x[0], 2.0], r"one tensor, not a list of tensors. Write torch\.stack\(values, dim=-1\)"),
        (([x[0], x[1]], [x[0], x[1]]), "not a tuple of tensors"),
    ):
        with pytest.raises(ShapeError, match=said):
            f(wrong)
    for wrong in (torch.float16, torch.bool, torch.complex128):
        with pytest.raises(InvalidValueError, match="float32 or float64, not torch"):
            f(torch.zeros(2, dtype=wrong))
    with pytest.raises(ExpressionError, match=r"swapped\? It is to_torch\(expressions, inputs\)"):
        kv.to_torch(A, "a")
    with pytest.raises(InvalidValueError, match="Unknown tier"):
        kv.to_torch(A, [A], tier="cuda")  # type: ignore[arg-type]


def test_the_example_on_the_page_runs(torch: Any) -> None:
    blocks = list(examples(ROOT / "docs" / "learning.md", "py"))
    assert blocks
    for block in blocks:
        exec(block.code, {})
