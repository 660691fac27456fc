"""Random trees of joints, mimic joints and custom frames, for hypothesis."""

from __future__ import annotations

import math

from hypothesis import strategies as st

import kineverse as kv

numbers = st.floats(-2, 2, allow_subnormal=False).map(lambda x: round(x, 3))
angles = st.sampled_from([0.0, 0.5, -1.2, math.pi / 2, math.pi, 3.0])
axes = st.sampled_from([(1, 0, 0), (0, 0, -1), (1, 1, 0), (0.3, -2, 1), (0, 1, 1e-3)])
KINDS = (
    "revolute",
    "continuous",
    "prismatic",
    "fixed",
    "screw",
    "universal",
    "cylindrical",
    "floating",
    "planar",
    "mimic",
    "own",
    "two",
)


@st.composite
def trees(draw: st.DrawFn, kinds: tuple[str, ...] = KINDS) -> kv.Model:
    """Return a model of one to seven frames, most of which move."""
    model = kv.Model()
    parents, movers = ["world"], list[str]()
    with model.edit() as edit:
        for k in range(draw(st.integers(1, 7))):
            kind, name = draw(st.sampled_from(kinds)), f"f{k}"
            parent = draw(st.sampled_from(parents))
            place = kv.rpy(draw(angles), draw(angles), draw(angles))
            origin = kv.translation(draw(numbers), draw(numbers), draw(numbers)) @ place
            common = {
                "name": name,
                "parent": parent,
                "child": name,
                "origin": kv.model.Pose.from_matrix(origin),
            }
            axis, low = draw(axes), draw(numbers)
            limits = {"lower": low, "upper": low + 1.5, "velocity": 2.0}
            if kind == "mimic" and movers:
                leader = kv.position(draw(st.sampled_from(movers)))
                follows = draw(st.sampled_from([-2.0, -1.0, 0.5, 1.0])) * leader + draw(numbers)
                joint = draw(st.sampled_from([kv.Revolute, kv.Prismatic]))
                edit.apply(joint(**common, axis=axis, position=follows))
            elif kind == "own":
                q = kv.position(f"{name}/q")
                motion = kv.translation(0, q, 0.4) @ kv.axis_angle((0.6, 0, 0.8), draw(angles) - 3 * q)
                edit.add_frame(name, parent=parent, transform=motion)
            elif kind == "two":
                q = kv.position(f"{name}/q")
                parts = [kv.rotation_x(2 * q), kv.translation(0.3, 0.1, 0), kv.rotation_z(q), origin]
                edit.add_frame(name, parent=parent, transform=parts)
            elif kind in ("revolute", "prismatic"):
                joint = kv.Revolute if kind == "revolute" else kv.Prismatic
                edit.apply(joint(**common, axis=axis, **limits))
                movers.append(name)
            elif kind == "screw":
                edit.apply(kv.articulations.Screw(**common, axis=axis, pitch=0.3))
            elif kind == "cylindrical":
                edit.apply(kv.articulations.Cylindrical(**common, axis=axis))
            elif kind == "planar":
                edit.apply(kv.Planar(**common, **draw(st.sampled_from([{}, limits]))))
            elif kind in ("continuous", "universal", "floating", "ball"):
                edit.apply(getattr(kv.articulations, kind.capitalize())(**common))
            else:
                edit.apply(kv.Fixed(**common))
            parents.append(name)
    return model
