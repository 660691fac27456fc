r"""Expressions and gradients as text and LaTeX of bounded length, and numbers with few digits.

In LaTeX, velocities are ``\dot{a}`` and arrays are matrices. It has only commands that TeX and MathJax, which
notebooks use, know alike. Names are escaped: they come from files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from itertools import islice
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from .expression import NODES, SYMBOLS, Expression
from .layout import SX, column, rows_and_columns

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

_LIMIT = 400
_ELEMENTS = 16
_DEPTH = 24
_LONGEST_MAPPING = 4 * _LIMIT

_INFIX = {ca.OP_ADD: ("+", 1), ca.OP_SUB: ("-", 1), ca.OP_MUL: ("*", 2), ca.OP_DIV: ("/", 2)}
_COMPARISONS = {
    ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!=", ca.OP_AND: "and", ca.OP_OR: "or",
}  # fmt: skip
_POWERS = (ca.OP_POW, ca.OP_CONSTPOW)
_FUNCTIONS = {
    ca.OP_SQRT: "sqrt", ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_ASIN: "arcsin",
    ca.OP_ACOS: "arccos", ca.OP_ATAN: "arctan", ca.OP_ATAN2: "arctan2", ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh", ca.OP_TANH: "tanh", ca.OP_ASINH: "arcsinh", ca.OP_ACOSH: "arccosh",
    ca.OP_ATANH: "arctanh", ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_FABS: "abs", ca.OP_SIGN: "sign",
    ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_FMIN: "minimum", ca.OP_FMAX: "maximum",
    ca.OP_IF_ELSE_ZERO: "if_else_zero", ca.OP_NOT: "not", ca.OP_EXPM1: "expm1", ca.OP_LOG1P: "log1p",
    ca.OP_COPYSIGN: "copysign", ca.OP_HYPOT: "hypot", ca.OP_FMOD: "fmod",
}  # fmt: skip


_LONGEST_FORMULA = 3000  # characters of LaTeX; notebooks take a second for ten times as many
_EDGE = 6  # most rows and columns of a matrix that are shown; the size of a Jacobian of a pose
_ENTRIES = 12  # most entries of a gradient that are shown

_NAMED = {
    "sin": r"\sin", "cos": r"\cos", "tan": r"\tan", "arcsin": r"\arcsin", "arccos": r"\arccos",
    "arctan": r"\arctan", "sinh": r"\sinh", "cosh": r"\cosh", "tanh": r"\tanh", "exp": r"\exp",
    "log": r"\ln", "minimum": r"\min", "maximum": r"\max",
}  # fmt: skip
_BRACKETS = {
    "sqrt": (r"\sqrt{", "}"), "abs": (r"\left|", r"\right|"),
    "floor": (r"\lfloor ", r"\rfloor "), "ceil": (r"\lceil ", r"\rceil "),
}  # fmt: skip
_SIGNS = {
    "<": r"\lt ", "<=": r"\le ", "==": "=", "!=": r"\ne ", "and": r"\land ", "or": r"\lor ",
    "less": r"\lt ",
}  # fmt: skip
_ESCAPED = {
    **{c: f"\\{c}" for c in "_%&#{}$"}, "\\": r"\backslash ", "<": r"\lt ", ">": r"\gt ", "~": r"\sim ",
    "^": r"\wedge ", " ": r"\ ", "'": r"\text{'}", '"': r"\text{''}", "`": r"\text{'}", "-": r"\text{-}",
}  # fmt: skip


def text(expression: Expression) -> str:
    """Return a bounded, readable form: the formula of a scalar, shape and first elements of an array."""
    writer = _Writer()
    elements = column(expression._sx, expression.shape)
    if not expression.shape:
        return writer.bounded(elements)
    shown = [writer.bounded(elements[i]) for i in range(min(expression.size, _ELEMENTS))]
    body = ", ".join(shown)
    if len(body) > _LIMIT or expression.size > _ELEMENTS:
        body = f"{body[:_LIMIT]} ..."
    return f"Expression{expression.shape}[{body}]"


def expression_latex(expression: Expression) -> str:
    r"""Return the formula of a scalar, or the matrix of an array, cut by ``\dots`` where it is too long."""
    for limit in (_LONGEST_FORMULA, 400, 100, 25):
        formula = _Latex(limit).array(expression)
        if len(formula) <= _LONGEST_FORMULA:
            return formula
    return _Latex.ellipsis


def gradient_latex(gradient: Mapping[Symbol, Expression], trends: frozenset[Symbol] = frozenset()) -> str:
    """Return the entries of a gradient, each said to be exact or, for some keys, a trend."""
    if not gradient:
        return r"\text{no entries}"
    for limit in (_LONGEST_FORMULA // 4, 200, 50):
        writer, lines = _Latex(limit), []
        for speed, entry in islice(gradient.items(), _ENTRIES):
            kind = "trend" if speed in trends else "exact"
            lines.append(rf"{writer.symbol(speed)} & : & {writer.array(entry)} & \text{{{kind}}}")
        if len(gradient) > _ENTRIES:
            lines.append(rf"\dots & & {len(gradient) - _ENTRIES}\ \text{{more}} & ")
        formula = r"\begin{array}{rcll}" + r" \\ ".join(lines) + r"\end{array}"
        if len(formula) <= 2 * _LONGEST_FORMULA:
            return formula
    return _Latex.ellipsis


def mapping_text(gradient: Mapping[Symbol, Expression]) -> str:
    """Return a gradient in the form of a dictionary, its first entries if it has many."""
    shown, length = [], 0
    for key, entry in gradient.items():
        text = repr(entry)
        shown.append(f"{key}: {text if len(text) <= _LIMIT else f'{text[:_LIMIT]} ...'}")
        length += len(shown[-1])
        if length > _LONGEST_MAPPING:
            break
    more = len(gradient) - len(shown)
    return f"{{{', '.join(shown)}{f', ... {more} more' if more else ''}}}"


class _Writer:
    """Writer of scalars as text of bounded length, with an ellipsis in place of deep parts."""

    ellipsis = "..."
    limit = _LIMIT

    left = _LIMIT

    def bounded(self, element: SX) -> str:
        for budget in (self.limit, self.limit // 4, self.limit // 16):
            self.left = budget
            written = self.write(element, 0)
            if len(written) <= self.limit:
                return written
        return self.ellipsis

    def write(self, element: SX, depth: int, strength: int = 0) -> str:
        self.left -= 1
        if depth > _DEPTH or self.left < 0:
            return self.ellipsis
        if element.nnz() == 0:
            return "0"
        if element.is_constant():
            written = self.number(float(element))
            # A number of LaTeX may be a product with a power of ten.
            return (
                self.grouped(written) if strength > 2 and (written[0] == "-" or " " in written) else written
            )
        if element.is_symbolic():
            return self.leaf(element, depth)
        operation = element.op()
        operands = [element.dep(i) for i in range(element.n_dep())]
        if operation in _INFIX:
            return self.infix(operation, operands, depth, strength)
        if operation == ca.OP_SQ:
            operands.append(ca.SX(2))
        elif operation == ca.OP_TWICE:
            return self.infix(ca.OP_MUL, [ca.SX(2), operands[0]], depth, strength)
        elif operation == ca.OP_INV:
            return self.infix(ca.OP_DIV, [ca.SX(1), operands[0]], depth, strength)
        elif operation == ca.OP_NEG:
            written = self.write(operands[0], depth + 1, 2)
            written = written[1:] if written.startswith("-") else f"-{written}"
            return self.grouped(written) if strength > 1 else written
        if operation in (*_POWERS, ca.OP_SQ):
            written = self.power(operands, depth)
            return self.grouped(written) if strength > 2 else written
        if operation in _COMPARISONS:
            a, b = (self.write(o, depth + 1, 1) for o in operands)
            return self.compared(_COMPARISONS[operation], a, b)
        name = _FUNCTIONS.get(operation, f"op{operation}")
        return self.call(name, [self.write(o, depth + 1) for o in operands])

    def infix(self, operation: int, operands: list[SX], depth: int, strength: int) -> str:
        sign, own = _INFIX[operation]
        stronger = own + (operation in (ca.OP_SUB, ca.OP_DIV))
        a, b = self.write(operands[0], depth + 1, own), self.write(operands[1], depth + 1, stronger)
        if sign in "+-" and b.startswith("-"):
            sign, b = "-" if sign == "+" else "+", b[1:]
        written = self.join(sign, a, b)
        return self.grouped(written) if own < strength else written

    def join(self, sign: str, a: str, b: str) -> str:
        return f"{a}{sign}{b}" if sign in "*/" else f"{a} {sign} {b}"

    def power(self, operands: list[SX], depth: int) -> str:
        return f"{self.write(operands[0], depth + 1, 3)}**{self.write(operands[1], depth + 1, 3)}"

    def number(self, value: float) -> str:
        return repr(int(value)) if abs(value) < 1e6 and value == int(value) else f"{value:.6g}"

    def compared(self, sign: str, a: str, b: str) -> str:
        return self.grouped(f"{a} {sign} {b}")

    def grouped(self, written: str) -> str:
        return f"({written})"

    def call(self, name: str, arguments: list[str]) -> str:
        return f"{name}({', '.join(arguments)})"

    def leaf(self, element: SX, depth: int) -> str:
        symbol = SYMBOLS.get(element.element_hash())
        if symbol is not None:
            return self.symbol(symbol)
        node = NODES[element.element_hash()]
        index = node.elements.index(element.element_hash())
        rows, columns = rows_and_columns(node.shape)
        place = np.unravel_index(index % rows * columns + index // rows, node.shape) if node.shape else ()
        suffix = f"[{', '.join(map(str, place))}]" if node.shape else ""
        if any(a.shape for a in node.arguments):
            return self.call(node.label, [self.ellipsis]) + suffix
        return self.call(node.label, [self.write(a._sx, depth + 1) for a in node.arguments]) + suffix

    def symbol(self, symbol: Symbol) -> str:
        return str(symbol)


class _Latex(_Writer):
    """Writer of scalars as LaTeX."""

    ellipsis = r"\dots "

    def __init__(self, limit: int) -> None:
        self.limit = limit

    def array(self, expression: Expression) -> str:
        """Return a matrix; of arrays with more axes the shape only."""
        if not expression.shape:
            return self.bounded(expression._sx)
        if expression.ndim > 2:
            shape = r" \times ".join(map(str, expression.shape))
            return rf"{self.ellipsis}\ \left({shape}\right)"
        rows, columns = expression._sx.shape
        lines = []
        for i in range(min(rows, _EDGE)):
            entries = [self.bounded(expression._sx[i, j]) for j in range(min(columns, _EDGE))]
            lines.append(" & ".join([*entries, *([r"\cdots "] if columns > _EDGE else [])]))
        if rows > _EDGE:
            lines.append(" & ".join([r"\vdots "] * (min(columns, _EDGE) + (columns > _EDGE))))
        return r"\begin{bmatrix}" + r" \\ ".join(lines) + r"\end{bmatrix}"

    def infix(self, operation: int, operands: list[SX], depth: int, strength: int) -> str:
        if operation != ca.OP_DIV:
            return super().infix(operation, operands, depth, strength)
        above, below = (self.write(operand, depth + 1) for operand in operands)
        written = rf"\frac{{{above}}}{{{below}}}"
        return self.grouped(written) if strength > 2 else written

    def join(self, sign: str, a: str, b: str) -> str:
        return f"{a} \\, {b}" if sign == "*" else f"{a} {sign} {b}"

    def power(self, operands: list[SX], depth: int) -> str:
        return f"{{{self.write(operands[0], depth + 1, 3)}}}^{{{self.write(operands[1], depth + 1)}}}"

    def number(self, value: float) -> str:
        if not math.isfinite(value):
            return r"\text{NaN}" if math.isnan(value) else rf"{'-' if value < 0 else ''}\infty "
        digits, _, exponent = super().number(value).partition("e")
        if not exponent:
            return digits
        power = f"10^{{{int(exponent)}}}"
        return power if digits == "1" else rf"{digits} \cdot {power}"

    def grouped(self, written: str) -> str:
        return written if _is_grouped(written) else rf"\left({written}\right)"

    def compared(self, sign: str, a: str, b: str) -> str:
        return self.grouped(f"{a} {_SIGNS[sign]}{b}")

    def call(self, name: str, arguments: list[str]) -> str:
        if name in _BRACKETS and len(arguments) == 1:
            return arguments[0].join(_BRACKETS[name])
        if name in ("less", "and", "or") and len(arguments) > 1:
            return self.grouped(f" {_SIGNS[name]}".join(arguments))
        if name == "not":
            return rf"\lnot {self.grouped(arguments[0])}"
        if name == "if_else_zero":
            return rf"\left[{arguments[0]}\right] \, {self.grouped(arguments[1])}"  # Iverson's bracket
        written = _NAMED.get(name) or rf"\operatorname{{{_escape(name)}}}"
        return rf"{written}\left({', '.join(arguments)}\right)"

    def symbol(self, symbol: Symbol) -> str:
        path = symbol.path
        name = path if len(path) == 1 and path.isalpha() else rf"\mathrm{{{_escape(path)}}}"
        if symbol.order == 0:
            return name
        if symbol.order <= 2:
            return rf"\{'d' * symbol.order}ot{{{name}}}"
        return rf"{{{name}}}^{{({symbol.order})}}"


def _is_grouped(written: str) -> bool:
    """Return whether the first parenthesis closes at the end."""
    depth = 0
    for part in re.split(r"(\\left|\\right)", written)[1:-2]:
        depth += {r"\left": 1, r"\right": -1}.get(part, 0)
        if not depth:
            return False
    return written.startswith(r"\left(") and written.endswith(r"\right)")


def _escape(name: str) -> str:
    return "".join(_ESCAPED.get(c, c if c.isprintable() else r"\ ") for c in name)


def format_number(value: float, digits: int = 4) -> str:
    """Return a number with few digits; an infinite limit as ``-``."""
    if math.isinf(value):
        return "-"
    text = f"{value:.{digits}g}"
    return "0" if float(text) == 0.0 else text
