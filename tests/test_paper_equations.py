"""The numbered equations of the two papers, one test each, with the numbers found a second way.

2022: "Kineverse: A Symbolic Articulation Model Framework for Model-Agnostic Mobile Manipulation", RA-L.
2020: the article of the same name that came before it, on arXiv.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv

a, b, c, d = (kv.position(name) for name in "abcd")
da, db, dc, dd = (s.derivative() for s in (a, b, c, d))
POINTS = [
    dict(zip((a, b, c, d), row, strict=True)) for row in np.random.default_rng(4).uniform(-2, 2, (12, 4))
]


def numbers(gradient, at):
    """Return the entries of a gradient as numbers, by the names of the keys."""
    return {str(key): entry(at) for key, entry in gradient.items()}


def slope(e, symbol, at, step=1e-6):
    """Return the central difference of a value: it knows nothing of gradients."""
    return (e({**at, symbol: at[symbol] + step}) - e({**at, symbol: at[symbol] - step})) / (2 * step)


# -- the paper of 2022 -------------------------------------------------------------------------------------


def turned_and_lifted():
    # The rotation that is printed there is the transpose of ours: it turns by -a if points are columns.
    return kv.translation(0, 0, b) @ kv.rotation_z(-a)


@pytest.mark.parametrize("at", POINTS)
def test_equation_1_of_2022(at):
    """Eq. 1: the pose that moves by b along z and turns by a about it, as a matrix of expressions in a and b."""
    T = turned_and_lifted()
    assert T.symbols == (a, b)
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_rotvec([0, 0, at[a]]).as_matrix().T
    expected[2, 3] = at[b]
    np.testing.assert_allclose(T(at), expected, atol=1e-15)
    entries = [[np.cos(a), np.sin(a), 0, 0], [-np.sin(a), np.cos(a), 0, 0], [0, 0, 1, b], [0, 0, 0, 1]]
    np.testing.assert_allclose(kv.array(entries)(at), expected, atol=1e-15)
    np.testing.assert_allclose(np.linalg.inv(kv.rotation_z(a)(at)), kv.rotation_z(-a)(at), atol=1e-15)


def test_equation_2_of_2022():
    """Eq. 2: that pose at a = π, b = 2, by numbers at once and by substitution."""
    expected = np.diag([-1.0, -1.0, 1.0, 1.0])
    expected[2, 3] = 2
    np.testing.assert_allclose(turned_and_lifted()({a: math.pi, b: 2.0}), expected, atol=1e-15)
    substituted = turned_and_lifted().substitute({a: math.pi, b: 2.0})
    assert substituted.is_constant
    np.testing.assert_allclose(substituted(), expected, atol=1e-15)


def phi():
    return np.sin(a) + b**2


@pytest.mark.parametrize("at", POINTS)
def test_equation_3_of_2022(at):
    """Eq. 3: the partial derivatives of sin a + b² by a and by b."""
    by_a, by_b = phi().partial([a, b])
    assert by_a == np.cos(a)
    assert by_a(at) == pytest.approx(slope(phi(), a, at), abs=1e-8)
    assert by_b(at) == pytest.approx(slope(phi(), b, at), abs=1e-8)
    assert by_b(at) == pytest.approx(2 * at[b])


@pytest.mark.parametrize("at", POINTS)
def test_equation_4_of_2022(at):
    """Eq. 4: the gradient as a column, which is what a Jacobian without augmentations is."""
    gradient = phi().jacobian([a, b])
    assert gradient.shape == (2,)
    np.testing.assert_allclose(gradient(at), [math.cos(at[a]), 2 * at[b]])
    np.testing.assert_allclose(gradient(at), [slope(phi(), s, at) for s in (a, b)], atol=1e-8)


@pytest.mark.parametrize("at", POINTS)
def test_equation_5_of_2022(at):
    """Eq. 5: the gradient as a mapping, whose keys are the derivatives of the variables."""
    gradient = phi().gradient()
    assert list(gradient) == [da, db]
    assert numbers(gradient, at) == pytest.approx(
        {"a:velocity": slope(phi(), a, at), "b:velocity": slope(phi(), b, at)}, abs=1e-8
    )


@pytest.mark.parametrize("at", POINTS)
def test_equation_6_of_2022(at):
    """Eq. 6: entries for c and d, which do not occur in the value; the others stay."""
    extended = phi().augment({dc: 4, dd: -4})
    assert c not in extended.symbols
    assert d not in extended.symbols
    assert extended(at) == phi()(at)
    assert numbers(extended.gradient(), at) == pytest.approx(
        {"a:velocity": math.cos(at[a]), "b:velocity": 2 * at[b], "c:velocity": 4, "d:velocity": -4}
    )


def test_equation_6_of_2022_drives_a_base():
    """Eq. 6, what it is for: a base whose x and angle are no functions of the wheels still moves with them."""
    r, width = 0.1, 0.5
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=r, track=width, left="left", right="right"
            )
        )
    pose = model.fk("base")
    left, right = kv.velocity("left"), kv.velocity("right")
    at = kv.State({"base/x": 0.3, "base/y": -1.0, "base/angle": 0.7})

    assert {left, right} <= pose.gradient().keys()
    assert kv.position("left") not in pose.symbols

    # Around the point that stands still both wheels roll the lengths of their own circles.
    speeds = {left: 1.5, right: 4.0}
    omega = r * (speeds[right] - speeds[left]) / width
    radius = r * (speeds[right] + speeds[left]) / 2 / omega
    centre = np.array([0.3, -1.0]) + radius * np.array([-math.sin(0.7), math.cos(0.7)])
    step = 1e-5
    turn = Rotation.from_rotvec([0, 0, omega * step]).as_matrix()[:2, :2]
    moved = centre + turn @ (np.array([0.3, -1.0]) - centre)
    tangent = sum(pose.gradient()[s](at) * v for s, v in speeds.items())
    np.testing.assert_allclose(tangent[:2, 3], (moved - [0.3, -1.0]) / step, atol=1e-5)
    assert tangent[1, 0] == pytest.approx(omega * math.cos(0.7))


def overridden():
    return phi().augment({db: 1, dc: 4})


@pytest.mark.parametrize("at", POINTS)
def test_equation_7_of_2022(at):
    """Eq. 7: the entry of b overridden with 1 and one of c added; that of a stays."""
    assert overridden()(at) == phi()(at)
    assert numbers(overridden().gradient(), at) == pytest.approx(
        {"a:velocity": math.cos(at[a]), "b:velocity": 1, "c:velocity": 4}
    )
    assert slope(overridden(), b, at) == pytest.approx(2 * at[b], abs=1e-8)  # the value does not know of it


@pytest.mark.parametrize("at", POINTS)
def test_equation_8_of_2022(at):
    """Eq. 8: times 4a, the product rule carries the overridden and the added entry along."""
    product = overridden() * (4 * a)
    x, y = at[a], at[b]
    assert numbers(product.gradient(), at) == pytest.approx(
        {"a:velocity": 4 * (math.sin(x) + x * math.cos(x) + y**2), "b:velocity": 4 * x, "c:velocity": 16 * x}
    )
    # Where nothing was overridden, the entry is the slope; where something was, the slope is 8ab.
    assert product.gradient()[da](at) == pytest.approx(slope(product, a, at), abs=1e-7)
    assert product.partial([b])(at) == pytest.approx([8 * x * y])
    assert slope(product, b, at) == pytest.approx(8 * x * y, abs=1e-7)


def test_equation_9_of_2022():
    """Eq. 9: one and the same range limits the position of b or its speed, by the symbol in the middle."""
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("position", -1, b, 2)
        edit.constrain("speed", -1, db, 2)
    assert {name: constraint.order for name, constraint in model.constraints.items()} == {
        "position": 0,
        "speed": 1,
    }
    for x in (-1.5, -1.0, 0.0, 2.0, 2.25):
        for v in (-1.25, 0.5, 2.0, 3.0):
            excess = {"position": max(-1 - x, x - 2, 0), "speed": max(-1 - v, v - 2, 0)}
            found = {entry.name: entry.excess for entry in model.violations({b: x, db: v})}
            assert found == pytest.approx({name: e for name, e in excess.items() if e})


def test_relevance_of_2022():
    """III-A2, beside Eq. 9: relevant is what has variables of the constrained expression in common.

    By default coordinates are compared, so that a limit on ȧ is found from a pose in a, and so is a limit on
    what the gradient alone knows of. ``exact=True`` is the formula of the papers.
    """
    triples = {
        "a": (-1, a, 1),
        "a speed": (-1, da, 1),
        "a and b": (0, a + b, c),
        "c": (0, c**2, a),
        "wheel": (-3, dd, 3),
    }
    model = kv.Model()
    with model.edit() as edit:
        for name, triple in triples.items():
            edit.constrain(name, *triple)
    for subject in [a, b * c, np.sin(da), c.augment({dd: a}), kv.rotation_x(b) @ kv.translation(a, 0, 0)]:
        variables = {str(s) for s in subject.symbols}
        shared = {n for n, (_, e, _) in triples.items() if {str(s) for s in e.symbols} & variables}
        assert set(model.constraints_for(subject, exact=True)) == shared
        paths = {s.path for s in (*subject.symbols, *subject.gradient())}
        widely = {n for n, (_, e, _) in triples.items() if {s.path for s in e.symbols} & paths}
        assert set(model.constraints_for(subject)) == widely
    assert set(model.constraints_for(a, exact=True)) == {"a", "a and b"}
    assert set(model.constraints_for(a)) == {"a", "a and b", "a speed"}
    assert set(model.constraints_for(c.augment({dd: a}))) == {"c", "wheel"}


@dataclass(frozen=True)
class Body(kv.Operation):
    """Place a frame at a height above another."""

    name: str
    parent: str
    height: float

    def apply(self, model):
        return kv.model.Writes(frames={self.name: (self.parent, kv.translation(0, 0, self.height))})


@dataclass(frozen=True)
class Hinge(kv.Operation):
    """Let what a frame already is turn about z, within a range."""

    name: str
    range: float

    def apply(self, model):
        frame, q = model.frames[self.name], kv.position(f"{self.name}/hinge")
        return kv.model.Writes(
            frames={self.name: (frame.parent, kv.rotation_z(q) @ frame.transform)},
            constraints={f"{self.name}/range": (0, q, self.range)},
        )


def test_equation_10_of_2022():
    """Eq. 10: a model is what operations make, one after the other, of the empty model."""
    operations = [Body("A", "world", 1.0), Hinge("A", 2.0), Body("B", "A", 0.5), Hinge("B", 3.0)]
    at = kv.State({"A/hinge": 0.4, "B/hinge": -0.3})

    model = kv.Model()
    assert set(model.frames) <= {"world"}
    assert not model.constraints
    stages = []
    for operation in operations:
        with model.edit() as edit:
            edit.apply(operation)
        stages.append(model.snapshot())

    # The same by hand: frames are pairs of parent and matrix, and every operation sees those before it.
    by_hand = {"world": np.eye(4)}
    for stage, (name, angle) in zip(stages, [("A", 0.0), ("A", 0.4), ("B", 0.0), ("B", -0.3)], strict=True):
        parent = {"A": "world", "B": "A"}[name]
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        motion[2, 3] = {"A": 1.0, "B": 0.5}[name]
        by_hand[name] = by_hand[parent] @ motion
        np.testing.assert_allclose(stage.fk(name)(at), by_hand[name], atol=1e-15)
    assert [sorted(stage.constraints) for stage in stages] == [
        [],
        ["A/range"],
        ["A/range"],
        ["A/range", "B/range"],
    ]

    at_once = kv.Model()
    with at_once.edit() as edit:
        for operation in operations:
            edit.apply(operation)
    assert at_once.snapshot() == model.snapshot()


def test_equation_10_of_2022_knows_where_to_insert():
    """Eq. 10 and what follows it: tags say where a change of A has to go if it is to affect B."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Body("A", "world", 1.0), tag="place A")
        edit.apply(Body("B", "A", 0.5), tag="connect A B")
        edit.apply(Body("C", "world", 0.25), tag="place C")
    assert model.history.readers("frames/A") == ["connect A B"]
    with model.edit() as edit:
        edit.insert(Hinge("A", 2.0), tag="turn A", to_affect="B")
    assert model.history.tags == ["place A", "turn A", "connect A B", "place C"]
    assert model.fk("B").symbols == (kv.position("A/hinge"),)
    assert model.fk("C").symbols == ()


# -- the paper of 2020 -------------------------------------------------------------------------------------


def test_equation_1_of_2020():
    """Eq. 1: variables of an expression, a mapping that gives them values, and none left once it is applied."""
    e = a + np.sin(b)
    assert set(e.symbols) == {a, b}
    expected = 3 + math.sin(4)
    assert e({a: 3, b: 4}) == pytest.approx(expected)
    assert e.substitute({a: 3, b: 4}).symbols == ()
    assert float(e.substitute({a: 3, b: 4})) == pytest.approx(expected)
    assert e.substitute({a: 3}).symbols == (b,)


@pytest.mark.parametrize("at", POINTS)
def test_equation_2_of_2020(at):
    """Eq. 2: the gradient has one entry for each variable, under its derivative: the partial derivative."""
    e = np.exp(a * b) * np.cos(c) + np.arctan2(d, 3 + a**2)
    assert set(e.gradient()) == {s.derivative() for s in e.symbols}
    for s in e.symbols:
        entry = e.gradient()[s.derivative()](at)
        # A step along the imaginary axis gives the derivative without taking a difference.
        shifted = {k: complex(v, 1e-30 if k is s else 0) for k, v in at.items()}
        x, y, z, w = (shifted[k] for k in (a, b, c, d))
        value = np.exp(x * y) * np.cos(z) + np.arctan(w / (3 + x * x))
        assert entry == pytest.approx(value.imag / 1e-30, rel=1e-12)


def test_equation_3_of_2020():
    """Eq. 3: sums add entry by entry, and a key that one side lacks counts as zero there."""
    left = kv.array(1.0).with_gradient({da: 2, db: 3})
    right = kv.array(5.0).with_gradient({db: -1, dc: 1})
    assert (left + right)() == 6
    assert numbers((left + right).gradient(), {}) == {"a:velocity": 2, "b:velocity": 2, "c:velocity": 1}
    first, second = np.array([2, 3, 0]), np.array([0, -1, 1])
    for p, q in ((1, 1), (1, -1), (2.5, 4)):
        entries = (p * left + q * right).gradient()
        found = [entries[k]() if k in entries else 0 for k in (da, db, dc)]
        np.testing.assert_allclose(found, p * first + q * second)


@pytest.mark.parametrize("at", POINTS)
@pytest.mark.parametrize("contrast", [0.5, 3.0, 1e10])
def test_equation_4_of_2020(at, contrast):
    """Eq. 4: a smooth "less than", and a gradient that is the trend of its truth and not its slope."""
    left, right = a * b, c + np.sin(a)
    e, difference = kv.logic.less(left, right, contrast=contrast), right(at) - left(at)
    # (1 + tanh x)/2 is the logistic function of 2x, here in the form that does not overflow.
    far = math.exp(-2 * abs(difference) * contrast)
    assert e(at) == pytest.approx(1 / (1 + far) if difference > 0 else far / (1 + far), rel=1e-9, abs=1e-12)

    wanted = {s: slope(right, s, at) - slope(left, s, at) for s in (a, b, c)}
    found = e.gradient()
    assert set(found) == {s.derivative() for s in wanted}
    for s, trend in wanted.items():
        assert found[s.derivative()](at) == pytest.approx(trend, abs=1e-8)
    assert not e.gradient(heuristic=False)
    assert e.partial([c])(at) == pytest.approx([slope(e, c, at)], abs=1e-5)


def test_boolean_operators_of_2020():
    """III-C, around Eq. 4: values are those of 1 - φ and φ·ψ; the trends are not those of the product rule.

    The papers derive the products like any others, and then a conjunction of two untruths has a trend of zero.
    ``&`` and ``~`` correct that; ``*`` and ``1 -`` are still what the papers write.
    """
    x, y = kv.logic.less(1, a), kv.logic.less(1, b)  # a and b have to grow
    for at in ({a: 0.0, b: 0.0}, {a: 2.0, b: 0.0}, {a: 0.0, b: 2.0}, {a: 2.0, b: 2.0}, {a: 1.0, b: 0.5}):
        p, q = float(at[a] > 1) + 0.5 * (at[a] == 1), float(at[b] > 1)
        for written, ours in ((x * y, x & y), (1 - x, ~x), (1 - (1 - x) * (1 - y), x | y)):
            assert ours(at) == written(at)
        assert (x & y)(at) == p * q
        assert numbers((x * y).gradient(), at) == {"a:velocity": q, "b:velocity": p}
        assert numbers((x & y).gradient(), at) == {"a:velocity": 1 - p + p * q, "b:velocity": 1 - q + p * q}
        assert numbers((~x).gradient(), at) == numbers((1 - x).gradient(), at) == {"a:velocity": -1}
    both_false = {a: 0.0, b: 0.0}
    assert numbers((x * y).gradient(), both_false) == {"a:velocity": 0, "b:velocity": 0}
    assert numbers((x & y).gradient(), both_false) == {"a:velocity": 1, "b:velocity": 1}
