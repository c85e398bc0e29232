"""The state in two parts: what the robot's own sensors tell, and what only the simulation knows."""

from __future__ import annotations

import numpy as np

from mjhab.envs.observations.modes import STATE_KEY
from mjhab.envs.observations.state import state_observation, state_table, unsensed_table
from mjhab.envs.sequential import SequentialTaskEnv

STATE_PARTS = "state"
OWN_STATE = "own"
"""Entry of a greeting, and its value of servers that want the parts of `split_state` in place of the state."""


def split_state(env: SequentialTaskEnv) -> tuple[np.ndarray, np.ndarray]:
    """Both parts of the present state of all worlds, float32: (W, 34) and (W, 11) for the default robot.

    They are ``observation.state`` and ``observation.environment_state`` of ``mjhab export lerobot``. ``env`` was reset.
    """
    assert env.signals is not None
    robot = env.layout.robot
    context = env.sensing.context(env.state, env.focus, env.signals)
    own, unsensed = (
        state_observation(table, context)[STATE_KEY]
        for table in (state_table(robot, own=True), unsensed_table(robot))
    )
    return own, unsensed
