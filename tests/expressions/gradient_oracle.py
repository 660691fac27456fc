"""The law of augmented gradients once more, in plain numpy and by itself: what the library is measured against.

A :class:`Value` is an array of numbers and a function that gives its D in one of two modes: with trends
(``heuristic=True``) or with facts alone. Entries of D are values again, so derivatives of any order follow.
"""

import numpy as np


class NearKink(Exception):  # noqa: N818 - not an error: the example says nothing
    """A comparison too close to call in floating point."""


class Value:
    def __init__(self, numbers, gradient=lambda heuristic: {}):
        self.v = np.asarray(numbers, dtype=float)
        self._gradient = gradient
        self._known = {}
        self.joined = {}  # the operands of a conjunction or disjunction: trends are over all of them together

    @property
    def shape(self):
        return self.v.shape

    def D(self, heuristic):
        if heuristic not in self._known:
            self._known[heuristic] = self._gradient(heuristic)
        return self._known[heuristic]


def linear(f, *operands):
    """A function that is linear in all operands together: sums, slices, stacks."""

    def gradient(heuristic):
        entries = [o.D(heuristic) for o in operands]
        return {
            key: linear(
                f, *(e.get(key, Value(np.zeros(o.shape))) for e, o in zip(entries, operands, strict=True))
            )
            for key in {k: None for e in entries for k in e}
        }

    return Value(f(*(o.v for o in operands)), gradient)


def bilinear(f, a, b):
    """A product: D(f(a, b)) = f(D(a), b) + f(a, D(b))."""

    def gradient(heuristic):
        of_a, of_b = a.D(heuristic), b.D(heuristic)
        result = {}
        for key in {**of_a, **of_b}:
            terms = [bilinear(f, of_a[key], b)] if key in of_a else []
            terms += [bilinear(f, a, of_b[key])] if key in of_b else []
            result[key] = terms[0] if len(terms) == 1 else add(*terms)
        return result

    return Value(f(a.v, b.v), gradient)


def chain(numbers, *parts):
    """Σ factor·D(operand): factors are computed only for operands that have a D."""

    def gradient(heuristic):
        result = {}
        for factor, operand in parts:
            for key, entry in operand.D(heuristic).items():
                term = mul(factor(), entry)
                result[key] = add(result[key], term) if key in result else term
        return result

    return Value(numbers, gradient)


def constant(numbers):
    return Value(numbers)


def symbol(s, number):
    return Value(number, lambda heuristic: {rate_of(s): Value(1.0)})


def rate_of(s):
    """The key of a symbol; that of a parameter is none that anyone sees, but what replaces it may move."""
    return s.derivative() if s.has_derivative else ("∂", s)


# -- arithmetic --------------------------------------------------------------------------------------------


def add(a, b):
    return linear(np.add, a, b)


def sub(a, b):
    return linear(np.subtract, a, b)


def neg(a):
    return linear(np.negative, a)


def mul(a, b):
    return bilinear(np.multiply, a, b)


def div(a, b):
    return mul(a, reciprocal(b))


def reciprocal(b):
    return chain(1 / b.v, (lambda: neg(reciprocal(mul(b, b))), b))


def power(a, b):
    whole = b.v == np.round(b.v)
    assert whole.all() or (a.v > 0).all()
    return chain(
        a.v**b.v, (lambda: mul(b, power(a, sub(b, Value(1.0)))), a), (lambda: mul(power(a, b), log(a)), b)
    )


def mod(a, b):
    return sub(a, mul(floor(div(a, b)), b))


def floor_divide(a, b):
    return floor(div(a, b))


def fmod(a, b):
    return sub(a, mul(trunc(div(a, b)), b))


def einsum(a, b):
    return matmul(a, linear(np.transpose, b))


def tensordot(a, b):
    return matmul(linear(np.transpose, a), b)


def solve(a, b):
    return matmul(inverse(a), b)


def matmul(a, b):
    return bilinear(np.matmul, a, b)


def cross(a, b):
    return bilinear(np.cross, a, b)


def outer(a, b):
    return bilinear(np.outer, a, b)


def inverse(a):
    def gradient(heuristic):
        return {k: neg(matmul(matmul(inverse(a), e), inverse(a))) for k, e in a.D(heuristic).items()}

    return Value(np.linalg.inv(a.v), gradient)


def det(a):
    def gradient(heuristic):  # Jacobi's formula
        return {k: mul(det(a), trace(matmul(inverse(a), e))) for k, e in a.D(heuristic).items()}

    return Value(np.linalg.det(a.v), gradient)


def trace(a):
    return linear(np.trace, a)


# -- elementary functions ----------------------------------------------------------------------------------


def square(a):
    return mul(a, a)


def sqrt(a):
    return chain(np.sqrt(a.v), (lambda: reciprocal(mul(Value(2.0), sqrt(a))), a))


def sin(a):
    return chain(np.sin(a.v), (lambda: cos(a), a))


def cos(a):
    return chain(np.cos(a.v), (lambda: neg(sin(a)), a))


def tan(a):
    return chain(np.tan(a.v), (lambda: add(Value(1.0), square(tan(a))), a))


def arcsin(a):
    return chain(np.arcsin(a.v), (lambda: reciprocal(sqrt(sub(Value(1.0), square(a)))), a))


def arccos(a):
    return chain(np.arccos(a.v), (lambda: neg(reciprocal(sqrt(sub(Value(1.0), square(a))))), a))


def arctan(a):
    return chain(np.arctan(a.v), (lambda: reciprocal(add(Value(1.0), square(a))), a))


def arctan2(y, x):
    def squared():
        return add(square(x), square(y))

    return chain(np.arctan2(y.v, x.v), (lambda: div(x, squared()), y), (lambda: neg(div(y, squared())), x))


def sinh(a):
    return chain(np.sinh(a.v), (lambda: cosh(a), a))


def cosh(a):
    return chain(np.cosh(a.v), (lambda: sinh(a), a))


def tanh(a):
    return chain(np.tanh(a.v), (lambda: sub(Value(1.0), square(tanh(a))), a))


def arcsinh(a):
    return chain(np.arcsinh(a.v), (lambda: reciprocal(sqrt(add(square(a), Value(1.0)))), a))


def arccosh(a):
    return chain(np.arccosh(a.v), (lambda: reciprocal(sqrt(sub(square(a), Value(1.0)))), a))


def arctanh(a):
    return chain(np.arctanh(a.v), (lambda: reciprocal(sub(Value(1.0), square(a))), a))


def exp(a):
    return chain(np.exp(a.v), (lambda: exp(a), a))


def expm1(a):
    return chain(np.expm1(a.v), (lambda: exp(a), a))


def log(a):
    return chain(np.log(a.v), (lambda: reciprocal(a), a))


def cbrt(a):
    return power(a, Value(1 / 3))


def exp2(a):
    return power(Value(2.0), a)


def log2(a):
    return div(log(a), Value(np.log(2.0)))


def log1p(a):
    return chain(np.log1p(a.v), (lambda: reciprocal(add(Value(1.0), a)), a))


# -- what has kinks ----------------------------------------------------------------------------------------


def compared(a, b):
    """Return the sign of a - b; floating point decides nothing here, except exact ties."""
    difference = a.v - b.v
    if (np.abs(difference) < 1e-6).any():
        raise NearKink
    return np.sign(difference)


def absolute(a):
    return mul(Value(compared(a, Value(0.0))), a)


def sign(a):
    return Value(compared(a, Value(0.0)))


def copysign(a, b):
    return mul(absolute(a), sign(b))


def floor(a):
    compared(a, Value(np.round(a.v)))
    return Value(np.floor(a.v))


def ceil(a):
    compared(a, Value(np.round(a.v)))
    return Value(np.ceil(a.v))


def rint(a):
    compared(a, Value(np.floor(a.v) + 0.5))
    return Value(np.round(a.v))


def trunc(a):
    compared(a, Value(np.round(a.v)))
    return Value(np.trunc(a.v))


def where(c, a, b):
    compared(c, Value(0.5))
    return selected(c.v >= 0.5, a, b)


def minimum(a, b):
    return selected(compared(a, b) < 0, a, b)


def maximum(a, b):
    return selected(compared(a, b) > 0, a, b)


def selected(chosen, a, b):
    return linear(lambda x, y: np.where(chosen, x, y), a, b)


def clip(x, lower, upper):
    return minimum(maximum(x, lower), upper)


def norm(a):
    return sqrt(linear(np.sum, square(a)))


def norms(a):
    return sqrt(linear(lambda x: np.sum(x, axis=1), square(a)))


def hypot(a, b):
    return sqrt(add(square(a), square(b)))


# -- augmentation and logic --------------------------------------------------------------------------------


def augment(value, entries, heuristic=False):
    def gradient(mode):
        own = value.D(mode)
        return own if heuristic and not mode else {**own, **_fitted(entries, value)}

    return Value(value.v, gradient)


def with_gradient(value, entries):
    return Value(value.v, lambda mode: _fitted(entries, value))


def _fitted(entries, value):
    return {k: linear(lambda x: np.broadcast_to(x, value.shape), e) for k, e in entries.items()}


def trend(numbers, *parts):
    full = chain(numbers, *parts)
    return Value(numbers, lambda heuristic: full.D(True) if heuristic else {})


def less(a, b, contrast):
    if contrast > 100:
        compared(a, b)
    return trend(
        (1 + np.tanh((b.v - a.v) * contrast)) / 2,
        (lambda: Value(-np.ones(np.broadcast_shapes(a.shape, b.shape))), a),
        (lambda: Value(np.ones(np.broadcast_shapes(a.shape, b.shape))), b),
    )


def logic_not(a):
    return trend(1 - a.v, (lambda: Value(-1.0), a))


def logic_and(*operands):
    """Σ (1 - v_i + P)·D_i."""
    operands = _flat("and", operands)
    product = np.prod(np.broadcast_arrays(*(o.v for o in operands)), axis=0)
    parts = [(lambda o=o: add(sub(Value(1.0), o), _product(operands)), o) for o in operands]
    return _remembering("and", operands, trend(product, *parts))


def logic_or(*operands):
    """Σ (v_i + Q)·D_i with Q = Π (1 - v_i)."""
    operands = _flat("or", operands)
    others = [sub(Value(1.0), o) for o in operands]
    none = np.prod(np.broadcast_arrays(*(o.v for o in others)), axis=0)
    result = trend(1 - none, *[(lambda o=o: add(o, _product(others)), o) for o in operands])
    return _remembering("or", operands, result)


def _flat(kind, operands):
    return [inner for o in operands for inner in o.joined.get(kind, [o])]


def _remembering(kind, operands, value):
    value.joined = {kind: operands}
    return value


def _product(operands):
    result = operands[0]
    for operand in operands[1:]:
        result = mul(result, operand)
    return result


# -- composition -------------------------------------------------------------------------------------------


def composed(outer_value, replacements):
    """e∘S of e evaluated where the symbols have the values of S: Σ (D(e)[ȧ]∘S)·D(S(a))[w] + the other keys."""
    rates = {rate_of(s): r for s, r in replacements.items()}

    def gradient(heuristic):
        result = {}
        for key, entry in outer_value.D(heuristic).items():
            carried = composed(entry, replacements)
            terms = {key: carried}
            if key in rates:
                terms = {w: mul(carried, rate) for w, rate in rates[key].D(heuristic).items()}
            for w, term in terms.items():
                result[w] = add(result[w], term) if w in result else term
        return result

    result = Value(outer_value.v, gradient)
    result.joined = {
        k: [composed(o, replacements) for o in joined] for k, joined in outer_value.joined.items()
    }
    return result
