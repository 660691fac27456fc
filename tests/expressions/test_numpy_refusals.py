"""What numpy can do and expressions cannot is refused by an error of the project that says what to do.

Nothing becomes an array of objects in silence, and nothing is written into arrays of numbers.
"""

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import ExpressionError, ShapeError

a, b = kv.position("np/a"), kv.position("np/b")
e, m, out = kv.array([a, b]), kv.array([[a, b, 1.0], [b, a, 2.0]]), np.zeros(2)


def refused(call, message, error=ExpressionError):
    with pytest.raises(error, match=message):
        call()
    assert out.tolist() == [0, 0]


@pytest.mark.parametrize("call", [
    lambda: np.sin(e, out=out), lambda: np.add(e, 1, out=out), lambda: np.add(out, e, out), lambda: out.__iadd__(e),
    lambda: out.__imul__(a), lambda: np.add.reduce(m, axis=1, out=out),
])  # fmt: skip
def test_out_with_an_array_of_numbers_is_refused(call):
    refused(
        call, r"cannot write expressions into an existing array|reduce with the options \['axis', 'out'\]"
    )


@pytest.mark.parametrize("call", [
    lambda: np.take(e, [0, 1], 0, np.zeros(2, dtype=int)), lambda: np.take(e, [0], out=out),
    lambda: np.concatenate([e], 0, out), lambda: np.concatenate([e], out=out), lambda: np.stack([a, b], 0, out),
    lambda: np.concatenate([e], dtype=float), lambda: np.vstack([e, e], dtype=int), lambda: np.stack([e], casting="no"),
])  # fmt: skip
def test_rearranging_with_out_or_dtype_is_refused(call):
    refused(call, "neither out= nor dtype=")


@pytest.mark.parametrize("name", ["where", "dtype", "casting", "order", "subok"])
def test_unknown_options_of_ufuncs_are_refused(name):
    refused(lambda: np.sin(e, **{name: {"where": [True, False], "dtype": float, "casting": "no", "order": "C", "subok": True}[name]}),
            f"np.sin of expressions takes no {name}=; leave it out")  # fmt: skip


@pytest.mark.parametrize("call", [
    lambda: np.sum(m, out=out), lambda: np.mean(m, dtype=float), lambda: np.cumsum(m, dtype=float),
    lambda: np.max(m, initial=0), lambda: np.sum(m, where=True), lambda: np.diff(e, prepend=0),
    lambda: np.zeros_like(m, dtype=int), lambda: np.where(e), lambda: np.clip(e, 0, 1, out),
    lambda: np.prod(m, 0, float), lambda: np.einsum("i,i", e, e, out=out), lambda: np.trace(m, dtype=float),
])  # fmt: skip
def test_unknown_options_of_functions_are_refused(call):
    refused(call, r"of expressions: .* Its parameters are \w+")


@pytest.mark.parametrize("call", [
    lambda: np.add.accumulate(e), lambda: np.add.outer(e, e), lambda: np.add.at(out, [0], a), lambda: np.hypot.reduce(e),
    lambda: np.add.reduceat(e, [0]), lambda: np.add.reduce(e, initial=1), lambda: np.multiply.outer(out, e),
])  # fmt: skip
def test_unknown_methods_of_ufuncs_are_refused(call):
    refused(call, r"is not available for expressions; there is reduce, with axis= and keepdims=, of np\.add")


UNAVAILABLE = [
    np.any, np.all, np.sort, np.argmin, np.std, np.median, np.isnan, np.isfinite,
    np.unique, np.linalg.eig, np.linalg.pinv, np.linalg.cholesky, np.linalg.svd, np.conjugate,
    np.nan_to_num, np.array2string, np.iscomplexobj, np.modf, np.frexp, np.isinf, np.real,
]  # fmt: skip
WITH_MORE = [
    lambda: np.isclose(e, 1), lambda: np.var(e), lambda: np.argmax(e), lambda: np.linalg.lstsq(m, e), lambda: np.meshgrid(e, e),
    lambda: np.allclose(out, e), lambda: np.interp(a, [0, 1], [0, 1]), lambda: np.linspace(0, a, 3), lambda: np.pad(e, 1),
    lambda: np.copyto(out, e), lambda: np.full_like(out, a), lambda: np.polyval([1, 2], a),
    lambda: np.insert(e, 0, 1), lambda: np.logical_xor(e, e), lambda: np.heaviside(e, 1), lambda: np.searchsorted(out, a),
    lambda: np.convolve(e, e), lambda: np.average(e, weights=[1, 2]),
]  # fmt: skip


@pytest.mark.parametrize("call", [*(lambda f=f: f(e) for f in UNAVAILABLE), *WITH_MORE])
def test_unavailable_functions_are_refused_with_an_alternative(call):
    refused(
        call,
        r"is not available for expressions(; write .*)?\. Of numbers it is: call the expression with values first",
    )


def test_alternatives_in_messages_work():
    refused(lambda: np.interp(a, [0, 1], [0, 1]), r"; write kv\.spline\(x, knots, values\)\.")
    refused(lambda: np.any(e), r"; write logic, a \| b\.")
    refused(lambda: np.ma.array([1, 2]) * e, "is not an array of numbers")


@pytest.mark.parametrize("call", [
    lambda: np.array([a, b]), lambda: np.array(e), lambda: np.asarray(e), lambda: np.array([a, 1.0], dtype=object),
    lambda: np.asarray([[a], [b]]), lambda: np.full(3, a), lambda: np.float64(e), lambda: np.vectorize(abs)(e),
    lambda: np.asarray(e, dtype=float), lambda: np.arange(a), lambda: out.dot(e), lambda: out.__setitem__(slice(None), e),
    lambda: np.ones(3)[e], lambda: np.sum([a, b]), lambda: np.roll(out, a), lambda: np.take([1, 2, 3], a),
    lambda: np.array([e, e], dtype=object), lambda: np.stack([[a, b], [1, 2]]),
])  # fmt: skip
def test_conversion_to_an_array_of_numbers_is_refused(call):
    refused(
        call,
        r"An expression is not an array of numbers\. Call it with values.*build arrays .* with kv\.array",
    )


def test_elements_of_arrays_of_numbers_stay_numbers():
    for call in (lambda: out.__setitem__(0, a), lambda: out.fill(a), lambda: np.fromiter([a, b], float)):
        refused(call, "setting an array element", ValueError)  # numpy's own words


@pytest.mark.parametrize("call", [
    lambda: np.tile(e, 1.5), lambda: np.transpose(m, "x"), lambda: np.repeat(e, a), lambda: np.moveaxis(m, [a], 0),
    lambda: np.roll(e, shift=a), lambda: np.broadcast_to(e, a), lambda: np.reshape(e, (2, "x")),
    lambda: np.clip(e, 0, 1, min=0), lambda: np.clip(e, None, 1, max=0),
    lambda: np.linalg.norm(m, 1), lambda: np.linalg.norm(m, 2), lambda: np.linalg.norm(e, "fro"), lambda: np.linalg.norm(m, "nuc"),
    lambda: e * 1j, lambda: np.array([1j, 2]) * e, lambda: np.array(["a", "b"]) + e, lambda: np.array([1, None]) * e,
    lambda: e + "1", lambda: e + None, lambda: np.array(["2020"], dtype="M8[Y]") + a,
])  # fmt: skip
def test_wrong_arguments_are_refused(call):
    refused(call, "expression|one lower and one upper")


@pytest.mark.parametrize(("call", "message"), [
    (lambda: np.concatenate([e, np.zeros((2, 2))]), r"numpy\.concatenate: .*\(of shape \(2,\) and \(2, 2\)\)"),
    (lambda: np.stack([e, m]), r"numpy\.stack: .*\(of shape \(2,\) and \(2, 3\)\)"),
    (lambda: np.concatenate([a, b]), r"zero-dimensional .*\(of shape \(\) and \(\)\)"),
    (lambda: np.reshape(m, (4, 2)), r"\(of shape \(2, 3\)\)"), (lambda: np.squeeze(m, 0), r"\(of shape \(2, 3\)\)"),
    (lambda: np.transpose(m, (0, 0)), r"\(2, 3\)"), (lambda: np.flip(m, 2), r"\(2, 3\)"), (lambda: np.take(e, 2), r"\(2,\)"),
    (lambda: np.moveaxis(m, 3, 0), r"\(2, 3\)"), (lambda: np.diagonal(e), r"\(2,\)"), (lambda: np.broadcast_to(m, (3, 3)), r"\(2, 3\)"),
    (lambda: np.ones(3) + e, r"\(3,\) and \(2,\)"), (lambda: m @ m, r"\(2, 3\) and \(2, 3\)"), (lambda: e @ 2, "use \\*"),
    (lambda: np.ones((2, 2, 3)) @ e, r"\(2, 2, 3\)"), (lambda: np.ones((2, 3, 2)) @ np.stack([m[:, :2]] * 3), r"\(3, 2, 2\)"), (lambda: np.linalg.inv(m), r"square matrix .* \(2, 3\)"),
    (lambda: np.linalg.det(e), r"square matrix .* \(2,\)"), (lambda: np.cross(e, e), r"3-vectors"), (lambda: np.trace(e), "diag"),
    (lambda: np.sum(m, axis=2), "Axis 2"), (lambda: np.max(m, axis=(0, 0)), "Axis"), (lambda: np.mean(m, axis=1.0), "Axis 1.0"),
    (lambda: np.mean(kv.array([])), "Nothing has no mean"), (lambda: np.linalg.norm(kv.array([])), "empty"),
    (lambda: np.where([[a], [b], [a]], e, m), r"\(3, 1\)"), (lambda: np.vdot(e, m), r"\(2,\) and \(6,\)"),
    (lambda: np.linalg.solve(m, e), r"square matrix .* \(2, 3\)"), (lambda: np.linalg.matrix_power(m, 2), "square"),
    (lambda: np.einsum("ij,jk", m, m), "'j' of 'ij,jk' is an axis of length 3 and of length 2"), (lambda: np.einsum("ij,j", e, e), "'ij' in"),
    (lambda: np.tensordot(m, e, 1), "do not pair"),
    (lambda: np.linalg.norm(m, axis=2), "Axis 2"), (lambda: np.cumsum(m, axis=2), "Axis 2"), (lambda: np.diff(m, axis=2), "Axis 2"),
    (lambda: np.split(kv.array([a, b, 1.0]), 2), "equal division"), (lambda: np.block([[e], [m]]), r"\(2, 3\)"),
])  # fmt: skip
def test_incompatible_shapes_are_refused(call, message):
    refused(call, message, ShapeError)


@pytest.mark.parametrize("call", [
    lambda: np.einsum("ij,jk->i1", m, m.T), lambda: np.einsum("ij->ii", m), lambda: np.einsum("ij->k", m), lambda: np.einsum("i,i,i", e, e),
    lambda: np.einsum(e, [0], e, [0]), lambda: np.einsum("i.j", m), lambda: np.linalg.matrix_power(m[:, :2], 0.5), lambda: np.diff(e, -1),
])  # fmt: skip
def test_invalid_einsum_subscripts_are_refused(call):
    refused(call, "einsum|whole")


@pytest.mark.parametrize(("given", "message"), [
    (np.ma.array([1.0, 2.0], mask=[False, True]), r"masked array has elements without a value.*x\.filled\(number\)"),
    (np.ma.array([1, "x"], mask=[False, True], dtype=object), "masked array"), (np.ones((1, 2)).view(np.matrix), r"Write np\.asarray\(m\), and @"),
    (np.array([(1.0, 2)], dtype=[("x", float), ("y", int)]), "array of numbers"), (np.array([1j]), "array of numbers"),
])  # fmt: skip
def test_masked_arrays_and_matrices_are_refused(given, message):
    """Nothing that an array says beside its numbers is dropped in silence."""
    for call in (
        lambda: kv.array(given),
        lambda: e * given,
        lambda: kv.maximum(a, given),
        lambda: kv.array([given, given]),
    ):
        refused(call, message)


def test_masked_values_are_refused():
    masked = np.ma.array([1.0, 2.0], mask=[False, True])
    f = kv.compile(a + b, tier="interpreter")
    evaluator = f.bind()
    for call in (lambda: f(masked), lambda: evaluator(masked), lambda: f.batch(masked[None])):
        refused(call, r"masked array, some of whose entries have no value. Write x\.filled", ShapeError)
    for call in (
        lambda: f({a: masked[1], b: 1}),
        lambda: (a + b)({a: 1, b: masked[1]}),
        lambda: kv.State({"a": masked[1]}),
    ):
        refused(call, "is not a number: masked", kv.errors.InvalidValueError)
    assert f(masked.filled(0)) == 1


@pytest.mark.parametrize(
    ("name", "instead"),
    [
        ("std", "np.sqrt(np.mean((e - np.mean(e))**2))"),
        ("subs", "e.substitute({symbol: expression})"),
        ("eval", "e({name: number})"),
        ("inv", "np.linalg.inv(e)"),
    ],
)
def test_attributes_of_other_libraries_name_the_equivalent(name, instead):
    for e in (kv.position("x"), kv.rotation_z(kv.position("x")), kv.array([1.0, 2.0])):
        with pytest.raises(kv.errors.UnknownAttributeError) as error:
            getattr(e, name)
        assert str(error.value) == f"An expression has no {name!r}. Here that is {instead}."


def test_unknown_attributes_are_refused():
    e = kv.rotation_z(kv.position("x"))
    with pytest.raises(kv.errors.UnknownAttributeError, match=r"no 'gradiant'\. Did you mean 'gradient' or"):
        e.gradiant  # noqa: B018
    assert not hasattr(e, "__array_interface__")


def test_formats_of_numbers():
    x = kv.position("x")
    assert (f"{x:>3}", f"{x}", f"{kv.array(1.25):.1f}") == ("  x", "x", "1.2")
    with pytest.raises(
        kv.errors.ExpressionError, match=r"The format '\.2f' is one of numbers.*call it with values"
    ):
        f"{x:.2f}"
