"""What is no document gives one error that names the place; nothing is half read or half written."""

import copy
import json
import os
import stat

import pytest
from document_models import rich_model
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.document import read_operations, to_json

TEXT = to_json(rich_model())
WITHOUT_HASH = TEXT[: TEXT.rindex(",\n")] + "}\n"
WRITES = '{"format": "kineverse", "version": 2, "operations": [%s]}'
NODE = WRITES % '{"tag": "t", "kind": "k", "writes": {}, "nodes": [%s]}'


def outcome(text):
    """Return what was read, or the message; anything but a FormatError fails the test."""
    try:
        return read_operations(text, "d.kv.json")
    except kv.errors.FormatError as error:
        return str(error)


def operation(kind="data", name="x", value="1", **others):
    parts = {
        "tag": '"t"',
        "kind": '"k"',
        "nodes": '[["symbol", "a", 0, "dof"]]',
        "reads": "{}",
        "writes": f'{{"{kind}": {{"{name}": {value}}}}}',
        **others,
    }
    return WRITES % ("{" + ", ".join(f'"{k}": {v}' for k, v in parts.items()) + "}")


def test_truncated_document_is_refused():
    text = to_json(kv.load("shelf_door"))
    end = len(text.rstrip())
    for length in (*range(0, end, 4), *range(end - 100, end)):
        assert isinstance(outcome(text[:length]), str), length
    assert isinstance(outcome(text[:end]), list)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not JSON"),
        ("[]", "does not begin with"),
        ('{"format": "kineverse", "version": 3, "operations": []}', "version 3, and this Kineverse reads version 2"),
        ('{"format": "kineverse", "version": 1, "nodes": [], "operations": []}', "version 1, and this Kineverse reads version 2 alone"),
        ('{"format": "kineverse", "version": true, "operations": []}', "not a whole number"),
        ('{"format": "kineverse", "version": 2}', "required field 'operations'"),
        ('{"format": "kineverse", "version": 2, "operations": [], "more": 0}', "unknown field 'more'"),
        ('{"format": "kineverse", "version": 2, "version": 2, "operations": []}', "occurs twice"),
        (NODE % '["constant", NaN]', "not JSON"),
        (NODE % '["constant", 1e999]', "nodes[0][1]: number out of range"),
        (NODE % '["constant", true]', "expected a number or a text, got true or false"),
        (NODE % f'["constant", {"9" * 5000}]', "number out of range"),
        (NODE % '["surprise", 1]', "invalid value 'surprise'"),
        (NODE % '["element", 0, 0]', "not the place of an earlier node"),
        (NODE % '["constant", 1], ["elementary", "add", [0, 1]]', "nodes[1]: 1 is not the place"),
        (NODE % '["constant", 1], ["elementary", "add", [0, -1]]', "expected a whole number >= 0"),
        (NODE % '["constant", 1], ["elementary", "eval", [0]]', "no elementary function 'eval'"),
        (NODE % '["constant", -1], ["elementary", "sqrt", [0]]', "NaN"),
        (NODE % '["constant", 1], ["elementary", "sin", [0, 0]]', "'sin' has 2 arguments"),
        (NODE % '["symbol", "a", 0, "dof"], ["elementary", "constpow", [0, 0]]', "is one of 'pow'"),
        (NODE % '["symbol", "a", 0, "king"]', "invalid enum value 'king'"),
        (NODE % '["symbol", "a//b", 0, "dof"]', "parts are not empty"),
        (NODE % '["symbol", "a", -1, "dof"]', "expected a whole number >= 0"),
        (NODE % '["symbol", "a", 0, "parameter"]', "invalid enum value 'parameter'"),
        (NODE % '["symbol", "\\ud800", 0, "dof"]', "not JSON"),
        (NODE % '["matrix", [1000000000, 1000000000], []]', "whole number <= 16777216"),
        (NODE % '["matrix", [0, 16777216, 16777216], []]', "too large"),
        (NODE % '["constant", 1], ["matrix", [2], [0]]', "do not fill"),
        (NODE % '["constant", 1], ["less", 0, 0, -1]', "positive"),
        (NODE % '["constant", 1], ["augment", 0, 1, false, []]', "true or false"),
        (NODE % '["symbol", "a", 0, "dof"], ["augment", 0, false, false, [[0, 0]]]', "derivative of a symbol"),
        (NODE % '["constant", 1], ["piecewise", 0, true, [0, 0], [[1]]]', "Knots increase"),
        (NODE % '["constant", 1], ["piecewise", 0, true, [0, 1], []]', "make 1 pieces"),
        (NODE % '["constant", 1], ["piecewise", 0, false, [0, "inf"], [[1], [1], [1]]]', "expected a number, got a text"),
        (NODE % '["constant", 1], ["piecewise", 0, 1, [0, 1], [[1]]]', "true or false"),
        (NODE % '["symbol", "a", 0, "dof"], ["carried", 0, []]', "no row for 'a'"),
        (NODE % '["symbol", "a", 0, "dof"], ["composed", 0, []]', "carried coordinate"),
        (operation(kind="soul"), "'soul'"),
        (operation(kind="frames", value='{"parent": "world", "factors": [[[1, 2]]]}'), "frames.factors[0][0]: expected a list of length >= 12"),
        (operation(kind="frames", value='{"parent": "world", "factors": [[[' + "2," * 11 + "2]]]}"), "not rigid"),
        (operation(kind="frames", value='{"parent": "world", "factors": [0]}'), "4×4"),
        (operation(kind="constraints", value="[0, 0]"), "expected a list of length 3"),
        (operation(kind="rates", name="a", value="[0, [[0, 0]]]"), "derivative of a symbol"),
        (operation(kind="bodies", value='{"visuals": [{"geometry": {"kind": "box", "size": [1, 1]}}]}'), "geometry.size: expected a list of length 3"),
        (operation(tag='""'), "tag: expected a text of length >= 1"),
        (operation(reads='{"value": ["nowhere"]}'), "'nowhere' is not a kind"),
        (operation(value='{"expression": 7}'), "7 is not the place"),
        (operation(value='{"integer": "12"}'), "no integer"),
        (operation(parameters='{"a": {"mapping": [[1, 0], [1.0, 0]]}}'), "two keys that are equal"),
        (operation(**{"a\\nb": 0}), "unknown field 'a b'"),
        ('{"format": "kineverse", "version": 2, "operations": [], "folders": {"/\\u0000": {}}}', "folders"),
        ('{"format": "kineverse", "version": 2, "operations": [], "sha256": "%s\\n"}' % ("0" * 64), "length <= 64"),
        ('{"format": ' + "[" * 1_000_000, "nested too deeply"),
        (operation(value="[" * 900 + "]" * 900), None),
    ],
)  # fmt: skip
def test_invalid_document_error_names_the_place(text, reason):
    result = outcome(text)
    if reason is None:
        return
    assert isinstance(result, str), result
    assert result.startswith("d.kv.json")
    assert reason in result
    assert len(result.splitlines()) == 1
    assert len(result) < 600


def test_deeply_nested_document_is_refused():
    """Nesting beyond what is followed is refused, and a long chain of plain sums is not nesting."""
    deep = ['["symbol", "a", 0, "dof"]', *(f'["not", {i}]' for i in range(5000))]
    assert "inside one another" in outcome(NODE % ",".join(deep))
    long = ['["symbol", "a", 0, "dof"]', *(f'["elementary", "sin", [{i}]]' for i in range(100_000))]
    assert isinstance(outcome(NODE % ",".join(long)), list)


@settings(max_examples=attempts(60), suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_document_with_a_changed_value_is_read_or_refused(data):
    """Replace, drop or double any part of a real document: a model or one error of our own comes out."""
    given = json.loads(TEXT)
    del given["sha256"]
    place, key = given, data.draw(st.just("operations"))
    while isinstance(place[key], (list, dict)) and place[key] and data.draw(st.integers(0, 5)):
        place = place[key]
        key = data.draw(st.sampled_from(range(len(place)) if isinstance(place, list) else sorted(place)))
    what = data.draw(st.integers(0, 2))
    if what == 0:
        del place[key]
    elif what == 1 and isinstance(place, list):
        place.insert(key, copy.deepcopy(place[key]))
    else:
        place[key] = data.draw(
            st.sampled_from([None, True, -1, 0, 3, 2.5, "", "a", "inf", [], [0], {}, {"a": 0}])
        )
    result = outcome(json.dumps(given))
    if isinstance(result, list):
        try:
            with kv.Model().edit() as edit:
                for tag, recorded in result:
                    edit.apply(recorded, tag)
        except kv.KineverseError:
            pass


@settings(max_examples=attempts(100))
@given(place=st.integers(0, len(WITHOUT_HASH) - 1), what=st.characters())
def test_document_with_a_changed_character_is_read_or_refused(place, what):
    outcome(TEXT[:place] + what + TEXT[place + 1 :])
    outcome(WITHOUT_HASH[:place] + what + WITHOUT_HASH[place + 1 :])


def test_files_that_are_no_documents_are_refused(tmp_path):
    path = tmp_path / "m.kv.json"
    with pytest.raises(kv.errors.UnknownNameError, match=r"m\.kv\.json"):
        kv.load(path)
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(kv.errors.FormatError, match="UTF-8"):
        kv.load(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(kv.errors.UnknownNameError, match=r"m\.kv\.json"):
        kv.load(path)


def test_failed_include_leaves_the_model_unchanged(tmp_path):
    path = tmp_path / "m.kv.json"
    kv.load("shelf_door").save(path)
    content = json.loads(path.read_text())
    del content["sha256"]
    content["operations"][-1]["writes"] = {"frames": {"late": {"parent": "nowhere", "factors": []}}}
    del content["operations"][-1]["parameters"]
    path.write_text(json.dumps(content))
    model = kv.load("kitchen")
    before = model.snapshot()
    with pytest.raises(kv.KineverseError):
        model.include(path)
    with pytest.raises(kv.errors.FormatError, match="its operations cannot be applied"):
        kv.load(path)
    assert model.snapshot() == before


class Odd:
    """Nothing that a document knows."""


def test_failed_save_names_the_part_and_leaves_the_file_unchanged(tmp_path):
    path = tmp_path / "m.kv.json"
    path.write_text("precious")
    model = kv.load("shelf_door")
    with model.edit() as edit:
        edit.write("odd", (1, Odd()), tag="the odd one")
    with pytest.raises(kv.errors.FormatError, match=r"data/odd.*the odd one.*Odd cannot be saved"):
        model.save(path)
    assert path.read_text() == "precious"
    assert os.listdir(tmp_path) == ["m.kv.json"]


def test_save_checks_ending_and_folder(tmp_path):
    model = kv.load("shelf_door")
    with pytest.raises(kv.errors.FormatError, match=r"m\.kv\.json"):
        model.save(tmp_path / "m.json")
    with pytest.raises(kv.errors.FormatError, match=r"the folder .*nowhere does not exist"):
        model.save(tmp_path / "nowhere" / "m.kv.json")
    assert os.listdir(tmp_path) == []


def test_saved_file_keeps_permissions_and_link_target(tmp_path):
    target, link = tmp_path / "real.kv.json", tmp_path / "link.kv.json"
    model = kv.load("shelf_door")
    model.save(target)
    target.chmod(0o640)
    link.symlink_to(target)
    model.save(link)
    assert link.is_symlink()
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert kv.load(target).snapshot() == model.snapshot()
