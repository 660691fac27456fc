"""Expected outcome of each file of ``urdf_conformance``: its degrees of freedom, or its error message.

``docs/urdf.md`` explains the files for which the parsers of ``verdicts.tsv`` disagree.
"""

from __future__ import annotations

from pathlib import Path

_TABLE = """
drake/accepting_renderer.urdf | 0
drake/all_geometries_as_collision.urdf | 0
drake/all_geometries_as_visual.urdf | 0
drake/bad.urdf | line 1, column 1, before any element: not well-formed XML
drake/collision_filter_group_parsing_test.urdf | line 13, <link name="link2">: there are 10 links
drake/conflicting_materials.urdf | line 6, <material name="brown">: is rgba 0.933333 0.2 0.2 1 here
drake/convex_and_nonconvex_test.urdf | 0
drake/duplicate_but_same_materials_with_texture.urdf | 1
drake/duplicate_materials.urdf | 0
drake/joint_parsing_test.urdf | line 116, <joint name="revolute_joint_no_limits">: is revolute but has no
drake/joint_parsing_test_missing_screw_thread_pitch.urdf | line 4, <link name="link2">: there are 2 links
drake/joint_parsing_test_missing_screw_thread_pitch_attribute.urdf | line 4, <link name="link2">: there are
drake/joint_parsing_test_tag_mismatch_1.urdf | line 4, <link name="link2">: there are 2 links
drake/joint_parsing_test_tag_mismatch_2.urdf | line 5, <joint name="ball_joint">: type="ball" is no joint type
drake/non_conflicting_materials_1.urdf | 0
drake/non_conflicting_materials_2.urdf | line 40, <link name="material_by_name">: there are 2 links
drake/non_conflicting_materials_3.urdf | 0
drake/two_unnamed_boxes.urdf | 0
drake/zero_dof_robot.urdf | 0
idyntree/frame.urdf | 0
idyntree/icalibrate.urdf | 3
idyntree/icubTwoLinks.urdf | 1
idyntree/oneLink.urdf | 0
idyntree/simple_model.urdf | 0
idyntree/threeLinks.urdf | 2
idyntree/twoLinks.urdf | 1
idyntree/twoLinksFixed.urdf | 0
idyntree/twoLinksRotationOnZAxis.urdf | 1
misc/collada_urdf_pr2_blank_lines_before_xml_decl.urdf | line 5, column 1, <?xml ...?>: not well-formed XML
ros_urdf/fail_pr2_desc_bracket.urdf | line 9, <joint name="fl_caster_rotation_joint">: <origin> rpy="0 0 1 }"
ros_urdf/fail_pr2_desc_double.urdf | line 31, <link name="fl_caster_rotation_link">: has the name of the link
ros_urdf/fail_pr2_desc_double_joint.urdf | line 21, <joint name="fl_caster_rotation_joint">: has the name of
ros_urdf/fail_pr2_desc_loop.urdf | line 5, <joint name="fl_caster_rotation_joint">: the joints
ros_urdf/fail_pr2_desc_no_filename_in_mesh.urdf | line 99, <link name="base_link">: <mesh> has no filename
ros_urdf/fail_pr2_desc_no_joint2.urdf | line 10, column 30, in <joint name="fl_caster_rotation_joint"> of
ros_urdf/fail_pr2_desc_parent_itself.urdf | line 4, <joint name="fl_caster_rotation_joint">: its child link
ros_urdf/fail_pr2_desc_two_trees.urdf | line 4, <joint name="fl_caster_rotation_joint">: its parent link
ros_urdf/fail_three_links_one_joint.urdf | line 1, column 7, <?xml ...?>: not well-formed XML
ros_urdf/no_visual.urdf | line 1, column 7, <?xml ...?>: not well-formed XML
ros_urdf/one_link.urdf | line 1, column 7, <?xml ...?>: not well-formed XML
ros_urdf/pr2_desc.urdf | line 816, <xacro:pr2_head_pan_gazebo_v0 name="head_pan">: is xacro
ros_urdf/pr2_desc_no_joint.urdf | 0
ros_urdf/singularity.urdf | line 1, column 7, <?xml ...?>: not well-formed XML
ros_urdf/test_robot.urdf | 8
ros_urdf/two_links_one_joint.urdf | line 1, column 7, <?xml ...?>: not well-formed XML
sdformat/cfm_damping_implicit_spring_damper.urdf | 4
sdformat/fixed_joint_example.urdf | 1
sdformat/fixed_joint_reduction.urdf | 5
sdformat/fixed_joint_reduction_collision.urdf | 5
sdformat/fixed_joint_reduction_collision_visual_empty_root.urdf | 0
sdformat/fixed_joint_reduction_collision_visual_extension.urdf | 0
sdformat/fixed_joint_reduction_disabled.urdf | 5
sdformat/fixed_joint_reduction_joint_frame_extension.urdf | 2
sdformat/fixed_joint_reduction_plugin_frame_extension.urdf | 0
sdformat/fixed_joint_reduction_simple.urdf | 6
sdformat/fixed_joint_reduction_visual.urdf | 5
sdformat/fixed_joint_simple.urdf | 0
sdformat/fixed_joint_static.urdf | 0
sdformat/force_torque_sensor.urdf | 2
sdformat/invalid_force_torque_sensor_lumped_and_reduced.urdf | 1
sdformat/invalid_force_torque_sensor_massless_child_link.urdf | 2
sdformat/joint_mimic_rack_pinion.urdf | 1
sdformat/material_valid.urdf | 0
sdformat/provide_feedback.urdf | 3
sdformat/urdf_gazebo_extensions.urdf | 6
sdformat/urdf_joint_parameters.urdf | 5
drake__atlas__urdf__robotiq_tendons.urdf | line 446, <joint name="finger_tensioner">: <limit> has no effort
drake__pr2__pr2_description__urdf__pr2_simplified.urdf | line 116, <joint name="x">: is prismatic but has no
oems__eveR3_halodi__eve_r3_description__urdf__eve_r3.urdf | 23
rethink_electric_gripper.urdf | line 143, <joint name="left_gripper_base">: its parent link "left_hand" does
rethink_pneumatic_gripper.urdf | line 31, <joint name="left_gripper_base">: its parent link "left_hand" does
open_manipulator_description__urdf__open_manipulator.urdf | line 7, <robot>: has no name
random__robot-assets__halodi__eve_r3.urdf | 23
r2_description__robots__r2_left_gripper.urdf | line 61, <link name="r2/left_leg/ati">: has the name of the
random__robot-assets__val_description__model__robots__imu_test.urdf | line 22, <xacro:make_pelvis>: is xacro
random__robot-assets__val_description__model__robots__test_bench.urdf | line 6, <robot name="valkyrie">: has
random__spot_ros__spot_description__urdf__spot_arm.urdf | line 170, <joint name="base_arm_joint">: its parent
robotics-toolbox__val_description__model__robots__imu_test.urdf | line 22, <xacro:make_pelvis>: is xacro
robotics-toolbox__val_description__model__robots__test_bench.urdf | line 6, <robot name="valkyrie">: has no
urdfdom/autogenerated.urdf | line 3, <joint name="name1">: type="type1" is no joint type of URDF
"""

_READ = """
drake/collision_filter_group_parsing_test.urdf | 0
drake/conflicting_materials.urdf | 0
drake/joint_parsing_test.urdf | 8
drake/joint_parsing_test_missing_screw_thread_pitch.urdf | 0
drake/joint_parsing_test_missing_screw_thread_pitch_attribute.urdf | 0
drake/joint_parsing_test_tag_mismatch_1.urdf | 0
drake/non_conflicting_materials_2.urdf | 0
misc/collada_urdf_pr2_blank_lines_before_xml_decl.urdf | 32
ros_urdf/fail_pr2_desc_no_filename_in_mesh.urdf | line 2297, <joint name="r_gripper_joint">: has no <parent
ros_urdf/fail_three_links_one_joint.urdf | line 24, column 5, in <joint name="joint12"> of line 21: not
ros_urdf/no_visual.urdf | 0
ros_urdf/one_link.urdf | 0
ros_urdf/pr2_desc.urdf | 34
ros_urdf/singularity.urdf | 0
ros_urdf/two_links_one_joint.urdf | 0
drake__atlas__urdf__robotiq_tendons.urdf | 10
drake__pr2__pr2_description__urdf__pr2_simplified.urdf | 28
open_manipulator_description__urdf__open_manipulator.urdf | 5
"""
"""Files with another outcome when they are not read strictly."""

_OUTCOMES = [tuple(line.split(" | ")) for line in _TABLE.strip().splitlines()]
COUNT = len(_OUTCOMES)


_READ_OUTCOMES = [tuple(line.split(" | ")) for line in _READ.strip().splitlines()]


def expected_outcome(file: Path, strict: bool = False) -> int | str:
    """Return the degrees of freedom of a file of the collection, or its error message."""
    found = [text for ending, text in _OUTCOMES if file.as_posix().endswith(ending)]
    if not strict:
        found = [text for ending, text in _READ_OUTCOMES if file.as_posix().endswith(ending)] or found
    (text,) = found
    return int(text) if text.isdecimal() else text
