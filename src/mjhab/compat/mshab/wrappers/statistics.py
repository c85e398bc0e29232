"""Returns, lengths and successes of episodes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import torch
from gymnasium.vector import VectorEnv, VectorWrapper

from mjhab.core.errors import unknown_name


class VectorRecordEpisodeStatistics(VectorWrapper):
    """Counts the episodes of a `ManiSkillVectorEnv`.

    In a step that ends episodes ``info["episode"]`` has (W,) "r" return, "l" length, "t" seconds, "s_o" success in some
    step, "s_e" success in the last step, 0 for worlds that go on, and ``info["_episode"]`` (W,) bool those that ended.
    mjhab adds "s_t": success in some step before the first failure, as an evaluation counts that ends at failures
    (the other rule of termination, whatever the environment's is).

    Attributes:
        return_queue, length_queue, success_once_queue, success_at_end_queue: of all episodes since `reset_queues`.
        success_before_fail_queue: likewise, of "s_t".
        extra_stats: entry of ``info`` to its values (T,) in every step of each episode.

    Args:
        env: the vector environment.
        extra_stat_keys: entries of ``info`` that are kept for every step.
        max_episode_steps: longest episode [control steps].
    """

    def __init__(
        self,
        env: VectorEnv,
        extra_stat_keys: Sequence[str] = (),
        max_episode_steps: int = -1,
    ) -> None:
        super().__init__(env)
        self.extra_stat_keys = list(extra_stat_keys)
        self.max_episode_steps = max_episode_steps
        self.episode_count = 0
        self._begin()
        self.reset_queues()

    @property
    def unwrapped(self) -> Any:
        """The environment of `worlds.env`."""
        return self.env.unwrapped

    def reset_queues(self) -> None:
        """Forget the episodes counted so far."""
        self.return_queue: list[torch.Tensor] = []
        self.length_queue: list[torch.Tensor] = []
        self.success_once_queue: list[torch.Tensor] = []
        self.success_at_end_queue: list[torch.Tensor] = []
        self.success_before_fail_queue: list[torch.Tensor] = []
        self.extra_stats: dict[str, list[torch.Tensor]] = {
            key: [] for key in self.extra_stat_keys
        }

    def summary(self) -> dict[str, float]:
        """Shares of success of the episodes counted, under both rules of termination; mjhab's addition.

        "success_once", "success_at_end": of the episodes as they were run. "success_before_fail": had they ended at
        their first failure (force over the limit, time of a subtask over, a placed object displaced).
        """
        queues = {
            "return": self.return_queue,
            "success_once": self.success_once_queue,
            "success_at_end": self.success_at_end_queue,
            "success_before_fail": self.success_before_fail_queue,
        }
        means = {
            name: float(torch.stack(list(queue)).float().mean())
            if queue
            else float("nan")
            for name, queue in queues.items()
        }
        return {"episodes": float(len(self.return_queue)), **means}

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin episodes; all counts begin anew."""
        obs, info = self.env.reset(**kwargs)
        self._begin()
        return obs, info

    def _begin(self) -> None:
        count = self.env.num_envs
        device = self.env.unwrapped.device  # type: ignore[attr-defined]

        def zeros(dtype: torch.dtype) -> torch.Tensor:
            return torch.zeros(count, dtype=dtype, device=device)

        self._since = zeros(torch.float64) + time.perf_counter()
        self.episode_returns = zeros(torch.float32)
        self.episode_lengths = zeros(torch.int32)
        self.episode_success_onces = zeros(torch.bool)
        self._failed = zeros(torch.bool)
        self._before_fail = zeros(torch.bool)
        self._kept: dict[str, torch.Tensor] = {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        done = terminated | truncated
        any_done = bool(done.any())
        last = info["final_info"] if any_done else info
        self._keep(last)
        self.episode_returns = self.episode_returns + reward
        self.episode_lengths = self.episode_lengths + 1
        success = last["success"]
        self.episode_success_onces = self.episode_success_onces | success
        self._before_fail = self._before_fail | (success & ~self._failed)
        self._failed = self._failed | last["fail"]
        # Figures of the vector environment below have the same name and other contents.
        info.pop("episode", None)
        info.pop("_episode", None)
        if any_done:
            info["episode"] = self._ended(done, success)
            info["_episode"] = done
        return obs, reward, terminated, truncated, info

    def _ended(self, done: torch.Tensor, success: torch.Tensor) -> dict[str, Any]:
        """Count the worlds that ended, and begin their counts anew."""
        elapsed = time.perf_counter() - self._since
        told = {
            "r": self.episode_returns,
            "l": self.episode_lengths,
            "t": elapsed,
            "s_o": self.episode_success_onces,
            "s_e": success,
            "s_t": self._before_fail,
        }
        queues = {
            "r": self.return_queue,
            "l": self.length_queue,
            "s_o": self.success_once_queue,
            "s_e": self.success_at_end_queue,
            "s_t": self.success_before_fail_queue,
        }
        for name, queue in queues.items():
            queue.extend(told[name][done])
        for key, rows in self._kept.items():
            # The rows are written over by the next episodes.
            self.extra_stats[key].extend(rows[done].clone())
        self.episode_count += int(done.sum())
        masked = {name: values.masked_fill(~done, 0) for name, values in told.items()}
        self._since = torch.where(done, time.perf_counter(), self._since)
        self.episode_returns = self.episode_returns.masked_fill(done, 0)
        self.episode_lengths = self.episode_lengths.masked_fill(done, 0)
        self.episode_success_onces = self.episode_success_onces & ~done
        self._before_fail = self._before_fail & ~done
        self._failed = self._failed & ~done
        return masked

    def _keep(self, info: dict[str, Any]) -> None:
        """Note the entries of this step in the rows (W, T) of their episodes.

        Raises:
            UsageError: ``info`` has no such entry.
        """
        rows = torch.arange(self.num_envs, device=self.episode_lengths.device)
        for key in self.extra_stat_keys:
            if key not in info:
                raise unknown_name("entry of info in extra_stat_keys", key, info)
            values = info[key]
            if key not in self._kept:
                shape = (self.num_envs, self.max_episode_steps)
                self._kept[key] = torch.zeros(
                    shape, dtype=values.dtype, device=values.device
                )
            self._kept[key][rows, self.episode_lengths.long()] = values
