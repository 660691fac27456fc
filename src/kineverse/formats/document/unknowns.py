"""Reading implicit functions, which may take more work than their text shows."""

from __future__ import annotations

from typing import Any

import casadi as ca

from kineverse.expressions.expression import Expression
from kineverse.expressions.implicit import Implicit, ImplicitFunction
from kineverse.expressions.leaves import bottom_up, leaves
from kineverse.expressions.node import Node
from kineverse.model.rates import all_symbols
from kineverse.symbols import Symbol

from .checks import RefusedError, exactly, listed, name, numbers, whole
from .graph import Graph
from .limits import COST_OF_STEP, MAX_LENGTH, MAX_STEPS


def read_implicit(graph: Graph, node: list[Any]) -> None:
    """Add an implicit function at some inputs."""
    # Where it holds is said by those that are known to hold within bounds, and by none of earlier versions.
    _, label, unknowns, inputs, residual, rows, seed, steps, arguments, *domain = exactly(
        node, 10 if len(node) > 9 else 9
    )
    x = tuple(graph.symbol(ref) for ref in listed(unknowns, "the unknowns"))
    u = tuple(graph.symbol(ref) for ref in listed(inputs, "the inputs"))
    r, first = graph.expression(residual), graph.expression(seed)
    # Asked before it is made, as who makes it asks for symbols, and so for values, and so takes the steps.
    work = _work(graph, r, x, whole(steps, MAX_STEPS))
    graph.budget.spend(work)
    graph.check_elements(r.shape)
    function = ImplicitFunction(
        name=name(label),
        unknowns=x,
        inputs=u,
        residual=r,
        rows=tuple(whole(row, MAX_LENGTH) for row in listed(rows, "the rows that are solved")),
        seed=first,
        steps=steps,
        domain=tuple(_interval(ends) for given in domain for ends in listed(given, "a domain")),
    )
    if domain and not function.domain:
        raise RefusedError("a domain has a bound, or is left out")
    graph.work[function.key] = work
    if len(listed(arguments, "the arguments")) != len(u):
        raise RefusedError(f"{len(arguments)} arguments for {len(u)} inputs")
    refs = [graph.scalar_at(ref) for ref in arguments]
    graph.add_opaque(Implicit, refs, (len(x),), (function,), (residual, seed))


def _interval(ends: Any) -> tuple[float, float]:
    lower, upper = numbers(ends, 2)
    return lower, upper


def _work(graph: Graph, residual: Expression, unknowns: tuple[Symbol, ...], steps: int) -> int:
    """Return about how many nodes the value has when all Newton steps are written out.

    Each step has the residual and its derivatives by the unknowns, and the solution of a linear system. An
    implicit function inside of it that has the unknowns among its inputs is written out in each step again.
    """
    n = len(unknowns)
    size = ca.n_nodes(residual._sx)
    for inner in bottom_up(leaves(residual)[1], _below, lambda _: False):
        size += sum(ca.n_nodes(part._sx) for part in inner.arguments)
        if isinstance(inner, Implicit):
            again = any(all_symbols(a).intersection(unknowns) for a in inner.arguments)
            size += graph.work[inner.function.key] if again else 0
    return int((steps + 1) * (COST_OF_STEP + (n + 2) * size + n**3))


def _below(node: Node) -> tuple[Expression, ...]:
    return node.arguments
