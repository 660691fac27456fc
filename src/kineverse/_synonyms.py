"""Names of other libraries and their equivalents in this one, for error messages."""

from __future__ import annotations

from collections.abc import Mapping


def _by_name(names: Mapping[str, str]) -> dict[str, str]:
    """Return the answer to each of several names, which are separated by spaces."""
    return {name: answer for answer, several in names.items() for name in several.split()}


MODULE_SYNONYMS = _by_name(
    {
        "kv.Revolute": "Hinge HingeJoint RevoluteJoint RevoluteDH JointModelRX JointModelRY JointModelRZ",
        "kv.Prismatic": "Slider Slide SliderJoint PrismaticJoint JointModelPX JointModelPY JointModelPZ",
        "kv.Continuous": "ContinuousJoint",
        "kv.articulations.Ball": "Spherical",
        "kv.Floating": "FreeFlyer FreeJoint Free JointModelFreeFlyer QuaternionFloatingJoint",
        "kv.Fixed": "FixedJoint Weld",
        "kv.articulations.Screw": "Helical",
        "kv.articulations.Universal": "UniversalJoint",
        "kv.Planar": "PlanarJoint",
        "kv.load": (
            "Robot URDF load_urdf load_model from_urdf read buildModelFromUrdf MjModel ERobot RobotWrapper "
            "Parser RobotModel load_robot_description from_xml_path parse"
        ),
        "kv.load, and place_robot of kv.manipulation": "World WorldModel",
        "model.save": "save write",
        "kv.transform and kv.model.Pose": "SE3 Transform RigidTransform Isometry3d SpatialMatrix",
        "kv.rpy, kv.quaternion and kv.axis_angle": "SO3 Rotation RotationMatrix Rotation3d",
        "kv.rpy": "RollPitchYaw from_euler euler rpyToMatrix",
        "kv.quaternion": "Quaternion from_quat",
        "kv.axis_angle": "AngleAxis from_rotvec rodrigues",
        "kv.rotation_x": "rotx trotx",
        "kv.rotation_y": "roty troty",
        "kv.rotation_z": "rotz trotz",
        "kv.translation": "transl Translation",
        "kv.spatial.exp_se3": "exp6",
        "kv.spatial.log_se3": "log6",
        "kv.spatial.exp_so3": "exp3",
        "kv.spatial.log_so3": "log3",
        "kv.position": "Variable Var SX MX SX_sym dynamicsymbols",
        "kv.parameter": "Parameter Constant",
        "kv.compile": "Function lambdify jit",
        "kv.array": "Matrix DM vertcat horzcat stack concatenate asarray",
        "kv.norm": "norm_2",
        "kv.minimum": "fmin",
        "kv.maximum": "fmax",
        "np.sin": "sin",
        "np.cos": "cos",
        "np.tan": "tan",
        "np.sqrt": "sqrt",
        "np.arctan2": "atan2 arctan2",
        "np.exp": "exp",
        "np.log": "log",
        "np.pi": "pi",
        "np.cross": "cross",
        "np.eye(4), of expressions kv.array(np.eye(4))": "eye",
        "kv.where": "if_else Piecewise cond",
        "e.gradient(), or e.jacobian([symbols]) of an expression": "diff gradient grad jacobian Derivative",
        "e.substitute({symbol: expression}) of an expression": "substitute subs",
        "kv.State": "JointState RobotState Configuration MjData",
        "model.fk(frame)": "fk forward_kinematics forwardKinematics mj_forward mj_kinematics fkine",
        "model.jacobian(frame)": "computeFrameJacobian computeJointJacobians mj_jac jacob0",
        "model.default_state()": "neutral",
        "model.integrate": "integrate",
        "kv.control.inverse_kinematics and kv.control.Controller": "solve_ik build_ik IK ik ikine_LM",
        "kv.control.Goal": "FrameTask PostureTask JointTask",
        "kv.control.Keep": "Limit ConfigurationLimit VelocityLimit Barrier",
        "kv.planning.Planner": "MoveGroupCommander MoveGroup RRT RRTConnect OMPL",
        "kv.geometry.Scene": (
            "PlanningScene GeometryModel CollisionManager SceneGraph computeCollisions computeDistances"
        ),
        "kv.planning.time_parameterize, and the trajectory of a kv.planning.Path": "TOPPRA jtraj",
        "kv.estimation.Tracker": "EKF KalmanFilter ExtendedKalmanFilter",
        "kv.show": "viewer visualize launch_passive Visualizer MeshcatVisualizer",
        "nothing: this library has kinematics and no dynamics; kv.worlds.MujocoWorld simulates": (
            "mj_step rnea crba aba MultibodyPlant"
        ),
        "kv.Revolute, kv.Prismatic and the others of kv.articulations": "Joint",
        "kv.model.Frame, by edit.add_frame": "Link",
    }
)

MODEL_SYNONYMS = _by_name(
    {
        "model.articulations and model.degrees_of_freedom": "joints",
        "model.degrees_of_freedom": (
            "joint_names actuated_joints dofs actuated_joint_names joint_map movable_joints"
        ),
        "model.frames and model.bodies": "links",
        "model.frames": "link_names link_map body_names site_names",
        "model.bodies": "meshes geometry collision_objects geoms",
        "model.articulations": "joint",
        "len(model.degrees_of_freedom)": "dof ndof nq num_dofs n",
        "len(model.speeds)": "nv",
        "len(model.frames)": "nbody",
        "model.degrees_of_freedom, with values from model.default_state()": "q",
        "model.default_state()": "qpos qpos0 neutral home zero_cfg referenceConfigurations",
        "model.default_state(); a model holds no state": "state",
        "model.fk(frame)": (
            "forward_kinematics forwardKinematics pose fkine link_fk getGlobalLinkTransform "
            "get_global_link_transform framePlacement frame_pose compute_fk get_frame"
        ),
        "model.fk(frame, relative_to)": "get_transform get_transform_frame_to_world CalcRelativeTransform",
        "model.jacobian(frame)": (
            "geometric_jacobian compute_jacobian jacob0 jacobe get_frame_jacobian getFrameJacobian "
            "computeJointJacobians"
        ),
        "model.limits(symbol)": (
            "joint_limits position_limits lower_limits upper_limits qlim lowerPositionLimit "
            "upperPositionLimit jnt_range velocityLimit"
        ),
        "model.violations(values)": "is_valid check satisfies_bounds",
        "a function of the state: model.fk(frame)(state)": "update_cfg set_state set_joint_positions",
        "kv.control.inverse_kinematics(model, goals)": (
            "ik inverse_kinematics ikine ikine_LM solve_ik set_from_ik"
        ),
        "model.center_of_mass()": "com centerOfMass center_of_mass_pose",
        "model.mass()": "total_mass computeTotalMass",
        "frame in model.frames, or name in model.symbols": "existFrame has_frame has_joint",
        "model.frames[name]": "getFrameId link_by_name",
        "model.articulations[name]": "getJointId joint_by_name",
        "kv.geometry.Scene(model)": "scene collision_check collision_model",
        "kv.planning.Planner(model)": "plan",
        "model.symbol(name)": "get_symbol variable coordinate",
        "model.integrate(state, speeds, seconds)": "step",
        "model.edit(), as in with model.edit() as edit: edit.apply(operation)": (
            "add_joint add_link add_body add_constraint"
        ),
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
        "edit.apply(kv.Revolute(...)) and the like": "add_joint addJoint add_revolute add_articulation",
        "edit.add_frame": "add_link addFrame",
        "edit.add_frame(..., body=)": "add_body addBody add_geometry add_object",
        "edit.constrain": "add_constraint add_limit",
        "edit.remove": "delete detach",
        "edit.attach": "move reparent attach_object set_parent",
        "edit.replace": "update",
        "nothing: the end of the with block commits": "commit",
        "an exception in the with block": "rollback",
        "edit.include": "load add_urdf add_model merge",
        "edit.close_loop": "add_loop equality",
        "edit.write": "set_data",
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
        "model.speeds_of(frame), of a Jacobian": "columns",
        "np.linalg.inv(e)": "inv inverse",
        "np.linalg.det(e)": "det",
        "kv.norm(e), or np.linalg.norm(e)": "norm",
        "e({name: number})": "value numpy eval evalf evaluate",
        "kv.compile(e)": "compile lambdify",
        "e.substitute({symbol: expression})": "subs replace",
        "e.gradient(), e.jacobian([symbols]) or kv.expressions.total_derivative(e)": "diff",
        "e.gradient()": "grad backward derivative",
        "E[:3, 3], of a pose": "position pos",
        "E[:3, :3], of a pose": "rotation rot",
        "kv.inverse(E), of a pose": "inverse_transform",
        "kv.spatial.to_quaternion(E)": "as_quat to_quaternion",
        "kv.spatial.to_rpy(E)": "as_euler to_rpy",
        "np.log(e), or kv.spatial.log_se3(E) of a pose": "log",
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

FUNCTION_SYNONYMS = _by_name(
    {
        "f(values)": "call eval evaluate run forward",
        "f.batch(rows)": "vmap map vectorize",
        "f.inputs": "args arguments symbols name_in free_symbols",
        "e.jacobian([symbols]) of an expression e, which is compiled then": "jacobian grad gradient diff",
        "nothing: a compiled function can be pickled": "save serialize generate dump",
        "f.wait()": "compile build jit",
    }
)

SCENE_SYNONYMS = _by_name(
    {
        "scene.update(state)": "set_state update_state set_configuration configure updateGeometryPlacements",
        "scene.distance(a, b)": "compute_distance computeDistances get_distance signed_distance",
        "scene.distances_to(body)": "min_distance minimum_distance min_distance_single",
        "scene.in_collision()": (
            "check_collision is_colliding collides collide isStateColliding has_collision "
            "in_collision_internal in_collision_single computeCollisions"
        ),
        "scene.first_contact()": "contact contacts get_contacts ncon",
        "scene.bodies": "objects geoms names frames links",
        "kv.geometry.Rule(a, b), in Scene(model, rules=[...])": (
            "allowed_collision_matrix acm ignore allow_collision disable_collisions addCollisionPair"
        ),
        "an edit of the model, which the scene follows": "add add_object add_box add_mesh remove_object",
        "scene.ray": "raycast ray_cast cast_ray",
        "kv.show(model)": "show view plot",
    }
)

TRACKER_SYNONYMS = _by_name(
    {
        "tracker.update(measurements)": "correct measure observe filter step",
        "tracker.predict": "propagate",
        "tracker.estimate": "belief get_state",
        "tracker.estimate.state": "state x mean",
        "tracker.estimate.covariance": "P covariance cov",
        "tracker.process_noise": "Q",
        "covariance= of kv.estimation.ObservedPose and the like": "R measurement_noise",
        "tracker.reset": "initialize init",
        "tracker.log_evidence": "log_likelihood likelihood",
    }
)

CONTROLLER_SYNONYMS = _by_name(
    {
        "controller.step(values)": "solve compute update control compute_command solve_ik command",
        "controller.set(target, value)": "set_target set_goal set_joint_goal set_cart_goal",
        "nothing: tasks are given to Controller(model, tasks)": (
            "add_task add_goal goals add_constraint add_cost add_limit limits"
        ),
        "controller.dt": "period timestep",
    }
)

PLANNER_SYNONYMS = _by_name(
    {
        "planner.plan(start, goals)": (
            "solve compute_plan find_path search go set_goal setGoalState set_start_state "
            "set_joint_value_target set_pose_target compute_cartesian_path"
        ),
        "planner.hold(a, b), for along= of planner.plan": (
            "add_constraint path_constraints set_path_constraints constraints"
        ),
        "planner.symbols": "joints joint_names coordinates",
        "planner.scene": "collision_scene",
        "planner.place(state)": "set_state set_current_state",
        "planner.valid": "is_valid isValid check_state collision_free",
        "seconds= of planner.plan": "planning_time set_planning_time",
        "nothing: the trajectory of a path is executed by your robot's controllers": "execute",
    }
)

IK_SYNONYMS = _by_name(
    {
        "solver.solve(values)": "compute ik run solve_ik ikine",
        "nothing: tasks are given to InverseKinematics(model, tasks)": "add_task add_goal set_target",
    }
)

IK_RESULT_SYNONYMS = _by_name(
    {
        "result.best": "q x configuration solution state joint_positions qpos values",
        "result.solved": "success converged ok found reached",
        "result.residuals": "error errors residual cost fun",
        "result.why": "message reason status",
        "result.iterations": "nit",
        "result.seconds": "time",
    }
)

PATH_SYNONYMS = _by_name(
    {
        "path.found": "success ok solved is_valid error_code",
        "path.states": "waypoints configurations milestones",
        "path.points": "q qs positions array",
        "path.why": "message reason",
        "path.trajectory()": "joint_trajectory retime time_parameterize",
        "path.length": "cost",
        "path.at": "interpolate eval",
    }
)

TRAJECTORY_SYNONYMS = _by_name(
    {
        "trajectory.at(time)": "eval value interpolate get_state",
        "trajectory.duration": "T end_time",
        "trajectory.positions": "q qs points states",
        "trajectory.velocities": "qd qdot dq velocity",
        "np.gradient(trajectory.velocities, trajectory.times, axis=0)": "accelerations acceleration qdd",
        "trajectory.times": "t time timestamps",
        "nothing: a trajectory is executed by your robot's controllers": "execute",
    }
)

COMMAND_SYNONYMS = _by_name(
    {
        "command.speeds": "velocity velocities dq qd qdot joint_velocities",
        "command.vector": "v u array",
        "command.errors": "error",
        "model.integrate(state, command.speeds, dt)": "q positions integrate",
        "command.active": "constraints active_constraints",
    }
)

ESTIMATE_SYNONYMS = _by_name(
    {
        "estimate.state": "x values q positions pose",
        "estimate.covariance": "P cov",
        "estimate.deviation(symbol)": "std sigma stddev standard_deviation uncertainty",
    }
)

DISTANCE_SYNONYMS = _by_name(
    {
        "result.distance": "min_distance dist depth penetration signed_distance",
        "result.point_a and result.point_b": "points nearest_points p1 p2 witness_points point",
        "result.a and result.b": "names bodies geom1 geom2 body_a body_b link_a link_b",
        "result.normal": "direction",
        "result.touches": "collides is_collision in_contact in_collision",
    }
)

IDENTIFICATION_SYNONYMS = _by_name(
    {
        "result.best": "model best_model winner best_fit joint",
        "result.best.family": "family type joint_type name",
        "result.best.parameters": "params parameters",
        "result.best.operation(name, parent, child)": "operation",
        "result.fits": "models candidates",
        "result.probabilities": "posterior weights bic scores",
    }
)
