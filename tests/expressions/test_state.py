"""States: immutable mappings from symbols to numbers, asked by symbol or by name."""

import copy
import math
import pickle
import re
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import State
from kineverse.errors import DuplicateNameError, ExpressionError, InvalidValueError, UnknownNameError

SYMBOLS = [
    kv.position("arm/a"),
    kv.position("arm/b"),
    kv.velocity("arm/a"),
    kv.symbols.symbol("arm/a", 7),
    kv.position("a:b%c"),
    kv.parameter("length", 2.0),
    kv.symbols.symbol("touch", 0, "contact"),
]
BY_NAME = SYMBOLS[:5]  # of these the name alone says everything
a, b, da = SYMBOLS[:3]
NUMBERS = st.floats(allow_nan=False)
VALUES = st.dictionaries(st.sampled_from(SYMBOLS), NUMBERS)
STAMPS = st.one_of(st.none(), st.floats(allow_nan=False))


# -- a mapping ---------------------------------------------------------------------------------------------


@given(VALUES)
def test_a_state_is_a_mapping(values):
    state = State(values)
    assert isinstance(state, Mapping)
    assert len(state) == len(values)
    assert bool(state) == bool(values)
    assert list(state) == list(state.keys()) == list(values)
    assert list(state.values()) == list(values.values())
    assert list(state.items()) == list(values.items())
    assert dict(state) == {**state} == values
    assert State(state) == state
    for symbol in SYMBOLS:
        assert (symbol in state) == (str(symbol) in state) == (symbol in values)
        assert state.get(symbol) == state.get(str(symbol)) == values.get(symbol)
        assert state.get(symbol, 7) == state.get(str(symbol), 7) == values.get(symbol, 7)
        if symbol in values:
            assert state[symbol] == state[str(symbol)] == values[symbol]
            assert type(state[symbol]) is float


@given(st.dictionaries(st.sampled_from(BY_NAME), NUMBERS), st.sets(st.sampled_from(BY_NAME)))
def test_keys_are_symbols_or_names(values, named):
    assert State({str(s) if s in named else s: v for s, v in values.items()}) == State(values)


def test_parts_of_names_are_no_keys():
    state = State({"arm/a": 1, "arm/a:velocity": 2, "arm/a:7": 3, "a%3Ab%25c": 4})
    assert [state[s] for s in SYMBOLS[:1] + SYMBOLS[2:5]] == [1, 2, 3, 4]
    for name in ("arm", "a", "arm/a:", "arm/a:acceleration", "a:b%c", "arm/", "", "ARM/A"):
        assert name not in state
        assert state.get(name) is None
    for other in (
        1,
        None,
        2.5,
        b,
        a + b,
        kv.parameter("arm/a", 1.0),
        kv.symbols.symbol("arm/a", 0, "contact"),
    ):
        assert other not in state
        assert state.get(other) is None


def test_values_are_plain_numbers():
    for value in (3, 3.0, np.float32(3), np.float64(3), np.int8(3), np.array(3.0)):
        state = State({a: value})
        assert type(state[a]) is float
        assert state == State({a: 3.0})
        assert hash(state) == hash(State({a: 3.0}))
    assert State({a: math.inf, b: -math.inf})[b] == -math.inf


def test_an_empty_state():
    for nothing in (State(), State({}), State(None)):
        assert len(nothing) == 0
        assert list(nothing) == []
        assert nothing == State()
        assert nothing.stamp is None
        assert nothing.source == ""
        with pytest.raises(UnknownNameError, match=r"has no value of 'x'\. There is no symbol at all"):
            nothing["x"]


def test_a_state_is_independent_of_its_argument():
    values = {a: 1.0}
    state = State(values)
    values[a] = 2.0
    values[b] = 3.0
    assert dict(state) == {a: 1.0}


# -- other values ------------------------------------------------------------------------------------------


@given(
    VALUES, VALUES, STAMPS, STAMPS, st.sampled_from(["", "encoder"]), st.sampled_from([None, "", "filter"])
)
def test_updated_changes_values(values, changes, stamp, new_stamp, source, new_source):
    state = State(values, stamp=stamp, source=source)
    before = dict(state)
    known = {s: v for s, v in changes.items() if s in values}
    new = {s: v for s, v in changes.items() if s not in values}
    updated = state.updated(known, stamp=new_stamp).extended(new, source=new_source)
    assert dict(updated) == {**values, **changes}
    for symbol in new:
        with pytest.raises(UnknownNameError):
            state.updated({symbol: 1.0})
    for symbol in values:
        with pytest.raises(DuplicateNameError, match=r"has a value for '.*' already; updated\(\{"):
            state.extended({symbol: 1.0})
    assert updated.stamp == (stamp if new_stamp is None else new_stamp)
    assert updated.source == (source if new_source is None else new_source)
    assert (dict(state), state.stamp, state.source) == (before, stamp, source)
    assert state.updated({}) == state


def test_updated_by_name_changes_values():
    state = State({a: 1, b: 2}, stamp=3.5, source="encoder")
    expected = State({a: 1, b: 5, da: 6}, stamp=3.5, source="encoder")
    assert state.updated({"arm/b": 5}).extended({"arm/a:velocity": 6}) == expected
    assert state.updated(State({b: 5}, stamp=9)) == State({a: 1, b: 5}, stamp=3.5, source="encoder")
    with pytest.raises(ExpressionError, match="A state has symbols or their names as keys"):
        state.updated({3: 5})
    with pytest.raises(ExpressionError, match="A state has symbols or their names as keys"):
        state.updated({a + b: 5})
    with pytest.raises(InvalidValueError, match="'arm/b' is NaN"):
        state.updated({"arm/b": math.nan})
    with pytest.raises(ExpressionError, match="mapping"):
        state.updated([(b, 5)])
    assert state["arm/b"] == 2


def test_updated_with_unknown_names_is_refused():
    state = State({"kitchen/fridge_door": 0.0, "kitchen/oven_door": 0.0, kv.parameter("length", 2.0): 3.0})
    with pytest.raises(UnknownNameError) as error:
        state.updated({"fridge_door": 1.0})
    assert str(error.value) == (
        "The state has no value of 'fridge_door', so there is nothing to update. "
        "Did you mean 'kitchen/fridge_door'? extended({'fridge_door': ...}) adds what is new."
    )
    assert state.updated({"length": 5})[kv.parameter("length", 2.0)] == 5
    with pytest.raises(UnknownNameError, match="It knows another symbol of that name"):
        state.updated({kv.position("length"): 5})
    with pytest.raises(DuplicateNameError) as error:
        state.updated({**state, "kitchen/oven_door": 1.0})
    assert str(error.value) == (
        "There are two values for 'kitchen/oven_door', by symbol and by name. Instead of "
        "{**state, 'kitchen/oven_door': ...} write state.updated({'kitchen/oven_door': ...})."
    )
    for values in ({**state, "kitchen/oven_door": 1.0},):
        for asked in (State, kv.position("kitchen/oven_door"), kv.compile(kv.position("kitchen/oven_door"))):
            with pytest.raises(
                DuplicateNameError, match=r"write state\.updated\(\{'kitchen/oven_door': \.\.\.\}\)"
            ):
                asked(values)


@given(VALUES, VALUES, STAMPS)
def test_or_joins_two_states(values, others, stamp):
    state = State(values, stamp=stamp, source="encoder")
    union = state | State(others, stamp=7.0, source="camera")
    assert dict(union) == {**values, **others}
    assert (union.stamp, union.source) == (stamp, "encoder")
    if others.keys() <= values.keys():
        assert state | others == state.updated(others)
    else:
        with pytest.raises(UnknownNameError, match="so there is nothing to update"):
            state | others


def test_or_with_a_state_on_the_right_is_refused():
    with pytest.raises(
        ExpressionError, match=r"A state stands on the left of \|: state \| \{\.\.\.\} changes values"
    ):
        {a: 1.0} | State({a: 2.0})
    with pytest.raises(TypeError):
        State({a: 2.0}) | 3


def test_html_of_a_state():
    shown = State({"<b>": 1.5, "x": 2}, stamp=3.0, source="encoder")._repr_html_()
    assert re.findall(">([^<]+)</td>", shown) == ["&lt;b&gt;", "1.5", "x", "2"]
    assert "2 values, at 3 s, from encoder" in shown
    assert len(State({f"j{i}": i for i in range(10_000)})._repr_html_()) < 5_000


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("update", "A state has no 'update'. Here that is state.updated({...}); a state is immutable."),
        ("update_d", "A state has no 'update_d'. Did you mean 'updated'?"),
        ("zzz", "A state has no 'zzz'. dir(...) lists what there is."),
    ],
)
def test_unknown_attributes_of_a_state_are_refused(name, message):
    with pytest.raises(kv.errors.UnknownAttributeError) as error:
        getattr(State({a: 1}), name)
    assert str(error.value) == message
    assert not hasattr(State(), name)


def test_a_symbol_as_an_attribute_names_the_item():
    with pytest.raises(kv.errors.UnknownAttributeError) as error:
        State({"door": 1}).door  # noqa: B018
    assert str(error.value) == "A state has no 'door'. Its value is state['door']."


def test_construction_does_not_search_for_similar_names(monkeypatch):
    def looked(*_):
        raise AssertionError("names were compared")

    monkeypatch.setattr("difflib.get_close_matches", looked)
    assert State({a: 1.0}, stamp=2.0).updated({a: 3.0})[a] == 3.0
    assert kv.position("never before").path == "never before"


# -- equality, hashes, copies ------------------------------------------------------------------------------


@given(VALUES, STAMPS, st.sampled_from(["", "encoder"]), st.randoms())
def test_equal_states(values, stamp, source, random):
    state, items = State(values, stamp=stamp, source=source), list(values.items())
    random.shuffle(items)
    same = State(dict(items), stamp=stamp, source=source)
    assert state == same
    assert hash(state) == hash(same)
    assert {state: 1}[same] == 1


def test_states_of_different_content_differ():
    state = State({a: 1, b: 2}, stamp=3.0, source="encoder")
    others = [
        State({a: 1, b: 2.5}, stamp=3.0, source="encoder"),
        State({a: 1}, stamp=3.0, source="encoder"),
        State({a: 1, b: 2, da: 0}, stamp=3.0, source="encoder"),
        State({a: 1, da: 2}, stamp=3.0, source="encoder"),
        State({a: 1, b: 2}, stamp=4.0, source="encoder"),
        State({a: 1, b: 2}, source="encoder"),
        State({a: 1, b: 2}, stamp=3.0),
        State({kv.parameter("arm/a", 1.0): 1, b: 2}, stamp=3.0, source="encoder"),
    ]
    for other in others:
        assert state != other
        assert hash(state) != hash(other)
    assert len({state, *others}) == len(others) + 1
    assert state != "state"
    assert (state == 3) is False


@settings(max_examples=attempts(30))
@given(VALUES, STAMPS)
def test_pickle_and_copy(values, stamp):
    state = State(values, stamp=stamp, source="encoder")
    copies = [pickle.loads(pickle.dumps(state, k)) for k in range(2, pickle.HIGHEST_PROTOCOL + 1)]
    for other in (*copies, copy.copy(state), copy.deepcopy(state)):
        assert other == state
        assert hash(other) == hash(state)
        assert list(other) == list(state)
        assert all(found is s for found, s in zip(other, state, strict=True))


def test_states_are_immutable():
    state = State({a: 1}, stamp=2.0, source="encoder")
    for name in ("stamp", "source", "_values", "anything"):
        with pytest.raises(ExpressionError, match=r"States are immutable; use updated\("):
            setattr(state, name, None)
    with pytest.raises(ExpressionError, match=r"^States are immutable; ") as error:
        state["arm/a"] = 2
    assert str(error.value) == "States are immutable; state.updated({'arm/a': 2}) returns another one."
    with pytest.raises(ExpressionError) as error:
        del state["arm/a"]
    assert str(error.value) == (
        "States are immutable, and 'arm/a' stays; state.updated({symbol: number}) returns one with other values."
    )
    assert state == State({a: 1}, stamp=2.0, source="encoder")


def test_repr_is_bounded():
    assert repr(State({a: 1, da: 0.5}, stamp=3)) == "State({arm/a: 1, arm/a:velocity: 0.5}, stamp=3)"
    assert repr(State()) == "State({})"
    many = State({f"joint/{i}": i for i in range(1000)})
    assert len(repr(many)) < 200
    assert repr(many).endswith("joint/7: 7, ... 992 more})")


# -- states where values are wanted ------------------------------------------------------------------------


def test_a_state_may_contain_more_symbols_than_needed():
    state = State({a: 2, b: 3, "elsewhere": 4})
    assert (a * a)(state) == 4
    assert kv.compile(a * b, tier="interpreter")(state) == 6
    with pytest.raises(UnknownNameError, match="No value for 'arm/a:velocity'"):
        (a * da)(state)


def test_parameters_have_their_own_values_unless_given():
    length = kv.parameter("length", 2.0)
    assert (a * length)(State({a: 3})) == 6
    assert (a * length)(State({a: 3, "length": 5})) == 15
    assert (a * length)(State({a: 3, length: 5})) == 15


def test_a_name_of_several_symbols_is_refused():
    short, long = kv.parameter("link", 1.0), kv.parameter("link", 2.0)
    state = State({short: 10, long: 20, a: 1})
    assert (state[short], state[long], state["arm/a"]) == (10, 20, 1)
    assert "link" in state
    assert (short + long * a)(state) == 30
    for ask in (lambda: state["link"], lambda: state.get("link"), lambda: state.updated({})["link"]):
        with pytest.raises(
            DuplicateNameError, match="Several symbols have the name 'link'; ask for one by symbol"
        ):
            ask()


# -- bad input ---------------------------------------------------------------------------------------------


def test_unknown_names_come_with_suggestions():
    state = State({"kitchen/fridge_door": 1, "kitchen/oven_door": 2, da: 3})
    for key, suggestion in [
        ("kitchen/fridge_dor", "Did you mean 'kitchen/fridge_door'"),
        ("oven_door", "Did you mean 'kitchen/oven_door'"),
        (a, "Did you mean .*'arm/a:velocity'"),
        ("x", r"Available: arm/a:velocity, kitchen/fridge_door, kitchen/oven_door\."),
    ]:
        with pytest.raises(UnknownNameError, match=f"has no value of '{key}'. {suggestion}") as error:
            state[key]
        assert isinstance(error.value, KeyError)


@pytest.mark.parametrize("value", [None, "1", b"1", [1], [1, 2], 1j, {}, a, a + 1, np.array([1, 2]), 10**400])
def test_values_that_are_not_numbers_are_refused(value):
    for key in (a, "arm/a"):
        with pytest.raises(InvalidValueError, match="The value of 'arm/a' is not a number"):
            State({b: 1, key: value})


@pytest.mark.parametrize("value", [math.nan, np.float32("nan"), np.array(math.nan)])
def test_nan_is_refused(value):
    with pytest.raises(InvalidValueError, match="The value of 'arm/a' is NaN"):
        State({"arm/a": value})


@pytest.mark.parametrize("stamp", ["now", "3", math.nan, [1.0], 1j, a])
def test_invalid_stamps_are_refused(stamp):
    with pytest.raises(InvalidValueError, match="stamp of a state is a time in seconds"):
        State({a: 1}, stamp=stamp)
    with pytest.raises(InvalidValueError, match="stamp of a state is a time in seconds"):
        State({a: 1}).updated({}, stamp=stamp)


def test_invalid_keys_are_refused():
    for key in (1, None, 2.5, a + b, kv.array([a]), ("arm/a",), b"arm/a"):
        with pytest.raises(ExpressionError, match="A state has symbols or their names as keys"):
            State({key: 1})
    with pytest.raises(ExpressionError, match="':speed' is not an order"):
        State({"arm/a:speed": 1})
    with pytest.raises(ExpressionError, match="path"):
        State({"": 1})
    for first, second in ((a, "arm/a"), ("arm/a:velocity", da)):
        with pytest.raises(DuplicateNameError, match="There are two values for 'arm/a"):
            State({first: 1, second: 1})


@pytest.mark.parametrize("values", [[(a, 1)], a, 3, "arm/a", {a}, np.zeros(2)])
def test_values_that_are_not_a_mapping_are_refused(values):
    with pytest.raises(ExpressionError, match=r"A state is made from a mapping \{name: number\}"):
        State(values)
