"""Where an implicit function has no solution: one error that says which and where, however it is evaluated."""

import implicit_functions as known
import numpy as np
import pytest
from implicit_functions import u, v

import kineverse as kv
from kineverse.compilation import batch
from kineverse.compilation.call_extension import call_extension
from kineverse.expressions import array
from kineverse.expressions import functions as f

a, b = kv.position("implicit/a"), kv.position("implicit/b")
p = kv.parameter("implicit/p", 0.5)
CIRCLE = known.half_circle()
height = CIRCLE.apply([a])[0]
TIERS = ["interpreter", pytest.param("c", marks=pytest.mark.compiler)]
WHERE = r"'half circle' has no solution at input/u = 1\.5\b"


@pytest.fixture(
    params=[pytest.param(True, marks=pytest.mark.compiler), False], ids=["extension", "no extension"]
)
def extension(request, monkeypatch):
    """Calls of C through the extension, and without it."""
    if not request.param:
        monkeypatch.setattr(call_extension, "module", None)
    elif call_extension.module is None:
        # It is made for the first compiled function.
        kv.compile(f.sin(a) * b + a, tier="c", wait=True)


def compiled(outputs, inputs=None, tier="interpreter"):
    return kv.compile(outputs, inputs, tier=tier, wait=True)


# -- the same numbers --------------------------------------------------------------------------------------


def outputs():
    result = []
    for function in (known.kepler(), known.polar(), known.spherical()):
        arguments = [f.sin(a) * 0.2 + 1.1, 0.4 * f.cos(b), 0.3 * a]
        itself = function.apply(arguments[: len(function.inputs)])
        result += [itself, itself.jacobian([a, b]), itself.jacobian([a, b]).jacobian([a, b])]
    nested = known.cubic().apply([known.kepler().apply([a, 0.3 * f.sin(b)])[0] * b])
    return [*result, nested, nested.jacobian([a, b])]


@pytest.mark.compiler
def test_all_tiers_give_the_same_bits(extension):
    wanted, fast = compiled(outputs(), [a, b]), compiled(outputs(), [a, b], "c")
    assert (wanted.tier, fast.tier) == ("interpreter", "c")
    bound, slow = fast.bind(), wanted.bind()
    for x in np.random.default_rng(0).uniform(-3, 3, (300, 2)):
        bits = [r.tobytes() for r in wanted(x)]
        assert [r.tobytes() for r in fast(x)] == bits
        bound(x), slow(x)
        assert [r.tobytes() for r in bound.outputs] == bits == [r.tobytes() for r in slow.outputs]
    x = [0.4, -1.3]
    assert [e({a: 0.4, b: -1.3}).tobytes() for e in outputs()] == [r.tobytes() for r in wanted(x)]


@pytest.mark.compiler
def test_batches_agree_with_single_calls():
    """Every step is the same to 4 ulp; after Newton's method the last digits are about all that differs."""
    function = compiled(outputs(), [a, b], "c")
    points = np.random.default_rng(3).uniform(-3, 3, (700, 2))
    many = function.batch(points)
    for i in range(0, 700, 7):
        for one, column in zip(function(points[i]), many, strict=True):
            scale = max(1.0, np.abs(one).max())
            np.testing.assert_allclose(column[i], one, rtol=0, atol=200 * np.finfo(float).eps * scale)


def test_values_do_not_depend_on_earlier_calls():
    evaluate = compiled([known.polar().apply([u, v])], [u, v])
    points = np.random.default_rng(5).uniform((0.5, -2), (3, 2), (200, 2))
    first = [evaluate(x)[0].tobytes() for x in points]
    orders = [np.random.default_rng(k).permutation(200) for k in range(3)]
    bound = evaluate.bind()
    for order in orders:
        for i in order:
            assert evaluate(points[i])[0].tobytes() == first[i]
            bound(points[i])
            assert bound.outputs[0].tobytes() == first[i]


# -- no solution -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "e", [height, height * 2 + a, array([[a, height]]), height.jacobian([a]), height + f.log(b)]
)
def test_evaluation_without_a_solution_is_refused(e):
    at = dict.fromkeys(e.symbols, 1.5)
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        e(at)
    assert np.isfinite(e(dict.fromkeys(e.symbols, 0.5))).all()


@pytest.mark.parametrize("tier", TIERS)
def test_compiled_function_without_a_solution_is_refused(tier, extension):
    for outs in (height, [height], [height, height.jacobian([a])], [a, a * b, height], [f.sin(height) * b]):
        function = compiled(outs, [a, b], tier)
        assert function.tier == tier
        for x in (
            [1.5, 2.0],
            np.array([1.5, 2.0]),
            {"implicit/a": 1.5, "implicit/b": 2.0},
            kv.State({a: 1.5, b: 2}),
        ):
            with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
                function(x)
        # It goes on as if nothing had been.
        fine = function([0.6, 2.0])
        assert all(np.isfinite(r).all() for r in (fine if isinstance(fine, tuple) else (fine,)))


@pytest.mark.parametrize("tier", TIERS)
def test_evaluator_without_a_solution_is_refused(tier, extension):
    bound = compiled([height, a * b], [a, b], tier).bind()
    bound.input[:] = 1.5, 2.0
    for _ in range(2):
        with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
            bound()
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        bound([1.5, 2.0])
    bound([0.6, 2.0])
    assert bound.outputs[0] == pytest.approx(0.8, abs=1e-15)


@pytest.mark.compiler
def test_evaluator_without_a_solution_is_refused_after_the_switch_to_c():
    function = kv.compile([height * f.cos(a - 3 * b) ** 3], [a, b])
    bound = function.bind()
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        bound([1.5, 0.0])
    function.wait()
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        bound([1.5, 0.0])
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        function([1.5, 0.0])


@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize("count", [1, 7, 40])
def test_batch_without_a_solution_names_the_first_row(tier, count):
    function, points = compiled([a + b, height], [a, b], tier), np.full((count, 2), 0.6)
    assert function.batch(points)[1] == pytest.approx(0.8, abs=1e-15)
    row = count * 2 // 3
    points[row, 0] = 1.5
    points[-1, 0] = 1.7 if row < count - 1 else 1.5
    with pytest.raises(kv.errors.NoSolutionError, match=rf"[Rr]ow {row}\b.*{WHERE}"):
        function.batch(points)
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        function.batch(points, out=[np.zeros(count), np.zeros(count)])
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        compiled(height, [a, b], tier).batch(points)


def test_large_batch_without_a_solution_names_the_first_row(monkeypatch):
    function = compiled([height], [a])
    monkeypatch.setattr(batch, "_STREAMED_BYTES", -1)
    points = np.linspace(-0.9, 0.9, 5001)[:, None]
    np.testing.assert_allclose(function.batch(points)[0], np.sqrt(1 - points[:, 0] ** 2), rtol=0, atol=1e-14)
    points[4321] = 1.5
    with pytest.raises(kv.errors.NoSolutionError, match=rf"4321\b.*{WHERE}"):
        function.batch(points)


def test_the_inner_one_of_nested_functions_is_named():
    nested = known.cubic().apply([height * b])[0]
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        nested({a: 1.5, b: 1.0})
    outer = CIRCLE.apply([known.cubic().apply([b])[0] * 1.0])[0]
    with pytest.raises(
        kv.errors.NoSolutionError, match=r"'half circle' has no solution at input/u = 1\.5\d*\b"
    ):
        outer({b: 1.5**3 + 1.5 + 1e-7})


def test_message_lists_all_inputs_and_parameters():
    e = known.radius_and_height().apply([a * 2, p])[0]
    assert e({a: 0.15}) == pytest.approx(0.4)
    with pytest.raises(
        kv.errors.NoSolutionError, match=r"'height' has no solution at input/u = 0\.6, input/v = 0\.5\b"
    ):
        e({a: 0.3})
    assert e({a: 0.3, p: 1.0}) == pytest.approx(0.8)


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e300])
def test_nan_inputs_give_nan(value):
    with pytest.raises(kv.errors.NoSolutionError, match="'half circle' has no solution at input/u = "):
        compiled([height], [a])([value])


def test_value_at_a_singular_configuration():
    """At the very end two roots meet and Newton's method crawls: an error, or a value that is one."""
    for x in (1.0, -1.0, 1 - 1e-15, 1 + 1e-15):
        try:
            value = height({a: x})
        except kv.errors.NoSolutionError:
            continue
        assert abs(value**2 + x**2 - 1) <= 1e-10


# -- what is not its fault ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tier", TIERS)
def test_nan_of_other_functions_stays_nan(tier, extension):
    function = compiled([height, a + b], [a, b], tier)
    first, second = function([np.nan, 1.0])
    assert np.isnan([first, second]).all()
    bound = function.bind()
    bound([np.nan, 1.0])
    assert np.isnan(bound.outputs[0])
    points = np.array([[0.6, 0.0], [np.nan, 0.0], [0.6, np.nan]])
    np.testing.assert_allclose(function.batch(points)[0], [0.8, np.nan, 0.8])
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        function.batch(np.vstack([points, [[1.5, 0.0]]]))


@pytest.mark.parametrize("tier", TIERS)
def test_nan_from_elsewhere_is_returned(tier):
    function = compiled([f.log(b), height], [a, b], tier)
    logarithm, found = function([0.6, -1.0])
    assert np.isnan(logarithm)
    assert found == pytest.approx(0.8)
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        function([1.5, -1.0])
    # A logarithm that an input of the function is made of.
    assert np.isnan(compiled([CIRCLE.apply([f.log(b)])[0]], [b], tier)([-1.0])[0])


# -- nor anything made of it -------------------------------------------------------------------------------

HIDING = {
    "minimum": f.minimum(height, 0.25),
    "maximum": f.maximum(0.25, height),
    "clip": f.clip(height, 0.1, 0.3),
    "less": height < 0.3,
    "and": (height < 0.3) & (b < 0),
    "minimum's slope": f.minimum(height, b).jacobian([b]),
    "sign": np.sign(height),
    "floor": np.floor(height),
    "absolute": abs(height),
    "hypot": np.hypot(height, np.inf),
}


@pytest.mark.parametrize("name", HIDING)
@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.sampled(2)
def test_comparisons_do_not_hide_a_missing_solution(name, tier):
    e, inputs = HIDING[name], [a, b]
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        e(dict.fromkeys(e.symbols, 1.5))
    function = compiled([e], inputs, tier)
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        function([1.5, 0.1])
    bound = function.bind()
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        bound([1.5, 0.1])
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        function.batch([[0.2, 0.1], [1.5, 0.1]])


@pytest.mark.parametrize("tier", TIERS)
def test_where_ignores_the_branch_that_is_not_selected(tier):
    e = f.where(a < 1.0, height, 7.0)
    assert e({a: 1.5}) == 7.0
    function = compiled([e], [a], tier)
    assert function([1.5])[0] == 7.0
    assert function([0.6])[0] == pytest.approx(0.8)
    assert function.batch([[1.5], [0.6]])[0] == pytest.approx([7.0, 0.8])


# -- what is chosen by it ----------------------------------------------------------------------------------


@pytest.mark.parametrize("tier", TIERS)
def test_where_with_a_condition_without_a_solution_is_refused(tier):
    """NaN compares false with everything, so a choice by it looked like the second branch."""
    chosen = f.where(height > 0.5, 2 * a, 3 * a)
    parts = [chosen, chosen.jacobian([a]), f.where(height > 0.5, array([a, b]), 0.0)]
    function = compiled(parts, [a, b], tier)
    for at, factor in ((0.1, 2.0), (0.95, 3.0)):
        value, slope, both = function([at, 7.0])
        assert (value, slope[0]) == (factor * at, factor)
        np.testing.assert_array_equal(both, [at, 7.0] if factor == 2 else [0.0, 0.0])
    for part in parts:
        with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
            compiled(part, [a, b], tier)([1.5, 0.0])
    many = compiled(chosen, [a], tier)
    np.testing.assert_allclose(many.batch(np.array([[0.1], [0.95]])), [0.2, 2.85])
    with pytest.raises(kv.errors.NoSolutionError, match=WHERE):
        many.batch(np.array([[0.1], [1.5]]))
