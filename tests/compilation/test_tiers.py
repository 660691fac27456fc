"""Interpreter and C: the same to the last bit, and nobody notices the change."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from compiled_programs import arm, every_operation, points, random_programs, same_bits
from hypothesis import HealthCheck, given, settings
from processes import states_of_group

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.compilation import build_queue, compiler_information
from kineverse.compilation.build_queue import working_seconds
from kineverse.compilation.call_extension import call_extension
from kineverse.compilation.codegen import generate_batch_source
from kineverse.compilation.program import Program
from kineverse.expressions.implicit import ImplicitFunction

a, b = kv.position("door/a"), kv.position("door/b")


def agree(first: kv.CompiledFunction, second: kv.CompiledFunction, rows: np.ndarray) -> None:
    for x in rows:
        for v, w in zip(first(x), second(x), strict=True):
            assert same_bits(v, w)


@pytest.mark.compiler
def test_tiers_agree_to_the_bit_on_an_arm() -> None:
    mechanism = arm()
    outputs = [mechanism.pose, mechanism.jacobian]
    slow, fast = kv.compile(outputs, tier="interpreter"), kv.compile(outputs, tier="c", wait=True)
    assert (slow.tier, fast.tier) == ("interpreter", "c")
    agree(slow, fast, np.random.default_rng(0).uniform(-7, 7, (4000, 7)))


@pytest.mark.compiler
def test_tiers_agree_to_the_bit_on_every_operation() -> None:
    symbols, values = every_operation(depth=6).expressions()
    slow = kv.compile([kv.array(values)], symbols, tier="interpreter")
    agree(slow, kv.compile([kv.array(values)], symbols, tier="c", wait=True), points(3000, 5))


@pytest.mark.compiler
@settings(max_examples=attempts(5), suppress_health_check=[HealthCheck.too_slow])
@given(random_programs())
def test_tiers_agree_to_the_bit_on_random_programs(program) -> None:
    symbols, values = program.expressions()
    slow = kv.compile([kv.array(values)], symbols, tier="interpreter")
    agree(slow, kv.compile([kv.array(values)], symbols, tier="c", wait=True), points(300, 5))


EXTREMES = (*(np.nan, -np.nan, 0.0, -0.0, np.inf, -np.inf, 5e-324, -5e-324, 1e-310, -2.2e-308), *(1.0, -1.0, 0.5),
            *(-2.0, 3.0, 1e300, -1e300, np.pi, 1e5, -1e6, 1e22, 709.0, -745.0, 20.0, 1e-8))  # fmt: skip


@pytest.mark.compiler
def test_signs_zeros_and_nan_are_the_same_in_all_tiers() -> None:
    unary = (
        "sin cos tan arcsin arccos arctan exp expm1 log log1p log2 log10 tanh sinh cosh arcsinh arccosh arctanh sqrt "
        "cbrt abs sign floor ceil rint trunc square negative reciprocal exp2"
    )
    binary = "add subtract multiply divide arctan2 power fmod mod hypot copysign minimum maximum fmin fmax floor_divide"
    outputs = [getattr(np, name)(a) for name in unary.split()]
    outputs += [getattr(np, name)(a, b) for name in binary.split()]
    # The sign of a NaN that is computed differs between scalar and vector instructions.
    outputs += [
        np.copysign(a, getattr(np, name)(b)) for name in ("log", "sqrt", "arccos", "arcsin", "arccosh")
    ]
    slow, fast = (kv.compile(outputs, [a, b], tier=tier, wait=True) for tier in ("interpreter", "c"))
    x = np.array([(one, other) for one in EXTREMES for other in EXTREMES])
    agree(slow, fast, x)
    batches = fast.batch(x), slow.batch(x)
    single = [np.array(column) for column in zip(*map(fast, x), strict=True)]
    for k, (by_c, by_interpreter, exact) in enumerate(zip(*batches, single, strict=True)):
        assert same_bits(by_interpreter, exact), k
        assert (np.isnan(by_c) == np.isnan(exact)).all(), k
        number = ~np.isnan(exact)
        assert (np.signbit(by_c) == np.signbit(exact))[number].all(), k
        assert ((by_c == 0) == (exact == 0))[number].all(), k
        assert (np.isinf(by_c) == np.isinf(exact)).all(), k


@pytest.mark.compiler
def test_calls_through_casadi_and_through_the_extension_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    mechanism = arm()
    direct = kv.compile([mechanism.pose, mechanism.jacobian], tier="c", wait=True)
    evaluator = direct.bind()
    if call_extension.module is None:
        pytest.skip("Python's headers are not installed, so there is no extension to compare")
    monkeypatch.setattr(call_extension, "module", None)
    buffered = kv.compile([mechanism.pose, mechanism.jacobian], tier="c", wait=True)
    assert type(evaluator) is not type(buffered.bind())
    agree(direct, buffered, points(500, 7))
    slow = buffered.bind()
    for x in points(100, 7):
        evaluator(x)
        slow(x)
        assert all(same_bits(v, w) for v, w in zip(evaluator.outputs, slow.outputs, strict=True))


def test_renamed_symbols_share_the_library() -> None:
    first, second = arm("left"), arm("right")
    assert Program([first.pose], first.symbols).key() == Program([second.pose], second.symbols).key()
    assert Program([first.pose], first.symbols).key() != Program([first.jacobian], first.symbols).key()
    assert Program([first.pose], first.symbols).key() != Program([first.pose], first.symbols[::-1]).key()


def test_no_name_reaches_generated_code() -> None:
    names = ["secret", 'x"; system("true"); "', "*/ evil /*", "unicode_é", "a\\nb", "sin"]
    symbols = [kv.position(f"house/{name}") for name in names]
    program = Program([np.sin(sum(symbols[1:], symbols[0]))], symbols)
    for source in (program.source(), generate_batch_source(program)):
        assert not any(word in source for word in ("secret", "house", "system(", "evil", "unicode", "a\\nb"))


@pytest.mark.compiler
def test_switch_to_c_during_calls_from_many_threads() -> None:
    mechanism = arm("busy", joints=6)
    outputs = [mechanism.pose, mechanism.jacobian]
    reference = kv.compile(outputs, tier="interpreter")
    rows = np.random.default_rng(1).uniform(-3, 3, (64, 6))
    wanted = [reference(x) for x in rows]
    # A constant that no other test has, so that it is compiled now.
    f = kv.compile([*outputs, mechanism.pose * 1.0625])
    evaluator = f.bind()
    wrong, after_the_change = [], []
    stop = threading.Event()

    def work(offset: int) -> None:
        i, calls_in_c = offset, 0
        while not stop.is_set() or calls_in_c < 200:
            i = (i + 1) % len(rows)
            calls_in_c += f.tier == "c"
            pose, jacobian, _ = f(rows[i])
            if not (same_bits(pose, wanted[i][0]) and same_bits(jacobian, wanted[i][1])):
                wrong.append(i)
        after_the_change.append(calls_in_c)

    threads = [threading.Thread(target=work, args=(k * 16,)) for k in range(4)]
    for thread in threads:
        thread.start()
    assert f.wait(60)
    stop.set()
    for thread in threads:
        thread.join()
    assert not wrong
    assert len(after_the_change) == 4
    assert f.tier == "c"
    evaluator(rows[3])
    assert same_bits(evaluator.outputs[0], wanted[3][0])


@pytest.mark.compiler
def test_evaluators_switch_to_c_with_their_function() -> None:
    f = kv.compile([a * 3.25 + b, b / a])
    evaluator = f.bind()
    outputs = evaluator.outputs
    evaluator([2.0, 3.0])
    assert f.wait(60)
    evaluator([4.0, 5.0])
    assert evaluator.outputs is outputs
    assert [float(v) for v in outputs] == [18.0, 1.25]


def test_tier_interpreter_never_compiles() -> None:
    f = kv.compile(a * b * 2.125, tier="interpreter", wait=True)
    assert f.tier == "interpreter"
    assert not f.wait(0.0)


@pytest.mark.usefixtures("no_compiler")
def test_functions_stay_interpreted_without_a_compiler(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        for factor in (1.5, 2.5):
            f = kv.compile(a * b * factor, wait=True)
            assert f.tier == "interpreter"
            assert not f.wait()
            assert f([2.0, 3.0]) == 6.0 * factor
            assert f.batch([[2.0, 3.0]] * 70).tolist() == [6.0 * factor] * 70
        with pytest.raises(kv.errors.CompileError, match="no C compiler"):
            kv.compile(a * b, tier="c")
    assert "[compiler]'" in caplog.text
    assert [r.name for r in caplog.records] == ["kineverse.compile.toolchain"]  # below the others' logger
    assert compiler_information().compiler is None


def broken_compiler(tmp_path: Path, script: str) -> str:
    path = tmp_path / "cc"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


def test_functions_stay_interpreted_if_the_compiler_fails(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setenv("CC", broken_compiler(tmp_path, "echo 'cannot do that' >&2; exit 3"))
    monkeypatch.setattr(build_queue, "_worker", build_queue._Worker())
    with caplog.at_level(logging.WARNING, "kineverse.compile"):
        f, g = kv.compile(a * b * 4.5, wait=True), kv.compile(a * b * 5.5, wait=True)
    assert (f.tier, g.tier) == ("interpreter", "interpreter")
    assert f([1.0, 2.0]) == 9.0
    assert len(caplog.records) == 1
    assert "cannot do that" in caplog.text
    with pytest.raises(kv.errors.CompileError, match="cannot do that"):
        kv.compile(a * b * 6.5, tier="c", wait=True)
    h = kv.compile(a * b * 7.5, tier="c")
    with pytest.raises(kv.errors.CompileError, match="cannot do that"):
        h.wait()
    with pytest.raises(kv.errors.CompileError, match="cannot do that"):
        h.batch([[1.0, 2.0]])


def test_functions_stay_interpreted_if_the_compiler_hangs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # What hangs is a child of the compiler, as with gcc: both have to go.
    group = tmp_path / "group"
    script = f"(echo $$ > {group}; while :; do sleep 0.1; done) & wait"
    monkeypatch.setenv("CC", broken_compiler(tmp_path, script))
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "libraries"))
    monkeypatch.setattr(build_queue, "_WALL_LIMIT", 0.3)
    with pytest.raises(kv.errors.CompileError, match="more than"):
        kv.compile(a * b * 8.5, tier="c", wait=True)
    if group.exists():
        assert set(states_of_group(int(group.read_text()))) <= {"Z"}
    assert list((tmp_path / "libraries").iterdir()) == []


def test_wait_returns_after_its_timeout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    script = f"echo >> {tmp_path}/runs; while [ ! -e {gate} ]; do sleep 0.01; done; exit 1"
    monkeypatch.setenv("CC", broken_compiler(tmp_path, script))
    monkeypatch.setattr(build_queue, "_worker", build_queue._Worker())
    f = kv.compile(a * b * 9.5)
    assert not f.wait(0.01)
    assert f.tier == "interpreter"
    waiting = [kv.compile(a * b * (10.5 + i)) for i in range(3)]
    # Nobody is interested in these when their turn comes, so the compiler never sees them.
    for i in range(20):
        kv.compile(a * b * (20.5 + i))
    last = kv.compile(a * b * 40.5)
    gate.touch()
    assert not any(g.wait(60) for g in waiting)
    assert last._library._build._done.wait(60)
    assert len((tmp_path / "runs").read_text().splitlines()) == 5


def test_working_seconds_stand_still_while_a_thread_waits(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("CC", broken_compiler(tmp_path, "sleep 0.5; exit 1"))
    monkeypatch.setattr(build_queue, "_worker", build_queue._Worker())
    function = kv.compile(a * b * 11.25)
    begin, worked = time.perf_counter(), working_seconds()
    function.wait()
    assert time.perf_counter() - begin > 0.5
    assert 0.0 <= working_seconds() - worked < 0.25


def test_the_queue_is_bounded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    monkeypatch.setenv("CC", broken_compiler(tmp_path, f"while [ ! -e {gate} ]; do sleep 0.01; done; exit 1"))
    monkeypatch.setattr(build_queue, "_worker", build_queue._Worker())
    monkeypatch.setattr(build_queue, "MAXIMUM_WAITING", 3)
    functions = [kv.compile(a * b * (50.5 + i)) for i in range(6)]
    assert len(build_queue._worker._wanted) == 3
    assert [f([1.0, 2.0]) for f in functions] == [2 * (50.5 + i) for i in range(6)]
    gate.touch()
    assert not functions[-1].wait(60)


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="sessions share the processor on Linux")
def test_session_of_a_compiler_yields_until_somebody_waits(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The niceness of a process counts within its session only, and a compiler has a session of its own."""
    gate, group = tmp_path / "gate", tmp_path / "group"
    script = (
        f"echo $$ > {group}.new; mv {group}.new {group}; while [ ! -e {gate} ]; do sleep 0.01; done; exit 1"
    )
    monkeypatch.setenv("CC", broken_compiler(tmp_path, script))
    monkeypatch.setattr(build_queue, "_worker", build_queue._Worker())

    def reaches(niceness: int) -> bool:
        for _ in range(3000):
            if group.exists():
                session = Path(f"/proc/{group.read_text().strip()}/autogroup").read_text()
                if int(session.split()[-1]) == niceness:
                    return True
            time.sleep(0.01)
        return False

    f = kv.compile(a * b * 60.5)
    assert reaches(19)
    time.sleep(0.2)  # the kernel accepts a change in a tenth of a second
    assert not f.wait(0.01)
    assert reaches(0)
    gate.touch()
    assert not f.wait(60)


def table(rows: int, columns: int) -> np.ndarray:
    """A matrix of any numbers, with those that are special."""
    numbers = np.random.default_rng(0).normal(size=(rows, columns)) * 10.0 ** np.arange(columns)
    numbers.flat[:5] = [0.0, -0.0, np.inf, -np.inf, 5e-324]
    return numbers


@pytest.mark.compiler
def test_tiers_agree_to_the_bit_on_dense_constants() -> None:
    """Constants among what is computed, alone, shared by results and operands, and a matrix times a vector."""
    numbers = table(12, 9)
    x = kv.array([kv.position(f"dense/x{k}") for k in range(9)])
    mixed = kv.array([[*row[:4], a * row[4], row[4] + b, *row[6:]] for row in numbers.tolist()])
    outputs = [kv.array(numbers), mixed, kv.array(numbers[1:]) @ x, kv.array(numbers[:3]), a * b]
    slow, fast = kv.compile(outputs, tier="interpreter"), kv.compile(outputs, tier="c", wait=True)
    rows = np.random.default_rng(1).uniform(-3, 3, (40, len(slow.inputs)))
    agree(slow, fast, rows)
    for one, other in zip(slow.batch(rows), fast.batch(rows), strict=True):
        assert same_bits(one, other)
    np.testing.assert_array_equal(fast(rows[0])[0], numbers)
    np.testing.assert_array_equal(fast(rows[0])[1][:, :4], numbers[:, :4])


@pytest.mark.compiler
def test_tiers_agree_to_the_bit_on_constants_beside_a_loop() -> None:
    u, x = kv.position("loop/u"), kv.position("loop/x")
    cubic = ImplicitFunction(
        "cubic", (x,), (u,), kv.array([x**3 + x - u]), (0,), kv.array([np.arcsinh(u)]), 12
    )
    outputs = [cubic.apply([a]), kv.array(table(20, 20))]
    slow, fast = kv.compile(outputs, tier="interpreter"), kv.compile(outputs, tier="c", wait=True)
    agree(slow, fast, np.random.default_rng(0).uniform(-0.5, 0.5, (20, len(slow.inputs))))


def test_constants_are_data_and_no_statements() -> None:
    """A compiler's time goes by statements and branches; of these a table of constants has none."""
    numbers = table(147, 62)
    inputs = tuple(sorted({kv.position(f"dense/x{k}") for k in range(62)}, key=lambda s: s.sort_key))
    alone = Program([kv.array(numbers)], ())
    assert alone.source().count("\n") < 200
    assert (
        generate_batch_source(alone).count("\n")
        - generate_batch_source(Program([kv.array(1.0)], ())).count("\n")
        < 5
    )
    product = Program([kv.array(numbers) @ kv.array(list(inputs))], inputs).source()
    assert "if (res" not in product
    assert "?" not in product.partition("casadi_f0(")[2].partition("\n}")[0]
