"""Node table of a document, written from expressions.

Every node is a list that begins with its type; a reference is the place of an earlier node in the table.
``docs/documents.md`` lists the types, :mod:`.node_types` defines them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence

import casadi as ca

from kineverse.errors import FormatError
from kineverse.expressions import layout
from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.implicit import Implicit, ImplicitFunction
from kineverse.expressions.node import Augment, Node
from kineverse.expressions.nonsmooth import Extremum, Norm, Power, Select
from kineverse.expressions.piecewise import Piecewise
from kineverse.logic import And, Less, Not, Or
from kineverse.model.rates import Carried, Composed, Dependent
from kineverse.model.traces import ReadNode
from kineverse.symbols import Symbol

from .budget import MAX_ELEMENTS, MAX_NODES
from .node_types import ELEMENTARY_NAMES

_PLAIN = (Not, And, Or, Select, Norm)

# A step of CasADi's program: a leaf (owner, element), a constant, or (name, steps ...).
_Leaf = tuple["Symbol | Node", int]


class NodeTable:
    """Topologically sorted table of the nodes of expressions; :meth:`ref` returns the place of one.

    Equal parts are one node, in the order in which the expressions need them: equal models have equal texts.
    """

    def __init__(self, expressions: Iterable[Expression]) -> None:
        self.lines: list[str] = []
        self._symbols: dict[Symbol, int] = {}
        self._nodes: dict[Node, int] = {}
        self._made: dict[str, int] = {}
        roots = list({id(e): e for e in expressions}.values())
        inner = topological_order(
            {n: None for e in roots for n in leaves(e)[1]}, lambda n: n.parts, lambda _: False
        )
        parts = [*roots, *(part for node in inner for part in node.parts)]
        self._program = _Program(list({id(e): e for e in parts}.values()))
        self._steps: list[int] = [-1] * len(self._program.steps)
        self._known: dict[int, int] = {}

    def ref(self, expression: Expression) -> int:
        """Return the place of an expression given to the constructor, or of any symbol."""
        if isinstance(expression, Symbol):
            return self._symbol(expression)
        known = self._known.get(id(expression))
        if known is None:
            for node in topological_order(leaves(expression)[1], lambda n: n.parts, self._nodes.__contains__):
                self._nodes[node] = self._node(node)
            known = self._known[id(expression)] = self._array(expression)
        return known

    def _array(self, expression: Expression) -> int:
        places, steps = self._program.elements[id(expression)]
        size = expression.size
        if not expression.shape and steps:
            return self._scalar(steps[0])
        if len(steps) == size and size:
            owner = self._program.steps[steps[0]]
            if isinstance(owner, tuple) and isinstance(owner[0], Node) and owner[0].shape == expression.shape:
                if [self._program.steps[s] for s in steps] == [(owner[0], i) for i in range(size)]:
                    return self._nodes[owner[0]]
        refs = ["null"] * size
        for place, step in zip(places, steps, strict=True):
            refs[place] = str(self._scalar(step))
        return self._shared(f'["matrix",[{",".join(map(str, expression.shape))}],[{",".join(refs)}]]')

    def _scalar(self, wanted: int) -> int:
        places, steps = self._steps, self._program.steps
        if places[wanted] >= 0:
            return places[wanted]
        stack = [wanted]
        while stack:
            step = stack[-1]
            what = steps[step]
            if places[step] >= 0:
                stack.pop()
            elif isinstance(what, float):
                places[stack.pop()] = self._shared(f'["constant",{encode_float(what)}]')
            elif not isinstance(what[0], str):
                places[stack.pop()] = self._leaf(what)
            else:
                missing = [a for a in what[1:] if places[a] < 0]
                if missing:
                    stack.extend(reversed(missing))
                    continue
                arguments = ",".join(str(places[a]) for a in what[1:])
                places[stack.pop()] = self._shared(f'["elementary","{what[0]}",{arguments}]')
        return places[wanted]

    def _leaf(self, leaf: _Leaf) -> int:
        owner, element = leaf
        if isinstance(owner, Symbol):
            return self._symbol(owner)
        place = self._nodes[owner]
        return self._shared(f'["element",{place},{element}]') if owner.shape else place

    def _symbol(self, symbol: Symbol) -> int:
        place = self._symbols.get(symbol)
        if place is None:
            value = "" if symbol.value is None else f",{encode_float(symbol.value)}"
            place = self._add(
                f'["symbol",{encode_string(symbol.path)},{symbol.order},"{symbol.role}"{value}]'
            )
            self._symbols[symbol] = place
        return place

    def _node(self, node: Node) -> int:
        if type(node) is Carried:
            return self._shared(f'["carried",{self.ref(node.coordinate)},{self._rates(node)}]')
        if type(node) is ReadNode:
            shape = ",".join(map(str, node.shape))
            path = ",".join(f"[{self.ref(key)},{str(trends).lower()}]" for key, trends in node.path)
            return self._shared(f'["read",{node.query},{node.part},[{shape}],[{path}]]')
        if node.size * max(len(node.arguments), 1) > MAX_ELEMENTS:
            raise FormatError(
                f"The model has a node '{node.label}' of shape {node.shape} with {len(node.arguments)} "
                f"arguments; a document has up to {MAX_ELEMENTS} elements in all arguments of one."
            )
        refs = [self.ref(argument) for argument in node.arguments]
        joined = ",".join(map(str, refs))
        if type(node) is Augment:
            entries = self._pairs(node.options[2:], refs[1:])
            flags = f"{str(node.replace).lower()},{str(node.heuristic).lower()}"
            return self._shared(f'["augment",{refs[0]},{flags},{entries}]')
        if type(node) is Less:
            return self._shared(f'["less",{joined},{encode_float(node.options[0])}]')
        if type(node) is Extremum:
            return self._shared(f'["extremum","{node.options[0]}",{joined}]')
        if type(node) is Piecewise:
            pieces = ",".join(_encode_floats(piece) for piece in node.pieces)
            knots = _encode_floats(node.knots)
            return self._shared(f'["piecewise",{joined},{str(node.periodic).lower()},{knots},[{pieces}]]')
        if type(node) is Composed:
            return self._shared(f'["composed",{refs[0]},{self._pairs(node.options, refs[1:])}]')
        if type(node) is Dependent:
            return self._shared(f'["dependent",{joined},{self.ref(node.coordinate)}]')
        if type(node) is Implicit:
            f = node.function
            within = ",".join(_encode_floats(ends) for ends in f.domain)
            domain = f",[{within}]" if within else ""
            return self._shared(f'["implicit",{self._function(f)},[{joined}]{domain}]')
        if type(node) is Power:
            return self._shared(f'["elementary","pow",{joined}]')
        if type(node) in _PLAIN:
            return self._shared(f'["{node.kind}",{joined}]')
        raise FormatError(
            f"A document of version 1 has no node '{node.kind}' ({type(node).__name__}); the model cannot be "
            "saved with it."
        )

    def _rates(self, node: Carried) -> str:
        rows = []
        for coordinate, row in sorted(node.rates.items(), key=lambda item: item[0].sort_key):
            pairs = self._pairs(list(row), [self.ref(entry) for entry in row.values()])
            rows.append(f"[{self.ref(coordinate)},{pairs}]")
        return f"[{','.join(rows)}]"

    def _function(self, f: ImplicitFunction) -> str:
        unknowns, inputs = (
            "[" + ",".join(str(self.ref(s)) for s in symbols) + "]" for symbols in (f.unknowns, f.inputs)
        )
        rows = "[" + ",".join(map(str, f.rows)) + "]"
        residual, seed = self.ref(f.residual), self.ref(f.seed)
        return f"{encode_string(f.name)},{unknowns},{inputs},{residual},{rows},{seed},{f.steps}"

    def _pairs(self, symbols: Sequence[Symbol], refs: Sequence[int]) -> str:
        pairs = (f"[{self._symbol(s)},{ref}]" for s, ref in zip(symbols, refs, strict=True))
        return f"[{','.join(pairs)}]"

    def _shared(self, line: str) -> int:
        place = self._made.get(line)
        if place is None:
            place = self._made[line] = self._add(line)
        return place

    def _add(self, line: str) -> int:
        if len(self.lines) >= MAX_NODES:
            raise FormatError(f"The model has more than {MAX_NODES:,} nodes, the most a document has.")
        self.lines.append(line)
        return len(self.lines) - 1


class _Program:
    """CasADi's program for all elements of expressions, with every common subexpression once."""

    def __init__(self, expressions: list[Expression]) -> None:
        self._keep = expressions
        self.steps: list[float | _Leaf | tuple[str, int] | tuple[str, int, int]] = []
        self.elements: dict[int, tuple[list[int], list[int]]] = {}
        if not expressions:
            return
        owners: dict[Symbol | Node, None] = {}
        for expression in expressions:
            symbols, nodes = leaves(expression)
            owners.update(dict.fromkeys(symbols))
            owners.update(dict.fromkeys(nodes))
        inputs = []
        leaf_of: list[_Leaf] = []
        for owner in owners:
            sx, shape = owner.sx, owner.shape
            inputs.append(layout.column(sx, shape))
            leaf_of.extend((owner, i) for i in range(math.prod(shape)))
        columns = [layout.column(e.sx, e.shape) for e in expressions]
        given = ca.vertcat(*inputs) if inputs else ca.SX(0, 1)
        outputs = self._run(ca.Function("document", [given], [ca.vertcat(*columns)]), leaf_of)
        offset = 0
        for expression, column in zip(expressions, columns, strict=True):
            places = column.sparsity().row()
            self.elements[id(expression)] = places, outputs[offset : offset + len(places)]
            offset += len(places)

    def _run(self, function: ca.Function, leaf_of: list[_Leaf]) -> list[int]:
        """Trace the program, which reuses its memory, and return the steps of its outputs."""
        operation, arguments = function.instruction_id, function.instruction_input
        results = function.instruction_output
        steps = self.steps
        memory: dict[int, int] = {}
        outputs = [-1] * function.nnz_out(0)
        for k in range(function.n_instructions()):
            code = operation(k)
            if code == ca.OP_OUTPUT:
                outputs[results(k)[1]] = memory[arguments(k)[0]]
                continue
            if code == ca.OP_CONST:
                steps.append(function.instruction_constant(k))
            elif code == ca.OP_INPUT:
                steps.append(leaf_of[arguments(k)[1]])
            elif code in ELEMENTARY_NAMES:
                steps.append((ELEMENTARY_NAMES[code], *(memory[a] for a in arguments(k))))  # type: ignore[arg-type]
            else:
                raise FormatError(f"A document of version 1 has no function with CasADi's code {code}.")
            memory[results(k)[0]] = len(steps) - 1
        return outputs


def _encode_floats(values: Sequence[float]) -> str:
    return f"[{','.join(map(encode_float, values))}]"


def encode_float(value: float) -> str:
    """Encode a number as JSON text that is read back as the same bits."""
    if value != value:
        raise FormatError("NaN has no place in a document.")
    if value in (math.inf, -math.inf):
        return '"inf"' if value > 0 else '"-inf"'
    return repr(float(value))


encode_string = json.JSONEncoder(ensure_ascii=False).encode
