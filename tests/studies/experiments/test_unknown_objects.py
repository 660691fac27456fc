"""Experiment on objects whose joints nobody described: what counts, and the model that the skill gets."""

from types import SimpleNamespace

import numpy as np
import pytest

from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.manipulation.unknown_objects import forget_joint
from kineverse_studies.experiments.unknown_objects import OBJECTS, is_known_early, is_open_early, make_model


def trial(done=True, **measures):
    known = {"true_family": "revolute", "family": "revolute", "decided_turn": 0.1, "decided_way": 0.04}
    return SimpleNamespace(done=done, measures={**known, "opened_seconds": 6.0, **measures})


@pytest.mark.parametrize(
    ("one", "known", "opened"),
    [
        (trial(), True, True),
        (trial(family="prismatic"), False, True),
        (trial(decided_turn=0.2), False, True),
        (trial(decided_way=0.09), False, True),
        (trial(opened_seconds=16.0), True, False),
        (trial(done=False), True, False),
        (SimpleNamespace(done=False, measures={"true_family": "revolute"}), False, False),
    ],
)
def test_bar_counts_the_right_family_early_and_the_time(one, known, opened):
    assert (is_known_early(one), is_open_early(one)) == (known, opened)


@pytest.mark.parametrize("name", OBJECTS)
def test_skill_gets_a_model_without_the_joint(name):
    thing = OBJECTS[name]
    model = make_model(SHIPPED["hsr"], thing)
    state = model.default_state().updated({thing.part: 0.1})
    believed = forget_joint(model, thing.part, state)
    assert thing.part not in {str(s) for s in believed.degrees_of_freedom}
    assert model.articulations[thing.part].kind == thing.family
    np.testing.assert_allclose(
        believed.fk(thing.handle)({}), model.fk(thing.handle)({thing.part: 0.1}), atol=1e-12
    )
