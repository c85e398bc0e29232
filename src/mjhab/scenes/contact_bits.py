"""Who may touch whom: MuJoCo contype/conaffinity bits of every class of geom.

Two geoms collide when the contype of one shares a bit with the conaffinity of the other. Furniture never
meets furniture, and the robot neither meets rugs (a base that is driven would scrape them in every step and
pile up "collision force") nor, floating 2 cm up, the floor.
"""

from __future__ import annotations

STATIC = 1
"""Walls, floor and furniture without joints; conaffinity 0."""
ROBOT = 2
"""Every robot link."""
OBJECT = 4
"""Movable objects."""
JOINTED = 8
"""Doors and drawers; conaffinity 0, so that they do not rub against their own frame."""
DISTAL = 16
"""The robot's forearm and hand, which its own trunk must feel."""
RUG = 32
"""Rugs and mats: objects lie on them, the robot drives over them; conaffinity 0."""

ROBOT_AFFINITY = STATIC | OBJECT | JOINTED
"""conaffinity of robot links; trunk links add DISTAL."""
OBJECT_AFFINITY = STATIC | ROBOT | OBJECT | JOINTED | RUG
"""conaffinity of movable objects."""
