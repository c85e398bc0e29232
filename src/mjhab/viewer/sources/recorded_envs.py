"""Environments of recorded episodes, made once per configuration."""

from __future__ import annotations

from mjhab.data.store.reading import RecordedEpisode
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.recorded import recorded_env


class RecordedEnvs:
    """Environments of one world with the configurations of recorded episodes. Only one thread may use them."""

    def __init__(self) -> None:
        self._envs: dict[str, SequentialTaskEnv] = {}

    def of(self, episode: RecordedEpisode) -> SequentialTaskEnv:
        """Return the environment of an episode's configuration.

        Raises:
            UsageError: a file or an asset pack that it was recorded with is not installed.
        """
        run = episode.run
        if run.config_id not in self._envs:
            self._envs[run.config_id] = recorded_env(run, num_envs=1, threads=1)
        return self._envs[run.config_id]

    def close(self) -> None:
        """Close all environments."""
        for env in self._envs.values():
            env.close()
