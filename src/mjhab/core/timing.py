"""How time is divided: every control step of the robot is a fixed number of steps of the physics.

Simulation at 100 Hz, control at 20 Hz (MS-HAB paper Sec. 4.1).
"""

from __future__ import annotations

TIMESTEP_SECONDS = 0.01
"""One step of the physics."""
SUBSTEPS = 5
"""Steps of the physics in one control step."""
STEP_SECONDS = SUBSTEPS * TIMESTEP_SECONDS
"""One control step: the robot is controlled at 20 Hz."""
