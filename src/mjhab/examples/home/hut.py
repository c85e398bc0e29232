"""A home as a Python file: one room, as many chairs around the table as `CHAIRS` says."""

import math

SIZE = (5.2, 5.0)
MIDDLE = (2.6, 3.1)
CHAIRS = 2
CHAIR_DISTANCE = 1.15

chairs = []
for k in range(CHAIRS):
    angle = 2 * math.pi * k / CHAIRS
    chairs.append(
        {
            "kind": "chair_01",
            "at": (
                MIDDLE[0] + CHAIR_DISTANCE * math.cos(angle),
                MIDDLE[1] + CHAIR_DISTANCE * math.sin(angle),
            ),
            "yaw_degrees": math.degrees(angle) - 180,
        }
    )

HOME = {
    "format": "mjhab-home-1",
    "name": "hut",
    "floor": {"size": SIZE, "material": "floor_tile"},
    "walls": {"outer": "wall_blue"},
    "furniture": [
        {"kind": "kitchen_counter", "at": (1.85, 0.345), "yaw_degrees": 90},
        {"kind": "fridge", "at": (4.5, 0.365), "yaw_degrees": 90},
        {"kind": "table_01", "at": MIDDLE, "yaw_degrees": 90},
        {"kind": "tvstand", "at": (1.2, 4.77), "yaw_degrees": -90},
        {"kind": "sofa", "at": (3.9, 4.5), "yaw_degrees": -90},
        *chairs,
    ],
}
