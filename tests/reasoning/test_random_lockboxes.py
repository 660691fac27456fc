"""Plans for random lockboxes agree with exhaustive search: a short run of ``tools/lockboxes.py``."""

import sys
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
from lockboxes import draw_box, try_box


@pytest.mark.parametrize(("first", "count"), [(0, 60), pytest.param(60, 600, marks=pytest.mark.long)])
def test_plans_for_random_lockboxes_agree_with_exhaustive_search(first, count):
    answers = {seed: try_box(draw_box(seed)) for seed in range(first, first + count)}
    assert {seed: answer.wrong for seed, answer in answers.items() if answer.wrong} == {}
    verdicts = Counter(answer.verdict for answer in answers.values())
    assert verdicts["undecided"] <= count / 100
    assert min(verdicts["found"], verdicts["refuted"]) > count / 10
