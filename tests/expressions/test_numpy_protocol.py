"""numpy's functions on expressions: what they give, called with numbers, is what numpy gives of the numbers.

What is not available is the subject of ``test_numpy_refusals``, gradients that of ``test_law``.
"""

import operator
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import ShapeError
from kineverse.expressions import numpy_protocol as protocol

SYMBOLS = [kv.position(f"np/{i:03}") for i in range(200)]
a, b = SYMBOLS[:2]
few = settings(max_examples=attempts(25))


def symbolic(numbers, first=0):
    """An expression of the shape of some numbers, and the values at which it is these numbers."""
    flat = np.ravel(numbers).tolist()
    symbols = SYMBOLS[first : first + len(flat)]
    e = kv.array(symbols).reshape(np.shape(numbers)) if flat else kv.array(np.zeros(np.shape(numbers)))
    return e, dict(zip(symbols, flat, strict=True))


def same(function, *numbers, which=None, rtol=1e-13):
    """Compare a function of arrays, the ones in ``which`` as expressions, with numpy."""
    which = range(len(numbers)) if which is None else which
    given_, at = list(numbers), {}
    for i in which:
        given_[i], values = symbolic(numbers[i], 50 * i)
        at |= values
    expected = function(*numbers)
    found = function(*given_)
    if isinstance(expected, tuple) and not isinstance(found, kv.Expression):
        assert len(found) == len(expected)
    else:
        found, expected = [found], [expected]
    for one, wanted in zip(found, expected, strict=True):
        assert isinstance(one, kv.Expression)
        assert one.shape == np.shape(wanted)
        value = one(at)
        assert value.dtype == float
        np.testing.assert_allclose(value, np.asarray(wanted, dtype=float), rtol=rtol, atol=1e-14)


SIDES = st.integers(0, 3)
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
PAIRS = hnp.mutually_broadcastable_shapes(num_shapes=2, max_dims=3, min_side=0, max_side=3).map(
    lambda s: s.input_shapes
)
SOME = st.sampled_from([(0,), (1,), (0, 1)])  # which operands are expressions


def filled(shape, low=-2.0, high=2.0, seed=0):
    return np.random.default_rng([seed, *shape]).uniform(low, high, shape)


# -- ufuncs ------------------------------------------------------------------------------------------------

DOMAINS = {np.arcsin: (-1, 1), np.arccos: (-1, 1), np.arctanh: (-0.9, 0.9), np.arccosh: (1, 3), np.log: (0.1, 3),
           np.log1p: (-0.9, 2), np.sqrt: (0, 3), np.reciprocal: (0.5, 2), np.log10: (0.1, 3), np.log2: (0.1, 3), np.logical_not: None, np.invert: None}  # fmt: skip
LOGIC = {np.logical_and, np.logical_or, np.bitwise_and, np.bitwise_or}
STRUCTURAL = {np.equal, np.not_equal}
OF_MATRICES = {getattr(np, name, np.matmul) for name in ("matmul", "vecdot", "matvec", "vecmat")}
UFUNCS = [*protocol._UNARY_OPS, *protocol._BINARY_OPS, *protocol._UFUNCS]
UNARY = [u for u in UFUNCS if u.nin == 1]
BINARY = [u for u in UFUNCS if u.nin == 2 and u not in STRUCTURAL | OF_MATRICES]


def truths(ufunc):
    """The ufunc on 0.0 and 1.0 instead of bits."""
    plain = {np.invert: np.logical_not, np.bitwise_and: np.logical_and, np.bitwise_or: np.logical_or}
    return lambda *x: (
        ufunc(*x) if any(isinstance(o, kv.Expression) for o in x) else plain.get(ufunc, ufunc)(*x)
    )


@pytest.mark.parametrize("ufunc", UNARY, ids=lambda u: u.__name__)
@settings(max_examples=attempts(8))
@given(SHAPES)
def test_unary_ufuncs(ufunc, shape):
    domain = DOMAINS.get(ufunc, (-2, 2))
    numbers = filled(shape, *domain) if domain else filled(shape).round().clip(0, 1)
    same(truths(ufunc), numbers)


@pytest.mark.parametrize("ufunc", BINARY, ids=lambda u: u.__name__)
@settings(max_examples=attempts(12))
@given(PAIRS, SOME)
def test_binary_ufuncs(ufunc, shapes, which):
    first, second = (filled(shape, seed=seed) for seed, shape in enumerate(shapes))
    if ufunc in LOGIC:
        first, second = (x.round().clip(0, 1) for x in (first, second))
    elif ufunc in (np.power, np.float_power):
        first = np.abs(first) + 0.1
    same(truths(ufunc), first, second, which=which)


@pytest.mark.parametrize(
    "ufunc",
    [u for u in UNARY if u not in (np.log, np.log2, np.log10, np.reciprocal, np.arccosh)],
    ids=lambda u: u.__name__,
)
def test_unary_ufuncs_at_special_points(ufunc):
    points = np.array([0.0, 1.0]) if ufunc in DOMAINS else np.array([0.0, 1.0, -1.0, -2.0, 3.5, -3.5])
    with np.errstate(all="ignore"):
        same(truths(ufunc), points)


@pytest.mark.parametrize(
    "ufunc", [np.arctan2, np.copysign, np.hypot, np.minimum, np.fmax, np.floor_divide, np.remainder]
)
def test_binary_ufuncs_at_special_points(ufunc):
    x = np.array([0.0, 1.0, -1.0, 2.5, -7.0])
    y = np.array([1.0, -1.0, 2.0, -2.5]) if ufunc in (np.floor_divide, np.remainder) else x
    for which in ((0,), (1,), (0, 1)):
        same(lambda p, q: ufunc(p[..., None], q), x, y, which=which)


def test_comparisons_where_numpy_has_equality():
    """As with ``==``, equal or not is a question about structure; a comparison of equals is half true."""
    e = kv.array([a, b])
    for found in (np.equal(e, kv.array([a, b])), np.array_equal(e, [a, b]), not np.not_equal(e, [a, b])):
        assert found is True
    for found in (np.equal(e, np.ones(2)), np.ones(2) == e, np.array_equal(np.ones(3), e), e == np.ones(2)):
        assert found is False
    assert np.less_equal(a, 1.0)({a: 1.0}) == np.greater_equal(1.0, a)({a: 1.0}) == 0.5


# -- operators ---------------------------------------------------------------------------------------------

OPERATORS = [operator.add, operator.sub, operator.mul, operator.truediv, operator.floordiv, operator.mod, operator.pow,
             operator.lt, operator.gt, operator.le, operator.ge]  # fmt: skip


@pytest.mark.parametrize("op", OPERATORS, ids=lambda o: o.__name__)
@settings(max_examples=attempts(12))
@given(PAIRS, SOME, st.sampled_from(["array", "list", "integers", "scalar", "float32"]))
def test_operators_with_arrays_on_either_side(op, shapes, which, kind):
    first, second = (filled(shape, 0.3, 3, seed) for seed, shape in enumerate(shapes))
    as_given = {
        "array": lambda x: x,
        "list": lambda x: np.asarray(x).tolist(),
        "integers": lambda x: np.asarray(x).astype(int) + 1,
        "scalar": lambda x: np.float64(1.75),
        "float32": lambda x: np.asarray(x).astype(np.float32),
    }[kind]
    numbers = [x if i in which else as_given(x) for i, x in enumerate((first, second))]
    assume(kind != "list" or np.size(numbers[0]))  # [[], []] says less than its shape
    assume(kind != "list" or np.size(numbers[1]))
    same(op, *numbers, which=which)


@few
@given(st.integers(0, 3), st.integers(0, 3), st.integers(0, 3), st.booleans(), st.booleans(), SOME)
def test_matrix_products(n, k, m, left, right, which):
    first, second = filled((k,) if left else (n, k)), filled((k,) if right else (k, m), seed=1)
    for product in (operator.matmul, np.matmul, np.dot, getattr(np.linalg, "matmul", np.matmul)):
        same(product, first, second, which=which)
    same(lambda x, y: np.inner(x, y.T), first, second, which=which)
    if 0 in which:
        same(lambda x, y: x.dot(y), first, second, which=which)


@few
@given(SHAPES, SHAPES, SOME)
def test_products_that_flatten(shape, other, which):
    same(np.outer, filled(shape), filled(other, seed=1), which=which)
    same(np.vdot, filled(shape), filled(shape, seed=1), which=which)
    same(np.dot, filled(shape), np.array(1.5), which=which)
    same(np.inner, np.array(1.5), filled(shape), which=which)
    same(np.cross, filled((3,)), filled((3,), seed=1), which=which)


# -- functions ---------------------------------------------------------------------------------------------


@st.composite
def arrays(draw, min_dims=0, min_side=0):
    shape = draw(hnp.array_shapes(min_dims=min_dims, max_dims=3, min_side=min_side, max_side=3))
    return np.arange(np.prod(shape, dtype=int), dtype=float).reshape(shape) + 0.5


@few
@given(st.data())
def test_rearranging(data):
    x = data.draw(arrays(min_dims=1))
    axis, other = (data.draw(st.integers(-x.ndim, x.ndim - 1)) for _ in range(2))
    shift, order = data.draw(st.integers(-4, 4)), data.draw(st.sampled_from("CFA"))
    permutation = data.draw(st.permutations(range(x.ndim)))
    many = data.draw(hnp.valid_tuple_axes(x.ndim))
    for function in (
        np.transpose, np.ravel, np.squeeze, np.flip, np.flipud, np.atleast_1d, np.atleast_2d, np.atleast_3d,
        lambda y: np.transpose(y, permutation), lambda y: np.transpose(y, axes=permutation),
        lambda y: np.ravel(y, order=order), lambda y: np.reshape(y, (-1,), order=order),
        lambda y: np.reshape(y, y.shape[::-1], order), lambda y: np.expand_dims(y, axis),
        lambda y: np.expand_dims(y, axis=(0, -1)), lambda y: np.moveaxis(y, axis, other),
        lambda y: np.swapaxes(y, axis, other), lambda y: np.flip(y, axis), lambda y: np.flip(y, axis=many),
        lambda y: np.roll(y, shift), lambda y: np.roll(y, shift, axis=axis), lambda y: np.tile(y, 2),
        lambda y: np.tile(y, (2, 1, 2)), lambda y: np.repeat(y, 2), lambda y: np.repeat(y, 3, axis=axis),
        lambda y: np.broadcast_to(y, (2, *y.shape)), lambda y: y.T, lambda y: y.flatten(), lambda y: y[..., None],
    ):  # fmt: skip
        same(function, x)
    if x.shape[axis]:
        picked = data.draw(
            hnp.arrays(
                int,
                st.sampled_from([(), (2,), (2, 2)]),
                elements=st.integers(-x.shape[axis], x.shape[axis] - 1),
            )
        )
        same(lambda y: np.take(y, picked, axis=axis), x)
        same(lambda y: np.take(y, picked + 5, axis, mode="wrap"), x)
    if x.ndim > 1:
        same(np.fliplr, x)
        same(lambda y: np.rot90(y, shift), x)
        same(lambda y: np.diagonal(y, shift % 3 - 1), x)
        same(lambda y: np.diagonal(y, axis1=-1, axis2=0), x)
        for offset in (-1, 0, 2):
            same(lambda y, k=offset: np.trace(y, k), x)
            same(lambda y, k=offset: np.trace(y, k, axis1=-1, axis2=0), x)
            same(lambda y, k=offset: np.tril(y, k), x)
            same(lambda y, k=offset: np.triu(y, k), x)
            same(lambda y, k=offset: np.diagflat(y, k), x)
            same(lambda y, k=offset: np.diag(y, k), x) if x.ndim == 2 else None
    else:
        same(lambda y: np.diag(y, shift), x)
    for cut in (
        lambda y: np.array_split(y, 2, axis=axis), lambda y: np.split(y, [1], axis=axis), lambda y: np.vsplit(y, [1]) if y.ndim > 1 else np.hsplit(y, [1]),
        lambda y: np.dsplit(y, [1, 2]) if y.ndim > 2 else (y,), lambda y: np.split(y, y.shape[axis], axis) if y.shape[axis] else (y,),
        lambda y: getattr(np, "unstack", tuple)(y),
    ):  # fmt: skip
        same(lambda y, cut=cut: tuple(cut(y)), x)
    same(lambda y: np.delete(y, [0], axis=axis), x) if x.shape[axis] else None
    same(np.copy, x)


@few
@given(st.data())
def test_joining(data):
    x = data.draw(arrays(min_dims=1))
    axis, which = data.draw(st.integers(-x.ndim, x.ndim - 1)), data.draw(SOME)
    longer = np.concatenate([x, x], axis=axis) + 9
    same(lambda y, z: np.concatenate([y, z], axis=axis), x, longer, which=which)
    same(lambda y, z: np.concatenate((z, y, z), axis), x, longer, which=which)
    same(lambda y, z: np.concatenate([y, z], axis=None), x, longer, which=which)
    same(lambda y, z: np.stack([y, z], axis=axis), x, -x, which=which)
    for join in (np.stack, np.vstack, np.hstack, np.dstack, np.column_stack, np.concatenate):
        same(lambda y, z, join=join: join([y, z]), x, -x, which=which)
        same(lambda y, join=join: join(np.stack([y, y])), x)
    scalar = np.array(2.5)
    for join in (np.stack, np.vstack, np.hstack, np.dstack, np.column_stack):
        same(lambda y, z, join=join: join([y, z, 1.0]), scalar, -scalar, which=which)
    same(lambda y, z: np.atleast_2d(y, z), x, scalar, which=which)
    same(lambda y, z: np.append(y, z), x, longer, which=which)
    same(lambda y, z: np.append(y, z, axis=axis), x, longer, which=which)
    same(lambda y, z: np.block([[y, y], [y, y]]), x, x, which=(0,))
    same(lambda y, z: np.block([y, z]), scalar, x, which=which) if x.ndim == 1 else None


@few
@given(PAIRS, SOME)
def test_selections(shapes, which):
    first, second = (filled(shape, seed=seed) for seed, shape in enumerate(shapes))
    same(lambda x, y: np.where(x > 0, x, y) + 0 * y, first, second, which=which)
    same(lambda x, y: np.where(first > 0.3, x, y), first, second, which=which)
    for clip in (
        lambda x, y: np.clip(x, -0.5, y), lambda x, y: np.clip(x, y, None), lambda x, y: np.clip(x, a_min=y, a_max=1),
        lambda x, y: np.clip(x, max=y), lambda x, y: np.clip(x, min=-1, max=y),
    ):  # fmt: skip
        same(clip, first, second, which=which)


def call_quietly(function, x, axis):
    """Return what numpy gives, None if that is an error or NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = np.asarray(function(x, axis=axis))
        except ValueError:
            return None
    return None if np.isnan(found).any() else found


@settings(max_examples=attempts(9))
@given(arrays())
def test_reductions(x):
    x = x - 3
    for axis in [None, *range(-x.ndim, x.ndim), tuple(range(x.ndim)), ()]:
        for function in (np.sum, np.prod, np.mean, np.min, np.max, np.amin, np.amax, np.ptp):
            found = call_quietly(function, x, axis)
            if found is None:
                with pytest.raises(ShapeError, match="Nothing has no"):
                    function(symbolic(x)[0], axis=axis)
            elif found.size:
                same(lambda y, function=function, axis=axis: function(y, axis=axis), x)
                same(lambda y, function=function, axis=axis: function(y, axis=axis, keepdims=True), x)
        same(lambda y, axis=axis: y.sum(axis), x)
    if x.size:
        same(np.linalg.norm, x) if x.ndim else None
        same(lambda y: np.linalg.norm(y, "fro"), x) if x.ndim == 2 else None
        same(lambda y: np.linalg.norm(y, 2), x) if x.ndim == 1 else None
    e, _ = symbolic(x)
    assert (np.shape(e), np.ndim(e), np.size(e)) == (x.shape, x.ndim, x.size)
    assert [np.size(e, k) for k in range(x.ndim)] == list(x.shape)
    for axis in [None, *range(-x.ndim, x.ndim)]:
        same(lambda y, axis=axis: np.cumsum(y, axis), x) if x.ndim or axis is None else None
        same(lambda y, axis=axis: np.cumprod(y, axis=axis), x)
        if axis is not None:
            same(lambda y, axis=axis: np.diff(y, axis=axis), x)
            same(lambda y, axis=axis: np.diff(y, 2, axis), x)
    for like, number in ((np.zeros_like, 0), (np.ones_like, 1)):
        assert like(e).is_constant
        assert like(e)().tolist() == np.full(x.shape, number).tolist()


@pytest.mark.parametrize("n", range(7))
def test_matrices(n):
    x = filled((n, n), seed=n) + 2 * np.eye(n)
    same(np.linalg.inv, x, rtol=1e-10)
    same(np.linalg.det, x, rtol=1e-11)
    same(np.trace, x)
    for power in (-2, -1, 0, 1, 2, 5):
        same(lambda y, n=power: np.linalg.matrix_power(y, n), x, rtol=1e-9)
    for right in (filled((n,)), filled((n, 2))):
        same(np.linalg.solve, x, right, rtol=1e-10)
        same(np.linalg.solve, x, right, which=(0,), rtol=1e-10)
        same(np.linalg.solve, x, right, which=(1,), rtol=1e-10)


@few
@given(PAIRS, st.data())
def test_products_of_stacks(stacks, data):
    """Stacks of matrices and vectors are broadcast against each other, as numpy does it."""
    (first, second), which = stacks, data.draw(SOME)
    assume(len(first) < 3 and len(second) < 3 and np.prod(first) * np.prod(second) < 30)
    n, k, m = (data.draw(SIDES) for _ in range(3))
    a, b = filled((*first, n, k)), filled((*second, k, m), seed=1)
    same(operator.matmul, a, b, which=which)
    same(lambda x, y: np.einsum("...ij,...jk->...ik", x, y), a, b, which=which)
    vectors = filled((*second, k), seed=2)
    for name, given_ in {"vecdot": (filled((*first, k)), vectors), "matvec": (a, vectors), "vecmat": (vectors, b)}.items():  # fmt: skip
        if hasattr(np, name):
            same(getattr(np, name), *given_, which=which)
    if hasattr(np.linalg, "vecdot"):
        same(np.linalg.vecdot, filled((*first, k)), vectors, which=which)
    same(np.kron, a, vectors, which=which)
    same(np.dot, a, filled((*first, k, 2), seed=3), which=which)
    same(np.inner, a, filled((*second, 2, k), seed=3), which=which)
    same(lambda x, y: np.tensordot(x, y, (-1, len(second))), a, b, which=which)
    same(lambda x, y: np.tensordot(x, y, 0), a, vectors, which=which)
    if n and m:
        same(lambda x, y: np.linalg.multi_dot([x, y, y.T]), filled((n, k)), filled((k, m)), which=which)
    threes = filled((*first, 3)), filled((*second, 3), seed=1)
    same(np.cross, *threes, which=which)
    same(lambda x, y: np.cross(x, y, axisa=0, axisc=0), np.moveaxis(threes[0], -1, 0), threes[1], which=which)


@pytest.mark.parametrize("subscripts", [
    "ij->ji", "ij->", "ii", "ii->i", "ij,jk", "ij,kj->ik", "ij,ij->i", "ij,jk,kl->il", "i,j", "i,j->ji", "i,i", "ij,j,i->",
    "...i->...", "...i,...i", "...ij,...jk->...ik", "i...,i...->...", "ab, bc -> ca", "ii,ij->j", "ij,k->kij",
])  # fmt: skip
def test_einsum(subscripts):
    operands = subscripts.split("->")[0].replace(" ", "").split(",")
    numbers = [
        filled((2,) * (len(o.replace("...", "")) + 2 * ("..." in o)), seed=k) for k, o in enumerate(operands)
    ]
    same(lambda *x: np.einsum(subscripts, *x), *numbers)
    same(lambda *x: np.einsum(subscripts, *x), *numbers, which=(0,))


def test_norms_along_axes():
    x = filled((2, 3, 3))
    for axis in (0, 1, -1):
        for order in (None, 2, 1, np.inf, -np.inf):
            for keepdims in (False, True):
                same(lambda y, o=order, a=axis, k=keepdims: np.linalg.norm(y, o, a, k), x)
                if hasattr(np.linalg, "vector_norm") and order:
                    same(
                        lambda y, o=order, a=axis, k=keepdims: np.linalg.vector_norm(
                            y, ord=o, axis=a, keepdims=k
                        ),
                        x,
                    )
    same(lambda y: np.linalg.norm(y, axis=(0, 2)), x)
    same(lambda y: np.linalg.norm(y, "fro", axis=(1, 2), keepdims=True), x)
    same(lambda y: np.linalg.norm(y, 1), x[0, 0])
    if hasattr(np.linalg, "matrix_norm"):
        same(np.linalg.matrix_norm, x)
        same(lambda y: np.linalg.vector_norm(y), x)
    for name in ("matrix_transpose", "diagonal", "trace"):
        same(getattr(np.linalg, name), x) if hasattr(np.linalg, name) else None
    same(lambda y: np.linalg.diagonal(y, offset=1), x) if hasattr(np.linalg, "diagonal") else None
    for name in ("cross", "tensordot"):
        if hasattr(np.linalg, name):
            same(getattr(np.linalg, name), x[0], x[1])
    same(np.linalg.outer, x[0, 0], x[1, 1]) if hasattr(np.linalg, "outer") else None


@pytest.mark.parametrize("call", [
    lambda y: y.sum(), lambda y: y.sum(0, keepdims=True), lambda y: y.prod(axis=1), lambda y: y.mean(), lambda y: y.mean(axis=(0, 1)),
    lambda y: y.min(axis=0), lambda y: y.max(), lambda y: y.clip(-1, 1), lambda y: y.clip(max=0.5), lambda y: y.copy(),
    lambda y: y.trace(), lambda y: y.trace(1), lambda y: y.diagonal(), lambda y: y.diagonal(-1), lambda y: y[:, None].squeeze(),
    lambda y: y.astype(float), lambda y: np.asarray(y.item(1, 2)) if isinstance(y, np.ndarray) else y.item(1, 2),
    lambda y: np.asarray(y.item(4)) if isinstance(y, np.ndarray) else y.item(4), lambda y: y.dot(y[0]), lambda y: y.round(1),
    lambda y: y.flatten(), lambda y: y.ravel(), lambda y: y.reshape(9), lambda y: y.reshape((1, -1)), lambda y: y.transpose(1, 0),
    lambda y: y.cumsum(), lambda y: y.cumprod(axis=1), lambda y: y.swapaxes(0, 1), lambda y: y.repeat(2, axis=0),
    lambda y: y.take([0, 2], axis=1), lambda y: divmod(y, 0.7), lambda y: divmod(2.5, y), lambda y: np.divmod(y, 0.7),
    lambda y: np.fix(y), lambda y: np.around(y, 2), lambda y: np.round(100 * y, -1), lambda y: getattr(np, "astype", lambda z, _: z)(y, float),
])  # fmt: skip
def test_methods_of_arrays(call):
    same(call, filled((3, 3)))


def test_methods_that_give_scalars():
    e = kv.array([[a, 2 * b]])
    assert e.tolist() == [[a, 2 * b]]
    assert a.tolist() is a
    assert a.item() is a
    assert round(a / 3, 2)({a: 1.0}) == 0.33
    assert round(a)({a: 2.5}) == 2
    for call, message in (
        (e.item, r"item\(\) is the element of an array that has one, and this has shape \(1, 2\)"),
        (lambda: e.astype(int), "64-bit floats, not int64. Call it with values"),
        (lambda: int(a), r"float\(\) needs a constant scalar"),
    ):
        with pytest.raises(kv.errors.ExpressionError, match=message):
            call()


def test_every_function_is_compared():
    """What is added to the tables is to be added here."""
    names = {
        f.__name__
        for f in (*protocol._FUNCTIONS, *protocol._REARRANGING, *protocol._SPREADING, *protocol._JOINING)
    }
    here = Path(__file__).read_text(encoding="utf-8")
    assert [name for name in sorted(names) if not re.search(rf"\b{name}\b", here)] == []
