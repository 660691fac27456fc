"""MJCF by grammar."""

from __future__ import annotations

import re
from random import Random
from xml.sax.saxutils import quoteattr

from fuzz import values
from fuzz.values import name, words
from fuzz.xml_trees import Vocabulary

VOCABULARY = Vocabulary(
    tags=words(
        """
        mujoco mujocoinclude compiler option default asset mesh material model texture hfield worldbody body
        joint freejoint geom site inertial frame replicate attach composite flexcomp plugin include equality
        connect weld tendon fixed spatial pulley actuator motor general position velocity muscle keyframe key
        custom numeric text tuple size contact exclude sensor extension camera light skin
        """
    ),
    attributes=words(
        """
        name class childclass type pos quat axisangle euler xyaxes zaxis axis range limited ref springref
        stiffness damping armature frictionloss size fromto mass density mesh material rgba contype
        conaffinity group gravcomp mocap diaginertia fullinertia joint joint1 joint2 body1 body2 site1 site2
        anchor relpose torquescale polycoef active coef divisor sidesite tendon tendon1 tendon2 geom site
        springlength count offset sep prefix model file vertex face scale refpos refquat inertia angle
        eulerseq autolimits coordinate balanceinertia boundmass inertiafromgeom inertiagrouprange settotalmass
        actuatorfrcrange actuatorfrclimited forcerange gear ctrlrange qpos
        """
    ),
    words=words(
        """
        hinge slide ball free true false auto degree radian local global XYZ zyx xzx xyy plane sphere capsule
        ellipsoid cylinder box mesh sdf hfield convex exact legacy shell a b c d e a0 b0 a1 s t l p q m part
        world part.xml part/part.xml ../part.xml home convexhull 1 2 3 100000
        """
    ),
)
_BODIES = ("a", "b", "c", "d")
_SEQUENCES = ("XYZ", "zyx", "xzx", "Zyz", "xyy", "xy", "abc")
_FORMS = ("sphere", "box", "capsule", "cylinder", "ellipsoid", "plane", "mesh")
_TETRAHEDRON = "0 0 0  1 0 0  0 1 0  0 0 1"


def generate(random: Random) -> bytes:
    """Return a tree of bodies with equalities, tendons and actuators."""
    world = _world(random)
    known = _Known(random, world)
    parts = [_compiler(random), _defaults(random), _assets(random), world]
    parts += [_equality(random, known), _tendons(random, known), _actuators(random, known), _keys(random)]
    if random.random() < 0.1:
        random.shuffle(parts)
    if random.random() < 0.03:
        parts.append(_include(random))
    return f'<mujoco model="m">{"".join(parts)}</mujoco>'.encode("utf-8", "replace")


class _Known:
    """Names of the elements so far, by kind."""

    def __init__(self, random: Random, text: str) -> None:
        self._random = random
        self._names = {tag: re.findall(rf'<{tag} name="(\w+)"', text) for tag in ("body", "site", "geom")}
        self._names["joint"] = re.findall(r'<joint name="(\w+)" type="(?:hinge|slide)"', text)

    def names(self, tag: str, count: int) -> list[str]:
        """Return several names of a kind, or as many as there are; rarely an unknown one."""
        found = self._names[tag]
        names = self._random.sample(found, min(count, len(found))) or ["a"]
        if self._random.random() < 0.05:
            names[-1] = name(self._random)
        return names

    def name(self, tag: str) -> str:
        """Return a name of a kind."""
        return self.names(tag, 1)[0]


def number(random: Random) -> str:
    """Return the text of a number, nearly always an ordinary one, since a file has many."""
    return numbers(random, 1)


def numbers(random: Random, count: int) -> str:
    """Return the texts of so many numbers."""
    if random.random() < 0.05:
        return values.numbers(random, count)
    usual = [f"{random.uniform(-2, 2):.3g}" for _ in range(count)]
    if random.random() < 0.03:
        usual[random.randrange(count)] = random.choice(values.EXTREME)
    return " ".join(usual)


def size(random: Random) -> str:
    """Return the text of a number that is mostly positive."""
    return number(random) if random.random() < 0.1 else f"{random.uniform(0.1, 2):.3g}"


def _compiler(random: Random) -> str:
    if random.random() < 0.5:
        return ""
    given = {
        "angle": ("radian", "degree"),
        "autolimits": ("true", "true", "false"),
        "eulerseq": _SEQUENCES if random.random() < 0.2 else _SEQUENCES[:5],
        "balanceinertia": ("true",),
        "boundmass": ("0.1", number(random)),
        "boundinertia": ("0.1", number(random)),
        "settotalmass": ("1", number(random)),
        "inertiafromgeom": ("auto", "true", "false"),
        "inertiagrouprange": ("0 5", "1 1", "3 2"),
        "meshdir": ("meshes", "..", "/"),
    }
    return _element("compiler", {k: random.choice(v) for k, v in given.items() if random.random() < 0.2})


def _defaults(random: Random) -> str:
    inside = _element("joint", {"damping": size(random)}) + _element("geom", {"size": "0.1 0.2 0.3"})
    settings = _joint_settings(random) if random.random() < 0.3 else {}
    inner = f'<default class="k">{_element("joint", settings)}</default>'
    return f"<default>{inside if random.random() < 0.3 else ''}{inner}</default>"


def _assets(random: Random) -> str:
    inside = f'<mesh name="q" vertex="{_TETRAHEDRON}"/><material name="t" rgba="1 0 0 0.5"/>'
    if random.random() < 0.03:
        given = {"name": "r", "vertex": numbers(random, 3 * random.choice((1, 4, 5, 6)))}
        inside += _element("mesh", given)
    if random.random() < 0.1:
        where = random.choice(("a.stl", "part/a.obj", "../a.stl", name(random)))
        inside += _element("mesh", {"name": "f", "file": where, "scale": numbers(random, 3)})
    where = "part.xml"
    if random.random() < 0.05:
        where = random.choice(("part/part.xml", "../part.xml", name(random)))
    inside += _element("model", {"name": "p", "file": where})
    return f"<asset>{inside}</asset>"


def _world(random: Random) -> str:
    names = list(_BODIES[: random.choice((1, 2, 3, 4))])
    return f'<worldbody><site name="sw"/>{_bodies(random, names)}</worldbody>'


def _bodies(random: Random, names: list[str]) -> str:
    """Return the first body with some of the others inside, and the rest beside it."""
    if not names:
        return ""
    inside = names[1 : random.choice((len(names), len(names), random.randint(1, len(names))))]
    beside = names[1 + len(inside) :]
    text = _body(random, names[0], _bodies(random, inside))
    what = random.random()
    if what < 0.06:
        text = _element("frame", {"name": "g", **_placed(random)}, text)
    elif what < 0.1:
        count = "2" if random.random() < 0.8 else random.choice(("3", "0", "-1", "1e9", number(random)))
        text = _element("replicate", {"count": count, "offset": numbers(random, 3)}, text)
    elif what < 0.14:
        thing = {"body": random.choice(("x", "y"))} if random.random() < 0.7 else {}
        text += _element("attach", {"model": "p", **thing, "prefix": name(random, ("u_", "v_"))})
    return text + _bodies(random, beside)


def _body(random: Random, body: str, inside: str) -> str:
    given = {**_named(random, body), **_placed(random)}
    if random.random() < 0.05:
        given["childclass"] = random.choice(("k", "k", "k", "k", "z"))
    parts = [_joint(random, f"{body}{i}") for i in range(random.choice((0, 1, 1, 1, 1, 2, 3)))]
    parts = [*(p for p in parts if "ball" not in p), *[p for p in parts if "ball" in p][:1]]
    if (body == "a" and random.random() < 0.1) or random.random() < 0.005:
        parts = [random.choice((_element("freejoint", _named(random, f"{body}0")), '<joint type="free"/>'))]
    if body == "a" and random.random() < 0.05:
        given["mocap"], parts = "true", []
    parts += [_geom(random) for _ in range(random.choice((1, 1, 1, 2)))]
    parts += ['<geom size=".1"/>'] if random.random() < 0.9 else []
    if random.random() < 0.15:
        given_ = {"pos": numbers(random, 3), "mass": size(random), "diaginertia": "1 1 1"}
        if random.random() < 0.1:
            given_ = {"pos": "0 0 0", "mass": "1", "fullinertia": numbers(random, 6)}
        parts.append(_element("inertial", given_))
    parts.append(_site(random, f"s{body}"))
    return _element("body", given, "".join(parts) + inside)


def _joint_settings(random: Random) -> dict[str, str]:
    low, high = sorted((random.uniform(-3, 3), random.uniform(-3, 3)))
    choices = {
        "range": f"{low} {high}" if random.random() < 0.9 else _range(random),
        "ref": number(random),
        "damping": size(random),
        "stiffness": size(random),
        "springref": number(random),
        "frictionloss": size(random),
        "armature": size(random),
        "limited": random.choice(("false", "auto", "auto", "true")),
        "actuatorfrcrange": f"-1 {size(random)}",
    }
    return {k: v for k, v in choices.items() if random.random() < (0.4 if k == "range" else 0.07)}


def _range(random: Random) -> str:
    """Return two numbers of any size, the smaller one first."""
    return " ".join(sorted(random.choices((*values.EXTREME, "-inf", "inf", "2"), k=2), key=float))


def _joint(random: Random, joint: str) -> str:
    kind = random.choice(("hinge", "hinge", "hinge", "slide", "slide", "ball"))
    given = {**_named(random, joint), "type": kind, **_joint_settings(random)}
    if kind != "ball":
        given["axis"] = random.choice(("1 0 0", "0 1 0", "0 0 1", numbers(random, 3)))
    else:
        given.pop("ref", None)
        given.pop("springref", None)
        if "range" in given:
            given["range"] = f"0 {size(random)}"
    if random.random() < 0.3:
        given["pos"] = numbers(random, 3)
    return _element("joint", given)


def _geom(random: Random) -> str:
    kind = random.choice(_FORMS)
    given = {"type": kind, "size": f"{size(random)} {size(random)} {size(random)}"}
    if kind == "mesh":
        given = {"type": kind, "mesh": "q" if random.random() < 0.95 else random.choice(("r", "f"))}
    elif kind == "plane" or random.random() < 0.5:
        given = {"size": ".1"}
    elif kind in ("capsule", "cylinder") and random.random() < 0.2:
        given["fromto"] = numbers(random, 6)
    elif random.random() < 0.3:
        given |= _placed(random)
    for key, value in (("mass", size(random)), ("group", "3"), ("contype", "0"), ("material", "t")):
        if random.random() < 0.03:
            given[key] = value
    return _element("geom", given)


def _site(random: Random, site: str) -> str:
    return _element("site", {**_named(random, site), **_placed(random)})


def _placed(random: Random) -> dict[str, str]:
    given = {"pos": numbers(random, 3)} if random.random() < 0.5 else {}
    notations = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
    if random.random() < 0.3:
        notation = random.choice(list(notations))
        given[notation] = numbers(random, notations[notation])
    return given


def _equality(random: Random, known: _Known) -> str:
    if random.random() < 0.5:
        return ""
    inside = ""
    for i in range(random.choice((1, 1, 2))):
        kind = random.choice(("joint", "joint", "connect", "weld", "tendon"))
        given = _named(random, f"e{i}")
        if kind in ("joint", "tendon"):
            ends = known.names("joint", 2) if kind == "joint" else ["t0", "t1"]
            given |= {f"{kind}{k + 1}": end for k, end in enumerate(ends[: random.choice((1, 2, 2))])}
            if random.random() < 0.7:
                given["polycoef"] = numbers(random, random.choice((2, 5)))
        elif random.random() < 0.3:
            given |= {"site1": known.name("site"), "site2": known.name("site")}
        else:
            ends = known.names("body", random.choice((1, 2, 2)))
            given |= {f"body{k + 1}": end for k, end in enumerate(ends)}
            if kind == "connect" or random.random() < 0.3:
                given["anchor"] = numbers(random, 3)
            if kind == "weld" and random.random() < 0.3:
                given["relpose"] = numbers(random, 7)
        if random.random() < 0.05:
            given["active"] = "false"
        inside += _element(kind, given)
    return f"<equality>{inside}</equality>"


def _tendons(random: Random, known: _Known) -> str:
    if random.random() < 0.6:
        return ""
    inside = ""
    for i in range(random.choice((1, 1, 2))):
        given = _named(random, f"t{i}")
        if random.random() < 0.3:
            given["range"] = random.choice(("0 2", f"0 {size(random)}"))
        if random.random() < 0.1:
            given |= {"stiffness": size(random), "springlength": f"0.1 {size(random)}"}
        if random.random() < 0.5:
            terms = [{"joint": joint, "coef": number(random)} for joint in known.names("joint", 2)]
            inside += _element("fixed", given, "".join(_element("joint", term) for term in terms))
        else:
            path = [_element("site", {"site": site}) for site in known.names("site", 4)]
            if len(path) == 4 and random.random() < 0.3:
                path[2:2] = [_element("pulley", {"divisor": size(random)})]
            if random.random() < 0.1:
                path[1:1] = [_element("geom", {"geom": known.name("geom")})]
            inside += _element("spatial", given, "".join(path))
    return f"<tendon>{inside}</tendon>"


def _actuators(random: Random, known: _Known) -> str:
    if random.random() < 0.8:
        return ""
    kind = random.choice(("motor", "position", "velocity", "general", "muscle"))
    given = {"joint": known.name("joint"), "forcerange": f"-1 {size(random)}", "gear": number(random)}
    if kind == "muscle" or random.random() < 0.3:
        given = {"joint": known.name("joint")}
    return f"<actuator>{_element(kind, given)}</actuator>"


def _keys(random: Random) -> str:
    if random.random() < 0.85:
        return ""
    given = {"name": random.choice(("home", "home", "other"))}
    if random.random() < 0.9:
        given["qpos"] = numbers(random, random.choice((1, 2, 3, 4, 7)))
    return f"<keyframe>{_element('key', given)}</keyframe>"


def _include(random: Random) -> str:
    where = random.choice(("bodies.xml", "part.xml", "../bodies.xml", "input.xml", name(random)))
    include = _element("include", {"file": where})
    return include if random.random() < 0.3 else f"<worldbody>{include}</worldbody>"


def _named(random: Random, usual: str) -> dict[str, str]:
    if random.random() < 0.05:
        return {}
    return {"name": usual if random.random() < 0.98 else name(random)}


def _element(tag: str, attributes: dict[str, str], inside: str = "") -> str:
    given = "".join(f" {key}={quoteattr(value)}" for key, value in attributes.items())
    return f"<{tag}{given}>{inside}</{tag}>" if inside else f"<{tag}{given}/>"
