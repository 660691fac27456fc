"""SDF by grammar."""

from __future__ import annotations

from random import Random
from xml.sax.saxutils import escape, quoteattr

from fuzz.values import name, number, numbers, words
from fuzz.xml_trees import Vocabulary

KINDS = ("fixed", "revolute", "continuous", "prismatic", "screw", "universal", "revolute2", "ball", "gearbox")
VERSIONS = ("1.4", "1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11", "1.12")
VOCABULARY = Vocabulary(
    tags=words(
        """
        sdf world model link joint frame pose include uri name static placement_frame parent child axis
        axis2 xyz limit lower upper velocity effort dynamics damping friction spring_stiffness mimic
        multiplier offset reference thread_pitch screw_thread_pitch gearbox_ratio gearbox_reference_body
        use_parent_model_frame inertial mass inertia ixx visual collision geometry box size sphere radius
        cylinder length ellipsoid radii cone capsule mesh scale plane submesh material diffuse transparency
        self_collide light state plugin xacro:a
        """
    ),
    attributes=words(
        """
        version name type relative_to attached_to frame canonical_link placement_frame degrees
        rotation_format expressed_in joint axis merge auto
        """
    ),
    words=(
        *(*KINDS, *VERSIONS),
        *words(
            "a b c d m n m::a n::a n::__model__ __model__ world true false quat_xyzw euler_rpy j0 j1 n::j0"
        ),
        *words("axis axis2 model://part part/model.sdf"),
    ),
)
_LINKS = ("a", "b", "c", "d")


def generate(random: Random) -> bytes:
    """Return a model, a world, or several models."""
    what = random.random()
    if what < 0.7:
        body = _model(random, "m", 0)
    elif what < 0.9:
        models = "".join(_model(random, m, 0) for m in ("m", "n")[: random.choice((1, 2))])
        models += _include(random) + _frame(random, ("m", "n")) + _joint(random, "j", ("m::a", "n::b"))
        body = f'<world name="w">{models}</world>'
    else:
        body = _model(random, "m", 0) + _model(random, name(random, ("n", "m")), 0)
    version = random.choice(VERSIONS) if random.random() < 0.99 else number(random)
    return f'<sdf version="{version}">{body}</sdf>'.encode("utf-8", "replace")


def _model(random: Random, model: str, depth: int) -> str:
    links = _LINKS[: random.choice((1, 2, 2, 3, 4))]
    parts = [_link(random, link, links) for link in links]
    names = [*links]
    for i in range(random.choice((0, 1, 2, 3, 4))):
        # Mostly a tree: from an earlier link to a later one, with some that close loops.
        ends: tuple[str, ...] = (links[min(i, len(links) - 1)], links[min(i + 1, len(links) - 1)])
        if random.random() < 0.2:
            ends = tuple(random.choice((*links, "world", "n::a")) for _ in range(2))
        parts.append(_joint(random, f"j{i}", ends))
        names.append(f"j{i}")
    parts += [_frame(random, tuple(names)) for _ in range(random.choice((0, 0, 1, 2)))]
    if depth < 2 and random.random() < 0.2:
        parts.append(_model(random, "n", depth + 1))
    if random.random() < 0.1:
        parts.append(_include(random))
    if random.random() < 0.05:
        parts.append(f"<static>{random.choice(('true', 'false', '1', 'no'))}</static>")
    random.shuffle(parts)
    extra = ""
    if random.random() < 0.1:
        extra += f" canonical_link={quoteattr(name(random, tuple(names)))}"
    if random.random() < 0.1:
        extra += f" placement_frame={quoteattr(name(random, tuple(names)))}"
    return f"<model name={quoteattr(model)}{extra}>{_pose(random, ())}{''.join(parts)}</model>"


def _include(random: Random) -> str:
    if random.random() < 0.5:
        return ""
    uri = random.choice(
        ("model://part", "part", "model://part/model.sdf", "model://none", "../part", "file:///etc")
    )
    merge = random.choice(("", "", ' merge="true"'))
    given = random.choice(
        ("", f"<name>{escape(name(random))}</name>", _pose(random, ("a",)), "<static>1</static>")
    )
    return f"<include{merge}><uri>{uri}</uri>{given}</include>"


def _link(random: Random, link: str, links: tuple[str, ...]) -> str:
    inside = [_pose(random, links)]
    if random.random() < 0.2:
        inside.append(
            f"<inertial><mass>{number(random)}</mass><inertia><ixx>{number(random)}</ixx></inertia></inertial>"
        )
    if random.random() < 0.3:
        inside.append(f"<visual name='v'>{_pose(random, links)}<geometry>{_form(random)}</geometry></visual>")
    shown = link if random.random() < 0.98 else name(random)
    return f"<link name={quoteattr(shown)}>{''.join(inside)}</link>"


def _form(random: Random) -> str:
    size = f"<radius>{number(random)}</radius>"
    box = f"<box><size>{numbers(random, 3)}</size></box>"
    ellipsoid = f"<ellipsoid><radii>{numbers(random, 3)}</radii></ellipsoid>"
    cone = "<cone><radius>1</radius><length>2</length></cone>"
    mesh = "<mesh><uri>a.dae</uri></mesh>"
    return random.choice((f"<sphere>{size}</sphere>", box, ellipsoid, cone, mesh, "<plane/>", "<empty/>", ""))


def _pose(random: Random, references: tuple[str, ...]) -> str:
    if random.random() < 0.5:
        return ""
    attributes, count = "", 6
    if references and random.random() < 0.3:
        attributes = f" relative_to={quoteattr(name(random, references))}"
    if random.random() < 0.1:
        attributes, count = attributes + ' rotation_format="quat_xyzw"', 7
    elif random.random() < 0.1:
        attributes += ' degrees="true"'
    return f"<pose{attributes}>{numbers(random, count)}</pose>"


def _frame(random: Random, names: tuple[str, ...]) -> str:
    attached = f" attached_to={quoteattr(name(random, names))}" if random.random() < 0.7 else ""
    return f"<frame name={quoteattr(name(random, ('f', 'g', 'h')))}{attached}>{_pose(random, names)}</frame>"


def _axis(random: Random, tag: str) -> str:
    inside = [f"<xyz>{random.choice(('1 0 0', '0 1 0', '0 0 1', numbers(random, 3)))}</xyz>"]
    if random.random() < 0.1:
        inside = [f'<xyz expressed_in="{random.choice(("a", "__model__", "b", "j0"))}">0 0 1</xyz>']
    if random.random() < 0.3:
        low, high = sorted((random.uniform(-3, 3), random.uniform(-3, 3)))
        inside.append(f"<limit><lower>{low}</lower><upper>{high}</upper></limit>")
    elif random.random() < 0.1:
        inside.append(f"<limit><lower>{number(random)}</lower><velocity>{number(random)}</velocity></limit>")
    if random.random() < 0.1:
        inside.append(f"<dynamics><damping>{number(random)}</damping></dynamics>")
    if random.random() < 0.15:
        numbers_ = "".join(f"<{k}>{number(random)}</{k}>" for k in ("multiplier", "offset", "reference"))
        inside.append(f'<mimic joint="j{random.randrange(3)}">{numbers_}</mimic>')
    return f"<{tag}>{''.join(inside)}</{tag}>"


def _joint(random: Random, joint: str, ends: tuple[str, ...]) -> str:
    kind = (
        random.choice((*KINDS, "revolute", "revolute", "prismatic"))
        if random.random() < 0.98
        else name(random)
    )
    inside = [f"<parent>{escape(ends[0])}</parent><child>{escape(ends[1])}</child>"]
    if random.random() < 0.3:
        inside.append(_pose(random, (*ends, "a", joint)))
    if random.random() < 0.9 and kind not in ("fixed", "ball"):
        inside.append(_axis(random, "axis"))
    if kind in ("universal", "revolute2", "gearbox") and random.random() < 0.9:
        inside.append(_axis(random, "axis2"))
    if kind == "screw":
        tag = random.choice(("thread_pitch", "screw_thread_pitch"))
        inside.append(f"<{tag}>{number(random)}</{tag}>")
    if kind == "gearbox":
        body = random.choice(("a", "b", "c"))
        ratio = f"<gearbox_ratio>{number(random)}</gearbox_ratio>"
        inside.append(f"<gearbox_reference_body>{body}</gearbox_reference_body>{ratio}")
    return f"<joint name={quoteattr(joint)} type={quoteattr(kind)}>{''.join(inside)}</joint>"
