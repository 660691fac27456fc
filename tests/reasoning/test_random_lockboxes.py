"""Plans for random lockboxes agree with exhaustive search: a short run of ``tools/lockboxes.py``."""

from collections import Counter

import pytest
from lockboxes import draw_box, try_box

from kineverse.reasoning.move_search import MoveSearch

REFUTED = (30012, 30015, 30021, 30031, 30054, 30056, 30076)
"""Boxes of which several combinations of intervals are within reach, and the goal is not."""


@pytest.mark.parametrize(("first", "count"), [(0, 30), pytest.param(30, 600, marks=pytest.mark.long)])
def test_plans_for_random_lockboxes_agree_with_exhaustive_search(first, count):
    answers = {seed: try_box(draw_box(seed)) for seed in range(first, first + count)}
    assert {seed: answer.wrong for seed, answer in answers.items() if answer.wrong} == {}
    verdicts = Counter(answer.verdict for answer in answers.values())
    assert verdicts["undecided"] <= count / 100
    assert min(verdicts["found"], verdicts["refuted"]) > count / 10


def test_refutations_of_the_best_first_search_are_confirmed(monkeypatch):
    """It leaves out what cannot help, so its regions are larger than the states that it visits."""
    monkeypatch.setattr(MoveSearch, "run", MoveSearch.search_best_first)
    answers = {seed: try_box(draw_box(seed)) for seed in REFUTED}
    assert {answer.verdict for answer in answers.values()} == {"refuted"}
    assert {seed: answer.wrong for seed, answer in answers.items() if answer.wrong} == {}
