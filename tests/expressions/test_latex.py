"""LaTeX of expressions and gradients: another library parses it, names cannot escape, trends are told apart."""

from __future__ import annotations

import itertools
import pickle

import gradient_checks
import numpy as np
import pytest
import random_programs
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.expressions import Expression

a, b = kv.position("a"), kv.position("b")
WORDS = random_programs.Vocabulary("latex")
LONGEST = 7000  # characters of LaTeX that a notebook typesets in a moment


def parse(shown: str) -> str:
    """Return the MathML of another library for what a notebook shows."""
    converter = pytest.importorskip("latex2mathml.converter")
    assert shown.startswith("$\\displaystyle ")
    assert shown.endswith("$")
    inner = shown.removeprefix("$\\displaystyle ").removesuffix("$")
    assert "$" not in inner.replace("\\$", "")
    assert not set("<>\n") & set(inner)
    plain = inner.replace("\\\\", "").replace("\\{", "").replace("\\}", "")
    assert min(itertools.accumulate((c == "{") - (c == "}") for c in plain)) >= 0
    for begin, end in (("{", "}"), (r"\left", r"\right"), (r"\begin", r"\end")):
        assert plain.count(begin) == plain.count(end)
    assert len(shown) < LONGEST
    return converter.convert(inner)


@settings(max_examples=attempts(150, long=600))
@given(gradient_checks.general(), st.booleans())
def test_random_expressions_and_their_gradients_are_latex(program, both):
    expression = random_programs.build(program, WORDS)
    if isinstance(expression, Expression):
        parse(expression._repr_latex_())
        if both:
            parse(expression.gradient()._repr_latex_())


@settings(max_examples=attempts(150, long=600))
@given(
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=12), st.integers(0, 6)
)
def test_no_name_breaks_latex(name, order):
    try:
        symbol = kv.symbols.symbol(name, order)
    except kv.KineverseError:
        return
    assert "<mtext>End of" not in parse((symbol / 2)._repr_latex_())


@pytest.mark.parametrize(
    "name",
    ["$", "$$x$$", "\\", "\\end{array}", "}{", "%", "&", "a_b^c~d", "<script>", "'\"`", "^^", "#1", "é中"],
)
def test_hostile_names_are_shown_as_they_are(name):
    shown = (kv.position(name) + kv.velocity(name))._repr_latex_()
    parse(shown)
    assert shown.count("\\dot{") == 1


@pytest.mark.parametrize(
    ("expression", "formula"),
    [
        (np.sin(a) / b, r"\frac{\sin\left(a\right)}{b}"),
        ((a - b) * 2, r"2 \, \left(a - b\right)"),
        (~((a < 0.5) & (b < a)), r"\lnot \left(\left(a \lt 0.5\right) \land \left(b \lt a\right)\right)"),
        ((a < b) | (b < 1), r"\left(\left(a \lt b\right) \lor \left(b \lt 1\right)\right)"),
        (1.5e-9 * np.sqrt(a), r"1.5 \cdot 10^{-9} \, \sqrt{a}"),
        (kv.array([[a, 0], [1, a.derivative().derivative()]]), r"\begin{bmatrix}a & 0 \\ 1 & \ddot{a}\end{bmatrix}"),
        (np.abs(a) ** 2.5, r"{\left|a\right|}^{2.5}"),
        ((a / b) ** 2.5, r"{\left(\frac{a}{b}\right)}^{2.5}"),
        (kv.position("two_words"), r"\mathrm{two\_words}"),
        (kv.array(float("inf")), r"\infty "),
    ],
)  # fmt: skip
def test_formulas(expression, formula):
    assert expression._repr_latex_() == f"$\\displaystyle {formula}$"
    parse(expression._repr_latex_())


def test_what_is_too_long_is_cut():
    pose = kv.load("pr2").fk("pr2/r_gripper_tool_frame")
    many = np.sum(kv.array([np.sin(kv.position(f"many/{i}")) ** 2 for i in range(300)]))
    for large in (pose, kv.array(np.ones((9, 9))) * a, kv.array([[[a]]]), many):
        assert "dots" in large._repr_latex_()
        parse(large._repr_latex_())
    parse(many.gradient()._repr_latex_())
    assert r"288\ \text{more}" in many.gradient()._repr_latex_()


def test_trends_are_told_from_exact_entries():
    motor = kv.velocity("motor")
    lured = (b * a).augment({motor: b}, heuristic=True)
    driven = a.augment({motor: 0.1})
    for expression, trends in (
        (b * np.sin(a), set()),
        (a < b, {a, b}),
        (np.sin(driven) * b, set()),
        (lured, {motor}),
        (lured * kv.where(a < b, a, 2 * b), {motor}),
        ((a < 1) * b, {a}),
    ):
        gradient = expression.gradient()
        expected = {s if s is motor else s.derivative() for s in trends}
        assert gradient.trends == pickle.loads(pickle.dumps(gradient)).trends == expected
        exact = expression.gradient(heuristic=False)
        assert not exact.trends
        assert gradient._repr_latex_().count(r"\text{trend}") == len(trends)
        assert gradient._repr_latex_().count(r"\text{exact}") == len(gradient) - len(trends)
        parse(gradient._repr_latex_())
