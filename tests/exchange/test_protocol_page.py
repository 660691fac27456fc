"""The page about the protocol says what the structs are: every message, its tag and its fields in order."""

from __future__ import annotations

import re
from typing import get_args

import msgspec

from kineverse.exchange import authority, conflicts, meshes, protocol, server
from markdown_examples import ROOT

PAGE = (ROOT / "docs" / "protocol.md").read_text("utf-8")


def listed() -> dict[str, tuple[str, list[str], list[str]]]:
    """Return tag, required and further fields of each message on the page."""
    found = {}
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if re.fullmatch(r"`[A-Z]\w+`", cells[0]):
            tag = cells.pop(1).strip("`") if re.fullmatch(r"`[a-z]+`", cells[1]) and len(cells) > 2 else ""
            required, _, further = cells[1].partition(";")
            found[cells[0].strip("`")] = (
                tag,
                re.findall(r"`(\w+)`", required),
                re.findall(r"`(\w+)`", further),
            )
    return found


def test_the_page_names_every_message_with_its_fields_in_order() -> None:
    defined = {}
    for name, struct in vars(protocol).items():
        if isinstance(struct, type) and issubclass(struct, protocol._Message) and not name.startswith("_"):
            fields = msgspec.structs.fields(struct)
            defined[name] = (
                struct.__struct_config__.tag or "",
                [field.name for field in fields if field.required],
                [field.name for field in fields if not field.required],
            )
    assert listed() == defined


def test_the_page_has_the_reasons_and_the_bounds() -> None:
    reasons = PAGE.partition("| reason |")[2].partition("##")[0]
    assert tuple(re.findall(r"^\| `(\w+)` \|", reasons, re.MULTILINE)) == get_args(protocol.Reason)
    for number in (protocol.MAX_BYTES, protocol.MAX_OPERATIONS, meshes.MAX_PART):
        assert f"{number:,}".replace(",", " ") in PAGE
    assert f"last {conflicts.KEPT:,} revisions".replace(",", " ") in PAGE
    assert f"last {authority.ANSWERS:,} answers".replace(",", " ") in PAGE
    assert f"up to {server.MOST_TOGETHER} edits or {1e3 * server.LONGEST_WAIT:g} ms" in PAGE
    assert f"every {server.BEAT:g} s" in PAGE
    assert f"version {protocol.PROTOCOL}." in PAGE
