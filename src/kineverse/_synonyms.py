"""Names of other libraries and their equivalents in this one, for error messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

from .errors import UnknownAttributeError

MODULE_SYNONYMS: Mapping[str, str] = {
    "Hinge": "kv.Revolute",
    "HingeJoint": "kv.Revolute",
    "RevoluteJoint": "kv.Revolute",
    "Slider": "kv.Prismatic",
    "Slide": "kv.Prismatic",
    "SliderJoint": "kv.Prismatic",
    "PrismaticJoint": "kv.Prismatic",
    "Spherical": "kv.articulations.Ball",
    "FreeFlyer": "kv.Floating",
    "FreeJoint": "kv.Floating",
    "Free": "kv.Floating",
    "FixedJoint": "kv.Fixed",
    "Weld": "kv.Fixed",
    "Helical": "kv.articulations.Screw",
    "UniversalJoint": "kv.articulations.Universal",
    "PlanarJoint": "kv.Planar",
    "Robot": "kv.load",
    "URDF": "kv.load",
    "load_urdf": "kv.load",
    "load_model": "kv.load",
    "from_urdf": "kv.load",
    "read": "kv.load",
    "buildModelFromUrdf": "kv.load",
    "MjModel": "kv.load",
    "save": "model.save",
    "SE3": "kv.transform and kv.model.Pose",
    "Transform": "kv.transform and kv.model.Pose",
    "Variable": "kv.position",
    "Parameter": "kv.parameter",
    "Var": "kv.position",
    "Function": "kv.compile",
    "lambdify": "kv.compile",
    "sin": "np.sin",
    "cos": "np.cos",
    "sqrt": "np.sqrt",
    "if_else": "kv.where",
    "JointState": "kv.State",
    "Joint": "kv.Revolute, kv.Prismatic and the others of kv.articulations",
    "Link": "kv.model.Frame, by edit.add_frame",
}

MODEL_SYNONYMS: Mapping[str, str] = {
    "joints": "model.articulations and model.degrees_of_freedom",
    "joint_names": "model.degrees_of_freedom",
    "actuated_joints": "model.degrees_of_freedom",
    "links": "model.frames and model.bodies",
    "link_names": "model.frames",
    "dofs": "model.degrees_of_freedom",
    "dof": "len(model.degrees_of_freedom)",
    "ndof": "len(model.degrees_of_freedom)",
    "nq": "len(model.degrees_of_freedom)",
    "nv": "len(model.speeds)",
    "q": "model.degrees_of_freedom, with values from model.default_state()",
    "qpos": "model.default_state()",
    "qpos0": "model.default_state()",
    "neutral": "model.default_state()",
    "home": "model.default_state()",
    "state": "model.default_state(); a model holds no state",
    "forward_kinematics": "model.fk(frame)",
    "forwardKinematics": "model.fk(frame)",
    "get_transform": "model.fk(frame, relative_to)",
    "pose": "model.fk(frame)",
    "geometric_jacobian": "model.jacobian(frame)",
    "compute_jacobian": "model.jacobian(frame)",
    "joint_limits": "model.limits(symbol)",
    "position_limits": "model.limits(symbol)",
    "lower_limits": "model.limits(symbol)",
    "upper_limits": "model.limits(symbol)",
    "is_valid": "model.violations(values)",
    "check": "model.violations(values)",
    "variables": "model.symbols",
    "parameters": "model.symbols",
    "velocities": "model.speeds",
    "load": "kv.load(source), or model.include(source)",
    "clone": "model.copy()",
    "show": "kv.show(model)",
    "plot": "kv.show(model)",
    "commit": "with model.edit() as edit: commits at its end",
    "transaction": "with model.edit() as edit:",
}

EDIT_METHODS = (
    "add_frame",
    "apply",
    "attach",
    "close_loop",
    "constrain",
    "insert",
    "remove",
    "replace",
    "set_rate",
    "write",
)

EDIT_SYNONYMS: Mapping[str, str] = {
    "add": "edit.apply(operation)",
    "append": "edit.apply(operation)",
    "add_joint": "edit.apply(kv.Revolute(...)) and the like",
    "add_link": "edit.add_frame",
    "add_body": "edit.add_frame(..., body=)",
    "add_constraint": "edit.constrain",
    "add_limit": "edit.constrain",
    "delete": "edit.remove",
    "move": "edit.attach",
    "reparent": "edit.attach",
    "update": "edit.replace",
    "commit": "nothing: the end of the with block commits",
    "rollback": "an exception in the with block",
    "load": "edit.include",
}

EXPRESSION_SYNONYMS: Mapping[str, str] = {
    "std": "np.sqrt(np.mean((e - np.mean(e))**2))",
    "var": "np.mean((e - np.mean(e))**2)",
    "ptp": "np.max(e) - np.min(e)",
    "any": "logic, a | b",
    "all": "logic, a & b",
    "sort": "np.min and np.max, or sorting what e({name: number}) returns",
    "argmin": "np.min, or kv.where",
    "argmax": "np.max, or kv.where",
    "fill": "nothing: an expression is immutable",
    "dtype": "64-bit floats, once it is called with values, e({name: number})",
    "real": "the expression itself; there are no complex numbers",
    "conj": "the expression itself; there are no complex numbers",
    "flat": "e.ravel()",
    "inv": "np.linalg.inv(e)",
    "inverse": "np.linalg.inv(e)",
    "det": "np.linalg.det(e)",
    "norm": "kv.norm(e), or np.linalg.norm(e)",
    "value": "e({name: number})",
    "numpy": "e({name: number})",
    "eval": "e({name: number})",
    "evalf": "e({name: number})",
    "evaluate": "e({name: number})",
    "compile": "kv.compile(e)",
    "lambdify": "kv.compile(e)",
    "subs": "e.substitute({symbol: expression})",
    "replace": "e.substitute({symbol: expression})",
    "diff": "e.gradient(), e.jacobian([symbols]) or kv.expressions.total_derivative(e)",
    "grad": "e.gradient()",
    "backward": "e.gradient()",
    "dt": "kv.expressions.total_derivative(e)",
    "free_symbols": "e.symbols",
    "variables": "e.symbols",
    "simplify": "nothing: what is computed twice is shared when it is compiled",
    "name": "str(symbol), of a symbol",
}

STATE_SYNONYMS: Mapping[str, str] = {
    "update": "state.updated({...}); a state is immutable",
    "set": "state.updated({...})",
    "copy": "nothing: a state is immutable",
    "time": "state.stamp",
    "timestamp": "state.stamp",
    "q": "state[symbol]",
    "position": "state[symbol]",
    "names": "state.keys()",
    "symbols": "state.keys()",
    "to_dict": "dict(state)",
}


def unknown_attribute_error(
    owner: str, name: str, available: Iterable[str], elsewhere: Mapping[str, str]
) -> UnknownAttributeError:
    """Return the error for an unknown attribute, with similar names or the equivalent of a foreign name.

    Parameters
    ----------
    owner
        The object, as the subject of a sentence.
    name
        The unknown attribute.
    available
        The known attributes.
    elsewhere
        From names in other libraries to their equivalents here.
    """
    problem = f"{owner} has no {name!r}."
    if name.startswith("_"):
        return UnknownAttributeError(problem)
    if name in elsewhere:
        return UnknownAttributeError(f"{problem} Here that is {elsewhere[name]}.")
    public = sorted({one for one in available if not one.startswith("_")})
    by_lower: dict[str, str] = {one.lower(): one for one in public}
    close = [by_lower[match] for match in difflib.get_close_matches(name.lower(), by_lower, n=3, cutoff=0.6)]
    if close:
        return UnknownAttributeError(f"{problem} Did you mean {' or '.join(map(repr, close))}?")
    return UnknownAttributeError(f"{problem} dir(...) lists what there is.")
