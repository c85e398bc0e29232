"""Start: the robot begins elsewhere, with its arm in another posture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.config.perturbing import Drawn, Perturbation, Quantity, StartScene


class StartAxis(Perturbation):
    """The base is shifted and turned, and every joint of the arm moved; what collides is drawn anew."""

    name = "start"
    about = "position, heading and arm of the robot at the start"
    quantities = {  # noqa: RUF012
        "shift": Quantity("m", (0.05, 0.1, 0.15, 0.2, 0.3), "length of the base's shift"),
        "turn": Quantity("deg", (5.0, 10.0, 15.0, 20.0, 30.0), "turn of the base"),
        "arm": Quantity(
            "rad", (0.05, 0.1, 0.15, 0.2, 0.3), "largest move of a joint of the arm"
        ),
    }
    on_device = True

    def start(
        self, drawn: Drawn, scene: StartScene, attempt: int
    ) -> tuple[np.ndarray, Mapping[str, Any]] | None:
        """Shift, turn and bend the robot by the numbers of the level, in drawn directions."""
        # Each try has its own numbers, so that a refused one is not drawn again.
        random = drawn.stream(attempt)
        amounts = drawn.amounts
        around = float(random.uniform(-np.pi, np.pi))
        turn = float(np.radians(amounts["turn"]) * random.choice((-1.0, 1.0)))
        base = np.array(
            [amounts["shift"] * np.cos(around), amounts["shift"] * np.sin(around), turn]
        )
        arm = amounts["arm"] * random.uniform(-1.0, 1.0, len(scene.robot.arm_columns))
        qpos = scene.moved(base, arm)
        if qpos is None:
            return None
        return qpos, {"base": base.tolist(), "arm": arm.tolist()}


START = StartAxis()
