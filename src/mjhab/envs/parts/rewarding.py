"""Rewards of a control step: inputs of the reward tables, and the state that they keep between steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.config.env import DENSE_MODES, REWARD_MODES
from mjhab.core.arrays import Array, as_like, cast, count, namespace, norm3, zeros
from mjhab.core.errors import unknown_name
from mjhab.core.joints import BASE_XY
from mjhab.envs.parts.plan_tables import Focus
from mjhab.envs.parts.sensing import Sensing
from mjhab.layout.layout import Layout
from mjhab.sim.protocol import SimState
from mjhab.tasks.progress import Progress
from mjhab.tasks.rewards.table import IDEAL_SPEED, RewardView, closed_near
from mjhab.tasks.scoring import DenseReward, RewardOptions, kinds_at_hand
from mjhab.tasks.signals import Signals, WorldState
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True, eq=False)
class RewardInputs:
    """Inputs of the reward of W worlds after `measure`; only the reward mode "pointer" reads ``progress``."""

    state: SimState
    world: WorldState
    signals: Signals
    focus: Focus
    progress: Progress


GoalDistance = Callable[[RewardInputs], Array]
"""Function for the length (W,) [m] of the path from the base to the goal of Navigate; entries of worlds with other
subtasks are ignored."""


def straight_distance(inputs: RewardInputs) -> Array:
    """Straight distance (W,) from the base to the goal of Navigate on the floor, obstacles ignored [m]."""
    delta = inputs.focus.active.goal_pos[:, :2] - inputs.world.base_pose[:, BASE_XY]
    return namespace(delta).sqrt(delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1])


@dataclass(frozen=True)
class RewardRules:
    """Options of the reward of an environment.

    Attributes:
        config: thresholds of the task.
        mode: "dense": sum of the terms of the active subtask's table (`tasks.rewards`); "normalized_dense": the same,
            divided by the normaliser of ``options``; "sparse": 1 while the active subtask succeeds; "pointer": the
            number of completed subtasks, from ``inputs.progress``; "none": 0.
        options: scales, formula and normaliser of the dense modes; None for the defaults.
        nav_distance: distance to the navigation goal. The default is the straight line; MS-HAB uses the shortest path
            over the navigation mesh (mshab/envs/navigate.py, with the straight line as an option).
        kinds: names of the kinds of subtasks in the plans, None for all; terms of others are not reported. With torch
            the terms of all these kinds are computed in every step, with numpy those of the active kinds.
    """

    config: TaskConfig
    mode: str
    options: RewardOptions | None = None
    nav_distance: GoalDistance = straight_distance
    kinds: Sequence[str] | None = None


class Rewarder:
    """Rewards of W worlds, whose active subtasks may be of any kind.

    Args:
        num_worlds: number of worlds W.
        rules: options of the reward.
        layout: layout of the worlds, for the joints of links.
        sensing: sensing of the same layout, for handle positions.
        like: an array of the simulator's library, device and dtype; numpy float64 if not given.

    Raises:
        UsageError: unknown mode, kind or term, or a scale that is not a finite number.
    """

    def __init__(
        self,
        num_worlds: int,
        rules: RewardRules,
        layout: Layout,
        sensing: Sensing,
        like: Array | None = None,
    ) -> None:
        mode = rules.mode
        kinds = rules.kinds
        if mode not in REWARD_MODES:
            raise unknown_name("reward mode", mode, REWARD_MODES)
        self.mode = mode
        if kinds is not None and mode not in DENSE_MODES:
            # Without a dense reward a subtask can still be counted.
            kinds = [name for name in kinds if SUBTASKS[name].reward is not None]
        self.dense = DenseReward(rules.config, rules.options, kinds)
        self._bounded = rules.options is None or rules.options.formula == "bounded"
        self.nav_distance = rules.nav_distance
        self._sensing = sensing
        robot = layout.robot
        self._torso = robot.columns.torso
        if self._torso is not None:
            low, high = robot.joint_limits[self._torso]
            self._torso_low = low
            self._torso_travel = high - low
        like = np.zeros(0) if like is None else like
        self._worlds = count(num_worlds, like)
        # The last entry is for "no link", index -1.
        self._ideal = as_like(
            [*(IDEAL_SPEED[ref.link.joint] for ref in layout.links), 0.0], like
        )
        self._zero = zeros((num_worlds,), like)
        self._zero6 = zeros((num_worlds, 6), like)
        self._low = as_like([0.0], like)
        self._high = as_like([1.0], like)
        self._closed_near = self._zero > 0

    def begin(self, mask: Array, inputs: RewardInputs) -> None:
        """Reset the memory of the worlds in ``mask`` (W,) bool to ``inputs``, the start of their subtask."""
        self._closed_near = self._closed_near & ~mask

    def step(self, inputs: RewardInputs) -> tuple[Array, dict[str, Array]]:
        """Compute the rewards of one control step, before the pointer moves.

        Returns:
            reward (W,), float64 on numpy; and, in the dense modes, raw x scale (W,) of every term in ``dense.names``,
            which sum to the dense reward before normalising, 0 where a world's subtask does not have the term.
        """
        if self.mode == "none":
            # A new array: the caller may write into what it gets.
            return self._zero + 0.0, {}
        if self.mode in ("sparse", "pointer"):
            counted = (
                inputs.signals.success
                if self.mode == "sparse"
                else inputs.progress.pointer
            )
            return cast(counted, self._zero.dtype), {}
        scored = self.dense.score(self._view(inputs))
        reward = (
            scored.total / scored.normaliser
            if self.mode == "normalized_dense"
            else scored.total
        )
        return reward, dict(zip(self.dense.names, scored.terms, strict=True))

    def _view(self, inputs: RewardInputs) -> RewardView:
        """Inputs of the reward tables; fields that no table of the present subtasks reads are zero."""
        state = inputs.state
        world = inputs.world
        focus = inputs.focus
        rows = self._worlds
        zero = self._zero
        xp = namespace(rows)
        kinds = kinds_at_hand(inputs.signals.kind, self.dense.tables.keys())
        reads = {name for kind in kinds for name in self.dense.tables[kind].reads}
        jointed = "joint" in reads
        distance = zero
        if jointed:
            # Worlds without a link compute some handle, and their result is not used.
            some = xp.where(focus.link > 0, focus.link, 0)
            handle = self._sensing.handle_pos(state, rows, some)
            distance = norm3(world.tcp_pos - handle)
            self._closed_near = closed_near(
                self._closed_near, inputs.signals.closed, distance
            )
        # For a robot without a torso the torso counts as fully up.
        torso = zero + 1.0
        if self._torso is not None:
            above = world.robot_q[:, self._torso] - self._torso_low
            torso = above / self._torso_travel
        clipped = xp.minimum(xp.maximum(torso, self._low), self._high)
        # The original takes the absolute value: a torso below its lower limit earns, too.
        torso = clipped if self._bounded else xp.abs(torso)
        return RewardView(
            world=world,
            signals=inputs.signals,
            tcp_vel=state.tcp_vel,
            object_pos=state.object_pose[rows, focus.obj, :3],
            object_vel=state.object_vel[rows, focus.obj]
            if "object_vel" in reads
            else self._zero6,
            goal_pos=focus.active.goal_pos,
            torso_up=torso,
            handle_distance=distance,
            joint_qd=state.link_qd[rows, focus.link] if jointed else zero,
            joint_ideal=self._ideal[focus.link] if jointed else zero,
            open_frac=focus.active.open_frac,
            nav_distance=self.nav_distance(inputs) if "nav_distance" in reads else zero,
            closed_near=self._closed_near,
        )

    def get_state(self, world: int) -> dict[str, bool]:
        """State of one world that is kept between steps."""
        return {"closed_near": bool(self._closed_near[world])}

    def set_state(self, world: int, state: Mapping[str, bool]) -> None:
        """Restore one world from `get_state`; other worlds are not changed."""
        self._closed_near[world] = state["closed_near"]
