"""Truncated, large, deep, strangely encoded and malicious URDF texts give one format error."""

from __future__ import annotations

import codecs
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from urdf_texts import SMALL, pair

from kineverse.errors import FormatError
from kineverse.formats import xml_reader
from kineverse.formats.reader_warnings import Fault
from kineverse.formats.urdf import UrdfRobot, parse_urdf, read_urdf


def outcome(data: str | bytes) -> UrdfRobot | str:
    """Return the robot or the message; anything but a FormatError fails the test."""
    try:
        return parse_urdf(data, source="r.urdf")
    except FormatError as error:
        return str(error)


@pytest.mark.parametrize("kind", [str, bytes])
def test_truncated_urdf_is_read_or_a_format_error(kind):
    text = SMALL if kind is str else SMALL.encode()
    end = len(text.rstrip())
    for length in range(end):
        message = outcome(text[:length])
        assert isinstance(message, str), length
        assert message.startswith("r.urdf, line "), message
    assert isinstance(outcome(text[:end]), UrdfRobot)


def test_truncation_error_names_the_open_element():
    assert outcome(SMALL[: SMALL.index("<axis")]) == (
        'r.urdf, line 19, column 5, in <joint name="elbow"> of line 16: not well-formed XML: '
        "no element found. The text is cut off."
    )


@given(st.integers(0, len(SMALL) - 1), st.binary(max_size=8))
def test_corrupted_urdf_is_read_or_a_format_error(position, replacement):
    data = SMALL.encode()
    result = outcome(data[:position] + replacement + data[position + len(replacement) :])
    assert isinstance(result, UrdfRobot) or result.startswith("r.urdf")


@given(st.binary(max_size=200) | st.text(max_size=200))
def test_random_bytes_are_a_format_error(data):
    assert isinstance(outcome(data), str)


BOMB = (
    '<!DOCTYPE robot [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    + ']>\n<robot name="&a9;"><link name="l"/></robot>'
)


def test_an_entity_bomb_is_refused_before_it_expands():
    assert outcome(BOMB).startswith(
        "r.urdf, line 1, <!DOCTYPE robot>: document types and entities are refused"
    )


@pytest.mark.parametrize("uri", ["file:///etc/passwd", "http://localhost/x"])
def test_external_entities_are_refused(uri):
    doctype = f'<!DOCTYPE r [<!ENTITY x SYSTEM "{uri}">]>'
    text = f'<?xml version="1.0"?>\n{doctype}\n<robot name="r"><link name="&x;"/></robot>'
    assert outcome(text).startswith("r.urdf, line 2, <!DOCTYPE r>")
    assert outcome(f'<!DOCTYPE robot SYSTEM "{uri}"><robot name="r"/>').startswith(
        "r.urdf, line 1, <!DOCTYPE robot>"
    )


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le", "utf-16-be"])
def test_an_entity_bomb_in_another_encoding_is_refused(encoding):
    assert "<!DOCTYPE robot>" in outcome(BOMB.encode(encoding)) or "not well-formed" in outcome(
        BOMB.encode(encoding)
    )


def test_unknown_entities_are_refused():
    assert "undefined entity. Only &lt;" in outcome('<robot name="&nbsp;"/>')


@pytest.mark.parametrize("outer", ["{}", "<gazebo>{}</gazebo>", "<link name='l'>{}</link>"])
def test_deep_nesting_is_refused(outer):
    depth = 100_000
    assert outcome("<robot name='r'>" + outer.format("<a>" * depth + "</a>" * depth) + "</robot>") == (
        "r.urdf, line 1, <a>: elements are nested more than 200 deep; no robot description needs that."
    )


def test_extensions_may_nest_as_deep_as_others():
    inner = "<a>" * 150 + "</a>" * 150
    text = f'<robot name="r"><gazebo>{inner}</gazebo><link name="l"/><x>{inner}</x><gazebo/></robot>'
    assert [link.name for link in parse_urdf(text).links] == ["l"]


def test_size_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(xml_reader, "MAX_BYTES", 100)
    path = tmp_path / "big.urdf"
    path.write_text(SMALL)
    with pytest.raises(FormatError, match="larger than 100 bytes"):
        read_urdf(path)
    assert "larger than 100 bytes" in outcome(SMALL)


def test_encodings_are_read():
    name = "Gelenk_ä"
    text = pair().replace('"j"', f'"{name}"')
    declared = '<?xml version="1.0" encoding="{}"?>\n' + text
    for data in (
        text,
        "\ufeff" + text,
        text.encode(),
        codecs.BOM_UTF8 + text.encode(),
        declared.format("UTF-16").encode("utf-16"),
        declared.format("iso-8859-1").encode("latin-1"),
        declared.format("windows-1252").encode("cp1252"),
    ):
        assert outcome(data).joints[0].name == name


@pytest.mark.parametrize(
    "data",
    [
        pair().replace('"j"', '"ä"').encode("latin-1"),
        b'<?xml version="1.0" encoding="klingon"?><robot name="r"/>',
        b'<?xml version="1.0" encoding="utf-7"?><robot name="r"/>',
        b'<?xml version="1.0" encoding="gb18030"?><robot name="r"/>',
        '<robot name="\ud800"/>',
        '<robot name="\0"/>',
        b"\xff\xfe<\0r\0",
        b"\x80" * 100,
    ],
)
def test_undecodable_text_is_refused(data):
    assert outcome(data).startswith("r.urdf, line ")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "r.urdf, line 1, column 1, before any element: not well-formed XML: no element found"),
        ("<robot name='r'>\n<link name='a'>\n</robot>", 'line 3, column 3, in <link name="a"> of line 2'),
        ("<robot name='r' name='s'/>", "duplicate attribute. Keep one"),
        ("<robot name='r'/><robot/>", "Remove what comes after"),
        ("<robot name='a&b'/>", "& and < are written"),
        ("no xml", "Is this XML at all?"),
    ],
)
def test_text_that_is_not_xml_is_refused(text, expected):
    assert expected in outcome(text)


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("\n\n<?xml version='1.0'?>{}", 3, "line 3, column 1, <?xml ...?>: "),
        ("<!-- c -->\n<?xml version='1.0'?>\n{}", 2, "line 2, column 1, <?xml ...?>: "),
        ("<?xml verison='1.0'?>{}", 1, 'The first line must read <?xml version="1.0"?>, or be left out.'),
        ("<?xml version='1.0'?>\n<?xml version='1.0'?>{}", 2, "Nothing, not even an empty line, may come"),
        ("<!-- a\n -- b -->{}", 1, "not well-formed"),
        ("<!-- <!-- -->{}", 1, "not well-formed"),
        ("\n<!--- a --->{}", 2, "not well-formed"),
    ],
)
@pytest.mark.parametrize("kind", [str, bytes])
def test_xml_mistakes_that_other_parsers_accept_are_warnings(text, line, expected, kind):
    whole = text.format(SMALL.removeprefix('<?xml version="1.0"?>\n'))
    data = whole if kind is str else whole.encode()
    read = parse_urdf(data)
    assert (len(read.links), len(read.joints)) == (2, 1)
    assert read.joints[0].line == whole[: whole.index("<joint")].count("\n") + 1
    (remark,) = read.remarks
    assert isinstance(remark, Fault)
    assert remark.startswith(f"line {line}, <")
    with pytest.raises(FormatError, match=re.escape(expected)):
        parse_urdf(data, strict=True)


def test_encoding_of_a_late_declaration_is_used():
    text = "\n<?xml version='1.0' encoding='latin-1'?><robot name='r'><link name='\xe9'/></robot>"
    assert parse_urdf(text.encode("latin-1")).links[0].name == "\xe9"
    assert parse_urdf(text).links[0].name == "\xe9"


def test_comment_marks_in_cdata_are_text():
    assert len(parse_urdf(SMALL.replace("<gazebo/>", "<a><![CDATA[ <!-- -- --> ]]></a>")).links) == 2


def test_many_comments_take_linear_time():
    text = SMALL.replace("<gazebo/>", "<!-- -- -->" * 20_000 + "<!-- a -->" * 20_000)
    assert len(parse_urdf(text).remarks) == 20_000
