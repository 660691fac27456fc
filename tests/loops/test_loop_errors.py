"""Loops that cannot be: one error of the project's own that names the loop and the number; nothing happened."""

import math
import warnings

import pytest
from linkages import X, Z, at, bar, four_bar, slider_crank

import kineverse as kv
from kineverse.errors import DuplicateNameError, InvalidValueError, ModelError, UnknownNameError

LOOP = "four-bar"


def refused(error, text, build):
    """Look whether building is refused, without a warning or a word of LAPACK's on the way."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(error, match=text) as caught:
            build()
    assert isinstance(caught.value, kv.KineverseError)
    assert caught.value.__cause__ is None
    assert not isinstance(caught.value, kv.errors.EditError), "an error inside, wrapped"


@pytest.fixture(scope="module")
def open_bars():
    return four_bar(close=False)


@pytest.fixture(scope="module")
def closed_bars():
    return four_bar()


def closing(model, frame="coupler_tip", to="rocker_tip", *, name=LOOP, **options):
    """Close a loop in a model that must stay as it is."""
    before, version = model.snapshot(), model.version
    try:
        with model.edit() as edit:
            edit.add_frame("some/thing", "world", kv.translation(0, 0, 1))
            edit.close_loop(frame, to, name=name, **options)
    finally:
        assert model.snapshot() == before
        assert model.version == version
        assert "some/thing" not in model.frames


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"mask": ("x", "q")}, InvalidValueError, r"mask of loop 'four-bar'.*'q'"),
        ({"mask": ()}, InvalidValueError, r"mask of loop 'four-bar'.*\(\)"),
        ({"mask": None}, InvalidValueError, "mask of loop 'four-bar'.*None"),
        ({"home": {"crank": "1"}}, InvalidValueError, "Loop 'four-bar' takes home=.*'1'"),
        ({"within": {"crank": ("0", 1)}}, InvalidValueError, "Loop 'four-bar' takes home=.*'0'"),
        ({"mask": ("x", "x")}, InvalidValueError, r"mask of loop 'four-bar'.*\('x', 'x'\)"),
        ({"mask": ("z",)}, ModelError, "Loop 'four-bar' is closed already"),
        (
            {"branch": 2},
            kv.errors.NoSolutionError,
            r"'four-bar' has 2 branches at crank = 0, numbered from 0, and none is 2\.",
        ),
        ({"branch": -1}, kv.errors.NoSolutionError, "'four-bar' has 2 branches.*none is -1"),
        ({"branch": 1.0}, InvalidValueError, r"branch of loop 'four-bar'.*1\.0"),
        ({"branch": True}, InvalidValueError, "branch of loop 'four-bar'.*True"),
        (
            {"dependent": ("rocker",)},
            InvalidValueError,
            "'four-bar' makes 2 of 3.*mobility is 1.*1 are given",
        ),
        ({"dependent": "rocker"}, InvalidValueError, "'four-bar' makes 2 of 3.*mobility is 1.*1 are given"),
        ({"dependent": ()}, InvalidValueError, "'four-bar' makes 2 of 3.*mobility is 1.*0 are given"),
        (
            {"dependent": ("rocker", "coupler", "crank")},
            InvalidValueError,
            "'four-bar'.*mobility is 1.*3 are given",
        ),
        ({"dependent": ("rocker", "rocker")}, InvalidValueError, "'four-bar'.*mobility is 1.*1 are given"),
        (
            {"dependent": ("rocker", "lift")},
            InvalidValueError,
            "'four-bar' is not about 'lift', only about crank, coup",
        ),
        ({"home": {"lift": 1.0}}, InvalidValueError, "'four-bar' is not about 'lift'"),
        ({"home": {"crank": math.nan}}, InvalidValueError, "'four-bar' cannot begin at crank = nan"),
        ({"home": {"crank": -math.inf}}, InvalidValueError, "'four-bar' cannot begin at crank = -inf"),
        ({"home": {"crank": "far"}}, InvalidValueError, "Loop 'four-bar' takes home=.*'far'"),
        ({"home": 3}, InvalidValueError, "Loop 'four-bar' takes home=.*not home=3"),
        ({"within": {"lift": (0, 1)}}, InvalidValueError, "'four-bar' is not about 'lift'"),
        ({"within": {"crank": (1, -1)}}, InvalidValueError, r"'four-bar'.*1\.0 <= crank <= -1\.0"),
        ({"within": {"crank": (math.nan, 1)}}, InvalidValueError, "'four-bar'.*nan <= crank"),
        ({"within": {"crank": (0, math.nan)}}, InvalidValueError, "'four-bar'.*crank <= nan"),
        ({"within": {"crank": 1}}, InvalidValueError, "Loop 'four-bar' takes home=.*within={'crank': 1}"),
        ({"within": {"rocker": (0, 2)}}, InvalidValueError, "'four-bar' has within=.*'rocker' follows crank"),
        ({"frame": "lid"}, UnknownNameError, "no frame 'lid'"),
        ({"to": "lid"}, UnknownNameError, "no frame 'lid'"),
        ({"more": (("lid", "crank"),)}, UnknownNameError, "no frame 'lid'"),
        (
            {"to": "coupler"},
            ModelError,
            "'four-bar' cannot move: 'coupler_tip' and 'coupler' are rigidly connected",
        ),
        ({"to": "coupler_tip"}, ModelError, "'four-bar' cannot move"),
        ({"to": "crank"}, kv.errors.NoSolutionError, r"'four-bar' does not close: at best 0\.7 is left"),
        ({"name": "crank"}, DuplicateNameError, "an articulation 'crank' already"),
    ],
)
def test_options_that_do_not_fit(open_bars, options, error, text):
    refused(error, text, lambda: closing(open_bars, **options))


@pytest.mark.parametrize(
    ("lengths", "text"),
    [
        # crank, coupler, rocker, ground
        ((0.4, 0.2, 0.1, 1.0), r"'four-bar' does not close: at best 0\.3 is left between its ends"),
        ((0.1, 2.0, 0.4, 1.0), r"'four-bar' does not close: at best 0\.5 is left between its ends"),
        (
            (0.4, 1.1, 0.4, 1.0),
            r"'four-bar' does not close at crank = 0: 0\.1 is left between its ends.*home",
        ),
    ],
)
def test_bars_that_are_too_short_or_too_long(lengths, text):
    refused(kv.errors.NoSolutionError, text, lambda: four_bar(*lengths))


@pytest.mark.parametrize(
    "options",
    [
        {"limits": {"lower": -2, "upper": 2}},
        pytest.param({"limits": {"lower": 0.5, "upper": 1.5}}, marks=pytest.mark.long),
        # A crank that is not the shortest and has no limits: it would have to go round.
        {"home": {"crank": 0.7}},
    ],
    ids=["on both sides", "on one side", "without limits"],
)
def test_the_error_names_the_place_at_which_a_loop_stops(options):
    """Closed at 0, until crank and coupler are stretched: 0.81 + 1 - 1.8 cos q = 1.2²."""
    stop = math.acos((0.9**2 + 1 - 1.2**2) / 1.8)
    text = rf"'four-bar' does not close between home and .*crank = -?{str(stop)[:5]}"
    refused(kv.errors.NoSolutionError, text, lambda: four_bar(0.9, 0.6, 0.6, 1.0, **options))


def test_a_loop_is_closed_until_shortly_before_it_stops():
    stop = math.acos((0.9**2 + 1 - 1.2**2) / 1.8)
    narrow = four_bar(0.9, 0.6, 0.6, 1.0, home={"crank": 0.7}, within={"crank": (0.3, stop - 0.02)})
    assert narrow.degrees_of_freedom == (kv.position("crank"),)


def test_the_error_names_the_singularity_at_the_end_of_the_range():
    """To the last stretched position itself, beyond which there is no margin."""
    stop = math.acos((0.9**2 + 1 - 1.2**2) / 1.8)
    refused(
        kv.errors.NoSolutionError,
        f"'four-bar'.*{str(stop)[:5]}",
        lambda: four_bar(0.9, 0.6, 0.6, 1.0, within={"crank": (0.3, stop)}),
    )


def test_singular_where_it_begins():
    """A parallelogram in one line can become two things."""
    refused(
        InvalidValueError,
        "'four-bar' is singular where it begins.*home",
        lambda: four_bar(0.4, 1.0, 0.4, 1.0),
    )
    # And goes through that line in every turn.
    refused(
        kv.errors.NoSolutionError,
        r"'four-bar' is singular.* near crank = -?3\.14",
        lambda: four_bar(0.4, 1.0, 0.4, 1.0, home={"crank": 1.0, "coupler": -1.0, "rocker": 1.0}),
    )


def test_a_free_coordinate_at_a_dead_centre_is_refused():
    refused(
        kv.errors.NoSolutionError,
        r"'slider-crank' .*piston = 0\.4",
        lambda: slider_crank(dependent=("crank", "rod"), within={"piston": (0.25, 0.4)}),
    )


def test_a_slide_needs_limits():
    text = r"'slider-crank' needs limits of 'piston'.*within"
    refused(InvalidValueError, text, lambda: slider_crank(dependent=("crank", "rod")))
    for far in ((0.3, math.inf), (-math.inf, 0.3), (-math.inf, math.inf)):
        refused(
            InvalidValueError,
            text,
            lambda f=far: slider_crank(dependent=("crank", "rod"), within={"piston": f}),
        )


def test_loops_that_are_already_closed_are_refused(closed_bars):
    refused(
        InvalidValueError,
        "'again' is closed whatever its coordinates are",
        lambda: closing(closed_bars, name="again"),
    )
    refused(DuplicateNameError, "tag 'loop four-bar' is taken", lambda: closing(closed_bars))
    refused(DuplicateNameError, "an articulation 'four-bar'", lambda: closing(closed_bars, tag="other"))
    refused(
        InvalidValueError,
        "'second' is not about 'rocker', only about crank",
        lambda: closing(closed_bars, "rocker_tip", "world", name="second", dependent=("rocker",)),
    )
    refused(
        kv.errors.NoSolutionError,
        "'second' does not close",
        lambda: closing(closed_bars, "rocker_tip", "world", name="second"),
    )


def test_a_coordinate_with_free_speeds_cannot_be_dependent():
    def towed(**options):
        model = kv.Model()
        with model.edit() as edit:
            edit.apply(
                kv.articulations.DifferentialDrive(
                    name="base", parent="world", child="base", radius=0.1, track=0.4
                )
            )
            bar(edit, "arm", "base", at(0.3))
            edit.add_frame("tip", "arm", kv.translation(0.5, 0, 0))
            edit.add_frame("post", "world", kv.translation(1, 0, 0))
            edit.close_loop("tip", "post", ("x", "y"), name="tow", **options)

    known = {"arm": (-1, 1), "base/yaw": (-1, 1), "base/x": (0, 0.5), "base/y": (-0.5, 0.5)}
    refused(
        InvalidValueError,
        "'tow' cannot make 'base/[xy]' follow: it is moved by speeds of its own",
        lambda: towed(
            dependent=("base/x", "base/y"), within={k: known[k] for k in ("arm",)} | _heading(known)
        ),
    )


def _heading(known):
    """Return the range of the base's heading, whatever it is called."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
    (name,) = {str(s) for s in model.rates} - {"base/x", "base/y"}
    return {name: known["base/yaw"]}


def test_a_quaternion_has_no_limits():
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "drive", "world", at(0), Z)
        edit.apply(kv.articulations.Ball(name="ball", parent="drive", child="rod", origin=at(0.1)))
        edit.add_frame("rod_end", "rod", kv.translation(0.55, 0, 0))
        bar(edit, "driven", "world", at(0.4, 0.3), X)
        edit.add_frame("driven_end", "driven", kv.translation(0, 0.25, 0))
    refused(
        InvalidValueError,
        "Loop 'rod' needs limits of 'ball/q[xyzw]'",
        lambda: closing(model, "rod_end", "driven_end", name="rod"),
    )


def test_frames_that_stand_still_but_apart():
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "wheel", "world", at(0, 0, 0.2))
    refused(
        kv.errors.NoSolutionError,
        r"'axle' does not close: 'wheel' and 'world' are 0\.2 apart along 'z'",
        lambda: closing(model, "wheel", "world", name="axle"),
    )


def test_a_weld_is_not_closed_at_half_a_revolution():
    """The sine of half a turn is zero as well, but that closes nothing."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "table", "world", at(0))
        edit.add_frame("plate", "table", kv.translation(0, 0, 0))
    with model.edit() as edit:
        edit.close_loop("plate", "world", ("rz",), name="bolt", home={"table": 3.1})
    assert model.rates.dependent[kv.position("table")]() % (2 * math.pi) == pytest.approx(0, abs=1e-12)


def test_limits_that_the_loop_cannot_keep():
    """A range of the loop in which it closes, in a joint whose limits it does not: nothing outside of it."""
    model = four_bar(
        0.9, 0.6, 0.6, 1.0, within={"crank": (0.3, 1.2)}, limits={"lower": -2, "upper": 2}, home={"crank": 1}
    )
    model.fk("rocker_tip")({"crank": 1.2})
    with pytest.raises(kv.errors.NoSolutionError, match=r"'four-bar' has no solution at crank = 1\.5"):
        model.fk("rocker_tip")({"crank": 1.5})
    with pytest.raises(kv.errors.NoSolutionError, match=r"'four-bar' has no solution at crank = 1\.5"):
        model.jacobian("rocker_tip")({"crank": 1.5})
