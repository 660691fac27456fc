"""Queries of a scene match brute force, at every state, after every edit, in every thread."""

import itertools
import threading

import numpy as np
import pytest
from scene_models import arm_among_boxes, body, brute_force, by_names, random_state

import kineverse as kv
from kineverse.geometry import Rule, Scene, bindings, broadphase, collision_world, distance_queries, objects
from kineverse.model.body import Body, Box, Shape, Sphere
from kineverse.model.kinematics import ancestors


@pytest.fixture(scope="module")
def model():
    return arm_among_boxes()


@pytest.fixture(params=["numpy", pytest.param("c", marks=pytest.mark.compiler)])
def either_broadphase(request, monkeypatch):
    library = bindings.CollisionLibrary()
    if request.param == "c":
        assert library.prepare(wait=True)
    else:
        library.place, library.near = broadphase.place_objects, broadphase.find_near_pairs
        library.prepare = lambda wait=False: False
    for module in (collision_world, distance_queries):
        monkeypatch.setattr(module, "collision_library", library)


def test_pairs_within_match_brute_force(model, either_broadphase):
    scene, rng = Scene(model), np.random.default_rng(1)
    state = random_state(model, rng)
    for step in range(25):
        size = 0.5 if step % 10 == 9 else 0.01
        state = state.updated({s: v + float(rng.normal()) * size for s, v in state.items()})
        scene.update(state)
        expected, radius = brute_force(scene, state), (0.0, 0.1, 0.4)[step % 3]
        near = scene.pairs_within(radius)
        want = {frozenset(names): d for names, d in expected.items() if d <= radius}
        assert by_names(near).keys() == want.keys()
        for names, distance in by_names(near).items():
            assert distance == pytest.approx(want[names], abs=1e-6)
        assert [r.distance for r in near] == sorted(r.distance for r in near)
        assert scene.in_collision == any(d <= 0 for d in expected.values())


@pytest.mark.parametrize("jump", [1e5, 1e12])
def test_pairs_within_are_exact_after_jumps_of_any_size(model, either_broadphase, jump):
    scene, state = Scene(model), model.default_state()
    for rail in (0.0, jump, *(np.arange(8) * 3e-5).tolist()):
        there = state.updated({"rail": rail})
        scene.update(there)
        near = by_names(scene.pairs_within(0.3))
    expected = brute_force(scene, there)
    want = {frozenset(names): pytest.approx(d, abs=1e-6) for names, d in expected.items() if d <= 0.3}
    assert near == want
    assert scene.distance("base", "box0").distance == pytest.approx(expected["base", "box0"], abs=1e-6)


def test_update_refuses_poses_that_are_too_far_away(model, either_broadphase):
    scene, state = Scene(model), model.default_state()
    scene.update(state)
    near = by_names(scene.pairs_within(0.3))
    for rail in (1e13, 1e200):
        with pytest.raises(kv.errors.InvalidValueError, match=r"'base', .*1e\+12 m away; nothing was moved"):
            scene.update(state.updated({"rail": rail}))
    assert by_names(scene.pairs_within(0.3)) == near
    far = kv.Model()
    with far.edit() as edit:
        edit.add_frame("post", "world", kv.translation(1e50, 0, 0), body(Sphere(0.1)))
    with pytest.raises(kv.errors.InvalidValueError, match="'post' stands further"):
        Scene(far)
    assert Scene(far, leave_out=["post"]).bodies == ()


def test_bounds_spare_most_distance_computations(model):
    scene, state = Scene(model), model.default_state()
    scene.update(state)
    scene.pairs_within(0.3)
    before = scene.collision_world.narrowphase.calls
    for k in range(20):
        scene.update(state.updated({"j0": 0.002 * k}))
        scene.pairs_within(0.3)
    assert (scene.collision_world.narrowphase.calls - before) / 20 < 0.3 * len(brute_force(scene, state))


def test_distances_to_and_distances_match_brute_force(model):
    scene, state = Scene(model), random_state(model, np.random.default_rng(4))
    scene.update(state)
    expected, around = brute_force(scene, state), scene.distances_to("hand")
    assert all(r.a == "hand" for r in around)
    assert {r.b: pytest.approx(r.distance, abs=1e-6) for r in around} == {
        (set(names) - {"hand"}).pop(): d for names, d in expected.items() if "hand" in names
    }
    assert [r.b for r in scene.distances_to("hand", around[1].distance)] == [r.b for r in around[:2]]
    one, other, boxes = scene.distances([("hand", "box0"), ("box0", "hand"), ("box1", "box2")])
    assert (one.a, one.b, other.a, other.b) == ("hand", "box0", "box0", "hand")
    assert one.distance == other.distance
    np.testing.assert_array_equal(one.point_a, other.point_b)
    np.testing.assert_array_equal(one.normal, -other.normal)
    assert boxes.distance == pytest.approx(boxes.normal @ (boxes.point_b - boxes.point_a), abs=1e-9)


def test_results_do_not_depend_on_earlier_queries(model):
    rng = np.random.default_rng(6)
    states = [random_state(model, rng) for _ in range(6)]
    used = Scene(model)
    for state in states[:-1]:
        used.update(state)
        used.pairs_within(0.5)
        used.first_contact()
    fresh = Scene(model)
    for scene in (used, fresh):
        scene.update(states[-1])
    one, other = used.pairs_within(0.4), fresh.pairs_within(0.4)
    assert [(r.a, r.b, r.distance) for r in one] == [(r.a, r.b, r.distance) for r in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.normal, b.normal)
    first, same = used.first_contact(0.2), fresh.first_contact(0.2)
    assert (first.a, first.b, first.distance) == (same.a, same.b, same.distance)


def test_self_pairs_and_pairs_between_select_subtrees(model):
    scene, state = Scene(model), random_state(model, np.random.default_rng(8))
    scene.update(state)
    everything = by_names(scene.pairs_within(0.5))
    own = {f"link{k}" for k in range(5)} | {"base", "hand"}
    assert by_names(scene.self_pairs("base", 0.5)) == {n: d for n, d in everything.items() if n <= own}
    assert by_names(scene.pairs_between("base", "ball", 0.5)) == {
        n: d for n, d in everything.items() if n & own and "ball/body" in n
    }


def test_scenes_in_two_threads_are_independent(model):
    rng = np.random.default_rng(9)
    states = [[random_state(model, rng) for _ in range(40)] for _ in range(2)]

    def answers(scene, states):
        found = []
        for state in states:
            scene.update(state)
            found.append([(r.a, r.b, r.distance, *r.point_a, *r.normal) for r in scene.pairs_within(0.2)])
        return found

    alone = [answers(Scene(model), s) for s in states]
    together = [None, None]

    def run(k):
        together[k] = answers(Scene(model), states[k])

    threads = [threading.Thread(target=run, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == alone


def test_update_takes_a_vector_of_inputs(model):
    by_name, by_vector = Scene(model), Scene(model)
    state = random_state(model, np.random.default_rng(2))
    by_name.update(dict(state))
    by_vector.update(np.array([state[s] for s in by_vector.inputs]))
    assert by_names(by_name.pairs_within(0.3)) == by_names(by_vector.pairs_within(0.3))
    np.testing.assert_allclose(by_name.pose("hand"), model.fk("hand")(state), atol=1e-12)


# -- edits -------------------------------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """Numbers of objects made, solids requested, and poses compiled."""
    counts = {"pieces": 0, "solids": 0, "compiled": 0}

    def counting(key, function):
        def wrapped(*args, **options):
            counts[key] += 1
            return function(*args, **options)

        return wrapped

    monkeypatch.setattr(objects, "CollisionObject", counting("pieces", objects.CollisionObject))
    monkeypatch.setattr(objects, "solid_from_geometry", counting("solids", objects.solid_from_geometry))
    monkeypatch.setattr(
        collision_world, "compile_expressions", counting("compiled", collision_world.compile_expressions)
    )
    return counts


def test_edit_rebuilds_only_the_objects_it_changes(counted):
    model = arm_among_boxes()
    scene, state = Scene(model), random_state(model, np.random.default_rng(3))
    scene.update(state)
    scene.pairs_within(0.3)

    def after(change):
        counted.update(dict.fromkeys(counted, 0))
        with model.edit() as edit:
            change(edit)
        near, fresh = scene.pairs_within(0.3), Scene(model)
        work = dict(counted)
        fresh.update({**state, **{s: model.default_state()[s] for s in model.symbols if s not in state}})
        assert by_names(near) == by_names(fresh.pairs_within(0.3))
        made = len(fresh.collision_world.objects)
        return {**work, "pieces": work["pieces"] - made, "compiled": work["compiled"] - 1}

    def constrain(edit):
        edit.constrain("limit", 0, kv.position("j1"), 1)

    def stand(edit):
        edit.add_frame("post", "world", kv.translation(0.5, 0, 0), body(Box((0.1, 0.1, 1))))

    def shift(edit):
        edit.attach("post", "world", kv.translation(0.4, 0, 0))

    def grow(edit):
        edit.add_frame("finger", "hand", kv.translation(0, 0, 0.1), body(Sphere(0.02), Sphere(0.03)))

    def remove(edit):
        edit.remove("frame post")
        edit.remove("attach post to world")

    assert after(constrain) == {"pieces": 0, "solids": 0, "compiled": 0}
    assert after(stand) == {"pieces": 1, "solids": 1, "compiled": 0}
    assert after(shift) == {"pieces": 1, "solids": 1, "compiled": 0}
    assert after(grow) == {"pieces": 2, "solids": 2, "compiled": 1}
    assert after(remove) == {"pieces": 0, "solids": 0, "compiled": 0}


def test_scenes_of_a_model_share_compiled_poses_until_it_is_edited(counted):
    model = arm_among_boxes()
    scenes = [Scene(model) for _ in range(3)]
    assert counted["compiled"] == 1
    with model.edit() as edit:
        edit.attach("box0", "hand", kv.translation(0, 0, 0.3))
    scenes += [Scene(model) for _ in range(2)]
    state = random_state(model, np.random.default_rng(4))
    for scene in scenes:
        scene.update(state)
        np.testing.assert_allclose(scene.pose("box0"), model.fk("box0")(state), atol=1e-12)
        np.testing.assert_allclose(scene.pose("hand"), model.fk("hand")(state), atol=1e-12)
    assert counted["compiled"] <= 4


def test_attached_body_moves_with_its_new_parent():
    model = arm_among_boxes(boxes=1)
    state, scene = random_state(model, np.random.default_rng(5)), Scene(model)
    scene.update(state)
    assert scene.checks_pair("hand", "box0")
    with model.edit() as edit:
        edit.attach("box0", "hand", kv.translation(0, 0, 0.3))
    assert not scene.checks_pair("hand", "box0")  # held, so they may touch
    assert scene.checks_pair("link1", "box0")
    np.testing.assert_allclose(scene.pose("box0"), model.fk("box0")(state), atol=1e-12)
    other = state.updated({"j0": 0.9})
    scene.update(other)
    assert by_names(scene.pairs_within(0.3)) == {
        frozenset(n): pytest.approx(d, abs=1e-6) for n, d in brute_force(scene, other).items() if d <= 0.3
    }


def test_pose_is_current_right_after_an_edit():
    model = arm_among_boxes(boxes=1)
    scene, state = Scene(model), model.default_state()
    scene.update(state)
    with model.edit() as edit:
        edit.attach("box0", "hand", kv.translation(0, 0, 0.3))
    np.testing.assert_allclose(scene.pose("box0"), model.fk("box0")(state), atol=1e-12)


def test_query_after_an_edit_needs_values_of_new_symbols():
    model = arm_among_boxes(boxes=1)
    scene = Scene(model)
    scene.update(model.default_state())
    with model.edit() as edit:
        edit.add_frame("flap", "world", kv.rotation_z(kv.position("flap")), body(Box((1, 0.1, 0.1))))
    with pytest.raises(kv.errors.UnknownNameError, match=r"flap.*update"):
        scene.pairs_within(0.1)
    scene.update(model.default_state())
    assert scene.distance("flap", "box0").distance > 0


def test_query_after_an_edit_reports_an_impossible_last_state():
    model = arm_among_boxes(boxes=1)
    scene = Scene(model)
    scene.update(model.default_state())
    with model.edit() as edit:
        root = np.sqrt(kv.position("rail") - 1)
        edit.add_frame("flap", "world", kv.translation(0, 0, root), body(Box((1, 0.1, 0.1))))
    with pytest.raises(kv.KineverseError, match=r"flap.*update"):
        scene.pairs_within(0.1)
    scene.update({**model.default_state(), kv.position("rail"): 2.0})
    assert scene.distance("flap", "box0").distance > 0


def test_query_fails_after_an_invalid_edit_until_it_is_mended():
    model = arm_among_boxes(boxes=1)
    scene = Scene(model)
    scene.update(model.default_state())
    near = by_names(scene.pairs_within(0.3))
    with model.edit() as edit:
        for k, width in enumerate((1.0, 2.0)):  # two parameters of one name
            post = kv.translation(kv.parameter("width", width), 0, 0)
            edit.add_frame(f"post{k}", "world", post, body(Box((0.1, 0.1, 0.1))))
    for _ in range(2):
        with pytest.raises(kv.errors.DuplicateNameError, match="width"):
            scene.pairs_within(0.3)
    with model.edit() as edit:
        edit.remove("frame post0")
        edit.remove("frame post1")
    assert by_names(scene.pairs_within(0.3)) == near


# -- rules -------------------------------------------------------------------------------------------------


def test_adjacent_bodies_are_not_checked(model):
    scene = Scene(model)
    assert not scene.checks_pair("link0", "link1")
    assert not scene.checks_pair("link4", "hand")  # rigidly connected
    assert not scene.checks_pair("link3", "hand")  # joined by one articulation, through link4
    assert not scene.checks_pair("box0", "box1")  # neither ever moves
    assert scene.checks_pair("link0", "link2")
    assert scene.checks_pair("base", "box0")  # the rail does not join the base to everything that stands
    assert scene.checks_pair("ball/body", "box0")


def test_door_is_adjacent_to_its_cupboard_and_not_to_the_wall():
    scene = Scene(kv.load("kitchen"))
    assert not scene.checks_pair("kitchen/fridge_door", "kitchen/fridge")
    assert scene.checks_pair("kitchen/fridge_door", "kitchen/wall")


def test_ends_of_a_closed_loop_are_adjacent(tmp_path):
    model = kv.load("articulations/four_bar")
    model.save(tmp_path / "four_bar.kv.json")
    parts = kv.Model()
    with parts.edit() as edit:
        edit.include(tmp_path / "four_bar.kv.json", "here")
    for each, prefix in ((model, "four_bar/"), (parts, "here/four_bar/")):
        scene = Scene(each)
        assert not scene.checks_pair(f"{prefix}coupler", f"{prefix}rocker")
        assert scene.checks_pair(f"{prefix}crank", f"{prefix}rocker")
        scene.update(each.default_state())
        assert not scene.in_collision


def test_rules_are_kept_as_data_and_the_last_one_decides(tmp_path):
    model = arm_among_boxes()
    scene = Scene(model)
    assert scene.checks_pair("hand", "box0")
    stored = (Rule("hand", "box*", why="it pushes them"), Rule("hand", "box1", check=True))
    with model.edit() as edit:
        edit.write(kv.geometry.RULES, kv.geometry.rules_as_data(stored))
    assert not scene.checks_pair("hand", "box0")
    assert scene.checks_pair("hand", "box1")
    model.save(tmp_path / "m.kv.json")
    again = Scene(kv.load(tmp_path / "m.kv.json"), rules=[Rule("link0", "link1", check=True)])
    assert not again.checks_pair("box0", "hand")
    assert again.checks_pair("box1", "hand")
    assert again.checks_pair("link1", "link0")


def test_rules_of_an_included_model_hold_below_its_prefix(tmp_path):
    part = arm_among_boxes(boxes=2)
    rules = (Rule("hand", why="whatever it meets"), Rule("hand", "box1", check=True))
    with part.edit() as edit:
        edit.write(kv.geometry.RULES, kv.geometry.rules_as_data(rules))
    part.save(tmp_path / "part.kv.json")
    model = kv.Model()
    with model.edit() as edit:
        edit.include(tmp_path / "part.kv.json", "one")
        edit.include(tmp_path / "part.kv.json", "two")
        edit.write(kv.geometry.RULES, kv.geometry.rules_as_data([Rule("two/hand", "two/box0", check=True)]))
    scene = Scene(model)
    assert not scene.checks_pair("one/hand", "one/box0")
    assert scene.checks_pair("one/hand", "one/box1")
    assert scene.checks_pair("two/hand", "two/box0")  # what the whole says comes last
    assert scene.checks_pair("one/hand", "two/box0")  # the part knows nothing of the other


@pytest.mark.parametrize(
    "entry", [("hand", "box0", "no"), ("hand", "box0", 1), ("hand", 3), (), 7, ("", "*")]
)
def test_scene_refuses_malformed_rules(model, entry):
    with pytest.raises(kv.errors.InvalidValueError, match="A rule is"):
        Scene(model, rules=[entry])


def test_rule_with_a_pattern_equals_one_rule_for_each_match(model):
    """A rule for each pair, or a pattern for all of them: the same."""
    scene = Scene(model)
    named = [Rule(a, b) for a in scene.bodies if a.startswith("link") for b in scene.bodies if b[:3] == "box"]
    named.append(Rule("box0", "link0", check=True))
    one = Scene(model, rules=named)
    other = Scene(model, rules=[Rule("link?", "box*"), Rule("link0", "box0", check=True)])
    np.testing.assert_array_equal(one.collision_world.table.allowed, other.collision_world.table.allowed)
    assert one.checks_pair("link0", "box0")
    assert not one.checks_pair("box1", "link0")


def test_find_never_colliding_excepts_pairs_that_never_touch(model):
    rng = np.random.default_rng(0)
    states = [random_state(model, rng) for _ in range(30)]
    scene = Scene(model)
    rules = scene.find_never_colliding(states)
    assert rules
    quiet = Scene(model, rules=rules)
    for state in states:
        for s in (scene, quiet):
            s.update(state)
        assert by_names(scene.pairs_within(0.0)) == by_names(quiet.pairs_within(0.0))
        assert len(quiet.pairs_within(0.5)) <= len(scene.pairs_within(0.5))
    with pytest.raises(kv.errors.InvalidValueError, match="there is none"):
        scene.find_never_colliding([])


def test_find_always_colliding_excepts_pairs_that_always_overlap(model):
    scene = Scene(model)
    assert not scene.find_always_colliding()
    rules = scene.find_always_colliding([model.default_state()], margin=0.3)
    scene.update(model.default_state())
    assert {frozenset(rule[:2]) for rule in rules} == by_names(scene.pairs_within(0.3)).keys()
    assert {rule.why for rule in rules} == {"within 0.3 m at all of 1 states"}
    quiet = Scene(model, rules=rules)
    assert quiet.rules == rules
    quiet.update(model.default_state())
    assert not quiet.pairs_within(0.3)


def test_links_that_overlap_around_a_joint_are_always_colliding():
    model = arm_among_boxes()
    with model.edit() as edit:  # as wide as the joint to link0, and joined only to the base
        edit.add_frame("cover", "base", kv.rotation_z(kv.position("spin")), body(Sphere(0.2)))
    scene = Scene(model)
    rules = scene.find_always_colliding()
    assert [set(rule[:2]) for rule in rules] == [{"link0", "cover"}]
    assert rules[0].why == "within 0 m at all of 201 states"
    with model.edit() as edit:
        edit.write(kv.geometry.RULES, kv.geometry.rules_as_data(rules))
    assert scene.rules == rules
    assert not scene.find_always_colliding()


def test_visual_shapes_replace_missing_collision_shapes():
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("seen", "world", np.eye(4), Body(visuals=(Shape(Box((1, 1, 1))),)))
        both = Body(visuals=(Shape(Box((9, 9, 9))),), collisions=(Shape(Sphere(0.5)),))
        edit.add_frame("both", "world", kv.translation(kv.position("x"), 0, 0), both)
        edit.add_frame("neither", "world", np.eye(4), Body())
    scene = Scene(model)
    assert scene.bodies == ("seen", "both")
    scene.update({"x": 2.0})
    assert scene.distance("seen", "both").distance == pytest.approx(1.0)
    assert objects.bodies_with_visual_collision(model) == ["seen"]


def test_selected_pairs_follow_the_model():
    """The pairs between two frames are kept until the model changes, and are those of all that are near."""
    scene = Scene(arm := arm_among_boxes())
    scene.update(random_state(arm, np.random.default_rng(2)))
    top = arm.frames[scene.bodies[-1]].parent

    def below(frame):
        return {
            b for b in scene.bodies if frame in ("world", b) or frame in ancestors(b, arm.frames.__getitem__)
        }

    for number in range(2):
        for one, other in itertools.product(("world", scene.bodies[0], top), repeat=2):
            want = {
                frozenset((near.a, near.b))
                for near in scene.pairs_within(0.5)
                if {near.a in below(one), near.b in below(other)} == {True}
                or {near.b in below(one), near.a in below(other)} == {True}
            }
            for _ in range(2):
                assert by_names(scene.pairs_between(one, other, 0.5)).keys() == want
        with arm.edit() as edit:
            edit.add_frame(
                f"another_{number}", scene.bodies[0], np.eye(4), Body(collisions=(Shape(Sphere(0.3)),))
            )
