"""Symbols: interned, sorted alike in every process, with names that are read back."""

import copy
import itertools
import json
import os
import pickle
import subprocess
import sys
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.errors import DuplicateNameError, ExpressionError, InvalidValueError, UnknownNameError
from kineverse.symbols import (
    ROLES,
    Symbol,
    check_symbols,
    parameter,
    parse_symbol_name,
    position,
    symbol,
    symbol_name,
    velocity,
)

a, b, p = position("a"), position("b"), parameter("p", 2.0)

PARTS = st.text(
    st.characters(exclude_categories=["Cs"], min_codepoint=0x20, exclude_characters="/"), min_size=1
)
# Names that look like what is escaped or like orders are the ones to get wrong.
TRICKY = st.sampled_from(
    [":", "%", "%3A", "%25", "%253A", "velocity", "a:velocity", "%3a", "ȧ", " ", "5", "a:5", "%%:"]
)
PATHS = st.lists(st.one_of(TRICKY, PARTS, st.builds(str.__add__, TRICKY, PARTS)), min_size=1, max_size=3).map(
    "/".join
)
ORDERS = st.integers(0, 12)


# -- one object for one meaning ----------------------------------------------------------------------------


def test_equal_symbols_are_one_object():
    assert position("x/y") is position("x/y") is Symbol("x/y") is symbol("x/y") is Symbol("x/y", 0, "dof")
    assert velocity("x/y") is Symbol("x/y", 1) is position("x/y").derivative()
    assert parameter("p", 2) is p is parameter("p", np.float64(2)) is parameter("p", np.array(2.0))
    assert Symbol("p", 0, "parameter", 2.0) is p is Symbol("p", 0, "parameter", 2)
    assert Symbol("p3", 0, "parameter", np.float64(3)) is parameter("p3", 3.0)
    assert kv.array([[a, b]])[0, 1] is b
    assert (a + 0) is a
    assert kv.translation(a, b)[1, 3] is b


def test_symbols_that_differ_in_a_field_differ():
    kinds = [
        Symbol("s"),
        Symbol("s", 1),
        Symbol("t"),
        *(Symbol("s", 0, role) for role in ROLES if role not in ("dof", "parameter")),
        parameter("s", 0),
        parameter("s", 1),
    ]
    for first, second in itertools.combinations(kinds, 2):
        assert first is not second
        assert first != second
        assert first - second != 0
        assert hash(first) != hash(second)
    assert len(dict.fromkeys(kinds)) == len(kinds)


def test_equality_and_hash():
    assert a == position("a") == kv.array([a, b])[0]
    assert a != "a"
    assert a != 1
    assert a not in [b, a + b, 2 * a, None, "a"]
    assert {a: 1}[position("a")] == 1
    assert a == (a + b) - b


def test_many_threads_get_the_same_symbols():
    """Threads switch as often as they can while all of them ask for the same new names."""
    names = [f"thread/{i}" for i in range(300)]
    start, found = threading.Barrier(8), {}

    def work(number):
        start.wait()
        found[number] = [(position(n), velocity(n), parameter(n, 1.5)) for n in names]

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert len(found) == 8
    for made in found.values():
        for of_one, of_all in zip(made, found[0], strict=True):
            for first, second in zip(of_one, of_all, strict=True):
                assert first is second
    for symbols in found[0]:
        assert (
            kv.array(symbols)[1] is symbols[1]
        )  # what is known by its element is the symbol that was handed out
        assert kv.array(symbols).symbols == tuple(sorted(symbols, key=lambda s: s.sort_key))


# -- the same in every process -----------------------------------------------------------------------------

SCRIPT = """
import json, sys
import kineverse as kv
from kineverse.symbols import ROLES, Symbol
names = ["z", "a", "ä", "a/b", "a/B", "B", "a:b", "a-1", "a10", "a2", "%"]
dofs = {Symbol(n, k) for n in names for k in (0, 1, 2, 11)}
symbols = dofs | {kv.parameter("a", v) for v in (2, -1, 10)}
symbols |= {Symbol("a", 0, "contact"), Symbol("a", 1, "location")}
e = kv.array([s * (i + 1) for i, s in enumerate(sorted(symbols, key=lambda s: s.sort_key))]).sum()
moving = {s for s in symbols if s.has_derivative}
f = (kv.logic.less(e, 1) & kv.position("z")).augment({s.derivative(): 1 for s in moving})
print(json.dumps({
    "symbols": [[str(s), s.role, s.value] for s in e.symbols],
    "keys": [str(s) for s in f.gradient()],
    "digests": [x.key.hex() for x in (e, f, kv.position("a"), kv.parameter("a", 2), f.gradient()[kv.velocity("z")])],
    "inputs": [str(s) for s in kv.compile(kv.array(list(dofs)).sum(), tier="interpreter").inputs],
}))
"""


def test_the_order_is_the_same_in_every_process():
    outputs = []
    for seed in ("0", "4242"):
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        outputs.append(json.loads(run.stdout))
    assert outputs[0] == outputs[1]
    names = [name for name, _, _ in outputs[0]["symbols"]]
    assert outputs[0]["inputs"] == [name for name, role, _ in outputs[0]["symbols"] if role == "dof"]
    order = [parse_symbol_name(name) for name in names]
    assert order == sorted(order)  # by path, as text, then by order
    assert [v for n, _, v in outputs[0]["symbols"] if n == "a" and v is not None] == [-1, 2, 10]


def test_sorting():
    symbols = [
        velocity("b"),
        position("b"),
        symbol("a", 10),
        symbol("a", 2),
        parameter("a", 3),
        parameter("a", -3),
    ]
    expected = [symbols[i] for i in (5, 4, 3, 2, 1, 0)]
    for shuffled in itertools.permutations(symbols):
        assert sorted(shuffled, key=lambda s: s.sort_key) == expected
    assert kv.array(symbols).symbols == tuple(expected)
    with pytest.raises(ExpressionError, match="no truth value"):
        sorted(symbols)  # < is logic


# -- names -------------------------------------------------------------------------------------------------


def test_names_of_orders():
    names = [str(symbol("kitchen/fridge_door", k)) for k in range(7)]
    assert names == [
        "kitchen/fridge_door",
        *(f"kitchen/fridge_door:{n}" for n in ("velocity", "acceleration", "jerk", "snap", "5", "6")),
    ]
    assert [parse_symbol_name(n) for n in names] == [("kitchen/fridge_door", k) for k in range(7)]
    assert repr(velocity("a")) == str(velocity("a")) == "a:velocity"
    assert str(position("a:b%c")) == "a%3Ab%25c"
    assert str(position("my__robot/j1")) == "my__robot/j1"


@given(PATHS, ORDERS)
def test_parse_symbol_name_inverts_symbol_name(path, order):
    name = symbol_name(path, order)
    assert parse_symbol_name(name) == (path, order)
    assert name.count(":") == (order > 0)


@given(PATHS, ORDERS, PATHS, ORDERS)
def test_different_symbols_have_different_names(path, order, other_path, other_order):
    same = symbol_name(path, order) == symbol_name(other_path, other_order)
    assert same == ((path, order) == (other_path, other_order))


@settings(max_examples=attempts(50))
@given(PATHS, ORDERS)
def test_names_and_symbols_are_equivalent_keys(path, order):
    s = symbol(path, order)
    assert str(s) == symbol_name(path, order)
    assert Symbol(*parse_symbol_name(str(s))) is s
    assert (s * 2)({str(s): 3.0}) == 6 == (s * 2)({s: 3.0})
    assert kv.State({str(s): 3.0})[s] == 3
    assert pickle.loads(pickle.dumps(s)) is s


@pytest.mark.parametrize("name", ["a:", "a:speed", "a:-1", "a:1.5", "a:velocity:velocity", "a: 1"])
def test_names_with_an_invalid_order_are_refused(name):
    with pytest.raises(ExpressionError, match="is not an order; write velocity, acceleration, jerk, snap or"):
        parse_symbol_name(name)


# -- derivatives and parameters ----------------------------------------------------------------------------


@settings(max_examples=attempts(50))
@given(PATHS, st.integers(0, 8), st.sampled_from([r for r in ROLES if r != "parameter"]))
def test_derivative_and_integral(path, order, role):
    s = symbol(path, order, role)
    assert (s.path, s.order, s.role, s.value) == (path, order, role, None)
    assert s.derivative().integral() is s
    assert (s.derivative().path, s.derivative().order, s.derivative().role) == (path, order + 1, role)
    assert s.position is symbol(path, 0, role)
    assert s.has_derivative
    assert dict(s.gradient()) == {s.derivative(): 1}
    lowest = s
    for _ in range(order):
        lowest = lowest.integral()
    assert lowest is s.position
    with pytest.raises(ExpressionError, match="is not the derivative of anything"):
        lowest.integral()


@pytest.mark.parametrize("path", ["[", "[a", "[a,b]", "[]", "[[a", "[a/b"])
def test_paths_with_brackets(path):
    """As they do for CasADi, to which "[a" is the name a."""
    x, plain = position(path), position("a")
    assert x.casadi.shape == (1, 1)
    assert x.casadi.name() != plain.casadi.name()
    assert str(x.derivative()) == f"{path}:velocity"
    assert (2 * x + plain)({path: 3.0, "a": 1.0}) == 7.0
    assert kv.compile([x * plain], [x, plain])([3.0, 2.0])[0] == 6.0
    assert x.key != plain.key


def test_parameters():
    assert (p.path, p.order, p.role, p.value) == ("p", 0, "parameter", 2.0)
    assert type(parameter("p", 7).value) is float
    assert not p.has_derivative
    assert p.position is p
    assert not p.gradient()
    assert p.symbols == (p,)
    assert not p.is_constant
    assert str(p) == "p"
    assert p({}) == 2
    assert p({"p": 5}) == p({p: 5}) == 5
    assert (p * a)({a: 3}) == 6
    with pytest.raises(
        ExpressionError, match=r"Parameter 'p' has no derivative: it does not change with time"
    ):
        p.derivative()
    with pytest.raises(ExpressionError, match="is not the derivative of anything"):
        p.integral()
    with pytest.raises(DuplicateNameError, match="Several symbols have the name 'p'"):
        (p * parameter("p", 3))({"p": 1})
    assert (p * parameter("p", 3))({}) == 6
    with pytest.raises(UnknownNameError, match="No value for 'p'"):
        (p * position("p"))({})


# -- values that stay what they are ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["path", "order", "role", "value", "sort_key", "anything"])
def test_symbols_are_immutable(name):
    for s in (a, p, velocity("a")):
        with pytest.raises(ExpressionError, match=f"Symbols are immutable: '{s}' keeps its {name}"):
            setattr(s, name, 1)
    assert (a.path, a.order, a.role, a.value) == ("a", 0, "dof", None)


def test_pickle_and_copy():
    for s in (a, velocity("x:y/%"), p, parameter("q", -0.5), symbol("c", 3, "contact")):
        for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
            assert pickle.loads(pickle.dumps(s, protocol)) is s
        assert copy.copy(s) is s
        assert copy.deepcopy({"list": [s]})["list"][0] is s
    e = pickle.loads(pickle.dumps((a * p).augment({velocity("b"): 2})))
    assert all(found is given for found, given in zip(e.symbols, (a, p), strict=True))


def test_zero_has_one_sign():
    """-0.0 == 0.0, so they are one parameter, and which came first must not matter."""
    assert parameter("zero", -0.0) is parameter("zero", 0.0)
    assert np.copysign(1, parameter("zero", 0.0).value) == 1


# -- bad input ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path", ["", "/", "a/", "/a", "a//b", "a\n", "\x00", "a/\x1f", "\ud800", None, 3, b"a", ["a"], a]
)
def test_invalid_paths_are_refused(path):
    for make in (position, velocity, symbol, lambda x: parameter(x, 1)):
        with pytest.raises(ExpressionError, match="path"):
            make(path)


@pytest.mark.parametrize("order", [-1, 1.0, True, "1", None, np.int64(1), [1]])
def test_invalid_orders_are_refused(order):
    for path in ("a", "never seen before"):
        with pytest.raises(ExpressionError, match="order of a symbol is a whole number from 0 on"):
            symbol(path, order)


@pytest.mark.parametrize("role", ["joint", "", None, 1, ["dof"], "DOF"])
def test_invalid_roles_are_refused(role):
    with pytest.raises(
        ExpressionError, match=r"Unknown role .*; roles are dof, parameter, contact, location"
    ):
        symbol("a", 0, role)


@pytest.mark.parametrize("value", [None, float("nan"), "2", b"2", True, [2.0], 1j, a, {}, 10**400])
def test_invalid_parameter_values_are_refused(value):
    assert parameter("p", 1.0) is not None  # True is not it
    with pytest.raises(InvalidValueError, match="Parameter 'p' needs a number as its value"):
        parameter("p", value)
    if value != 10**400:
        with pytest.raises(InvalidValueError, match="Parameter 'p' needs a number as its value"):
            Symbol("p", 0, "parameter", value)


def test_invalid_combinations_are_refused():
    for value in (1.0, True, "x", [1]):
        with pytest.raises(ExpressionError, match="Only parameters have a value of their own"):
            Symbol("a", 0, "dof", value)
    with pytest.raises(ExpressionError, match="A parameter has no derivatives"):
        Symbol("p", 1, "parameter", 2.0)


def test_check_symbols():
    assert list(check_symbols(s for s in (a, p))) == [a, p]
    assert list(check_symbols([])) == []
    with pytest.raises(ExpressionError, match=r"A sequence of symbols is wanted: \[a\]"):
        check_symbols(a)
    for item in (a + b, "a", 1.0, kv.array([a])):
        with pytest.raises(
            ExpressionError, match=r"is not a symbol; symbols are made by kv.position\('path'\)"
        ):
            check_symbols([a, item])
