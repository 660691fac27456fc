"""Expressions as text, LaTeX and HTML of bounded length; HTML tables for notebooks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from html import escape
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
_LONGEST_FORMULA = 3000
_LONGEST_MAPPING = 4 * _LIMIT
_ROWS = 40

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


def latex(expression: Expression) -> str | None:
    r"""Return LaTeX: ``\dot{a}`` for velocities, matrices up to 6×6; None if it is too long to read."""
    writer = _Latex()
    if not expression.shape:
        formula = writer.bounded(expression._sx)
        return formula if len(formula) <= _LONGEST_FORMULA and formula != writer.ellipsis else None
    rows, columns = expression._sx.shape
    if expression.ndim > 2 or rows > 6 or columns > 6:
        return None
    lines = []
    for i in range(rows):
        entries = [writer.bounded(expression._sx[i, j]) for j in range(columns)]
        lines.append(" & ".join(entries))
        if sum(map(len, lines)) > _LONGEST_FORMULA or writer.ellipsis in entries:
            return None
    return r"\begin{bmatrix}" + r" \\ ".join(lines) + r"\end{bmatrix}"


def html(expression: Expression) -> str:
    """Return the text as HTML, for expressions that are too long for a formula."""
    return f"<code>{escape(repr(expression))}</code>"


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


def mapping_html(gradient: Mapping[Symbol, Expression]) -> str:
    """Return a gradient as a table of HTML, its first entries if it has many."""
    rows = [(str(key), repr(entry)) for key, entry in itertools.islice(gradient.items(), _ROWS)]
    return html_table("D", ("speed", "entry"), rows, len(gradient))


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
            return self.grouped(written) if strength > 2 and written.startswith("-") else written
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
            return self.grouped(f"{a} {_COMPARISONS[operation]} {b}")
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
    ellipsis = r"\dots"
    limit = 4 * _LIMIT

    def join(self, sign: str, a: str, b: str) -> str:
        return {"*": f"{a} \\, {b}", "/": f"\\frac{{{a}}}{{{b}}}"}.get(sign, f"{a} {sign} {b}")

    def power(self, operands: list[SX], depth: int) -> str:
        return f"{{{self.write(operands[0], depth + 1, 3)}}}^{{{self.write(operands[1], depth + 1)}}}"

    def grouped(self, written: str) -> str:
        return rf"\left({written}\right)"

    def call(self, name: str, arguments: list[str]) -> str:
        return rf"\operatorname{{{name}}}\left({', '.join(arguments)}\right)"

    def symbol(self, symbol: Symbol) -> str:
        name = _escape_latex(symbol.path)
        if symbol.order == 0:
            return name
        if symbol.order <= 4:
            return rf"\{'d' * symbol.order}ot{{{name}}}"
        return rf"{name}^{{({symbol.order})}}"


def _escape_latex(path: str) -> str:
    if len(path) == 1:
        return path
    table = {c: f"\\{c}" for c in "_%&#{}"} | {"\\": r"\backslash "}
    return r"\mathrm{" + "".join(table.get(c, c) for c in path) + "}"


_MOST_TABLE_ROWS = 50
_LONGEST_CELL = 200


def html_table(
    caption: str, header: Sequence[str], rows: Sequence[Sequence[str]], total: int | None = None
) -> str:
    """Return an HTML table of texts, which are escaped; long texts and many rows are cut."""
    head = "".join(f"<th>{escape(title)}</th>" for title in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(_shorten_cell(cell))}</td>' for cell in row)}</tr>"
        for row in rows[:_MOST_TABLE_ROWS]
    )
    more = (len(rows) if total is None else total) - min(len(rows), _MOST_TABLE_ROWS)
    if more:
        body += f'<tr><td colspan="{len(header)}">... {more} more</td></tr>'
    return (
        f"<table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table>"
    )


def _shorten_cell(text: str) -> str:
    return text if len(text) <= _LONGEST_CELL else f"{text[: _LONGEST_CELL - 1]}…"


def format_number(value: float, digits: int = 4) -> str:
    """Return a number with few digits; an infinite limit as ``-``."""
    if math.isinf(value):
        return "-"
    text = f"{value:.{digits}g}"
    return "0" if float(text) == 0.0 else text
