"""Texts are read and written in an encoding that is said, not in that of the environment."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
CALLS = re.compile(r"\b(read_text|write_text|run|Popen|check_output|open)\s*\(")


def unsaid_encodings(tree: ast.AST) -> Iterator[ast.Call]:
    """Yield calls that open, read or write a text, or run a program that does, without an encoding."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        keywords = {k.arg: k.value for k in node.keywords}
        if "encoding" in keywords:
            continue
        if name in ("read_text", "write_text"):
            if len(node.args) <= (name == "write_text"):
                yield node
        elif name in ("run", "Popen", "check_output") and {"text", "universal_newlines"} & keywords.keys():
            yield node
        elif name == "open" and (isinstance(function, ast.Name) or not node.args or is_mode(node.args[0])):
            modes = [a for a in (*node.args, keywords.get("mode")) if a is not None and is_mode(a)]
            if not any("b" in ast.literal_eval(mode) for mode in modes):
                yield node


def is_mode(node: ast.AST) -> bool:
    value = getattr(node, "value", None)
    return isinstance(value, str) and bool(value) and set(value) <= set("rwxabt+")


def test_calls_without_an_encoding_are_found() -> None:
    wrong = 'p.read_text()\nq.write_text("a")\nopen(p)\np.open()\nopen(p, "w")\np.open("w")\nrun(c, text=True)\nopen(p, mode="a")'
    right = 'p.read_text("utf-8")\nq.write_text("a", "utf-8")\nopen(p, "rb")\np.open("wb")\nrun(c)\ncache.open(key)\nopen(p, mode="ab")'
    assert [call.lineno for call in unsaid_encodings(ast.parse(wrong))] == [*range(1, 9)]
    assert [*unsaid_encodings(ast.parse(right))] == []


def test_every_text_has_its_encoding() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{call.lineno}: {ast.unparse(call)[:80]}"
        for folder in ("src", "studies", "tools", "examples")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if CALLS.search(text := path.read_text("utf-8"))
        for call in unsaid_encodings(ast.parse(text))
    ]
    assert not found, "\n".join(found)
