"""Hardened XML reader: elements with line numbers, limits on depth and size.

An element is a plain tuple ``(tag, attributes, children, line)``: a file of 10^5 links becomes as many tuples
in linear time. Document types, and with them all declarations of entities, are refused, so that nothing is
expanded or fetched. Nesting and size are bounded. Text is dropped, unless the text of elements without
children is requested.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple, NoReturn, TypeAlias
from xml.parsers import expat
from xml.parsers.expat import errors

from kineverse.errors import FormatError

from .files import MAX_BYTES

MAX_DEPTH = 200  # deepest nesting of elements. A URDF needs 5, however long its kinematic chains are
Element: TypeAlias = "tuple[str, dict[str, str], list[Element], int]"  # tag, attributes, children, line

_CHUNK_BYTES = 1 << 12

TEXT = ""  # key of the text of an element among its attributes; no attribute of XML has an empty name

Visit: TypeAlias = Callable[[Element], None]
Begin: TypeAlias = Callable[[Element], Visit]
XmlFaultHandler: TypeAlias = Callable[[int, str], None]
"""Handler of faults in the XML that can be repaired, called with the line and a description."""


class ElementError(Exception):
    """Mistake in an element; the reader that knows the file turns it into a FormatError."""

    def __init__(self, element: Element, message: str):
        super().__init__(message)
        self.element = element
        self.message = message

    def __reduce__(self) -> tuple[object, ...]:
        return ElementError, (self.element, self.message)

    def located(self, source: str, owner: Element | None = None) -> FormatError:
        """Return the error with its file and line; the element is ``owner`` or a part of it."""
        part = "" if owner in (None, self.element) else f"{label(self.element)} "
        where = f"{source}, line {self.element[3]}, {label(owner or self.element)}"
        return FormatError(f"{where}: {part}{self.message}")


def parse_xml(
    data: str | bytes,
    source: str,
    skipped: frozenset[str] = frozenset(),
    begin: Begin | None = None,
    texts: bool = False,
    depth: int = MAX_DEPTH,
    on_recoverable_error: XmlFaultHandler | None = None,
) -> Element:
    """Parse a document and return its root element."""
    if len(data) > MAX_BYTES:
        raise FormatError(f"{source}: larger than {MAX_BYTES} bytes, the most that is read of one document.")
    encoding = None
    if on_recoverable_error is not None:
        text, (data, encoding) = data, _declared(data, on_recoverable_error)
        data = _commented(data, on_recoverable_error)
        if isinstance(text, str) and not isinstance(data, str):
            encoding = "utf-8"
    parser = expat.ParserCreate(encoding)
    document: list[Element] = []
    open_lists = [document]
    skipped_depth = 0
    visit: Visit | None = None
    pieces: list[str] = []

    def start_root(tag: str, attributes: dict[str, str]) -> None:
        nonlocal visit
        parser.StartElementHandler = start
        start(tag, attributes)
        if begin is not None:
            visit = begin(document[0])
            parser.EndElementHandler = end_visiting

    # These run for every element of the file and are kept short for speed.
    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag in skipped and len(open_lists) == 2:
            parser.StartElementHandler, parser.EndElementHandler = start_skipped, end_skipped
            return
        children: list[Element] = []
        open_lists[-1].append((tag, attributes, children, parser.CurrentLineNumber))
        open_lists.append(children)
        pieces.clear()
        if len(open_lists) > depth:
            refuse_depth(tag)

    def end(tag: str) -> None:
        open_lists.pop()

    def end_with_text(tag: str) -> None:
        children = open_lists.pop()
        if pieces and not children:
            open_lists[-1][-1][1][TEXT] = "".join(pieces)
        pieces.clear()

    def end_visiting(tag: str) -> None:
        open_lists.pop()
        if len(open_lists) == 2:
            visit(open_lists[1].pop())  # type: ignore[misc]  # set before this can be called

    def start_skipped(tag: str, attributes: dict[str, str]) -> None:
        nonlocal skipped_depth
        skipped_depth += 1
        if skipped_depth > depth:
            refuse_depth(tag)

    def end_skipped(tag: str) -> None:
        nonlocal skipped_depth
        if skipped_depth:
            skipped_depth -= 1
        else:
            parser.StartElementHandler = start
            parser.EndElementHandler = end if visit is None else end_visiting

    def refuse_depth(tag: str) -> NoReturn:
        raise FormatError(
            f"{source}, line {parser.CurrentLineNumber}, <{abbreviate(tag)}>: elements are nested more than "
            f"{depth} deep; no robot description needs that."
        )

    def refuse_doctype(name: str, *_: object) -> None:
        raise FormatError(
            f"{source}, line {parser.CurrentLineNumber}, <!DOCTYPE {abbreviate(name)}>: document types and "
            "entities are refused, since they can expand without bound or read other files. Remove the "
            "declaration and write out what its entities stand for."
        )

    parser.StartElementHandler, parser.EndElementHandler = start_root, end_with_text if texts else end
    if texts:
        parser.buffer_text = True
        parser.CharacterDataHandler = pieces.append
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise FormatError(_describe(error, source, document, len(open_lists) - 1)) from None
    except (ValueError, LookupError) as error:
        if document or isinstance(error, FormatError):
            raise
        # An encoding that expat lacks, or a str with lone surrogates.
        raise FormatError(f"{source}, line 1: cannot be decoded: {error}. Save it as UTF-8.") from None
    return document[0]


def read_root_tag(data: bytes) -> str:
    """Return the tag of the root element; empty if there is none."""
    text, encoding = _declared(data, lambda *_: None)
    parser = expat.ParserCreate(encoding)
    found: list[str] = []

    def start(tag: str, _: dict[str, str]) -> None:
        found.append(tag)
        parser.StartElementHandler = None

    parser.StartElementHandler = start
    parser.StartDoctypeDeclHandler = lambda *_: found.append("")
    try:
        for begin in range(0, len(text), _CHUNK_BYTES):
            parser.Parse(text[begin : begin + _CHUNK_BYTES])
            if found:
                break
    except (expat.ExpatError, ValueError, LookupError):
        pass  # the reader of the whole document reports the error
    return found[0] if found else ""


class StartTag(NamedTuple):
    """Start tag of an element in a document of UTF-8, ``data[begin:end]``."""

    element: Element  # without its children
    depth: int  # 1 for the root
    begin: int
    end: int


def find_start_tags(data: bytes) -> list[StartTag]:
    """Return all start tags of a document in UTF-8 that :func:`parse_xml` has read, in its order."""
    same_length, _ = _declared(data, lambda *_: None)
    text = _bytes(_commented(same_length, lambda *_: None))
    before = len(data) - len(text)  # the byte order mark, which may have been removed
    parser = expat.ParserCreate("utf-8")
    found: list[StartTag] = []
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        begin = parser.CurrentByteIndex
        whole = _START_TAG.match(text, begin)
        assert whole is not None
        element: Element = (tag, attributes, [], parser.CurrentLineNumber)
        found.append(StartTag(element, depth, begin + before, whole.end() + before))

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(text, True)
    return found


_START_TAG = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_DECLARED = re.compile(rb"\s*(?:<!--(?:(?!-->).)*-->\s*)*<\?xml\s[^<>]*\?>", re.DOTALL)
_GOOD = re.compile(rb"<\?xml\s+version\s*=\s*[\"']1\.\d[\"']")
_ENCODING = re.compile(rb"encoding\s*=\s*[\"']([\w.-]{1,40})[\"']")
_NOT_A_BREAK = re.compile(rb"[^\n]")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def _bytes(data: str | bytes) -> bytes:
    try:
        return data.encode() if isinstance(data, str) else data
    except UnicodeEncodeError:  # the parser reports it
        return b""


def _declared(data: str | bytes, on_recoverable_error: XmlFaultHandler) -> tuple[str | bytes, str | None]:
    """Return a document with blanks for a misplaced or misspelt declaration, and the encoding in it."""
    content = _bytes(data[: 1 << 16]).removeprefix(_BYTE_ORDER_MARK)
    good = _GOOD.match(content)
    if good and not _DECLARED.match(content, content.find(b">", good.end()) + 1):
        return data, None
    found, end, encoding = _DECLARED.match(content), 0, None
    while found is not None:
        said = _ENCODING.search(content[end : found.end()])
        encoding = encoding or (said[1].decode() if said else None)
        end = found.end()
        found = _DECLARED.match(content, end)
    if not end:
        return data, None
    line = content[:end].count(b"\n") + 1
    on_recoverable_error(
        line, "<?xml ...?>: is not the first of the file, or misspelt, which XML forbids; it is passed over."
    )
    rest = _bytes(data).removeprefix(_BYTE_ORDER_MARK)
    blank = _NOT_A_BREAK.sub(b" ", rest[:end]) + rest[end:]
    return blank, encoding


def _commented(data: str | bytes, on_recoverable_error: XmlFaultHandler) -> str | bytes:
    content = _bytes(data)
    pieces: list[bytes] = []
    start, at, literal = 0, 0, content.find(b"<![CDATA[")
    line, counted = 1, 0
    while (at := content.find(b"<!--", at)) >= 0:
        if 0 <= literal < at:
            end = content.find(b"]]>", literal)
            if end < 0:
                break
            at, literal = max(at, end), content.find(b"<![CDATA[", end)
            continue
        end = content.find(b"-->", at + 4)
        if end < 0:
            break
        inside = content[at + 4 : end]
        if b"--" in inside or inside.endswith(b"-"):
            line, counted = line + content.count(b"\n", counted, at), at
            on_recoverable_error(
                line, "<!-- ... -->: has '--' inside, which XML forbids; it is a comment all the same."
            )
            pieces += [content[start:at], _NOT_A_BREAK.sub(b" ", content[at : end + 3])]
            start = end + 3
        at = end + 3
    return b"".join([*pieces, content[start:]]) if pieces else data


def decode_xml(data: str | bytes) -> str | None:
    """Return the text of a document; None if it cannot be decoded."""
    if isinstance(data, str):
        return data
    said = _ENCODING.search(data[:_CHUNK_BYTES].replace(b"\0", b"").partition(b"?>")[0])
    encoding = "utf-8-sig" if said is None else said[1].decode()
    try:
        return data.decode(encoding)
    except (UnicodeDecodeError, LookupError):
        return None


def read_name(element: Element) -> str:
    """Return the name of an element."""
    name = element[1].get("name")
    if not name:
        raise ElementError(
            element, "has no name; names are required." if name is None else "has an empty name."
        )
    return name


def find_child(element: Element, tag: str) -> Element | None:
    """Return the first child with a tag, None if there is none."""
    for candidate in element[2]:
        if candidate[0] == tag:
            return candidate
    return None


def label(element: Element) -> str:
    """Return an element as its opening tag, with its name if it has one, for errors."""
    tag, attributes, _, _ = element
    name = attributes.get("name")
    return f"<{abbreviate(tag)}>" if name is None else f"<{abbreviate(tag)} name={quote(name)}>"


def quote(text: str) -> str:
    """Return a name in quotes, for errors."""
    return f'"{abbreviate(text)}"'


def abbreviate(text: str, limit: int = 80) -> str:
    """Return text for an error: on one line, printable and of limited length."""
    if not text[:limit].isprintable():
        text = text[:limit].encode("unicode_escape").decode("ascii")  # up to ten times as long
    return text if len(text) <= limit else text[: limit - 1] + "…"


_CUT_OFF = (errors.XML_ERROR_NO_ELEMENTS, errors.XML_ERROR_UNCLOSED_TOKEN)
_DECLARATION = (errors.XML_ERROR_XML_DECL, errors.XML_ERROR_MISPLACED_XML_PI)
_HINTS = {
    errors.XML_ERROR_XML_DECL: 'The first line must read <?xml version="1.0"?>, or be left out.',
    errors.XML_ERROR_MISPLACED_XML_PI: (
        "Nothing, not even an empty line, may come before <?xml ...?>: remove what does."
    ),
    errors.XML_ERROR_UNDEFINED_ENTITY: "Only &lt; &gt; &amp; &quot; &apos; and character numbers are known.",
    errors.XML_ERROR_INVALID_TOKEN: ("A character is where none can be; & and < are written &amp; and &lt;."),
    errors.XML_ERROR_TAG_MISMATCH: "The closing tag is not that of the element.",
    errors.XML_ERROR_DUPLICATE_ATTRIBUTE: "Keep one of the two attributes.",
    errors.XML_ERROR_JUNK_AFTER_DOC_ELEMENT: "Remove what comes after the end of the root element.",
    errors.XML_ERROR_UNKNOWN_ENCODING: "Save the file as UTF-8.",
}


def _describe(error: expat.ExpatError, source: str, document: list[Element], depth: int) -> str:
    innermost: Element | None = None
    children = document
    for _ in range(depth):
        innermost = children[-1]
        children = innermost[2]
    reason = expat.ErrorString(error.code)
    if innermost is not None:
        inside = f", in {label(innermost)} of line {innermost[3]}"
    else:
        inside = "" if document else ", <?xml ...?>" if reason in _DECLARATION else ", before any element"
    unknown = "The text is cut off." if reason in _CUT_OFF else "" if document else "Is this XML at all?"
    where = f"{source}, line {error.lineno}, column {error.offset + 1}{inside}"
    return f"{where}: not well-formed XML: {reason}. {_HINTS.get(reason, unknown)}".rstrip()
