"""mjhab as frameworks for reinforcement learning of vision-language-action models drive environments.

The class has the interface of RLinf's environments (rlinf/envs/maniskill/maniskill_env.py, August 2026) and needs no
RLinf: tensors in and out, groups of worlds with the same start for group-relative advantages, resets of some worlds,
chunks of actions, rewards by success. B worlds, H actions of a chunk, A numbers of an action.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

import mjhab.envs as envs
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.envs.observations.modes import STATE_KEY, camera_key
from mjhab.envs.sequential import SequentialTaskEnv

STARTS = 1000
"""Default number of start states that groups are drawn from: episodes 0 to STARTS - 1."""
LOGGED = 10_000
"""Number of finished episodes that the log keeps."""
REWARDS = ("only_success", "raw")
"""Paid: 1 in success, or the reward of the environment."""
IMAGES = ("main_images", "wrist_images")
"""Names of the images, in the order of the robot's cameras."""


class RLinfEnv(gymnasium.Env):
    """B worlds in groups of equal starts.

    Observations: ``main_images``, ``wrist_images`` (B, h, w, 3) uint8, where the mode has "rgb"; ``states`` (B, S)
    float32; ``task_descriptions``, B sentences. ``log``: of every finished episode its number, sentence, success and
    return.

    Args:
        cfg: with the entries seed, group_size, auto_reset, ignore_terminations, use_fixed_reset_state_ids,
            use_rel_reward, reward_mode (one of REWARDS), num_starts (STARTS) and init_params, options of
            `mjhab.make_train`; an omegaconf, a mapping or an object with such attributes.
        num_envs: number of worlds of this process.
        seed_offset: of this process; groups of other offsets are drawn from another stream.
        total_num_processes, worker_info, record_metrics: of RLinf; not needed here.

    Raises:
        UsageError: an invalid entry or option.
    """

    def __init__(
        self,
        cfg: Any,
        num_envs: int,
        seed_offset: int = 0,
        total_num_processes: int = 1,
        worker_info: Any = None,
        record_metrics: bool = True,
    ) -> None:
        self.cfg = cfg
        self.seed = int(_entry(cfg, "seed", 0)) + seed_offset
        self.auto_reset = bool(_entry(cfg, "auto_reset", False))
        self.ignore_terminations = bool(_entry(cfg, "ignore_terminations", False))
        self.use_fixed_reset_state_ids = bool(
            _entry(cfg, "use_fixed_reset_state_ids", True)
        )
        self.use_rel_reward = bool(_entry(cfg, "use_rel_reward", False))
        self.reward_mode = str(_entry(cfg, "reward_mode", REWARDS[0]))
        if self.reward_mode not in REWARDS:
            raise unknown_name("reward_mode", self.reward_mode, REWARDS)
        self.group_size = int(_entry(cfg, "group_size", 1))
        if self.group_size < 1 or num_envs % self.group_size:
            raise wrong_value(
                "group_size", self.group_size, f"a divisor of the {num_envs} worlds"
            )
        self.num_group = num_envs // self.group_size
        self.total_num_group_envs = int(_entry(cfg, "num_starts", STARTS))
        options = dict(_entry(cfg, "init_params", {}))
        # Resets are made here, where groups of equal starts are known.
        self.env: SequentialTaskEnv = envs.make_train(
            **{"obs_mode": "rgb", **options}, num_envs=num_envs, autoreset="disabled"
        )
        self.num_envs = num_envs
        self.device = torch.device("cpu")
        self.single_action_space = self.env.single_action_space
        self.action_space = self.env.action_space
        self.is_start = True
        self.info_logging_keys: list[str] = []
        # Bounded, as a training of days would fill the memory.
        self.log: deque[dict[str, Any]] = deque(maxlen=LOGGED)
        self._generator = torch.Generator().manual_seed(self.seed)
        self._sentences: list[str] = [""] * num_envs
        self._episodes = torch.zeros(num_envs, dtype=torch.int64)
        self._over = torch.ones(num_envs, dtype=torch.bool)
        self.elapsed_steps = torch.zeros(num_envs, dtype=torch.int32)
        self.returns = torch.zeros(num_envs)
        self.prev_step_reward = torch.zeros(num_envs)
        self.success_once = torch.zeros(num_envs, dtype=torch.bool)
        self.fail_once = torch.zeros(num_envs, dtype=torch.bool)
        self.update_reset_state_ids()

    @property
    def instruction(self) -> list[str]:
        """The sentences of the B worlds."""
        return list(self._sentences)

    def update_reset_state_ids(self) -> None:
        """Draw the starts of the groups anew: ``reset_state_ids`` (B,), equal within a group."""
        drawn = self._drawn(self.num_group)
        self.reset_state_ids = drawn.repeat_interleave(self.group_size)

    def _drawn(self, count: int) -> Tensor:
        return torch.randint(
            self.total_num_group_envs, (count,), generator=self._generator
        )

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: nothing depends on it: a start is told by its number, and by the seed of the homes in init_params.
            options: "env_idx" (n,) worlds, all without it; "episode_id" (n,) their starts, by default those of
                their groups, or, without fixed ones, new ones for worlds that are reset alone.
        """
        given = options or {}
        every = torch.arange(self.num_envs)
        worlds = torch.as_tensor(given.get("env_idx", every))
        starts = given.get("episode_id")
        if starts is None:
            drawn = self.use_fixed_reset_state_ids or len(worlds) == self.num_envs
            starts = self.reset_state_ids[worlds] if drawn else self._drawn(len(worlds))
        # The environment takes episodes in the order of its worlds.
        order = torch.argsort(worlds)
        starts = torch.as_tensor(starts)[order]
        mask = torch.zeros(self.num_envs, dtype=torch.bool)
        mask[worlds] = True
        asked = {"episode": starts.numpy(), "reset_mask": mask.numpy()}
        obs, info = self.env.reset(options=asked)
        self._episodes[mask] = starts
        self._over[mask] = False
        for values in (self.elapsed_steps, self.returns, self.prev_step_reward):
            values[mask] = 0
        self.success_once[mask] = self.fail_once[mask] = False
        self.is_start = False
        return self._seen(obs, info), self._told(info)

    def step(
        self, actions: Any = None, auto_reset: bool = True
    ) -> tuple[dict[str, Any], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Take a control step with actions (B, A); worlds whose episode is over are paid nothing."""
        obs, paid, terminated, truncated, info = self.env.step(_numpy(actions))
        running = ~self._over
        infos = self._told(info)
        self.success_once |= infos["success"] & running
        self.fail_once |= infos["fail"] & running
        self.elapsed_steps += running
        reward = torch.where(running, self._reward(paid, infos["success"]), 0.0)
        self.returns += reward
        ends, cut = (
            torch.as_tensor(flags) & running for flags in (terminated, truncated)
        )
        if self.ignore_terminations:
            ends = torch.zeros_like(ends)
        done = ends | cut
        infos["episode"] = self._metrics(infos)
        self._over |= done
        self._note(done)
        seen = self._seen(obs, info)
        if done.any() and auto_reset and self.auto_reset:
            seen, infos = self._renewed(done, seen, infos)
        return seen, reward, ends, cut, infos

    def chunk_step(
        self, chunk_actions: Any
    ) -> tuple[list[dict[str, Any]], Tensor, Tensor, Tensor, list[dict[str, Any]]]:
        """Execute chunks (B, H, A); what ends within is told at the last action.

        Returns:
            H observations; rewards, terminations, truncations (B, H); H infos.
        """
        seen, rewards, ends, cuts, infos = zip(
            *(
                # A reset within a chunk would mix two episodes in one answer of the model.
                self.step(actions, auto_reset=False)
                for actions in np.moveaxis(_numpy(chunk_actions), 1, 0)
            ),
            strict=True,
        )
        observations, told = list(seen), list(infos)
        ended, cut = (torch.stack(flags, 1).any(1) for flags in (ends, cuts))
        if self.auto_reset and (ended | cut).any():
            observations[-1], told[-1] = self._renewed(
                ended | cut, observations[-1], told[-1]
            )
        flags = torch.zeros(2, self.num_envs, len(seen), dtype=torch.bool)
        flags[0, :, -1], flags[1, :, -1] = ended, cut
        return observations, torch.stack(rewards, 1), flags[0], flags[1], told

    def close(self) -> None:
        """Free the worlds."""
        self.env.close()

    def _reward(self, paid: Any, success: Tensor) -> Tensor:
        raw = self.reward_mode == "raw"
        reward = torch.as_tensor(paid).float() if raw else success.float()
        change = reward - self.prev_step_reward
        self.prev_step_reward = reward
        return change if self.use_rel_reward else reward

    def _renewed(
        self, done: Tensor, seen: dict[str, Any], infos: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the next episodes of worlds; what was last is told beside them."""
        observation, told = self.reset(options={"env_idx": done.nonzero()[:, 0]})
        last = {"final_observation": seen, "final_info": infos}
        flags = dict.fromkeys(
            ("_final_observation", "_final_info", "_elapsed_steps"), done
        )
        return observation, told | last | flags

    def _metrics(self, infos: Mapping[str, Tensor]) -> dict[str, Tensor]:
        found = {
            # Clones, as the worlds' own tensors are changed in place.
            "success_once": self.success_once.clone(),
            "fail_once": self.fail_once.clone(),
            "return": self.returns.clone(),
            "episode_len": self.elapsed_steps.clone(),
            "reward": self.returns / self.elapsed_steps.clamp_min(1),
        }
        if self.ignore_terminations:
            found |= {f"{name}_at_end": infos[name] for name in ("success", "fail")}
        return found

    def _note(self, done: Tensor) -> None:
        for world in done.nonzero()[:, 0].tolist():
            self.log.append(
                {
                    "episode": int(self._episodes[world]),
                    "sentence": self._sentences[world],
                    "success": bool(self.success_once[world]),
                    "return": float(self.returns[world]),
                    "steps": int(self.elapsed_steps[world]),
                }
            )

    def _told(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {name: torch.as_tensor(info[name]).clone() for name in ("success", "fail")}

    def _seen(self, obs: Mapping[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
        self._sentences = [str(sentence) for sentence in info["instruction"]]
        found: dict[str, Any] = {
            "states": torch.as_tensor(obs[STATE_KEY]).float(),
            "task_descriptions": self.instruction,
        }
        cameras = self.env.observer.cameras
        for name, camera in zip(IMAGES, cameras, strict=False):
            image = obs.get(camera_key(camera, "rgb"))
            if image is not None:
                found[name] = torch.as_tensor(image)
        return found


def _entry(cfg: Any, name: str, default: Any) -> Any:
    """An entry of a configuration of any kind."""
    value = cfg.get(name) if hasattr(cfg, "get") else getattr(cfg, name, None)
    return default if value is None else value


def _numpy(actions: Any) -> np.ndarray:
    if isinstance(actions, Tensor):
        # numpy has no bfloat16, in which such models compute.
        actions = actions.detach().cpu().float().numpy()
    return np.asarray(actions, np.float32)
