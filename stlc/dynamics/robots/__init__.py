"""Robots: descriptions, kinematics, functions from outside."""
