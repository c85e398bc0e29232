"""Collision filtering: MuJoCo contype/conaffinity bits of every class of geom.

Two geoms collide if the contype of one shares a bit with the conaffinity of the other. Furniture does not collide with
furniture. The robot does not collide with rugs, because a driven base would touch them in every step and accumulate
collision force, and its base is 2 cm above the floor.
"""

from __future__ import annotations

STATIC = 1
"""Walls, floor and furniture without joints; conaffinity 0."""
ROBOT = 2
"""Every robot link."""
OBJECT = 4
"""Movable objects."""
JOINTED = 8
"""Doors and drawers; conaffinity 0, so that they do not collide with their own frame."""
DISTAL = 16
"""The robot's forearm and hand, which collide with its trunk."""
RUG = 32
"""Rugs and mats, which support objects but do not collide with the robot; conaffinity 0."""
WALL = 64
"""Walls, beside STATIC, where doors meet them: in layouts with the joint dynamics "published" (`layout.joints`)."""

ROBOT_AFFINITY = STATIC | OBJECT | JOINTED
"""conaffinity of robot links; trunk links add DISTAL."""
OBJECT_AFFINITY = STATIC | ROBOT | OBJECT | JOINTED | RUG
"""conaffinity of movable objects."""
