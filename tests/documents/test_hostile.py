"""Documents that are small as text and large as work: refused with one error, or used without harm."""

from __future__ import annotations

import contextlib
import json
import random
import resource
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.formats.document import budget, encoding, read_operations, traces

ONE: list[Any] = ["constant", 1.0]
A: list[Any] = ["symbol", "a", 0, "dof"]
B: list[Any] = ["symbol", "b", 0, "dof"]
AV: list[Any] = ["symbol", "a", 1, "dof"]
POSE = [[1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0]]
STEPS = "more than 30,000,000 steps"


def document(nodes: list[Any], operations: list[Any]) -> str:
    """Return a document of operations that each have the table, or of one that only has the table."""
    given = [{**one, "nodes": nodes} for one in operations or [operation("t", {})]]
    return json.dumps({"format": "kineverse", "version": 2, "operations": given})


def operation(tag: str, writes: Any, reads: Any = None, **others: Any) -> dict[str, Any]:
    return {"tag": tag, "kind": "K", "reads": reads or {}, "writes": writes, **others}


def constraint(ref: int, name: str = "c") -> dict[str, Any]:
    return operation(name, {"constraints": {name: [0, ref, 1]}})


def about_last(nodes: list[Any]) -> str:
    return document(nodes, [constraint(len(nodes) - 1)])


def repeated(levels: int, *types: Any, start: list[Any] | None = None) -> str:
    """Return a document in which each level is made of the one before it, twice."""
    nodes = [*(start or [ONE, A])]
    for _ in range(levels):
        for make in types:
            nodes.append(make(len(nodes) - 1))
    return about_last(nodes)


def symbols(count: int) -> list[Any]:
    return [ONE, *(["symbol", f"s{i}", 0, "dof"] for i in range(count))]


def newton_in_newton(levels: int, steps: int) -> str:
    """Return functions whose residuals have the one before them at the unknown."""
    nodes: list[Any] = [ONE, A]
    before: list[Any] | None = None
    for i in range(levels):
        x, u = len(nodes), len(nodes) + 1
        nodes += [["symbol", f"x{i}", 0, "dof"], ["symbol", f"u{i}", 0, "dof"]]
        nodes += (
            [["elementary", "sin", [x]]] if before is None else [[*before, [x], []], ["element", u + 1, 0]]
        )
        nodes += [["elementary", "sub", [len(nodes) - 1, u]], ["elementary", "add", [len(nodes), x]]]
        nodes += [["matrix", [1], [len(nodes) - 1]], ["matrix", [1], [u]]]
        before = ["implicit", f"f{i}", [x], [u], len(nodes) - 2, [0], len(nodes) - 1, steps]
    nodes += [[*(before or []), [1], []], ["element", len(nodes), 0]]
    return about_last(nodes)


def many_unknowns(count: int) -> str:
    nodes = [ONE, A, *(["symbol", f"x{i}", 0, "dof"] for i in range(count))]
    nodes += [["matrix", [count], list(range(2, 2 + count))], ["matrix", [count], [0] * count]]
    rows, x = list(range(count)), list(range(2, 2 + count))
    nodes += [["implicit", "f", x, [1], len(nodes) - 2, rows, len(nodes) - 1, 100, [1], []]]
    return about_last([*nodes, ["element", len(nodes) - 1, 0]])


def composed(levels: int) -> str:
    start = [ONE, A, ["symbol", "v", 1, "dof"], ["elementary", "sin", [1]], ["carried", 1, [[1, [[2, 3]]]]]]
    return repeated(
        levels,
        lambda last: ["elementary", "mul", [last, last]],
        lambda last: ["composed", last - 1, [[1, last]]],
        start=start,
    )


def ring_of_rates(count: int) -> str:
    """Return rates in a chain, each row made of the next coordinate, the last of the first."""
    nodes: list[Any] = [ONE]
    for i in range(count):
        nodes += [["symbol", f"x{i}", 0, "dof"], ["symbol", f"x{i}", 1, "dof"]]
    nodes.append(["symbol", "v", 1, "dof"])
    last = len(nodes) - 1
    rates = {
        f"x{i}": [1 + 2 * i, [[4 + 2 * i if i < count - 1 else last, 1 + 2 * ((i + 1) % count)]]]
        for i in range(count)
    }
    return document(nodes, [operation("rates", {"rates": rates})])


REFUSED = {
    "elements of nothing": (document([["matrix", [0, 1 << 24], []]], []), "too large"),
    "arrays again and again": (
        document([ONE, A, ["matrix", [9000], [1] * 9000], *(["not", i] for i in range(2, 300))], []),
        STEPS,
    ),
    "an array in many arguments": (
        document([ONE, A, ["matrix", [3000], [1] * 3000], ["and", [*([2] * 3000)]]], []),
        "9000000 elements are more than 10000",
    ),
    "a wide conjunction": (document([*symbols(20_000), ["and", [*range(1, 20_001)]]], []), "more than 10000"),
    "a long norm": (
        document([*symbols(2000), ["matrix", [2000], list(range(1, 2001))], ["norm", 2001]], []),
        "norm of 2000 elements",
    ),
    "pieces for each element": (
        document(
            [ONE, A, ["matrix", [900], [1] * 900], ["piecewise", 2, True, list(range(901)), [[1, 2]] * 900]],
            [],
        ),
        "1620000 coefficients",
    ),
    "Newton in Newton": (newton_in_newton(10, 8), STEPS),
    "many unknowns": (many_unknowns(200), STEPS),
    "compositions of compositions": (composed(13), "more than 12 compositions"),
    "constraints about all that is below": (
        document(
            [
                *symbols(600),
                *(["less", 1, i, 10.0] for i in range(1, 601)),
                ["and", [*range(601, 1201)]],
                *(["elementary", "mul", [1201, i]] for i in range(1, 3001)),
            ],
            [operation("all", {"constraints": {f"c{i}": [0, 1202 + i, 1] for i in range(3000)}})],
        ),
        STEPS,
    ),
    "coupled rates": (ring_of_rates(1500), STEPS),
    "listings of everything": (
        document(
            [], [operation(f"o{i}", {"data": {f"d{i}": i}}, {"listing": ["data"]}) for i in range(3000)]
        ),
        STEPS,
    ),
    "answers of many elements": (document([["read", 0, 0, [10_001], []]], []), "elements are more than"),
    "a long way into a gradient": (document([A, AV, ["read", 0, 0, [], [[1, True]] * 17]], []), "up to 16"),
    "deep parameters": (
        document([], [operation("t", {}, parameters={"p": json.loads("[" * 200 + "]" * 200)})]),
        "nested too deeply",
    ),
    "deep data": (
        document([], [operation("t", {"data": {"x": json.loads("[" * 200 + "]" * 200)}})]),
        "nested too deeply",
    ),
    "integers in plain": (document([], [operation("t", {"data": {"x": 1 << 64}})]), "more than 64 bits"),
    "a question for a thing that is none": (
        document([], [operation("t", {}, trace={"questions": [["frame", 0, 7]], "writes": {}})]),
        "text is expected",
    ),
    "an answer to what is not asked": (
        document(
            [ONE, ["read", 1, 0, [], []]],
            [
                operation(
                    "t",
                    {"data": {"x": 1}},
                    trace={"questions": [["datum", 0, "y"]], "writes": {"data": {"x": {"expression": 1}}}},
                )
            ],
        ),
        "question 1, which is not asked",
    ),
    "a part that an answer has not": (
        document(
            [ONE, ["read", 0, 7, [], []]],
            [
                operation("up", {"data": {"y": 2.0}}),
                operation(
                    "t",
                    {"data": {"x": 1}},
                    trace={"questions": [["datum", 0, "y"]], "writes": {"data": {"x": {"expression": 1}}}},
                ),
            ],
        ),
        "needs more than there is",
    ),
    "an answer outside of a trace": (
        document([["read", 0, 0, [], []]], [operation("t", {"data": {"x": {"expression": 0}}})]),
        "outside of a trace",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.sampled(2)
def test_document_beyond_the_budget_is_refused(name: str) -> None:
    text, reason = REFUSED[name]
    assert len(text) < 1_000_000
    with pytest.raises(kv.errors.FormatError, match=reason):
        read_operations(text)


@pytest.mark.parametrize(
    "others", [{"parameters": {"x": [1] * 100}}, {"reads": {"value": ["data/x"] * 100}}, {}]
)
def test_values_and_reads_are_work(others: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "MAX_WORK", 90)
    with pytest.raises(kv.errors.FormatError, match="more than 90 steps"):
        read_operations(
            document([], [operation("t", {"data": {"x": [] if others else [1] * 100}}, **others)])
        )


def test_an_expression_of_any_depth_is_compared() -> None:
    """CasADi's own serialisation recurses, and would end the process."""
    ((_, deep),) = read_operations(
        about_last([ONE, A, *(["elementary", "sin", [i]] for i in range(1, 100_000))])
    )
    assert hash(deep.recorded["constraints", "c"])


def test_coupled_rates_that_come_alone_are_work() -> None:
    (rates,) = json.loads(ring_of_rates(1500))["operations"]
    blob = encoding.make_blob(rates)
    with pytest.raises(kv.errors.FormatError, match=STEPS):
        kv.formats.operation_from_bytes(blob)


def test_refusing_ten_million_nodes_takes_no_memory() -> None:
    text = (
        b'{"format":"kineverse","version":2,"operations":[{"nodes":[["constant",1.0]'
        + b',["constant",1.0]' * 10_000_000
    )
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(kv.errors.FormatError, match="more than 10,000,000 lists"):
        read_operations(text + b"]}]}")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 600_000  # kB; the text is 170 MB


@pytest.mark.parametrize(
    "text", ["[" * 1_000_000, '{"a":' * 1_000_000, '{"format":"kineverse","x":' + "[" * 1_000_000]
)
def test_nesting_of_a_million_levels_is_refused(text: str) -> None:
    with pytest.raises(kv.errors.FormatError, match=r"nested too deeply|does not begin with"):
        read_operations(text)


def used(levels: int, compositions: int) -> dict[str, str]:
    """Return documents that are read, by name, of so many levels where these cost something."""
    return {
        "sums of sums": repeated(50_000, lambda last: ["elementary", "add", [last, last]]),
        "products of products": repeated(
            300, lambda last: ["elementary", "mul", [last, last]], lambda last: ["elementary", "sin", [last]]
        ),
        "augmented again and again": repeated(
            levels,
            lambda last: ["elementary", "mul", [last, last]],
            lambda last: ["augment", last, False, False, [[2, last - 1]]],
            start=[ONE, A, AV, ["elementary", "sin", [1]]],
        ),
        "choices of choices": repeated(
            levels,
            lambda last: ["elementary", "sin", [last]],
            lambda last: ["select", last - 1, last, last - 1],
        ),
        "logic of logic": repeated(
            levels,
            lambda last: ["less", last, last - 1, 1.0],
            lambda last: ["and", [last, last - 1]],
            start=[ONE, A, B],
        ),
        "smallest of largest": repeated(
            levels,
            lambda last: ["extremum", "min", [last, last - 1]],
            lambda last: ["extremum", "max", [last - 1, last]],
            start=[ONE, A, B],
        ),
        "norms of norms": repeated(
            levels, lambda last: ["matrix", [3], [last, 1, last]], lambda last: ["norm", last]
        ),
        "profiles of profiles": repeated(
            levels, lambda last: ["piecewise", last, True, [0, 1, 2], [[1, 2, 3], [1, 2, 4]]]
        ),
        "compositions": composed(compositions),
        "Newton in Newton": newton_in_newton(2, 3),
        "a table of rates": ring_of_rates(60),
    }


USED, DEEP = used(60, 7), used(190, 10)


@pytest.mark.parametrize(
    "text",
    [
        *(pytest.param(text, id=name) for name, text in USED.items()),
        *(
            pytest.param(text, id=f"{name}, deep", marks=pytest.mark.long)
            for name, text in DEEP.items()
            if text != USED[name]
        ),
    ],
)
def test_accepted_document_can_be_evaluated(text: str, tmp_path: Any) -> None:
    """Poses, both gradients, evaluation, relevance, validity, saving, and an edit: nothing hangs or crashes."""
    path = tmp_path / "hostile.kv.json"
    path.write_text(text)
    model = kv.load(path)
    for given in model.constraints.values():
        e = given.expression
        gradients = [*e.gradient().values(), *e.gradient(heuristic=False).values()]
        f = kv.compile([e, *gradients], tier="interpreter")
        with contextlib.suppress(kv.errors.NoSolutionError):
            f(np.full(len(f.inputs), 0.3))
        assert model.constraints_for(e)
    model.save(tmp_path / "again.kv.json")
    assert kv.formats.document_hash(kv.load(tmp_path / "again.kv.json")) == kv.formats.document_hash(model)
    with model.edit() as edit:
        edit.replace(model.history.tags[0], kv.model.SetData("nothing", 0))


def growing(question: Any, count: int) -> str:
    """Return a trace in which each question is about the answer to the one before it."""
    nodes: list[Any] = [ONE, A, ["read", 0, 0, [], []], ["matrix", [1], [1]]]
    questions: list[Any] = [["datum", 0, "up"]]
    for i in range(count):
        last = len(nodes) - 1 if i else 2
        nodes.append(["elementary", "mul", [last, last]])
        nodes.append(["matrix", [1], [len(nodes) - 1]])
        questions.append(question(len(nodes) - 2, len(nodes) - 1))
        nodes.append(["read", i + 1, 0, [], []])
    writes = {"data": {"y": {"expression": len(nodes) - 1}}}
    return document(
        nodes,
        [
            operation("up", {"data": {"up": {"expression": 1}}}),
            operation(
                "t",
                {"data": {"y": {"expression": 0}}},
                {"value": ["data/up"]},
                trace={"questions": questions, "writes": writes},
            ),
        ],
    )


@pytest.mark.parametrize("look", [0, 2])
@pytest.mark.parametrize("work", [1_000_000, pytest.param(budget.MAX_WORK, id="all", marks=pytest.mark.long)])
def test_edit_upstream_of_an_exploding_trace_is_refused(
    work: int, look: int, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(traces, "MAX_WORK", work)  # of reading; the edit has a limit of its own
    path = tmp_path / "hostile.kv.json"
    path.write_text(growing(lambda e, at: ["substitute", look, e, 3, at], 60))
    model = kv.load(path)
    before = model.snapshot()
    with (
        pytest.raises(kv.errors.EditError, match=r"made of more than 200,000 nodes|which has changed"),
        model.edit() as edit,
    ):
        edit.replace("up", kv.model.SetData("up", 2 * kv.position("z")))
    assert model.snapshot() == before


def test_cycle_of_frames_is_refused(tmp_path: Any) -> None:
    path = tmp_path / "circle.kv.json"
    circles = (
        [operation("f", {"frames": {"f": {"parent": "f", "factors": [POSE]}}})],
        [operation("f", {"frames": {n: {"parent": p, "factors": [POSE]} for n, p in ("fg", "gf")}})],
        [
            operation(n, {"frames": {n: {"parent": p, "factors": [POSE]}}})
            for n, p in (("f", "world"), ("g", "f"))
        ]
        + [operation("h", {"frames": {"f": {"parent": "g", "factors": [POSE]}}})],
        [operation("w", {"frames": {"world": {"parent": "world", "factors": [POSE]}}})],
    )
    for operations in circles:
        path.write_text(document([], operations))
        model = kv.load("shelf_door")
        before = model.snapshot()
        with pytest.raises(kv.KineverseError):
            model.include(path)
        assert model.snapshot() == before
        with pytest.raises(kv.errors.FormatError, match=r"circle\.kv\.json"):
            kv.load(path)


def test_very_long_kinematic_chain_is_read(tmp_path: Any) -> None:
    """Frames on frames are many, and no way down."""
    count = 3000
    operations = [
        operation(
            f"f{i}",
            {"frames": {f"f{i}": {"parent": f"f{i - 1}" if i else "world", "factors": [POSE]}}},
            {"existence": [f"frames/f{i - 1}"]} if i else {},
        )
        for i in range(count)
    ]
    path = tmp_path / "arm.kv.json"
    path.write_text(document([], operations))
    assert kv.load(path).fk(f"f{count - 1}")[0, 3]() == count / 2


def test_random_tables_are_read_or_refused() -> None:
    """Tables by grammar: nodes of all types over anything that came before."""
    draw = random.Random(7)
    for _ in range(20):
        nodes: list[Any] = [ONE, ["constant", -0.5], A, B, ["symbol", "v", 1, "dof"]]
        for _ in range(30):
            ref = lambda: draw.randrange(len(nodes))  # noqa: E731, B023
            nodes.append(
                draw.choice(
                    [
                        ["elementary", draw.choice(["add", "mul", "div", "pow"]), [ref(), ref()]],
                        ["elementary", draw.choice(["sin", "sqrt", "log", "floor"]), [ref()]],
                        ["matrix", [2], [ref(), draw.choice([None, ref()])]],
                        ["element", ref(), draw.randrange(3)],
                        ["augment", ref(), draw.random() < 0.5, draw.random() < 0.5, [[4, ref()]]],
                        ["less", ref(), ref(), 2.0],
                        ["and", [ref(), ref()]],
                        ["select", ref(), ref(), ref()],
                        ["extremum", "min", [ref(), ref()]],
                        ["norm", ref()],
                        ["carried", 2, [[2, [[4, ref()]]]]],
                        ["composed", ref(), [[2, ref()]]],
                        ["dependent", ref(), 3],
                        ["implicit", "f", [3], [2], ref(), [0], ref(), 2, [ref()], []],
                        [
                            "implicit",
                            "f",
                            [3],
                            [2],
                            ref(),
                            [0],
                            ref(),
                            2,
                            [ref()],
                            [[ref(), 0.5 + draw.random()]],
                        ],
                    ]
                )
            )
            try:
                read_operations(document(nodes, [constraint(len(nodes) - 1)]))
            except kv.errors.FormatError:
                nodes.pop()


def test_unreadable_model_is_not_written(tmp_path: Any) -> None:
    """The writer keeps the limits of the reader; parameters that go too deep are left out."""
    deep: Any = 1
    for _ in range(150):
        deep = (deep,)
    model = kv.Model()
    with model.edit() as edit:
        edit.write("deep", deep)
    with pytest.raises(kv.errors.FormatError, match="nested too deeply"):
        model.save(tmp_path / "deep.kv.json")
    wide = kv.Model()
    with wide.edit() as edit:
        edit.constrain("all", 0, kv.logic.logic_and(*(kv.position(f"s{i}") for i in range(10_001))), 1)
    with pytest.raises(kv.errors.FormatError, match="up to 10000 elements"):
        wide.save(tmp_path / "wide.kv.json")
