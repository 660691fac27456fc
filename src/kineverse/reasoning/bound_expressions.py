"""Bounds of a case as expressions."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from kineverse.expressions.expression import Expression, as_expression, binary, unary
from kineverse.expressions.functions import maximum, minimum, where
from kineverse.expressions.piecewise import piecewise
from kineverse.intervals.graph import Term, reachable_terms
from kineverse.logic import less
from kineverse.symbols import Symbol

from .abstract_values import live_arguments
from .case_split import Case
from .polynomial import Polynomial


def express_bound(case: Case, term: Term, names: Mapping[int, Symbol]) -> Expression:
    """Return a term as an expression simplified for a case; ``names`` maps terms to symbols for them."""
    found: dict[int, Expression] = {}
    for part in reachable_terms((term,)):
        value = case.value(part)
        if value.polynomial is not None:
            found[part.index] = _sum_of(value.polynomial)
        elif part.index in names:
            found[part.index] = names[part.index]
        elif part.op != "implicit" and part.op != ca.OP_CONST:
            chosen = live_arguments(part, case.values, case.sign)
            found[part.index] = _step(part, chosen, found)
        elif part.op == ca.OP_CONST:
            found[part.index] = as_expression(part.data)
        else:
            node, element = part.data
            whole = node.value
            found[part.index] = whole if not whole.shape else whole.ravel()[element]
    return found[term.index]


def _sum_of(polynomial: Polynomial) -> Expression:
    total: Expression | None = None
    for monomial, factor in sorted(polynomial.terms.items(), key=lambda item: (not item[0], str(item[0]))):
        term: Expression | None = None
        for symbol, power in monomial:
            part = symbol if power == 1 else symbol**power
            term = part if term is None else term * part
        number = float(factor)
        term = as_expression(number) if term is None else term if number == 1 else number * term
        total = term if total is None else total + term
    return as_expression(0.0) if total is None else total


def _step(term: Term, chosen: tuple[Term, ...], found: dict[int, Expression]) -> Expression:
    args = [found[a.index] for a in term.args]
    op = term.op
    if op == "select":
        return found[chosen[0].index] if len(chosen) == 1 else where(*args)
    if op in (ca.OP_FMIN, ca.OP_FMAX):
        if len(chosen) == 1:
            return found[chosen[0].index]
        return minimum(*args) if op == ca.OP_FMIN else maximum(*args)
    if op == "less":
        return less(0.0, args[0], term.data)
    if op == "piecewise":
        return piecewise(args[0], *term.data)
    assert isinstance(op, int)
    if op == ca.OP_IF_ELSE_ZERO and len(chosen) == 1 and args[0].is_constant:
        return args[1]
    return unary(op, args[0]) if len(args) == 1 else binary(op, *args)
