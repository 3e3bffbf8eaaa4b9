"""Robots: URDF descriptions, kinematics, external functions."""
