"""Random programs over everything an expression can do, run by the library and by the oracle.

A program is a nested tuple ``(operation, options, *operands)``. Functions that need a domain get it inside the
program, so no example is thrown away for it.
"""

import functools
import operator

import gradient_oracle as oracle
import numpy as np
from hypothesis import strategies as st

from kineverse import logic
from kineverse.expressions import array
from kineverse.expressions import functions as f
from kineverse.symbols import Symbol, parameter, position, velocity

S, V3, M23, M33 = (), (3,), (2, 3), (3, 3)


class Vocabulary:
    """The symbols of a set of programs; mutants get their own, as equal nodes are shared and cached."""

    def __init__(self, namespace):
        self.positions = [position(f"{namespace}/{name}") for name in "abc"]
        self.others = [
            velocity(f"{namespace}/a"),
            velocity(f"{namespace}/wheel"),
            parameter(f"{namespace}/p", 0.7),
        ]
        self.symbols = [*self.positions, *self.others]
        self.keys = [
            *(s.derivative() for s in self.positions),
            velocity(f"{namespace}/wheel"),
            Symbol(f"{namespace}/a", 2),
        ]
        everything = [*self.symbols, *self.keys]
        numbers = np.random.default_rng(7).uniform(0.2, 1.3, len(everything)) * [
            1,
            -1,
            1,
            1,
            -1,
            1,
            1,
            1,
            -1,
            1,
            1,
        ]
        self.values = {s: float(x) for s, x in zip(everything, numbers, strict=True)}


# -- the library's side ------------------------------------------------------------------------------------


ELEMENTWISE = {
    "sin": np.sin, "cos": f.cos, "tan": np.tan, "arcsin": f.arcsin, "arccos": np.arccos, "arctan": np.arctan,
    "sinh": np.sinh, "cosh": f.cosh, "tanh": np.tanh, "arcsinh": np.arcsinh, "arccosh": np.arccosh,
    "arctanh": f.arctanh, "exp": np.exp, "expm1": np.expm1, "log": np.log, "log1p": f.log1p, "sqrt": np.sqrt,
    "square": np.square, "absolute": abs, "sign": np.sign, "floor": np.floor, "ceil": f.ceil, "neg": operator.neg,
    "reciprocal": np.reciprocal, "logic_not": operator.invert, "cbrt": np.cbrt, "log2": np.log2, "exp2": np.exp2,
    "rint": np.round, "trunc": np.trunc,
}  # fmt: skip

PAIRWISE = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "power": operator.pow, "mod": operator.mod, "arctan2": np.arctan2, "copysign": np.copysign,
    "hypot": np.hypot, "minimum": np.minimum, "maximum": f.maximum,
    "logic_and": operator.and_, "logic_or": operator.or_,
    "iadd": operator.iadd, "isub": operator.isub, "imul": operator.imul, "itruediv": operator.itruediv,
    "imatmul": operator.imatmul, "matmul": operator.matmul, "cross": np.cross, "outer": np.outer,
    "floor_divide": operator.floordiv, "fmod": np.fmod, "solve": np.linalg.solve,
    "einsum": lambda a, b: np.einsum("ij,kj->ik", a, b), "tensordot": lambda a, b: np.tensordot(a, b, (0, 0)),
}  # fmt: skip

STRUCTURAL = {
    "inverse": np.linalg.inv, "det": np.linalg.det, "trace": np.trace, "norm": np.linalg.norm, "T": lambda x: x.T,
    "sum": np.sum, "sum0": lambda x: np.sum(x, axis=0), "mean": np.mean, "flip": np.flip, "first": lambda x: x[0],
    "last": lambda x: x[..., -1], "ravel": lambda x: x.ravel()[1:4], "rows": lambda x: x[1:],
    "reversed": lambda x: x[::-1], "reshape": lambda x: x.reshape(3, -1)[:, 0], "masked": lambda x: x[[2, 0, 1]],
    "element": lambda x: x[-1, 1], "roll": lambda x: np.roll(x, 1), "diagonal": np.diagonal,
    "index": lambda x: x[1], "column": lambda x: x[:, 1], "norms": lambda x: np.linalg.norm(x, axis=1),
    "cumsum": lambda x: np.cumsum(x, axis=0), "diag": np.diag,
}  # fmt: skip

JOINING = {
    "concatenate": lambda *x: np.concatenate(x), "stack": lambda *x: np.stack(x), "vstack": lambda *x: np.vstack(x),
    "array": lambda *x: array(list(x)), "nested": lambda *x: array([[*x], [x[1], 2.0, x[0]], [0.5, *x[1:]]]),
    "stack1": lambda *x: np.stack(x, axis=1),
}  # fmt: skip


def build(program, vocabulary):
    """Run a program with the library."""
    kind, options, *operands = program
    if kind == "symbol":
        return vocabulary.symbols[options]
    if kind == "constant":
        return np.array(options) if np.shape(options) else options
    if kind in ("augment", "heuristic", "with_gradient"):
        value, *entries = (build(o, vocabulary) for o in operands)
        value = array(value) if not hasattr(value, "augment") else value
        given = dict(zip((vocabulary.keys[i] for i in options), entries, strict=True))
        if kind == "with_gradient":
            return value.with_gradient(given)
        return value.augment(given, heuristic=kind == "heuristic")
    if kind == "substitute":
        value, *replacements = (build(o, vocabulary) for o in operands)
        chosen = [vocabulary.symbols[i] for i in options]
        return array(value).substitute(dict(zip(chosen, replacements, strict=True)))
    values = [build(o, vocabulary) for o in operands]
    if kind == "less":
        return logic.less(*values, contrast=options)
    if kind == "where":
        return f.where(*values)
    if kind == "clip":
        return np.clip(array(values[0]), *values[1:])
    if kind == "logic_all":
        return logic.logic_and(*values)
    if kind == "logic_any":
        return logic.logic_or(*values)
    for table in (ELEMENTWISE, STRUCTURAL):
        if kind in table:
            return table[kind](array(values[0]))
    if kind in JOINING:
        return JOINING[kind](*values)
    left, right = values
    if not hasattr(left, "gradient") and (kind.startswith("i") or not hasattr(right, "gradient")):
        left = array(left)
    return PAIRWISE[kind](left, right)


# -- the oracle's side -------------------------------------------------------------------------------------

_SAME = {"iadd": "add", "isub": "sub", "imul": "mul", "itruediv": "div", "imatmul": "matmul"}
_LINEAR = {
    **{k: STRUCTURAL[k] for k in STRUCTURAL if k not in ("inverse", "det", "norm", "norms")},
    **{k: JOINING[k] for k in JOINING if k not in ("array", "nested")},
    "array": lambda *x: np.array(x),
    "nested": None,
}


def interpret(program, vocabulary, values):
    """Run a program with the oracle."""
    kind, options, *operands = program
    if kind == "symbol":
        s = vocabulary.symbols[options]
        return values[s] if isinstance(values[s], oracle.Value) else oracle.symbol(s, values[s])
    if kind == "constant":
        return oracle.constant(options)
    if kind == "substitute":
        value, *replacements = operands
        chosen = [vocabulary.symbols[i] for i in options]
        by = {s: interpret(r, vocabulary, values) for s, r in zip(chosen, replacements, strict=True)}
        inside = interpret(value, vocabulary, {**values, **{s: float(r.v) for s, r in by.items()}})
        return oracle.composed(inside, by)
    results = [interpret(o, vocabulary, values) for o in operands]
    if kind in ("augment", "heuristic", "with_gradient"):
        given = dict(zip((vocabulary.keys[i] for i in options), results[1:], strict=True))
        if kind == "with_gradient":
            return oracle.with_gradient(results[0], given)
        return oracle.augment(results[0], given, heuristic=kind == "heuristic")
    if kind == "less":
        return oracle.less(*results, options)
    if kind in ("logic_all", "logic_any"):
        return (oracle.logic_and if kind == "logic_all" else oracle.logic_or)(*results)
    if kind == "nested":
        two, half = oracle.constant(2.0), oracle.constant(0.5)
        entries = [*results, results[1], two, results[0], half, *results[1:]]
        return oracle.linear(lambda *x: np.array(x).reshape(3, 3), *entries)
    if kind in _LINEAR:
        return oracle.linear(_LINEAR[kind], *results)
    return getattr(oracle, _SAME.get(kind, kind))(*results)


# -- strategies --------------------------------------------------------------------------------------------

# Strategies are made once: to make and check them anew for every draw takes longer than all that is drawn.


@functools.cache
def choice(*values):
    """Return a strategy that draws one of some values."""
    return st.sampled_from(values)


@functools.cache
def several(least, most, last):
    """Return a strategy that draws some different numbers from 0 to a last one."""
    return st.lists(st.integers(0, last), min_size=least, max_size=most, unique=True)


def apply(kind, *operands, options=None):
    return (kind, options, *operands)


def const(x):
    return ("constant", x)


def _positive(x):
    return apply("add", apply("square", x), const(0.6))


def _bounded(x):
    return apply("mul", const(0.8), apply("sin", x))


_DOMAIN = {
    "arcsin": _bounded, "arccos": _bounded, "arctanh": _bounded, "log": _positive, "log1p": _positive,
    "sqrt": _positive, "reciprocal": _positive, "arccosh": lambda x: apply("add", _positive(x), const(1.0)),
    "cbrt": _positive, "log2": _positive, "exp2": _bounded, "tan": _bounded, "sinh": _bounded, "cosh": _bounded, "exp": _bounded, "expm1": _bounded,
}  # fmt: skip


def _numbers(shape):
    size = int(np.prod(shape))
    values = st.lists(st.integers(-8, 8).map(lambda k: k / 4 + 0.05), min_size=size, max_size=size)
    return values.map(lambda x: np.reshape(x, shape).tolist())


@functools.cache
def leaf(shape):
    symbols = st.integers(0, 5).map(lambda i: ("symbol", i))
    if shape == S:
        return st.one_of(symbols, symbols, _numbers(S).map(const))
    if shape == V3:
        return st.one_of(
            st.tuples(symbols, symbols, symbols).map(lambda x: apply("array", *x)), _numbers(V3).map(const)
        )
    if shape == M23:
        return st.tuples(leaf(V3), leaf(V3)).map(lambda x: apply("stack", *x))
    return st.one_of(
        st.tuples(symbols, symbols, symbols).map(lambda x: apply("nested", *x)), _numbers(M33).map(const)
    )


SMOOTH = ("pairwise", "pairwise", "structural", "structural", "elementwise")
EVERYTHING = (*SMOOTH, "augmented", "augmented", "truth", "selection")


@functools.cache
@st.composite
def programs(draw, shape=S, depth=3, kinds=EVERYTHING):
    if depth == 0:
        return draw(leaf(shape))

    def inner(inner_shape=shape, less=1):
        return draw(programs(inner_shape, max(depth - less, 0), kinds))

    def fitting():
        shapes = {S: [S], V3: [V3, V3, S], M23: [M23, M23, V3, S], M33: [M33, M33, V3, S]}[shape]
        return inner(draw(choice(*shapes)))

    def elementwise():
        kind = draw(choice(*sorted(set(ELEMENTWISE) - {"logic_not"})))
        return apply(kind, _DOMAIN.get(kind, lambda x: x)(inner()))

    def pairwise():
        names = ["add", "sub", "mul", "mul", "div", "power", "integer", "mod", "arctan2", "copysign", "hypot"]
        names += ["floor_divide", "fmod"]
        kind = draw(choice(*names, "minimum", "maximum", "iadd", "isub", "imul", "itruediv"))
        a, b = inner(), fitting()
        if draw(st.booleans()) and not kind.startswith("i"):
            a, b = b, a
        if kind in ("div", "mod", "floor_divide", "fmod", "itruediv"):
            b = _positive(b)
        elif kind in ("arctan2", "hypot"):
            a = _positive(a)
        elif kind == "power":
            a, b = _positive(_bounded(a)), _bounded(b)
        elif kind == "integer":
            kind, b = "power", const(draw(choice(0.0, 1.0, 2.0, 3.0, -1.0, -2.0)))
            a = _positive(a) if b[1] < 0 else a
        return apply(kind, a, b)

    def selection():
        if draw(choice("where", "clip")) == "where":
            return apply("where", truth(), inner(), fitting())
        return apply("clip", inner(), const(-0.513), const(0.467))

    def truth(level=2):
        kind = draw(
            choice("less", "less", "sharp", "logic_and", "logic_or", "logic_not", "logic_all", "logic_any")
        )
        if kind in ("less", "sharp") or level == 0:
            contrast = 1e10 if kind == "sharp" else 2.0
            return apply("less", inner(less=2), fitting(), options=contrast)
        if kind == "logic_not":
            return apply(kind, truth(level - 1))
        count = 3 if kind in ("logic_all", "logic_any") else 2
        return apply(kind, *(truth(level - 1) for _ in range(count)))

    def augmented():
        kind = draw(choice("augment", "augment", "heuristic", "with_gradient"))
        keys = draw(several(0, 3, 4))
        return apply(kind, inner(), *(fitting() for _ in keys), options=tuple(keys))

    def structural():
        if shape == S:
            kind = draw(
                choice("norm", "sum", "mean", "trace", "det", "element", "index", "matmul", "raveled")
            )
            if kind == "norm":
                return apply("norm", apply("concatenate", inner(V3), const([0.3])))
            if kind == "matmul":
                return apply("matmul", inner(V3), inner(V3))
            if kind == "det":
                return apply("det", invertible())
            sources = {"trace": [M33], "element": [M33, M23], "index": [V3], "raveled": [M33]}
            source = inner(draw(choice(*sources.get(kind, [V3, M23]))))
            return apply("index", apply("ravel", source)) if kind == "raveled" else apply(kind, source)
        if shape == V3:
            kind = draw(
                choice(
                    *("first", "column", "ravel", "diagonal", "masked", "sum0", "Mv", "vM", "cross", "array"),
                    *("solve", "norms", "cumsum"),
                )
            )
            if kind == "solve":
                return apply("solve", invertible(), inner(V3))
            if kind == "norms":
                return apply("norms", apply("stack1", inner(V3), inner(V3), const([0.3, 0.4, 0.5])))
            if kind == "array":
                return apply("array", inner(S), inner(S), inner(S))
            if kind == "cross":
                return apply("cross", inner(V3), inner(V3))
            if kind in ("Mv", "vM"):
                pair = inner(M33), inner(V3)
                return apply("matmul", *(pair if kind == "Mv" else pair[::-1]))
            source = {"column": M33, "diagonal": M33, "masked": V3, "cumsum": V3}.get(kind, M23)
            return apply(kind, inner(source))
        if shape == M23:
            kind = draw(choice("rows", "stack", "vstack", "matmul", "imatmul"))
            if kind == "rows":
                return apply(kind, inner(M33))
            if kind in ("stack", "vstack"):
                return apply(kind, inner(V3), inner(V3))
            return apply(kind, inner(M23), inner(M33))
        kind = draw(
            choice(
                "inverse",
                "T",
                "matmul",
                "outer",
                "vstack",
                "stack1",
                "flip",
                "roll",
                "reversed",
                "einsum",
                "tensordot",
                "crosses",
                "diag",
                "cumsum",
            )
        )
        if kind == "einsum" or kind == "tensordot":
            return apply(kind, inner(), inner())
        if kind == "crosses":
            return apply("cross", inner(), inner(V3))
        if kind == "diag":
            return apply(kind, inner(V3))
        if kind == "inverse":
            return apply(kind, invertible())
        if kind == "outer":
            return apply(kind, inner(V3), inner(V3))
        if kind == "vstack":
            return apply(kind, inner(V3), inner(M23))
        if kind == "stack1":
            return apply(kind, inner(V3), inner(V3), inner(V3))
        return apply(kind, inner(), inner()) if kind == "matmul" else apply(kind, inner())

    def invertible():
        return apply(
            "add", apply("mul", const(0.4), apply("tanh", inner(M33))), const((1.5 * np.eye(3)).tolist())
        )

    chosen = {
        "elementwise": elementwise,
        "pairwise": pairwise,
        "selection": selection,
        "truth": truth,
        "augmented": augmented,
        "structural": structural,
    }
    return chosen[draw(choice(*kinds))]()


@functools.cache
@st.composite
def nested(draw, shape=S, levels=3):
    """Draw augment inside augment inside augment, with something in between: general programs hardly ever do."""
    program = draw(programs(shape, 1))
    for _ in range(levels):
        between = draw(choice("nothing", "sin", "mul", "add", "select", "logic", "maximum", "double"))
        other = draw(programs(shape, 1))
        program = {
            "nothing": program,
            "sin": apply("sin", program),
            "mul": apply("mul", program, other),
            "add": apply("add", other, program),
            "select": apply("where", apply("less", other, const(0.1), options=1e10), program, other),
            "logic": apply("logic_and", apply("less", program, other, options=2.0), other),
            "maximum": apply("maximum", program, other),
            "double": apply("div", program, _positive(program)),
        }[between]
        kind = draw(choice("augment", "augment", "augment", "heuristic", "with_gradient"))
        keys = draw(several(1, 2, 4))
        entries = [
            draw(st.one_of(programs(shape, 1), st.just(apply("mul", const(2.0), program)))) for _ in keys
        ]
        program = apply(kind, program, *entries, options=tuple(keys))
    return program


@functools.cache
@st.composite
def compositions(draw, shape=S):
    """Draw a substitution into a program that is likely to be augmented by keys of replaced symbols."""
    inside = draw(st.one_of(nested(shape, 2), programs(shape, 2)))
    chosen = draw(several(1, 4, 5))
    replacements = [draw(st.one_of(programs(S, 1), nested(S, 1), leaf(S))) for _ in chosen]
    program = apply("substitute", inside, *replacements, options=tuple(chosen))
    around = draw(choice("nothing", "mul", "again"))
    if around == "mul":
        return apply("mul", program, draw(programs(shape, 1)))
    if around == "again":
        again = draw(several(1, 2, 2))
        return apply("substitute", program, *(draw(programs(S, 1)) for _ in again), options=tuple(again))
    return program
