"""URDF by grammar."""

from __future__ import annotations

from random import Random
from xml.sax.saxutils import quoteattr

from fuzz.values import name, number, numbers, words
from fuzz.xml_trees import Vocabulary

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_WORDS = (
    *KINDS,
    "a",
    "b",
    "c",
    "l0",
    "l1",
    "l2",
    "j0",
    "j1",
    "1.0",
    "1.1",
    "1.2",
    "Floating",
    "world",
    "j0/x",
    "x",
)
VOCABULARY = Vocabulary(
    tags=words(
        """
        robot link joint origin axis limit mimic safety_controller dynamics parent child visual collision
        inertial mass inertia geometry box sphere cylinder capsule mesh material color texture gazebo
        transmission xacro:macro calibration
        """
    ),
    attributes=words(
        """
        name type link xyz rpy quat_xyzw lower upper effort velocity joint multiplier offset
        soft_lower_limit soft_upper_limit k_position k_velocity damping friction value ixx ixy size radius
        length filename scale rgba version acceleration jerk xmlns:xacro
        """
    ),
    words=_WORDS,
)


def generate(random: Random) -> bytes:
    """Return a robot: a tree of links, mostly."""
    count = random.choice((1, 2, 2, 3, 3, 4, 6))
    names = [f"l{i}" if random.random() < 0.97 else name(random) for i in range(count)]
    parts = [_link(random, link) for link in names]
    for i in range(1, count):
        parent = names[random.randrange(i)] if random.random() < 0.97 else random.choice(names)
        parts.append(_joint(random, f"j{i - 1}", parent, names[i], count - 1))
    if random.random() < 0.1:
        parts.append(f'<material name="m">{_colour(random)}</material>')
    if random.random() < 0.2:
        random.shuffle(parts)
    version = random.choice(("", "", "", ' version="1.1"', ' version="1.2"'))
    return f'<robot name="r"{version}>{"".join(parts)}</robot>'.encode("utf-8", "replace")


def _link(random: Random, link: str) -> str:
    inside = []
    if random.random() < 0.3:
        tensor = " ".join(f'{key}="{number(random)}"' for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
        mass = f'<mass value="{number(random)}"/>'
        inside.append(f"<inertial>{_origin(random)}{mass}<inertia {tensor}/></inertial>")
    for tag in ("visual", "collision"):
        if random.random() < 0.3:
            colour = f'<material name="m">{_colour(random)}</material>' if random.random() < 0.5 else ""
            inside.append(f"<{tag}>{_origin(random)}<geometry>{_form(random)}</geometry>{colour}</{tag}>")
    return f"<link name={quoteattr(link)}>{''.join(inside)}</link>"


def _form(random: Random) -> str:
    size = abs(random.gauss(1, 1)) if random.random() < 0.9 else number(random)
    return random.choice((
        f'<box size="{size} {size} {size}"/>', f'<sphere radius="{size}"/>', "<box/>", "<plane/>",
        f'<cylinder radius="{size}" length="{size}"/>', f'<capsule radius="{size}" length="{size}"/>',
        f'<mesh filename={quoteattr(name(random))} scale="{numbers(random, 3)}"/>',
    ))  # fmt: skip


def _colour(random: Random) -> str:
    return random.choice(("", f'<color rgba="{numbers(random, 4)}"/>', '<texture filename="a.png"/>'))


def _origin(random: Random) -> str:
    turn = random.choice((f'rpy="{numbers(random, 3)}"', f'quat_xyzw="{numbers(random, 4)}"', ""))
    return random.choice(("", f'<origin xyz="{numbers(random, 3)}" {turn}/>'))


def _joint(random: Random, joint: str, parent: str, child: str, count: int) -> str:
    ends = f"<parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>"
    inside = [_origin(random)]
    if random.random() < 0.8:
        inside.append(f'<axis xyz="{numbers(random, 3)}"/>')
    if random.random() < 0.95:
        low, high = sorted((random.uniform(-3, 3), random.uniform(-3, 3)))
        bounds = f'lower="{low}" upper="{high}"'
        if random.random() < 0.1:
            bounds = f'lower="{number(random)}" upper="{number(random)}"'
        inside.append(f'<limit {bounds} effort="{number(random)}" velocity="{number(random)}"/>')
    if random.random() < 0.3:
        leader = f"j{random.randrange(count)}"
        inside.append(f'<mimic joint="{leader}" multiplier="{number(random)}" offset="{number(random)}"/>')
    if random.random() < 0.2:
        soft = f'soft_lower_limit="{number(random)}" soft_upper_limit="{number(random)}"'
        inside.append(f'<safety_controller {soft} k_position="1" k_velocity="{number(random)}"/>')
    if random.random() < 0.2:
        inside.append(f'<dynamics damping="{number(random)}" friction="{number(random)}"/>')
    kind = random.choice(KINDS) if random.random() < 0.97 else name(random)
    return f'<joint name="{joint}" type={quoteattr(kind)}>{ends}{"".join(inside)}</joint>'
