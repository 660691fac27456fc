"""What a document says twice and differently: followed where that is possible, else refused by its place."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from trace_models import Custom, build, read_document

import kineverse as kv
from kineverse.formats.document import read_operations, to_json, traces
from kineverse.model.body import Box

HEIGHT = "frame car"


def placed(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Read a pose, a number, whether something is there, and what bodies there are."""
    height = model.fk("car")[2, 3] + model.data["number"] + len(list(model.bodies)) + ("x" in model.data)
    return kv.model.Writes(frames={"knob": ("car", kv.translation(0, 0, height))}, data={"tall": height})


def tree() -> dict[str, Any]:
    """Return a document of something that is read, and of an operation that reads it."""
    content: dict[str, Any] = json.loads(to_json(build(placed)))
    return content


def sealed(content: dict[str, Any]) -> str:
    """Return the text of a document without the hash, which no longer belongs to it."""
    return json.dumps({key: value for key, value in content.items() if key != "sha256"})


def custom(content: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = content["operations"][-1]
    assert found["tag"] == "custom"
    assert found["trace"]
    return found


def read(content: dict[str, Any], prefix: str | None = None) -> kv.Model:
    return read_document(sealed(content), prefix)


def without_reads(content: dict[str, Any]) -> None:
    custom(content)["reads"] = {}


def existence_only(content: dict[str, Any]) -> None:
    reads = custom(content)["reads"]
    custom(content)["reads"] = {"existence": [*reads.get("existence", []), *reads["value"]]}


def without_one(content: dict[str, Any]) -> None:
    custom(content)["reads"]["value"].remove("frames/car")
    custom(content)["reads"].pop("listing")


def with_more(content: dict[str, Any]) -> None:
    custom(content)["reads"]["value"] += ["data/nowhere", "frames/flap"]


@pytest.mark.parametrize("prefix", [None, "a"])
@pytest.mark.parametrize("tamper", [without_reads, existence_only, without_one, with_more])
def test_queries_count_as_reads_even_if_the_document_omits_them(
    tamper: Callable[[dict[str, Any]], None], prefix: str | None
) -> None:
    content = tree()
    tamper(content)
    model, live = read(content, prefix), build(placed, car=kv.translation(0, 0, 7), number=2.25)
    before = f"{prefix}/" if prefix else ""
    with model.edit() as edit:
        edit.replace(f"{before}data number", kv.model.SetData(f"{before}number", 2.25))
        car = kv.model.Frame.from_transform("world", kv.translation(0, 0, 7))
        edit.replace(f"{before}frame car", kv.model.AddFrame(f"{before}car", car))
    at = {f"{before}{name}": 0.3 for name in ("lift", "hinge")}
    found = model.fk(f"{before}knob")(at)
    np.testing.assert_allclose(found, live.fk("knob")({"lift": 0.3, "hinge": 0.3}), rtol=1e-13, atol=1e-14)
    assert float(found[2, 3]) == 7 + 7 + 2.25
    assert float(model.data[f"{before}tall"]) == 9.25


def test_listed_names_count_as_reads_even_if_the_document_omits_them() -> None:
    content = tree()
    without_reads(content)
    model = read(content)
    with pytest.raises(kv.errors.EditError, match="the list of all bodies has changed"), model.edit() as edit:
        edit.insert(
            kv.model.AddFrame(
                "new",
                kv.model.Frame.from_transform("world", np.eye(4)),
                kv.model.Body((kv.model.Shape(Box((1, 1, 1))),)),
            ),
            before="custom",
        )


def test_a_consistent_document_has_its_recorded_reads() -> None:
    assert to_json(read(tree())) == to_json(build(placed))
    stripped = tree()
    without_reads(stripped)
    assert to_json(read(stripped)) == to_json(build(placed))


def other_value(content: dict[str, Any]) -> None:
    nodes = custom(content)["nodes"]
    node = len(nodes)
    nodes.append(["constant", 8.125])
    custom(content)["writes"]["data"]["tall"] = {"expression": node}


def other_name(content: dict[str, Any]) -> None:
    data = custom(content)["writes"]["data"]
    data["small"] = data.pop("tall")


def other_parent(content: dict[str, Any]) -> None:
    custom(content)["writes"]["frames"]["knob"]["parent"] = "flap"


def fewer_writes(content: dict[str, Any]) -> None:
    del custom(content)["trace"]["writes"]["data"]


def frozen_too(content: dict[str, Any]) -> None:
    custom(content)["frozen"] = "it looks at all the values that it reads"


def gone(content: dict[str, Any]) -> None:
    """Let the trace be about an answer that the document's own model does not give."""
    next(q for q in custom(content)["trace"]["questions"] if q[0] == "datum")[2] = "nowhere"


def not_written(content: dict[str, Any]) -> None:
    content["operations"][0]["parameters"]["frame"] = {"written": "frames/elsewhere"}


def homeless(content: dict[str, Any]) -> None:
    (hinge,) = (o for o in content["operations"] if o["tag"] == "hinge")
    hinge["writes"]["articulations"]["hinge"]["home"] = [0.0, 0.5]


@pytest.mark.parametrize(
    ("tamper", "message"),
    [
        (other_value, r"\('custom'\), trace: it leads to other values than the writes"),
        (other_parent, r"\('custom'\), trace: it leads to other values than the writes"),
        (other_name, r"\('custom'\), trace: it writes other things than the operation"),
        (fewer_writes, r"\('custom'\), trace: it writes other things than the operation"),
        (frozen_too, r"\('custom'\), trace: an operation with a trace is not frozen"),
        (gone, r"\('custom'\), trace: it cannot be followed: it needs more than there is"),
        (
            not_written,
            r"\('frame car'\), parameters: 'frames/elsewhere' is not among the values that it writes",
        ),
        (homeless, r"writes articulations/hinge: .* has 2 homes for 1 coordinates"),
    ],
)
def test_contradictions_are_refused(tamper: Callable[[dict[str, Any]], None], message: str) -> None:
    content = tree()
    tamper(content)
    with pytest.raises(kv.errors.FormatError, match=message):
        read_operations(sealed(content))


@pytest.mark.parametrize("work", [0, 100, 500])
def test_of_traces_that_are_too_much_work_reads_are_known_all_the_same(
    work: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(traces, "MAX_WORK", work)
    content = tree()
    without_reads(content)
    assert to_json(read(content)) == to_json(build(placed))
    other_value(content)
    assert float(read(content).data["tall"]) == 8.125  # and values are taken as they are said


def test_custom_code_is_written_as_before() -> None:
    """Comparing does not change what is written, nor how it is called."""
    model = build(placed)
    assert isinstance(model.history.operation("custom"), Custom)
    assert kv.formats.document_hash(model) == kv.formats.document_hash(read(json.loads(to_json(model))))


def implicit(content: dict[str, Any]) -> list[Any]:
    found: list[Any] = next(
        node for one in content["operations"] for node in one.get("nodes", []) if node[0] == "implicit"
    )
    return found


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        (3, lambda u, x: [], "the residual is about"),
        (3, lambda u, x: [*u, *u], "a symbol is given twice"),
        (3, lambda u, x: [*u, x[0]], "a symbol is given twice"),
        (2, lambda x, _: x[:1], "has 1 unknowns; seed and rows are as many"),
        (5, lambda rows, _: [0] * len(rows), "rows are 2 different ones"),
        (5, lambda rows, _: [99] * len(rows), "rows are 2 different ones"),
        (8, lambda u, _: [*u, *u], "2 arguments for 1 inputs"),
    ],
)
def test_loops_that_contradict_themselves_are_refused(
    place: int, change: Callable[[list[Any], list[Any]], list[Any]], message: str
) -> None:
    content = json.loads(to_json(kv.load("articulations/four_bar")))
    node = implicit(content)
    node[place] = change(node[place], node[2])
    with pytest.raises(kv.errors.FormatError, match=rf"nodes\[\d+\]: .*{message}"):
        read_operations(sealed(content))
