"""Expected outcome of each published SDF: its frames and degrees of freedom, or its error message."""

from __future__ import annotations

_TABLE = """
articulated_objects/drake_bsd3/cupboard.sdf | 6 2
articulated_objects/drake_bsd3/shelves.sdf | 1 0
articulated_objects/gazebo_ccby3/door_handle/model.sdf | 1 0
articulated_objects/gazebo_ccby3/drc_practice_ball_valve/model.sdf | 1 1
articulated_objects/gazebo_ccby3/drc_practice_hand_wheel_valve/model.sdf | 1 1
articulated_objects/gazebo_ccby3/drc_practice_hinged_door/model.sdf | 4 3
articulated_objects/gazebo_ccby3/drc_practice_weighted_door/model.sdf | 4 3
articulated_objects/gazebo_ccby3/hinged_door/model.sdf | 4 3
articulated_objects/semantic_digital_twin_lgpl3/drawer.sdf | 3 2
articulated_objects/semantic_digital_twin_lgpl3/hinged_door.sdf | 3 1
sdf_joint_types/drake/frames_as_joint_parent_or_child.sdf | 12 7
sdf_joint_types/drake/joint_actuator_parsing_test.sdf | 4 3
sdf_joint_types/drake/joint_parsing_test.sdf | 23 53
sdf_joint_types/drake/negative_damping_joint.sdf | 1 1
sdf_joint_types/drake/revolute_spring_parsing_test.sdf | 5 4
sdf_joint_types/drake/universal_joint.sdf | 1 2
sdf_joint_types/gazebo_models_ccby3/demo_joint_types/model.sdf | 24 12
sdf_joint_types/gazebo_models_ccby3/double_pendulum_with_base/model.sdf | 3 2
sdf_joint_types/gazebo_models_ccby3/fire_hose_long_curled/model.sdf | 62 43
sdf_joint_types/gazebo_models_ccby3/follower_vehicle/model.sdf | 6 6
sdf_joint_types/gazebo_models_ccby3/mass_on_rails/model.sdf | 2 1
sdf_joint_types/gazebo_models_ccby3/osrf_elevator/model.sdf | 34 0
sdf_joint_types/gazebo_models_ccby3/trisphere_cycle/model.sdf | 5 4
sdf_joint_types/gazebo_models_ccby3/u_joint_part/model.sdf | 1 0
sdf_joint_types/gazebo_models_ccby3/utility_cart/model.sdf | 12 11
sdf_joint_types/gz_physics/joint_across_models.sdf | 8 21
sdf_joint_types/gz_physics/joint_across_models_fixed.sdf | 8 14
sdf_joint_types/gz_physics/joint_constraint.sdf | 8 21
sdf_joint_types/gz_physics/mimic_fast_slow_pendulums_world.sdf | 14 27
sdf_joint_types/gz_physics/mimic_pendulum_world.sdf | 6 9
sdf_joint_types/gz_physics/mimic_prismatic_world.sdf | 10 12
sdf_joint_types/gz_physics/mimic_universal_world.sdf | 9 11
sdf_joint_types/gz_physics/pendulum_joint_wrench.sdf | 9 1
sdf_joint_types/gz_physics/string_pendulum.sdf | 4 1
sdf_joint_types/sdformat_test/ball_prismatic_joint.sdf | 6 12
sdf_joint_types/sdformat_test/double_pendulum.sdf | 3 2
sdf_joint_types/sdformat_test/empty_axis.sdf | 2 0
sdf_joint_types/sdformat_test/flattened_test_nested_model_with_frames.sdf | 13 17
sdf_joint_types/sdformat_test/include_with_interface_api_frame_semantics.sdf | line 9, <include>: <uri> "doub
sdf_joint_types/sdformat_test/include_with_interface_api_reposture.sdf | line 18, <include>: <uri> "nonexiste
sdf_joint_types/sdformat_test/joint_axis_in_rotated_frame.sdf | 3 2
sdf_joint_types/sdformat_test/joint_axis_infinite_limits.sdf | 6 11
sdf_joint_types/sdformat_test/joint_axis_invalid_expressed_in.sdf | line 12, <joint name="joint">: <xyz> refe
sdf_joint_types/sdformat_test/joint_axis_xyz_normalization.sdf | line 38, <joint name="joint4">: <axis> has t
sdf_joint_types/sdformat_test/joint_child_frame.sdf | 4 0
sdf_joint_types/sdformat_test/joint_child_model_frame.sdf | 3 0
sdf_joint_types/sdformat_test/joint_child_world.sdf | line 7, <joint name="joint">: has the world as its chil
sdf_joint_types/sdformat_test/joint_complete.sdf | 20 19
sdf_joint_types/sdformat_test/joint_invalid_child.sdf | line 10, <joint name="joint">: <child> refers to "inv
sdf_joint_types/sdformat_test/joint_invalid_parent.sdf | line 9, <joint name="joint">: <parent> refers to "in
sdf_joint_types/sdformat_test/joint_invalid_parent_same_as_child.sdf | line 7, <joint name="joint">: its pare
sdf_joint_types/sdformat_test/joint_invalid_resolved_parent_same_as_child.sdf | line 14, <joint name="J2">: i
sdf_joint_types/sdformat_test/joint_invalid_self_child.sdf | line 7, <joint name="self">: is its own child.
sdf_joint_types/sdformat_test/joint_invalid_self_parent.sdf | line 7, <joint name="self">: is its own parent.
sdf_joint_types/sdformat_test/joint_nested_parent_child.sdf | 11 0
sdf_joint_types/sdformat_test/joint_parent_frame.sdf | 4 0
sdf_joint_types/sdformat_test/joint_parent_model_frame.sdf | 2 0
sdf_joint_types/sdformat_test/joint_parent_world.sdf | 2 0
sdf_joint_types/sdformat_test/joint_screw_thread_pitch.sdf | 10 0
sdf_joint_types/sdformat_test/joint_sensors.sdf | 2 0
sdf_joint_types/sdformat_test/merge_include_with_interface_api_frame_semantics.sdf | line 11, <include>: <uri
sdf_joint_types/sdformat_test/merge_include_with_interface_api_reposture.sdf | line 13, <include>: <uri> "non
sdf_joint_types/sdformat_test/model_canonical_link.sdf | 3 7
sdf_joint_types/sdformat_test/model_duplicate_joints.sdf | line 12, <joint name="joint">: has the name of the
sdf_joint_types/sdformat_test/model_frame_attached_to.sdf | 6 0
sdf_joint_types/sdformat_test/model_frame_attached_to_joint.sdf | 6 0
sdf_joint_types/sdformat_test/model_frame_attached_to_nested_model.sdf | 5 7
sdf_joint_types/sdformat_test/model_frame_invalid_attached_to.sdf | line 7, <frame name="F3">: refers to "A",
sdf_joint_types/sdformat_test/model_frame_invalid_attached_to_cycle.sdf | line 5, <frame name="F1">: it moves
sdf_joint_types/sdformat_test/model_frame_relative_to.sdf | 6 0
sdf_joint_types/sdformat_test/model_frame_relative_to_joint.sdf | 7 0
sdf_joint_types/sdformat_test/model_invalid_frame_only.sdf | line 3, <model name="model_invalid_frame_only">:
sdf_joint_types/sdformat_test/model_invalid_frame_relative_to.sdf | line 9, <frame name="F">: <pose> refers t
sdf_joint_types/sdformat_test/model_invalid_frame_relative_to_cycle.sdf | line 8, <frame name="F1">: its pose
sdf_joint_types/sdformat_test/model_invalid_joint_relative_to.sdf | line 12, <joint name="J">: <pose> refers
sdf_joint_types/sdformat_test/model_invalid_link_relative_to.sdf | line 5, <link name="L">: <pose> refers to
sdf_joint_types/sdformat_test/model_invalid_placement_frame.sdf | line 3, <model name="model_invalid_placemen
sdf_joint_types/sdformat_test/model_invalid_reserved_names.sdf | line 5, <link name="world">: has a reserved
sdf_joint_types/sdformat_test/model_invalid_root_reference.sdf | line 7, <frame name="frame1">: refers to "__
sdf_joint_types/sdformat_test/model_invalid_top_level_frame.sdf | line 9, <model name="M">: <pose> refers to
sdf_joint_types/sdformat_test/model_joint_axis_expressed_in.sdf | 6 9
sdf_joint_types/sdformat_test/model_joint_relative_to.sdf | 6 7
sdf_joint_types/sdformat_test/model_link_joint_same_name.sdf | 3 0
sdf_joint_types/sdformat_test/model_multi_nested_model.sdf | 8 0
sdf_joint_types/sdformat_test/model_nested_frame_attached_to.sdf | 11 7
sdf_joint_types/sdformat_test/model_relative_to_nested_reference.sdf | 19 56
sdf_joint_types/sdformat_test/model_with_placement_frame_attribute.sdf | 2 7
sdf_joint_types/sdformat_test/nested_canonical_link.sdf | 10 14
sdf_joint_types/sdformat_test/nested_explicit_canonical_link.sdf | 4 7
sdf_joint_types/sdformat_test/nested_model.sdf | 6 15
sdf_joint_types/sdformat_test/nested_model_cross_references.sdf | 11 28
sdf_joint_types/sdformat_test/nested_without_links_invalid.sdf | line 6, <model name="nested_without_links3">
sdf_joint_types/sdformat_test/placement_frame.sdf | line 56, <include>: <uri> "test_model_with_frames" is not
sdf_joint_types/sdformat_test/placement_frame_missing_pose.sdf | line 7, <include>: <uri> "test_model_with_fr
sdf_joint_types/sdformat_test/sensors.sdf | 1 0
sdf_joint_types/sdformat_test/world_complete.sdf | 4 7
sdf_joint_types/sdformat_test/world_frame_attached_to.sdf | 8 7
sdf_joint_types/sdformat_test/world_frame_invalid_attached_to.sdf | line 5, <frame name="F">: refers to "A",
sdf_joint_types/sdformat_test/world_frame_invalid_attached_to_scope.sdf | line 15, <frame name="F">: refers t
sdf_joint_types/sdformat_test/world_frame_invalid_relative_to.sdf | line 13, <model name="M">: <pose> refers
sdf_joint_types/sdformat_test/world_frame_relative_to.sdf | 14 28
sdf_joint_types/sdformat_test/world_invalid_root_reference.sdf | line 36, <include>: <uri> "test_model_with_f
sdf_joint_types/sdformat_test/world_joint_child_frame.sdf | 8 11
sdf_joint_types/sdformat_test/world_joint_invalid_child_world.sdf | line 22, <joint name="J2">: has the world
sdf_joint_types/sdformat_test/world_joint_invalid_resolved_parent_same_as_child.sdf | line 21, <joint name="J
sdf_joint_types/sdformat_test/world_joint_parent_frame.sdf | 8 11
sdf_joint_types/sdformat_test/world_model_frame_same_name.sdf | line 15, <frame name="ground">: has the name
sdf_joint_types/sdformat_test/world_model_frame_same_name_1_6.sdf | 5 14
sdf_joint_types/sdformat_test/world_nested_frame.sdf | 7 7
sdf_joint_types/sdformat_test/world_nested_frame_attached_to.sdf | 13 7
sdf_joint_types/sdformat_test/world_nested_model.sdf | 7 22
sdf_joint_types/sdformat_test/world_relative_to_nested_reference.sdf | 12 14
sdf_joint_types/sdformat_test/world_valid_root_reference.sdf | 3 7
"""

OUTCOMES: dict[str, str] = dict(line.split(" | ", 1) for line in _TABLE.strip().splitlines())  # type: ignore[misc]
