"""SubtaskTrain: one subtask, over and over, with dense rewards: what policies are trained in."""

from __future__ import annotations

import dataclasses

from mjhab.config.env import TrainConfig
from mjhab.core.seeding import stream
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.episodes.generator import Episode


class SubtaskTrainEnv(SequentialTaskEnv):
    """A SequentialTask of one subtask whose arrangements come from a pool. Build it with `mjhab.envs.make_train`.

    Where the robot starts, which target of the arrangement is meant and how far links stand open are drawn anew by
    (seed, world, episode); only the arrangement of objects is one of ``config.episode_pool``, because settling it
    costs more than a whole episode of control steps is worth.
    """

    config: TrainConfig

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        self._pool: dict[tuple[int, int], Episode] = {}

    def make_episode(self, seed: int, index: int) -> Episode:
        pool = self.config.episode_pool
        if not pool or self.config.episodes_file or self.starts.spawn_set is not None:
            return super().make_episode(seed, index)
        key = (self.config.seed, int(stream(seed, "pool", index).integers(pool)))
        if key not in self._pool:
            self._pool[key] = super().make_episode(*key)
        return dataclasses.replace(self._pool[key], seed=seed, index=index)
