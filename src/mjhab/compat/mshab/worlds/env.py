"""The environments behind MS-HAB's ids: W worlds of ours as one `gymnasium.Env` of tensors (W, ...).

The layer translates: physics, success, rewards and pictures are those of `mjhab.make` with the values of profile
"ms_hab". A world goes on after success and failure until `reset` begins its next episode; the wrappers of
`wrappers.vector` reset those that ended.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from mjhab.compat.mshab.worlds.arguments import read_arguments
from mjhab.compat.mshab.worlds.draws import FIRST_SEED, OwnDraw
from mjhab.compat.mshab.worlds.observing import Reading, as_tensor, blank, space_of
from mjhab.compat.mshab.worlds.parts import SceneParts
from mjhab.compat.mshab.worlds.starting import open_setting
from mjhab.compat.mshab.worlds.telling import Telling
from mjhab.core.arrays import to_numpy
from mjhab.core.errors import UsageError, unknown_name, wrong_type, wrong_value
from mjhab.envs.spaces import batched

RESET_OPTIONS = (
    "env_idx",
    "reconfigure",
    "task_plan_idxs",
    "build_config_idxs",
    "spawn_selection_idxs",
    "init_config_idxs",
)
CONTROL_TIMESTEP_S = 0.05


class MsHabEnv(SceneParts, gymnasium.Env):
    """W worlds of one subtask, or of a whole task, under MS-HAB's arguments (`arguments`).

    Observations are nested dicts of tensors (W, ...) (`observing`), `info` a dict of tensors (W,) (`telling`).
    ``success`` and ``fail`` end an episode; time does in `wrappers.time_limit`.

    Attributes:
        worlds: the environment of ours.
        num_envs: W. device: of the tensors.
        single_observation_space, single_action_space: spaces of one world; observation_space, action_space: of all.
        task_cfgs: limits by kind of subtask.
        task_plan: the subtasks at every place of the plans; each knows those of all worlds
            (``composite_subtask_uids``).
        base_task_plans: plans by the uids of their subtasks.
        build_config_idxs, task_plan_idxs, init_config_idxs, spawn_selection_idxs: (W,) what was drawn for each world.
        elapsed_steps: (W,) int32 control steps of the episodes.

    Raises:
        UsageError: an argument is unknown or cannot be honoured.
    """

    metadata: ClassVar[dict[str, Any]] = {
        # Gymnasium would put a window of its own in the place of a mode that is not listed; ours says what there is.
        "render_modes": ["rgb_array", "all", "sensors", "human"],
        "render_fps": 20,
    }

    def __init__(self, *, subtask: str, **given: Any) -> None:
        arguments = read_arguments(subtask, given)
        self.arguments = arguments
        setting = open_setting(arguments)
        super().__init__(setting.worlds, setting.draw, arguments)
        self.num_envs = arguments.num_envs
        self.obs_mode = arguments.obs_mode
        self.reward_mode = arguments.reward_mode
        self.control_mode = arguments.control_mode
        self.render_mode = arguments.render_mode
        self.robot_uids = "fetch"
        self.reconfiguration_freq = int(arguments.redraws_homes)
        self.control_timestep = CONTROL_TIMESTEP_S
        flat = setting.worlds.single_observation_space
        assert isinstance(flat, spaces.Dict)
        self._reading = Reading(flat, arguments.obs_mode)
        self._telling: Telling | None = None
        self._obs = self._reading.read(blank(flat, 1))
        self.update_obs_space(self._obs)
        self.single_action_space = self.worlds.single_action_space
        self.action_space = self.worlds.action_space
        self.elapsed_steps = torch.zeros(
            self.num_envs, dtype=torch.int32, device=self.device
        )
        self._episode_seed = np.full(self.num_envs, FIRST_SEED, np.int64)
        self._next_seed: int | list[int] | None = FIRST_SEED
        self._ever_reset = False

    # -- spaces ----------------------------------------------------------------------------------------------------

    def update_obs_space(self, obs: Any) -> None:
        """Take the spaces from an observation (n, ...) of any number of worlds, as wrappers show it."""
        self._init_raw_obs = obs
        self.single_observation_space: spaces.Space = space_of(obs)
        self.observation_space = batched(self.single_observation_space, self.num_envs)

    # -- reset and step --------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of the draws from now on, one for all worlds or (W,); None goes on.
            options: "env_idx": indices of the worlds that begin one, default all; "reconfigure": draw homes anew;
                "task_plan_idxs", "build_config_idxs", "spawn_selection_idxs": see `draws.PlanDraw`.

        Raises:
            UsageError: an unknown option, or an index that does not exist.
        """
        if options is not None and not isinstance(options, Mapping):
            raise wrong_type("options", options, "a mapping such as {'env_idx': [0]}")
        options = dict(options or {})
        for name in options:
            if name not in RESET_OPTIONS:
                raise unknown_name("reset option", name, RESET_OPTIONS)
        begun = _indices(options.get("env_idx"), self.num_envs)
        reconfigure = bool(options.get("reconfigure"))
        whole = len(set(begun)) == self.num_envs
        if not (whole or self._ever_reset):
            raise wrong_value(
                "env_idx", begun, "left out in the first reset, which begins all worlds"
            )
        if seed is not None and not (whole or self._on_host):
            raise UsageError("on a device a seed is for all worlds: leave out env_idx.")
        if reconfigure and not whole:
            raise UsageError("reconfigure=True is for all worlds: leave out env_idx.")
        reconfigure = reconfigure or (self.arguments.redraws_homes and whole)
        # The first reset may choose homes, as every one that builds them.
        reconfigure = reconfigure or not self._ever_reset
        seeds = self._seeds(seed)
        self._begin(begun, seeds, options, reconfigure)
        self._ever_reset = True
        return self._obs, {**self._info(reset=True), "reconfigure": reconfigure}

    def _begin(
        self,
        begun: list[int],
        seeds: list[int] | None,
        options: Mapping[str, Any],
        reconfigure: bool,
    ) -> None:
        """Begin episodes in the worlds ``begun`` and observe all worlds."""
        if seeds is not None:
            self._episode_seed = np.array(seeds, np.int64)
        mask = torch.zeros(self.num_envs, dtype=torch.bool)
        mask[begun] = True
        ours: dict[str, Any] = {"reset_mask": self._given(mask)}
        draw = self._draw
        if isinstance(draw, OwnDraw):
            draw.refuse(options)
            flat, _ = self.worlds.reset(seed=self._own_seed(seeds), options=ours)
        else:
            draw.begin(seeds, begun)
            if reconfigure:
                draw.build(options.get("build_config_idxs"))
            ours["episode"] = draw.rows(begun, options)
            flat, _ = self.worlds.reset(options=ours)
        # Views read plans when they are asked for; those of the last episodes are stale now.
        self._forget_plans()
        # A new tensor: info of earlier steps keeps the one that it was given.
        self.elapsed_steps = self.elapsed_steps.masked_fill(mask.to(self.device), 0)
        self._obs = self._reading.read(flat)

    def _seeds(self, seed: Any) -> list[int] | None:
        """(W,) seeds of a reset; before any was given, the first reset has its own."""
        if seed is None:
            seed, self._next_seed = self._next_seed, None
            if seed is None:
                return None
        self._next_seed = None
        listed = list(seed) if isinstance(seed, Sequence | np.ndarray) else [seed]
        if len(listed) == 1:
            listed = listed * self.num_envs
        if len(listed) != self.num_envs:
            raise wrong_value("seed", seed, f"one number, or {self.num_envs}")
        try:
            return [operator.index(each) for each in listed]
        except TypeError as error:
            raise wrong_type("seed", seed, "a whole number, or one per world") from error

    def _own_seed(self, seeds: list[int] | None) -> Any:
        """Seed for our environment: one number, or one for each world, where it takes those."""
        if seeds is None:
            return None
        return seeds[0] if len(set(seeds)) == 1 else seeds

    def _given(self, values: torch.Tensor) -> Any:
        """A tensor as our environment takes it."""
        return values.numpy() if self._on_host else values.to(self.device)

    def step(self, action: Any) -> tuple[Any, torch.Tensor, Any, Any, dict[str, Any]]:
        """One control step of 50 ms in every world.

        Args:
            action: (W, A) tensor or array; with one world also (A,). Clipped to the action space.

        Returns:
            Observations, reward (W,) float32, terminated (W,) bool (success or failure), truncated (W,) bool (never),
            and `info`.
        """
        try:
            action = torch.as_tensor(action)
        except (TypeError, ValueError, RuntimeError) as error:
            raise wrong_type("action", action, "a tensor or array of numbers") from error
        if action.ndim == 1 and self.num_envs == 1:
            action = action[None]
        ours = action.detach().cpu().numpy() if self._on_host else action
        flat, reward, *_ = self.worlds.step(ours)
        # Not in place: info of the last step holds the same tensor.
        self.elapsed_steps = self.elapsed_steps + 1
        self._obs = self._reading.read(flat)
        info = self._info()
        success = info["success"]
        fail = info["fail"]
        return (
            self._obs,
            self._reward(reward, info),
            success | fail,
            torch.zeros_like(success),
            info,
        )

    def _reward(self, reward: Any, info: Mapping[str, Any]) -> torch.Tensor:
        mode = self.reward_mode
        if mode == "none":
            return torch.zeros(self.num_envs, device=self.device)
        if mode == "sparse":
            return info["success"].float() - info["fail"].float()
        if not self.arguments.subtask:
            # The reward of a whole task is how many of its subtasks are finished.
            return info["subtask"].float()
        return as_tensor(reward).float()

    def _info(self, reset: bool = False) -> dict[str, torch.Tensor]:
        worlds = self.worlds
        # After a step the outcome counts: `signals` may be of a subtask that has begun since.
        signals = worlds.signals if reset else worlds.outcome_signals
        assert signals is not None
        return self._teller().info(signals, self.elapsed_steps)

    def _teller(self) -> Telling:
        if self._telling is None:
            kinds = [each.type for each in self.task_plan]
            self._telling = Telling(
                self.worlds, self.task_cfgs, kinds, self.arguments.tells_events
            )
        return self._telling

    def get_obs(self, info: Any = None) -> Any:
        """Observations of the present state."""
        return self._obs

    def get_info(self) -> dict[str, Any]:
        """`info` of the present state."""
        return self._info(reset=True)

    def close(self) -> None:
        """Close the environment of ours."""
        self.worlds.close()


def _indices(chosen: Any, worlds: int) -> list[int]:
    """Worlds of "env_idx", a tensor, array or list of their indices; all if None."""
    if chosen is None:
        return list(range(worlds))
    listed = to_numpy(chosen) if isinstance(chosen, torch.Tensor) else chosen
    try:
        indices = np.asarray(listed)
    except ValueError:
        indices = np.zeros(0, object)
    # numpy makes an empty list an array of floats.
    kinds = "iu" if indices.size else "iuf"
    good = indices.ndim == 1 and indices.dtype.kind in kinds
    if not good or not ((indices >= 0) & (indices < worlds)).all():
        raise wrong_value("env_idx", chosen, f"indices of worlds, each below {worlds}")
    return indices.astype(int).tolist()
