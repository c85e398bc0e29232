"""Motions of the arm: inverse kinematics, clearance, release."""
