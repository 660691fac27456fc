"""Names that people from other libraries try: each exists, or its error says what it is called here."""

from __future__ import annotations

import inspect
import pickle
import re
from operator import attrgetter
from typing import Any

import pytest

import kineverse as kv
from kineverse import _synonyms
from kineverse._names import answer_foreign_names, match_names
from kineverse.compilation import CompiledFunction
from kineverse.control import Command, Controller, IkResult, InverseKinematics
from kineverse.errors import KineverseError, UnknownAttributeError
from kineverse.estimation import Estimate, IdentificationResult, Tracker
from kineverse.geometry import DistanceResult, Scene
from kineverse.planning import Path, Planner, Trajectory

# Name that is tried, and what has to stand in the message. A name alone exists.
TRIED: dict[Any, str] = {
    kv: """
        acceleration position velocity parameter where norm clip
        symbol→kv.symbols.symbol SE3→kv.transform SO3→kv.rpy Rotation→kv.quaternion RigidTransform→kv.transform
        RotationMatrix→kv.rpy RollPitchYaw→kv.rpy Quaternion→kv.quaternion AngleAxis→kv.axis_angle
        from_euler→kv.rpy from_quat→kv.quaternion from_rotvec→kv.axis_angle rotx→kv.rotation_x
        trotz→kv.rotation_z transl→kv.translation exp6→kv.spatial.exp_se3 log3→kv.spatial.log_so3
        skew→kv.spatial.skew URDF→kv.load Robot→kv.load ERobot→kv.load MjModel→kv.load
        buildModelFromUrdf→kv.load load_robot_description→kv.load RobotModel→kv.load World→kv.load
        MjData→kv.State RobotState→kv.State Configuration→kv.State JointState→kv.State
        JointModelRX→kv.Revolute RevoluteJoint→kv.Revolute PrismaticJoint→kv.Prismatic
        JointModelFreeFlyer→kv.Floating Weld→kv.Fixed Hinge→kv.Revolute FrameTask→kv.control.Goal
        PostureTask→kv.control.Goal solve_ik→kv.control.inverse_kinematics VelocityLimit→kv.control.Keep
        InverseKinematics→kv.control.InverseKinematics Controller→kv.control.Controller
        MoveGroupCommander→kv.planning.Planner RRTConnect→kv.planning.Planner Planner→kv.planning.Planner
        PlanningScene→kv.geometry.Scene GeometryModel→kv.geometry.Scene Scene→kv.geometry.Scene
        Tracker→kv.estimation.Tracker EKF→kv.estimation.Tracker identify→kv.estimation.identify
        SX→kv.position MX→kv.position vertcat→kv.array Matrix→kv.array stack→kv.array if_else→kv.where
        Piecewise→kv.where fmin→kv.minimum fmax→kv.maximum norm_2→kv.norm Function→kv.compile
        lambdify→kv.compile jit→kv.compile sin→np.sin atan2→np.arctan2 pi→np.pi cross→np.cross eye→np.eye
        diff→gradient grad→gradient jacobian→jacobian subs→substitute forwardKinematics→model.fk
        fkine→model.fk mj_forward→model.fk computeFrameJacobian→model.jacobian neutral→model.default_state
        integrate→model.integrate mj_step→MujocoWorld rnea→MujocoWorld save→model.save show
        viewer→kv.show MeshcatVisualizer→kv.show Var→kv.position Transform→kv.transform revolute→Revolute
    """,
    kv.Model: """
        fk jacobian limits violations save copy edit
        forward_kinematics→model.fk fkine→model.fk link_fk→model.fk getGlobalLinkTransform→model.fk
        get_transform→model.fk jacob0→model.jacobian getFrameJacobian→model.jacobian
        joint_names→degrees_of_freedom actuated_joint_names→degrees_of_freedom joints→articulations
        links→model.frames link_map→model.frames meshes→model.bodies nq→len(model.degrees_of_freedom)
        nv→len(model.speeds) num_dofs→len(model.degrees_of_freedom) qpos0→default_state neutral→default_state
        joint_limits→model.limits qlim→model.limits upperPositionLimit→model.limits
        inverse_kinematics→inverse_kinematics ikine_LM→inverse_kinematics solve_ik→inverse_kinematics
        com→center_of_mass scene→Scene plan→Planner add_joint→model.edit show→kv.show update_cfg→model.fk
        getFrameId→model.frames existFrame→model.frames step→model.integrate state→default_state
        add_frame→add_frame variables→model.symbols Joints→articulations Com→center_of_mass FK→'fk'
    """,
    kv.model.Edit: """
        apply add_frame constrain remove add→edit.apply add_joint→edit.apply add_link→edit.add_frame
        add_body→edit.add_frame add_constraint→edit.constrain delete→edit.remove attach_object→edit.attach
        commit→with merge→edit.include add_loop→edit.close_loop rollback→exception
    """,
    kv.Expression: """
        gradient jacobian substitute T shape diff→gradient subs→substitute evalf→e({ evaluate→e({
        free_symbols→e.symbols simplify→compiled norm→kv.norm inv→np.linalg.inv numpy→e({ lambdify→kv.compile
        as_quat→to_quaternion as_euler→to_rpy position→E[:3, rotation→E[:3, dt→total_derivative
    """,
    kv.State: """
        get keys values updated q→state[symbol] set→updated update→updated time→stamp to_dict→dict(state)
        names→keys copy→immutable
    """,
    CompiledFunction: """
        batch inputs call→f(values) vmap→f.batch args→f.inputs jacobian→jacobian save→pickled name_in→f.inputs
    """,
    Scene: """
        distance in_collision bodies set_state→scene.update is_colliding→in_collision collide→in_collision
        compute_distance→scene.distance min_distance→distances_to acm→Rule addCollisionPair→Rule
        add_box→edit raycast→scene.ray contacts→first_contact geoms→scene.bodies
    """,
    Tracker: """
        update predict reset correct→tracker.update x→estimate.state P→covariance Q→process_noise
        R→covariance= initialize→tracker.reset likelihood→log_evidence
    """,
    Controller: """
        step set set_target→controller.set solve→controller.step set_cart_goal→controller.set
        add_task→Controller(model
    """,
    Planner: """
        plan hold solve→planner.plan set_goal→planner.plan go→planner.plan set_pose_target→planner.plan
        add_constraint→planner.hold is_valid→planner.valid joints→planner.symbols execute→trajectory
    """,
    InverseKinematics: "solve solve_ik→solver.solve add_task→InverseKinematics(model",
    IkResult: "best solved q→result.best success→result.solved error→result.residuals message→result.why",
    Path: "found points success→path.found waypoints→path.states cost→path.length q→path.points",
    Trajectory: "at duration eval→trajectory.at qd→velocities accelerations→np.gradient t→times",
    Command: "speeds velocity→command.speeds v→command.vector q→model.integrate",
    Estimate: "mean covariance x→estimate.state P→covariance std→deviation",
    DistanceResult: "distance normal min_distance→result.distance nearest_points→point_a link_a→result.a",
    IdentificationResult: "best model→result.best params→parameters posterior→probabilities",
}  # fmt: skip

OBJECTS = {kv: kv, kv.Model: kv.Model(), kv.Expression: kv.array(1.0), kv.State: kv.State()}
TABLES = {
    "kv": (kv, _synonyms.MODULE_SYNONYMS),
    "model": (kv.Model, _synonyms.MODEL_SYNONYMS),
    "edit": (kv.model.Edit, _synonyms.EDIT_SYNONYMS),
    "e": (kv.Expression, _synonyms.EXPRESSION_SYNONYMS),
    "state": (kv.State, _synonyms.STATE_SYNONYMS),
    "f": (CompiledFunction, _synonyms.FUNCTION_SYNONYMS),
    "scene": (Scene, _synonyms.SCENE_SYNONYMS),
    "tracker": (Tracker, _synonyms.TRACKER_SYNONYMS),
    "controller": (Controller, _synonyms.CONTROLLER_SYNONYMS),
    "planner": (Planner, _synonyms.PLANNER_SYNONYMS),
    "solver": (InverseKinematics, _synonyms.IK_SYNONYMS),
    "result of a solver": (IkResult, _synonyms.IK_RESULT_SYNONYMS),
    "path": (Path, _synonyms.PATH_SYNONYMS),
    "trajectory": (Trajectory, _synonyms.TRAJECTORY_SYNONYMS),
    "command": (Command, _synonyms.COMMAND_SYNONYMS),
    "estimate": (Estimate, _synonyms.ESTIMATE_SYNONYMS),
    "result of a distance": (DistanceResult, _synonyms.DISTANCE_SYNONYMS),
    "result of an identification": (IdentificationResult, _synonyms.IDENTIFICATION_SYNONYMS),
}


def _example(owner: Any) -> Any:
    """Return an object of a class, without its content: attributes are looked up on it only."""
    return OBJECTS[owner] if owner in OBJECTS else object.__new__(owner)


def _names(owner: Any) -> set[str]:
    """Return the attributes of a class's objects, those set in ``__init__`` included."""
    if owner is kv:
        return {*dir(kv)}
    source = "".join(
        inspect.getsource(kind) for kind in owner.__mro__ if kind.__module__.startswith("kineverse")
    )
    return {*dir(owner), *getattr(owner, "__annotations__", ()), *re.findall(r"self\.(\w+)\b", source)}


@pytest.mark.parametrize("wrong", [["a"], {"a": 1}, 5, None])
def test_what_is_no_name_is_said_to_be_none(wrong: Any) -> None:
    model = kv.Model()
    for ask in (model.fk, lambda name: model.fk("world", name), model.symbol, model.limits):
        with pytest.raises(KineverseError, match="by its name, a text"):
            ask(wrong)


def test_long_names_are_cut_in_messages() -> None:
    model, long = kv.Model(), "long" * 1000
    lookups = (model.fk, model.symbol, model.constraints.__getitem__, lambda n: getattr(model, n))
    for ask in (*lookups, lambda name: match_names(name, ["a"], "part"), lambda n: kv.position("a")({n: 1})):
        with pytest.raises(KineverseError) as error:
            ask(long)
        assert len(str(error.value)) < 400


def test_there_are_many() -> None:
    assert sum(len(text.split()) for text in TRIED.values()) >= 250


@pytest.mark.parametrize("owner", TRIED, ids=lambda o: getattr(o, "__name__", ""))
def test_a_name_exists_or_is_answered(owner: Any) -> None:
    example, names = _example(owner), _names(owner)
    for tried in TRIED[owner].split():
        name, arrow, answer = tried.partition("→")
        if not arrow:
            assert name in names, name
            continue
        with pytest.raises(UnknownAttributeError) as error:
            getattr(example, name)
        said = str(error.value).replace(f"'{name}'", "", 1)  # the name itself is no answer
        assert answer in said, (name, said)
        assert isinstance(error.value, AttributeError)


@pytest.mark.parametrize("name", TABLES)
def test_answers_exist_and_names_of_others_do_not(name: str) -> None:
    owner, table = TABLES[name]
    names = _names(owner)
    assert not [foreign for foreign in table if foreign in names]
    begin = name.partition(" ")[0]
    for answer in set(table.values()):
        for path in re.findall(r"\bkv\.([\w.]*\w)", answer):
            assert attrgetter(path)(kv) is not None
        for attribute in re.findall(rf"(?<![\w.]){begin}\.(\w+)", answer):
            assert attribute in names, answer


@answer_foreign_names("A thing", {})
class Thing:
    @property
    def name(self) -> str:
        raise AttributeError("the reason")


def test_a_property_that_fails_says_why() -> None:
    with pytest.raises(AttributeError, match="the reason"):
        _ = Thing().name


def test_an_object_that_answers_can_be_pickled_and_asked() -> None:
    a = kv.position("a")
    f = pickle.loads(pickle.dumps(kv.compile([2 * a], [a])))
    assert not hasattr(f, "__array_interface__")
    assert not hasattr(f, "forward_kinematic")
    assert getattr(f, "_none", None) is None
