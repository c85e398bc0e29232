"""Evaluation rules of a reproduction: those of the paper's Table 1 and those of its ablations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mjhab.config.profiles import DEFAULT_PROFILE, profile_named

TABLE1 = "table1"
FORCE_LIMITS = "force_limits"
GOAL_ZONES = "goal_zones"
LONG_HORIZON = "long_horizon"
SAFE_FORCE_LIMIT = 1400.0
"""Limit on the cumulative force in the paper's ablation of human-safe force thresholds [N x control steps]."""


@dataclass(frozen=True)
class Variant:
    """Rules of an evaluation.

    name: of the folder of its runs. about: description. force_limit: on the cumulative force [N x control steps];
    infinity for no limit, None for the limit of the profile. goal_type: see `TaskConfig.goal_type`; "" takes that of
    the profile.
    """

    name: str
    about: str
    force_limit: float | None = None
    goal_type: str = ""

    def env_options(self, options: Mapping[str, Any], subtask: str) -> dict[str, Any]:
        """Environment options under these rules.

        Args:
            options: environment options to extend, with their profile. subtask: "" for a whole task.
        """
        changed = dict(options)
        overrides: dict[str, Any] = {}
        if self.goal_type:
            overrides["goal_type"] = self.goal_type
        if self.force_limit is not None:
            # A binding profile allows no other limit, so its values are set one by one on the default profile.
            profile = profile_named(changed.get("profile", DEFAULT_PROFILE))
            values = profile.options(subtask, trains=False)
            changed = {**values, **changed, "profile": DEFAULT_PROFILE}
            if math.isinf(self.force_limit):
                changed["force_limits"] = False
            else:
                overrides[f"{subtask}.force_limit"] = self.force_limit
        return {**changed, "overrides": overrides} if overrides else changed


AS_PUBLISHED = Variant("evaluation", "the rules of Table 1")
NO_LIMIT = Variant("no_force_limit", "no force limit", force_limit=math.inf)
VARIANTS: dict[str, tuple[Variant, ...]] = {
    TABLE1: (AS_PUBLISHED,),
    FORCE_LIMITS: (
        AS_PUBLISHED,
        NO_LIMIT,
        Variant("force_limit_1400", "force limit of 1,400 N x steps", SAFE_FORCE_LIMIT),
    ),
    GOAL_ZONES: (
        AS_PUBLISHED,
        Variant("cylinder", "goals are cylinders", goal_type="cylinder"),
        Variant("zone", "goals are rectangles of furniture", goal_type="zone"),
    ),
    LONG_HORIZON: (
        AS_PUBLISHED,
        NO_LIMIT,
        Variant("cylinder", "goals are cylinders", goal_type="cylinder"),
        Variant("simplified", "no force limit, goals are cylinders", math.inf, "cylinder"),
    ),
}
"""Rules of evaluation for each result of the paper, by the result's name. Training uses the rules of Table 1."""
