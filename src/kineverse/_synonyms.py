"""Names of other libraries and their equivalents in this one, for error messages."""

from __future__ import annotations

from collections.abc import Mapping


def _by_name(names: Mapping[str, str]) -> dict[str, str]:
    """Return the answer to each of several names, which are separated by spaces."""
    return {name: answer for answer, several in names.items() for name in several.split()}


MODULE_SYNONYMS = _by_name(
    {
        "kv.Revolute": "Hinge HingeJoint RevoluteJoint",
        "kv.Prismatic": "Slider Slide SliderJoint PrismaticJoint",
        "kv.articulations.Ball": "Spherical",
        "kv.Floating": "FreeFlyer FreeJoint Free",
        "kv.Fixed": "FixedJoint Weld",
        "kv.articulations.Screw": "Helical",
        "kv.articulations.Universal": "UniversalJoint",
        "kv.Planar": "PlanarJoint",
        "kv.load": "Robot URDF load_urdf load_model from_urdf read buildModelFromUrdf MjModel",
        "model.save": "save",
        "kv.transform and kv.model.Pose": "SE3 Transform",
        "kv.position": "Variable Var",
        "kv.parameter": "Parameter",
        "kv.compile": "Function lambdify",
        "np.sin": "sin",
        "np.cos": "cos",
        "np.sqrt": "sqrt",
        "kv.where": "if_else",
        "kv.State": "JointState",
        "kv.Revolute, kv.Prismatic and the others of kv.articulations": "Joint",
        "kv.model.Frame, by edit.add_frame": "Link",
    }
)

MODEL_SYNONYMS = _by_name(
    {
        "model.articulations and model.degrees_of_freedom": "joints",
        "model.degrees_of_freedom": "joint_names actuated_joints dofs",
        "model.frames and model.bodies": "links",
        "model.frames": "link_names",
        "len(model.degrees_of_freedom)": "dof ndof nq",
        "len(model.speeds)": "nv",
        "model.degrees_of_freedom, with values from model.default_state()": "q",
        "model.default_state()": "qpos qpos0 neutral home",
        "model.default_state(); a model holds no state": "state",
        "model.fk(frame)": "forward_kinematics forwardKinematics pose",
        "model.fk(frame, relative_to)": "get_transform",
        "model.jacobian(frame)": "geometric_jacobian compute_jacobian",
        "model.limits(symbol)": "joint_limits position_limits lower_limits upper_limits",
        "model.violations(values)": "is_valid check",
        "model.symbols": "variables parameters",
        "model.speeds": "velocities",
        "kv.load(source), or model.include(source)": "load",
        "model.copy()": "clone",
        "kv.show(model)": "show plot",
        "with model.edit() as edit: commits at its end": "commit",
        "with model.edit() as edit:": "transaction",
    }
)

EDIT_METHODS = (
    *("add_frame", "apply", "attach", "close_loop", "constrain", "insert", "net"),
    *("remove", "replace", "savepoint", "set_rate", "undo", "write"),
)

EDIT_SYNONYMS = _by_name(
    {
        "edit.apply(operation)": "add append",
        "edit.apply(kv.Revolute(...)) and the like": "add_joint",
        "edit.add_frame": "add_link",
        "edit.add_frame(..., body=)": "add_body",
        "edit.constrain": "add_constraint add_limit",
        "edit.remove": "delete",
        "edit.attach": "move reparent",
        "edit.replace": "update",
        "nothing: the end of the with block commits": "commit",
        "an exception in the with block": "rollback",
        "edit.include": "load",
    }
)

EXPRESSION_SYNONYMS = _by_name(
    {
        "np.sqrt(np.mean((e - np.mean(e))**2))": "std",
        "np.mean((e - np.mean(e))**2)": "var",
        "np.max(e) - np.min(e)": "ptp",
        "logic, a | b": "any",
        "logic, a & b": "all",
        "np.min and np.max, or sorting what e({name: number}) returns": "sort",
        "np.min, or kv.where": "argmin",
        "np.max, or kv.where": "argmax",
        "nothing: an expression is immutable": "fill",
        "64-bit floats, once it is called with values, e({name: number})": "dtype",
        "the expression itself; there are no complex numbers": "real conj",
        "e.ravel()": "flat",
        "np.linalg.inv(e)": "inv inverse",
        "np.linalg.det(e)": "det",
        "kv.norm(e), or np.linalg.norm(e)": "norm",
        "e({name: number})": "value numpy eval evalf evaluate",
        "kv.compile(e)": "compile lambdify",
        "e.substitute({symbol: expression})": "subs replace",
        "e.gradient(), e.jacobian([symbols]) or kv.expressions.total_derivative(e)": "diff",
        "e.gradient()": "grad backward",
        "kv.expressions.total_derivative(e)": "dt",
        "e.symbols": "free_symbols variables",
        "nothing: what is computed twice is shared when it is compiled": "simplify",
        "str(symbol), of a symbol": "name",
    }
)

STATE_SYNONYMS = _by_name(
    {
        "state.updated({...}); a state is immutable": "update",
        "state.updated({...})": "set",
        "nothing: a state is immutable": "copy",
        "state.stamp": "time timestamp",
        "state[symbol]": "q position",
        "state.keys()": "names symbols",
        "dict(state)": "to_dict",
    }
)
