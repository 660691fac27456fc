"""Control: a QP velocity controller and inverse kinematics for any model (layer 5)."""
