"""Evaluation rules of a reproduction: those of the paper's Table 1 and those of its ablations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mjhab.config.profiles import unbound
from mjhab.learning.configs import BC, DIFFUSION
from mjhab.paper.reproduce.rows import RL_ALL, RL_PER

TABLE1 = "table1"
FORCE_LIMITS = "force_limits"
GOAL_ZONES = "goal_zones"
LONG_HORIZON = "long_horizon"
TABLE5 = "table5"
DEMO_COUNT = "demo_count"
FILTERS = "filters"
CHOICES = "choices"
"""Not a result of the paper: what single choices of our presets are worth."""
STUDIES = (TABLE5, DEMO_COUNT, FILTERS, CHOICES)
"""Results about imitation: their variants differ in how policies are trained, not in how they are judged."""
SAC_PPO = "sac_ppo"
PER_ALL = "per_all"
CURVES = "curves"
REWARDED = (SAC_PPO, PER_ALL, CURVES)
"""The same about reinforcement learning."""
SEEDS = 3
"""Seeds of the learning curves, as in the paper."""
DEMOS_PER_OBJECT = (1, 10, 100, 500, 1000)
PLACED = "placed"
DROPPED = "dropped"
UNDISTURBED = "undisturbed"
SEARCHED = "searched"
SAFE_FORCE_LIMIT = 1400.0
"""Limit on the cumulative force in the paper's ablation of human-safe force thresholds [N x control steps]."""


@dataclass(frozen=True)
class Imitation:
    """How a study trains a policy by imitation.

    algorithm: of `mjhab train`. data: names of the data sets that it learns from, keys of `STYLES`; with several, the
    first half of the episodes of each. per_target: number of demonstrations of every target, 0 for all. changes: fields
    of the preset that are set, see `with_changes`.
    """

    algorithm: str = BC
    data: tuple[str, ...] = ("",)
    per_target: int = 0
    changes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reinforcement:
    """How a study trains policies by reinforcement learning.

    column: one of `rows.POLICY_COLUMNS`, says what each policy is for.
    algorithm: sac or ppo; "" for that of the column.
    seed_shift: added to the seed of the request.
    """

    column: str
    algorithm: str = ""
    seed_shift: int = 0


STYLES: dict[str, tuple[str, ...]] = {
    "": (),
    PLACED: ("plan=search", "release=place"),
    DROPPED: ("plan=search", "release=drop"),
    UNDISTURBED: ("noise=0", "base_noise=0"),
    SEARCHED: ("plan=search", "waits=counted", "pull=base", "open_further=0"),
}
"""What the data sets of a study change in the style of the preset's expert, by name."""


CHANGED: dict[str, tuple[str, tuple[str, ...]]] = {
    "preset": ("the preset as it is", ()),
    "chunk_1": ("one action predicted and executed", ("chunk=1", "execute=1")),
    "chunk_4": ("4 actions predicted", ("chunk=4",)),
    "whole_episodes": ("demonstrations are not cut after success", ("hold_steps=-1",)),
    "last_weights": ("no moving average of the weights", ("optimizer.ema=0",)),
    "no_previous_action": (
        "without the previous action",
        ("inputs.previous_action=false",),
    ),
    "no_base_velocity": (
        "without the velocity of the base",
        ("inputs.base_velocity=false",),
    ),
    "px_64": ("images of 64 x 64 px", ("inputs.image_size=64",)),
}
"""Variants of `CHOICES` that change fields of the preset: description and fields, by name."""


@dataclass(frozen=True)
class Variant:
    """Rules of an evaluation, or a way of training.

    name: of the folder of its runs. about: description. force_limit: on the cumulative force [N x control steps];
    infinity for no limit, None for the limit of the profile. goal_type: see `TaskConfig.goal_type`; "" takes that of
    the profile. imitation, reinforcement: how the policies are trained, in a study; else None.
    """

    name: str
    about: str
    force_limit: float | None = None
    goal_type: str = ""
    imitation: Imitation | None = None
    reinforcement: Reinforcement | None = None

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
            # A binding profile allows no other limit.
            changed = unbound(changed, subtask, trains=False)
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
        Variant(
            "simplified", "no force limit, goals are cylinders", math.inf, "cylinder"
        ),
    ),
    TABLE5: (
        Variant("bc", "behaviour cloning", imitation=Imitation(BC)),
        Variant("dp", "the published diffusion policy", imitation=Imitation(DIFFUSION)),
    ),
    DEMO_COUNT: tuple(
        Variant(
            f"demos_{count}",
            f"at most {count:,} demonstrations per object",
            imitation=Imitation(per_target=count),
        )
        for count in DEMOS_PER_OBJECT
    ),
    FILTERS: (
        Variant("place_in_goal", "objects put down", imitation=Imitation(data=(PLACED,))),
        Variant("drop_to_goal", "objects dropped", imitation=Imitation(data=(DROPPED,))),
        Variant(
            "split_50_50", "half of each", imitation=Imitation(data=(PLACED, DROPPED))
        ),
    ),
    SAC_PPO: (
        Variant("sac", "SAC", reinforcement=Reinforcement(RL_ALL, "sac")),
        Variant("ppo", "PPO", reinforcement=Reinforcement(RL_ALL, "ppo")),
    ),
    PER_ALL: (
        Variant(RL_PER, "one policy per object", reinforcement=Reinforcement(RL_PER)),
        Variant(RL_ALL, "one policy for all", reinforcement=Reinforcement(RL_ALL)),
    ),
    CURVES: tuple(
        Variant(
            f"seed_{k}", f"seed + {k}", reinforcement=Reinforcement(RL_ALL, seed_shift=k)
        )
        for k in range(SEEDS)
    ),
    CHOICES: (
        *(
            Variant(name, about, imitation=Imitation(changes=changes))
            for name, (about, changes) in CHANGED.items()
        ),
        Variant(
            "no_noise",
            "the expert is not disturbed (no DART)",
            imitation=Imitation(data=(UNDISTURBED,)),
        ),
        Variant(
            "search",
            "the usual expert, disturbed: it searches instead of following a rule",
            imitation=Imitation(data=(SEARCHED,)),
        ),
        Variant(
            "px_128",
            "images of 128 x 128 px",
            imitation=Imitation(changes=("inputs.image_size=128",)),
        ),
    ),
}
"""Rules of evaluation, or ways of training, for each result of the paper, by the result's name. Training uses the rules
of Table 1, so does the evaluation of STUDIES and of REWARDED."""
