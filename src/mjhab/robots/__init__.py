"""Robots: joints, links, servo gains, geometry, kinematics and controllers."""
