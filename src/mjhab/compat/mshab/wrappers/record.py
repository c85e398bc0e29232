"""Trajectories (HDF5 and JSON) and films (mp4) of the worlds, as MS-HAB records them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch

from mjhab.compat.mshab.tools.pictures import put_info_on_image, tile_images
from mjhab.compat.mshab.tools.trees import mapped, to_numpy
from mjhab.compat.mshab.wrappers.film import RecordedFilm
from mjhab.compat.mshab.wrappers.forwarding import ForwardingWrapper
from mjhab.compat.mshab.wrappers.trajectory import TrajectoryFile, described_episode
from mjhab.compat.mshab.wrappers.vector import find_max_episode_steps_value
from mjhab.core.errors import UsageError, wrong_value


class RecordEpisode(ForwardingWrapper):
    """Records the episodes of every world; the observations are those of the environment below.

    A trajectory is written when its world begins the next episode, and at `close`.

    Args:
        env: an environment of `worlds.env`, perhaps in wrappers.
        output_dir: folder of the files.
        save_trajectory: write ``<trajectory_name>.h5`` and ``.json``.
        trajectory_name: default: date and time.
        save_video: write ``0.mp4``, ``1.mp4``, ... of all worlds side by side.
        info_on_video: with the numbers of `info` on it.
        save_on_reset: episodes are written when their worlds are reset; else only by `flush_trajectory`.
        save_video_trigger: whether a control step, counted from the beginning, is filmed.
        max_steps_per_video: length of a film; with more than one world it must be given.
        clean_on_close: at `close`, remove the trajectories without a step, which `flush_trajectory` can be asked for,
            and number the others anew.
        record_reward, record_env_state: whether rewards, and states (`get_state_dict`), are written.
        label_episode: label episodes of one subtask by the published rules.
        valid_episode_labels: labels of episodes that are written; all if None.
        max_trajectories: no more are written.
        video_fps: pictures per second.
        avoid_overwriting_video: skip the numbers of films that exist.
        source_type, source_desc: for the JSON file.

    Raises:
        UsageError: several worlds are filmed without max_steps_per_video, or chains are to be labelled.
    """

    WRITES_INFO: ClassVar[bool] = False
    """Whether a trajectory has `info`, too."""

    def __init__(
        self,
        env: gymnasium.Env,
        output_dir: str | Path,
        save_trajectory: bool = True,
        trajectory_name: str | None = None,
        save_video: bool = True,
        info_on_video: bool = False,
        save_on_reset: bool = True,
        save_video_trigger: Callable[[int], bool] | None = None,
        max_steps_per_video: int | None = None,
        clean_on_close: bool = True,
        record_reward: bool = True,
        record_env_state: bool = True,
        label_episode: bool = False,
        valid_episode_labels: Sequence[str] | None = None,
        max_trajectories: int | None = None,
        video_fps: int = 20,
        avoid_overwriting_video: bool = False,
        source_type: str | None = None,
        source_desc: str | None = None,
        render_substeps: bool = False,
    ) -> None:
        super().__init__(env)
        if render_substeps:
            raise wrong_value(
                "render_substeps", True, "left out: films have a picture per control step"
            )
        base = self.base_env
        if save_video and base.num_envs > 1 and max_steps_per_video is None:
            raise UsageError(
                "films of several worlds need max_steps_per_video, because their episodes end at different times."
            )
        if label_episode and not base.arguments.subtask:
            raise UsageError("label_episode is for environments of one subtask.")
        self.output_dir = Path(output_dir)
        self.max_episode_steps = find_max_episode_steps_value(env)
        self.save_trajectory = save_trajectory
        self.save_on_reset = save_on_reset
        self.max_trajectories = max_trajectories
        self.label_episode = label_episode
        self.valid_episode_labels = valid_episode_labels
        self._parts = {"reward": record_reward, "state": record_env_state}
        self._trigger = save_video_trigger
        self._filming = save_video
        self._info_on_video = info_on_video
        self._cleans = clean_on_close
        self._film = RecordedFilm(
            self.output_dir, video_fps, max_steps_per_video, avoid_overwriting_video
        )
        self._elapsed = 0
        self._closed = False
        self._steps: list[dict[str, Any]] = []
        self._begun = np.zeros(base.num_envs, np.int64)
        self._file: TrajectoryFile | None = None
        if save_trajectory:
            name = trajectory_name or time.strftime("%Y%m%d_%H%M%S")
            about = {"source_type": source_type, "source_desc": source_desc}
            self._file = TrajectoryFile(
                self.output_dir / f"{name}.h5",
                base,
                self.max_episode_steps,
                {key: text for key, text in about.items() if text is not None},
            )

    @property
    def base_env(self) -> Any:
        """The environment of `worlds.env`."""
        return self.env.unwrapped

    @property
    def num_envs(self) -> int:
        """Worlds."""
        return self.base_env.num_envs

    @property
    def num_saved_trajectories(self) -> int:
        """Trajectories written."""
        return 0 if self._file is None else len(self._file.episodes)

    @property
    def reached_max_trajectories(self) -> bool:
        """Whether no more trajectories will be written."""
        most = self.max_trajectories
        return most is not None and self.num_saved_trajectories >= most

    @property
    def save_video(self) -> bool:
        """Whether the present control step is filmed."""
        trigger = self._trigger
        return self._filming and (trigger is None or bool(trigger(self._elapsed)))

    # -- reset and step --------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None, **kwargs: Any
    ) -> tuple[Any, dict[str, Any]]:
        """Write the episodes that end, and begin new ones."""
        chosen = (options or {}).get("env_idx")
        begun = (
            np.arange(self.num_envs) if chosen is None else np.asarray(to_numpy(chosen))
        )
        if self.save_on_reset:
            # With several worlds a film spans the episodes of all, and ends by its length.
            if self.num_envs == 1:
                self.flush_video()
            if self._steps:
                self.flush_trajectory(env_idxs_to_flush=begun)
        obs, info = self.env.reset(seed=seed, options=options, **kwargs)
        self._first_info = info
        if self._file is not None:
            self._note_reset(begun, obs, info)
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step."""
        filmed = self.save_video
        # A film begins with the state before its first step.
        if filmed and not self._film.frames:
            self._film.add(self._picture(self._first_info))
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self._file is not None:
            self._steps.append(
                self._noted(obs, info)
                | {
                    "action": _rows(action),
                    "reward": _rows(reward),
                    "terminated": _rows(terminated),
                    "truncated": _rows(truncated),
                }
            )
        if filmed:
            shown = {**info, "reward": reward}
            self._film.add(self._picture(shown))
            if self._film.is_full:
                self.flush_video()
        self._elapsed += 1
        return obs, reward, terminated, truncated, info

    def _noted(self, obs: Any, info: Mapping[str, Any]) -> dict[str, Any]:
        """What is kept of a state of all worlds: arrays that later steps do not modify."""
        told = {
            name: _rows(values)
            for name, values in info.items()
            if isinstance(values, torch.Tensor)
        }
        step = {"obs": mapped(_rows, obs), "info": told}
        if self._parts["state"]:
            step["state"] = mapped(_rows, self.base_env.get_state_dict())
        return step

    def _note_reset(self, begun: np.ndarray, obs: Any, info: Mapping[str, Any]) -> None:
        """Begin the trajectories of the worlds ``begun`` with the present state."""
        first = self._noted(obs, info)
        if self._steps:
            # The last row of the others stays: their episodes go on.
            last = self._steps[-1]
            self._steps[-1] = {**last, **_merged(last, first, begun)}
        else:
            self._steps = [first]
        self._begun[begun] = len(self._steps) - 1
        oldest = int(self._begun.min())
        # Steps before the oldest episode that still runs are written, and would fill the memory.
        del self._steps[:oldest]
        self._begun -= oldest

    # -- files -----------------------------------------------------------------------------------------------------

    def flush_trajectory(
        self,
        verbose: bool = False,
        ignore_empty_transition: bool = True,
        env_idxs_to_flush: Any = None,
        save: bool = True,
    ) -> None:
        """Write the episodes of some worlds (default all), up to now; ``save=False`` drops them.

        A world without a step since its episode began has none; with ``ignore_empty_transition=False`` one of length 0.
        """
        file = self._file
        if file is None:
            return
        worlds = range(self.num_envs) if env_idxs_to_flush is None else env_idxs_to_flush
        for world in map(int, worlds):
            start = int(self._begun[world])
            steps = self._steps[start:]
            empty = len(steps) <= 1
            if self.reached_max_trajectories or (empty and ignore_empty_transition):
                continue
            if save:
                self._save(file, world, steps)
            self._begun[world] = len(self._steps) - 1
        file.describe()

    def _save(
        self, file: TrajectoryFile, world: int, steps: list[dict[str, Any]]
    ) -> None:
        kept = self._kept(steps, world)
        if kept == 0 and len(steps) > 1:
            return
        steps = steps[: 1 + kept]
        arrays = _stacked(steps, world, self._parts)
        actions = self.base_env.single_action_space.shape
        # Without a step nothing tells how wide an action is.
        arrays["action"] = arrays["action"].reshape(-1, *actions)
        labelled = self.label_episode and len(steps) > 1
        about = described_episode(self.base_env, world, arrays, labelled)
        if self._is_wanted(arrays, about):
            file.add(arrays, about, with_info=self.WRITES_INFO)

    def _kept(self, steps: list[dict[str, Any]], world: int) -> int:
        """Control steps of a world's episode that are written; ``steps`` has a row more, the start."""
        return len(steps) - 1

    def _is_wanted(self, arrays: Mapping[str, Any], about: Mapping[str, Any]) -> bool:
        """Whether an episode is written; ``arrays`` and ``about`` as in `TrajectoryFile.add`."""
        valid = self.valid_episode_labels
        return valid is None or about.get("label") in valid

    def flush_video(
        self, name: str | None = None, suffix: str = "", save: bool = True, **_: Any
    ) -> None:
        """Write the film up to now, ``<name>.mp4``; without a name it has the next number, and ``suffix``."""
        self._film.flush(name, suffix, save)

    def capture_image(self, info: Mapping[str, Any] | None = None) -> np.ndarray:
        """Picture (H, W, 3) uint8 of all worlds side by side."""
        return self._picture(info or {})

    def _picture(self, info: Mapping[str, Any] | None) -> np.ndarray:
        images = np.asarray(to_numpy(self.env.render()))
        if self._info_on_video and info:
            images = np.stack(
                [
                    put_info_on_image(image, _numbers(info, world))
                    for world, image in enumerate(images)
                ]
            )
        # About as many rows as columns, as ManiSkill tiles its worlds.
        return tile_images(images, nrows=int(np.sqrt(self.num_envs)))

    def close(self) -> None:
        """Write what is not written yet, and close the files and the worlds."""
        if self._closed:
            return
        self._closed = True
        if self._file is not None:
            if self.save_on_reset and self._steps:
                self.flush_trajectory()
            if self._cleans:
                self._file.clean()
            self._file.close()
        self._film.flush(None, "", save=self.save_on_reset)
        super().close()


def _rows(values: Any) -> np.ndarray:
    """A copy (W, ...) on the host."""
    # A copy: worlds on the host write into the same arrays in the next step.
    return np.array(to_numpy(values))


def _merged(last: Any, first: Any, begun: np.ndarray) -> Any:
    """``last`` with the rows of the worlds ``begun`` of ``first``; entries that ``first`` lacks are left out."""
    if isinstance(first, dict):
        return {
            key: _merged(last[key], first[key], begun) if key in last else first[key]
            for key in first
        }
    whole = last.copy()
    whole[begun] = first[begun]
    return whole


def _stacked(
    steps: list[dict[str, Any]], world: int, parts: Mapping[str, bool]
) -> dict[str, Any]:
    """One world's episode: "obs", "told" (`info` from the start on) and "state" with T+1 rows, the others with T."""
    after = steps[1:]
    names = [
        "action",
        "terminated",
        "truncated",
        *(["reward"] if parts["reward"] else []),
    ]
    made: dict[str, Any] = {
        name: np.array([step[name][world] for step in after]) for name in names
    }
    made["obs"] = _stacked_tree([step["obs"] for step in steps], world)
    # A reset may tell less than a step does.
    told = _stacked_tree([step["info"] for step in after or steps], world)
    made["info"] = told if after else mapped(lambda rows: rows[:0], told)
    common = [name for name in steps[0]["info"] if name in steps[-1]["info"]]
    rows = [{name: step["info"][name] for name in common} for step in steps]
    made["told"] = _stacked_tree(rows, world)
    if parts["state"]:
        made["state"] = _stacked_tree([step["state"] for step in steps], world)
    return made


def _stacked_tree(trees: list[Any], world: int) -> Any:
    if isinstance(trees[0], dict):
        return {
            key: _stacked_tree([tree[key] for tree in trees], world) for key in trees[0]
        }
    return np.stack([tree[world] for tree in trees])


def _numbers(info: Mapping[str, Any], world: int) -> dict[str, Any]:
    """Numbers of one world in `info`."""
    return {
        name: to_numpy(values[world])
        for name, values in info.items()
        if isinstance(values, torch.Tensor) and values.ndim == 1
    }
