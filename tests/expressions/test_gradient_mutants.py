"""The tests of the law are worth something: each way to get the law wrong that we could think of fails them.

A mutant replaces one piece of the library by a wrong one and then runs programs of :mod:`random_programs` and a few
single cases. It is killed if anything disagrees with the oracle or raises. Every mutant has symbols of its own,
because equal nodes are shared and remember their gradients.
"""

import functools

import casadi as ca
import gradient_checks as lc
import gradient_oracle as oracle
import numpy as np
import pytest
import random_programs as lp

from kineverse import logic
from kineverse.errors import KineverseError
from kineverse.expressions import array, expression, gradient, graph, numpy_protocol, substitution
from kineverse.expressions.expression import as_expression, binary
from kineverse.expressions.functions import maximum, norm, where
from kineverse.expressions.linear_algebra import matrix_inverse
from kineverse.expressions.node import Augment, Node
from kineverse.expressions.nonsmooth import Extremum, Norm, Select
from kineverse.logic import And, Less, Not, Or, weighted_sum


@functools.cache
def programs():
    """Return the programs that every mutant is put to; a worker that runs none of this does not draw them."""
    corpora = (lc.corpus(strategy, 20) for strategy in (lc.general(), lc.nested(), lc.compositions()))
    return [program for programs in zip(*corpora, strict=True) for program in programs]


def suite(vocabulary):
    """Run all of it; raises if something is wrong."""
    cases(vocabulary)
    for program in programs():
        values = vocabulary.values
        try:
            with np.errstate(all="ignore"):
                value = lp.interpret(program, vocabulary, values)
                usable = lc.largest(value, 2) < 1e5
        except oracle.NearKink:
            continue
        if usable:
            lc.check(array(lp.build(program, vocabulary)), value, values)


def cases(vocabulary):
    """What random numbers do not meet: ties, the origin, jacobians, tangents."""
    a, b, c = vocabulary.positions
    da, db, _, wheel, jerk = vocabulary.keys
    at = {**vocabulary.values, a: 0.5, b: 0.5}

    def gradient_at(e, values=at, heuristic=True):
        return {k: float(entry(values)) for k, entry in e.gradient(heuristic).items()}

    def column(e, key):
        return e.gradient().get(key, 0 * e)(at)

    assert gradient_at(maximum(a, b)) == {da: 0.5, db: 0.5}
    assert gradient_at(norm(array([a, b])), {a: 0, b: 0}) == {da: 0, db: 0}
    assert gradient_at(where(a, b, c)).get(db) == 1
    assert gradient_at(where(a < b, np.sqrt(a), a * 3), {a: 0, b: -1}) == {da: 3}
    replaced = array(2.0).augment({da: 1, wheel: b}).substitute({a: b * 2, b: c})
    assert gradient_at(replaced) == pytest.approx({db: 2, wheel: at[c]})
    assert gradient_at(array(2.0).augment({da: 1}).substitute({a: b * 2})) == {db: 2}
    moved = a.augment({wheel: 1}).substitute({a: b.augment({jerk: 1}, heuristic=True)})
    assert gradient_at(moved) == {db: 1, wheel: 1, jerk: 1}
    assert gradient_at(moved, heuristic=False) == {db: 1, wheel: 1}
    # Terms that meet at one key, and an entry that only a node deep inside is about.
    dc = vocabulary.keys[2]
    met = (a * b).augment({wheel: 1}).substitute({a: 2 * c, b: 3 * c})
    assert gradient_at(met) == pytest.approx({dc: 12 * at[c], wheel: 1})
    deep = maximum(b.augment({wheel: a}), array(-10.0)).substitute({a: 3 * c})
    assert gradient_at(deep) == pytest.approx({db: 1, wheel: 3 * at[c]})
    p = vocabulary.others[2]
    assert gradient_at((p * c).augment({wheel: p}).substitute({p: a * 3})) == pytest.approx(
        {da: 3 * at[c], vocabulary.keys[2]: 1.5, wheel: 1.5}
    )
    lc.close(array([a * b, c]).jacobian([c, a])(at), np.array([[0, 0.5], [1, 0]]))
    assert gradient_at(a & (b & c)) == pytest.approx(gradient_at((a & b) & c))
    fact, trend, whole = (
        a.augment({wheel: 1}),
        a.augment({wheel: 1}, heuristic=True),
        a.with_gradient({wheel: 1}),
    )
    assert [sorted(map(str, x.gradient(False))) for x in (fact, trend, whole)] == [
        sorted(map(str, keys)) for keys in ([da, wheel], [da], [wheel])
    ]
    e = a.augment({da: 3, wheel: 2}, heuristic=True).augment({jerk: 1})
    lc.close(e.jacobian([a], heuristic=False)(at), np.array([1.0]))
    lc.close(e.partial([a])(at), np.array([1.0]))
    lc.close(a.augment({da: 3}).partial([a])(at), np.array([1.0]))
    speeds = {**at, da: 2.0, wheel: 3.0, jerk: 5.0}
    lc.close(gradient.total_derivative(e)(speeds), np.array(2.0 + 5.0))
    lc.close(gradient.total_derivative(array(1.0).augment({wheel: 2}))(speeds), np.array(6.0))
    m = array([[a.augment({da: 4}), b], [1.0, c.augment({wheel: 2})]])
    slope = column(m, da)
    lc.close(column(m @ m, da), slope @ m(at) + m(at) @ slope)
    inverted = np.linalg.inv(m(at))
    lc.close(column(np.linalg.inv(m), da), -inverted @ slope @ inverted)
    assert (a.augment({wheel: b}) - a.augment({wheel: b})).gradient() == {}
    assert (a.augment({wheel: b}) - a.augment({wheel: c})).gradient() != {}


MUTANTS = {}


def mutant(change):
    """Register a function that puts something wrong in place."""
    MUTANTS[change.__name__] = change
    return change


# -- augmentation ------------------------------------------------------------------------------------------


@mutant
def overrides_are_lost(patch):
    patch(Augment, "_gradient", lambda self, h: self.arguments[0].gradient(h))


@mutant
def the_rest_is_forgotten(patch):
    patch(Augment, "_gradient", lambda self, h: _own(self, h) if self.heuristic and not h else self.entries)


@mutant
def what_is_replaced_is_kept(patch):
    patch(
        Augment,
        "_gradient",
        lambda self, h: _own(self, h) if self.heuristic and not h else {**_own(self, h), **self.entries},
    )


@mutant
def inner_overrides_win(patch):
    patch(
        Augment,
        "_gradient",
        lambda self, h: _own(self, h) if self.heuristic and not h else {**self.entries, **_own(self, h)},
    )


@mutant
def inner_overrides_are_lost(patch):
    def gradient_of(self, h):
        inside = self.arguments[0]
        bare = {n: n.value for n in graph.leaves(inside)[1] if isinstance(n, Augment)}
        own = substitution.replace_nodes(inside, bare).gradient(h)
        if self.heuristic and not h:
            return own
        return self.entries if self.replace else {**own, **self.entries}

    patch(Augment, "_gradient", gradient_of)


@mutant
def keys_of_other_symbols_are_lost(patch):
    original = Augment._gradient

    def gradient_of(self, h):
        known = {s.derivative() for s in self.symbols if s.has_derivative}
        return {k: e for k, e in original(self, h).items() if k in known or k in self.options[2:]}

    patch(Augment, "_gradient", gradient_of)


@mutant
def heuristic_entries_are_facts(patch):
    patch(
        Augment,
        "_gradient",
        lambda self, h: self.entries if self.replace else {**_own(self, h), **self.entries},
    )


@mutant
def heuristic_entries_are_nothing(patch):
    original = Augment._gradient
    patch(Augment, "_gradient", lambda self, h: _own(self, h) if self.heuristic else original(self, h))


@mutant
def facts_are_trends(patch):
    original = gradient.gradient
    patch(gradient, "gradient", lambda e, heuristic=True: original(e, True))


@mutant
def equal_values_share_a_node(patch):
    original = Node._content_key.__func__
    patch(Augment, "_content_key", classmethod(lambda cls, a, shape, o: original(cls, a[:1], shape, o)))


@mutant
def equal_keys_share_a_node(patch):
    patch(Augment, "_options_key", classmethod(lambda cls, o: repr([k.sort_key for k in o[2:]])))


# -- the chain rule ----------------------------------------------------------------------------------------


@mutant
def symbols_beside_nodes_are_constants(patch):
    patch(gradient, "leaves", lambda e: ((), graph.leaves(e)[1]) if graph.leaves(e)[1] else graph.leaves(e))


@mutant
def nodes_are_constants(patch):
    patch(gradient, "leaves", lambda e: (graph.leaves(e)[0], ()))


@mutant
def nodes_after_the_first_are_constants(patch):
    patch(gradient, "leaves", lambda e: (graph.leaves(e)[0], graph.leaves(e)[1][:1]))


@mutant
def symbols_of_higher_order_are_constants(patch):
    def low(e):
        symbols, nodes = graph.leaves(e)
        return tuple(s for s in symbols if s.order == 0), nodes

    patch(gradient, "leaves", low)


@mutant
def entries_lie_column_by_column(patch):
    patch(gradient.layout, "column", lambda sx, shape: ca.vec(sx))


@mutant
def columns_come_in_another_order(patch):
    original = gradient.stack_columns
    patch(gradient, "stack_columns", lambda columns, shape: original(columns[::-1], shape))


@mutant
def columns_are_one_order_too_low(patch):
    def of(e, symbols, heuristic=True):
        entries = e.gradient(heuristic)
        return gradient.stack_columns([entries.get(s) for s in symbols], e.shape)

    patch(gradient, "jacobian", of)


@mutant
def products_look_at_the_value_on_the_right(patch):
    original = expression.matmul
    patch(expression, "matmul", lambda x, y: original(x, gradient._without_augmentation(as_expression(y))))


@mutant
def products_look_at_the_value_on_the_left(patch):
    original = expression.matmul
    patch(expression, "matmul", lambda x, y: original(gradient._without_augmentation(as_expression(x)), y))


def inverting(patch, instead):
    patch(numpy_protocol, "_FUNCTIONS", {**numpy_protocol._FUNCTIONS, np.linalg.inv: instead})


@mutant
def inverses_look_at_the_value(patch):
    inverting(patch, lambda m: matrix_inverse(gradient._without_augmentation(m)))


@mutant
def inverses_have_the_other_sign(patch):
    def inverted(m):
        result = matrix_inverse(m)
        return result.with_gradient({k: -entry for k, entry in result.gradient().items()})

    inverting(patch, inverted)


@mutant
def tangents_see_only_symbols_inside(patch):
    def of(e, heuristic=False):
        entries = e.gradient(heuristic)
        return sum(
            (entries[s.derivative()] * s.derivative() for s in e.symbols if s.derivative() in entries),
            start=as_expression(np.zeros(e.shape)),
        )

    patch(gradient, "total_derivative", of)


@mutant
def tangents_follow_trends(patch):
    original = gradient.gradient
    patch(gradient, "gradient", lambda e, heuristic=True: original(e, heuristic or e.shape == ()))


@mutant
def partials_are_augmented(patch):
    patch(gradient, "_without_augmentation", lambda e: e)


# -- selections --------------------------------------------------------------------------------------------


@mutant
def where_blends(patch):
    def gradient_of(self, h):
        c, a, b = self.arguments
        return weighted_sum([(c, a.gradient(h)), (1 - c, b.gradient(h))])

    patch(Select, "_gradient", gradient_of)


@mutant
def where_carries_the_trend_of_its_condition(patch):
    original = Select._gradient

    def gradient_of(self, h):
        c, a, b = self.arguments
        return weighted_sum([(1, original(self, h)), (a - b, c.gradient(h))])

    patch(Select, "_gradient", gradient_of)


@mutant
def where_wants_more_than_half(patch):
    patch(Select, "_is_true", property(lambda self: binary(ca.OP_LT, 0.5, self.arguments[0])))


@mutant
def where_takes_the_first_slope(patch):
    patch(Select, "_gradient", lambda self, h: self.arguments[1].gradient(h))


def extremum(patch, share):
    def gradient_of(self, h):
        x, y = self.arguments
        first, second = (x, y) if self.options[0] == "min" else (y, x)
        part = share(binary(ca.OP_LT, first, second), binary(ca.OP_LT, second, first))
        return weighted_sum([(part, x.gradient(h)), (1 - part, y.gradient(h))])

    patch(Extremum, "_gradient", gradient_of)


@mutant
def a_tie_goes_to_the_first(patch):
    extremum(patch, lambda ahead, behind: 1 - behind)


@mutant
def a_tie_goes_to_nobody(patch):
    extremum(patch, lambda ahead, behind: ahead)


@mutant
def the_other_one_has_the_slope(patch):
    extremum(patch, lambda ahead, behind: (1 + behind - ahead) / 2)


@mutant
def both_have_half_a_slope(patch):
    extremum(patch, lambda ahead, behind: as_expression(0.5))


@mutant
def a_norm_has_a_slope_at_the_origin(patch):
    def gradient_of(self, h):
        (v,) = self.arguments
        return {k: v @ e / self.value for k, e in v.gradient(h).items()}

    patch(Norm, "_gradient", gradient_of)


@mutant
def a_norm_is_squared(patch):
    def gradient_of(self, h):
        (v,) = self.arguments
        return {k: v @ e for k, e in v.gradient(h).items()}

    patch(Norm, "_gradient", gradient_of)


# -- logic -------------------------------------------------------------------------------------------------


@mutant
def logic_is_a_fact(patch):
    patch(logic._Logic, "_gradient", lambda self, h: self._trend())


@mutant
def logic_has_no_trend(patch):
    patch(logic._Logic, "_gradient", lambda self, h: {})


@mutant
def less_is_greater(patch):
    patch(
        Less,
        "_trend",
        lambda self: weighted_sum([(s, e.gradient()) for s, e in zip((1, -1), self.arguments, strict=True)]),
    )


@mutant
def less_looks_at_one_side(patch):
    patch(Less, "_trend", lambda self: dict(self.arguments[1].gradient()))


@mutant
def less_has_its_true_slope(patch):
    patch(Less, "_trend", lambda self: dict(self.value.gradient()))


@mutant
def not_keeps_the_sign(patch):
    patch(Not, "_trend", lambda self: dict(self.arguments[0].gradient()))


def joined(patch, kind, weight):
    def trend(self):
        return weighted_sum([(weight(v, self), v.gradient()) for v in self.arguments])

    patch(kind, "_trend", trend)


@mutant
def and_follows_the_product_rule(patch):
    patch(And, "_trend", lambda self: dict(self.value.gradient()))


@mutant
def and_is_a_plain_sum(patch):
    joined(patch, And, lambda v, self: 1)


@mutant
def and_leaves_out_the_product(patch):
    joined(patch, And, lambda v, self: 1 - v)


@mutant
def and_looks_at_what_holds(patch):
    joined(patch, And, lambda v, self: v + self.value)


@mutant
def or_follows_the_product_rule(patch):
    patch(Or, "_trend", lambda self: dict(self.value.gradient()))


@mutant
def or_is_a_plain_sum(patch):
    joined(patch, Or, lambda v, self: 1)


@mutant
def or_leaves_out_the_product(patch):
    joined(patch, Or, lambda v, self: v)


@mutant
def trends_of_one_key_overwrite(patch):
    def overwriting(terms):
        return {key: weight * entry for weight, entries in terms for key, entry in entries.items()}

    patch(logic, "weighted_sum", overwriting)


@mutant
def conjunctions_nest(patch):
    patch(logic, "_is_only", lambda e, kind: None)


# -- composition -------------------------------------------------------------------------------------------


@mutant
def overridden_keys_are_not_composed(patch):
    patch(Augment, "substitute", Node.substitute)


@mutant
def overridden_keys_of_absent_symbols_are_not_seen(patch):
    patch(Augment, "depends_on", Node.depends_on)


@mutant
def entries_deep_inside_are_not_seen(patch):
    def depends_on(self, replaced):
        return any(s in replaced for argument in self.arguments for s in graph.free_symbols(argument))

    patch(Node, "depends_on", depends_on)


def composing(patch, change):
    def compose(entries, replacements, heuristic):
        result = {}
        rates = {s.derivative(): e for s, e in replacements.items() if s.has_derivative}
        for key, entry in entries.items():
            carried = substitution.apply_substitution(entry, replacements)
            terms = {key: carried}
            if key in rates:
                terms = {k: carried * rate for k, rate in rates[key].gradient(heuristic).items()}
            change(result, key, entry, terms, rates)
        return result

    patch(substitution, "compose_gradient", compose)


def added(result, terms):
    for key, term in terms.items():
        result[key] = result[key] + term if key in result else term


@mutant
def entries_are_not_composed(patch):
    def change(result, key, entry, terms, rates):
        added(result, terms if key in rates else {key: entry})

    composing(patch, change)


@mutant
def keys_of_replaced_symbols_stay(patch):
    composing(
        patch,
        lambda result, key, entry, terms, rates: added(result, {key: next(iter(terms.values()), entry)}),
    )


@mutant
def other_keys_are_dropped(patch):
    composing(patch, lambda result, key, entry, terms, rates: added(result, terms if key in rates else {}))


@mutant
def keys_that_meet_overwrite(patch):
    composing(patch, lambda result, key, entry, terms, rates: result.update(terms))


@mutant
def keys_of_replaced_symbols_are_dropped(patch):
    composing(patch, lambda result, key, entry, terms, rates: added(result, {} if key in rates else terms))


@mutant
def facts_are_composed_of_trends(patch):
    original = substitution.compose_gradient
    patch(substitution, "compose_gradient", lambda entries, by, heuristic: original(entries, by, True))


@mutant
def trends_are_composed_of_facts(patch):
    original = substitution.compose_gradient
    patch(substitution, "compose_gradient", lambda entries, by, heuristic: original(entries, by, False))


@mutant
def what_replaces_a_parameter_stands_still(patch):
    patch(substitution, "dummy_symbols", lambda symbols: {})


def _own(node, heuristic):
    return node.arguments[0].gradient(heuristic)


def test_the_checks_pass_without_a_mutant():
    suite(lp.Vocabulary("sound"))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", MUTANTS)
def test_the_checks_fail_with_a_mutant(name, monkeypatch):
    MUTANTS[name](monkeypatch.setattr)
    vocabulary = lp.Vocabulary(f"mutant/{name}")
    survived = True
    try:
        suite(vocabulary)
    except (AssertionError, KineverseError) as error:  # anything else is a fault of the mutant
        error.__traceback__ = None
        survived = False
    assert not survived, f"The tests of the law do not notice: {name.replace('_', ' ')}."
