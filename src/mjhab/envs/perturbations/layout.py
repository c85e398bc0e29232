"""Layout: objects that nobody asks for, beside the one that is handled, and chairs that stand elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.config.perturbing import Drawn, ObjectScene, Perturbation, Quantity


class LayoutAxis(Perturbation):
    """Objects of the home that the episode does not handle stand beside the target, or beside the goal of a Place; and
    loose furniture is moved."""

    name = "layout"
    about = "distractors beside the target, chairs and other loose furniture moved"
    quantities = {  # noqa: RUF012
        "objects": Quantity("", (1, 2, 3, 4, 5), "most distractors beside the target"),
        "gap": Quantity("m", (0.1, 0.08, 0.06, 0.05, 0.04), "least gap between them"),
        "furniture": Quantity(
            "m",
            (0.1, 0.2, 0.3, 0.45, 0.6),
            "largest shift of chairs and other loose furniture",
        ),
    }
    on_device = True

    def furniture(self, drawn: Drawn) -> float:
        """That of the level."""
        return drawn.amounts["furniture"]

    def objects(
        self, drawn: Drawn, scene: ObjectScene, attempt: int
    ) -> tuple[np.ndarray, Mapping[str, Any]] | None:
        """Put as many as find room; every second attempt is with one less."""
        random = drawn.stream(attempt)
        most = min(int(drawn.amounts["objects"]), len(scene.distractors))
        # Fewer with every second try: a full table has no room for many.
        count = max(most - attempt // 2, 0)
        if not count:
            return None
        chosen = random.choice(np.array(scene.distractors), count, replace=False)
        slots = [int(slot) for slot in chosen]
        pose = scene.beside_target(slots, drawn.amounts["gap"], random)
        return None if pose is None else (pose, {"distractors": count})


LAYOUT = LayoutAxis()
