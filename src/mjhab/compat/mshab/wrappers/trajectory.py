"""A file of trajectories in MS-HAB's layout: groups ``traj_0``, ``traj_1``, ... and a JSON file beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.compat.mshab.tools.json_files import dump_json
from mjhab.compat.mshab.tools.labels import get_episode_label_and_events
from mjhab.compat.mshab.worlds.env import MsHabEnv
from mjhab.core.version import __version__
from mjhab.data.imports.ms_hab_layout import TRAJECTORY

PICTURES = ("rgb", "depth", "segmentation")
GZIP_LEVEL = 5
"""Compression of pictures, as there."""
_UNTOLD = ("task_plans", "spawn_data_fp")


class TrajectoryFile:
    """Trajectories that are added one by one.

    Attributes:
        episodes: what the JSON file says of each.

    Args:
        path: the HDF5 file; an old one is replaced.
        env: the environment of `worlds.env`.
        max_episode_steps: of the environment.
        about: further entries of the JSON file.
    """

    def __init__(
        self,
        path: Path,
        env: MsHabEnv,
        max_episode_steps: int | None,
        about: Mapping[str, Any],
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = h5py.File(path, "w")
        self._json = path.with_suffix(".json")
        self.episodes: list[dict[str, Any]] = []
        spec = env.spec
        kwargs = {} if spec is None else spec.kwargs
        told = {k: v for k, v in kwargs.items() if k not in _UNTOLD}
        self._about = {
            "env_info": {
                "env_id": None if spec is None else spec.id,
                "env_kwargs": told,
                "max_episode_steps": max_episode_steps,
            },
            "commit_info": {"mjhab": __version__},
            **about,
        }

    def add(
        self, arrays: Mapping[str, Any], about: Mapping[str, Any], *, with_info: bool
    ) -> None:
        """Append a trajectory.

        Args:
            arrays: "obs", "told" and perhaps "state" with T+1 rows, in nested dicts; "action", "terminated",
                "truncated", perhaps "reward", and "info" with T rows.
            about: its entry in the JSON file.
            with_info: whether "told", `info` from the start on, is written as a group "info".
        """
        number = len(self.episodes)
        # h5py would list members by name; readers lay the state out in the order of writing.
        group = self._file.create_group(f"{TRAJECTORY}{number}", track_order=True)
        _put(group, "obs", arrays["obs"])
        group["actions"] = arrays["action"].astype(np.float32)
        for name in ("terminated", "truncated"):
            group[name] = arrays[name].astype(bool)
        for name in ("success", "fail"):
            group[name] = arrays["info"][name].astype(bool)
        if with_info:
            _put(group, "info", arrays["told"])
        if "state" in arrays:
            _put(group, "env_states", arrays["state"])
        if "reward" in arrays:
            group["rewards"] = arrays["reward"].astype(np.float32)
        self.episodes.append({"episode_id": number, **about})

    def clean(self) -> None:
        """Remove the trajectories without a step, and number the others anew."""
        kept: list[dict[str, Any]] = []
        for episode in self.episodes:
            name = f"{TRAJECTORY}{episode['episode_id']}"
            if not episode["elapsed_steps"]:
                del self._file[name]
                continue
            number = len(kept)
            if number != episode["episode_id"]:
                # Readers count from 0 without gaps.
                self._file.move(name, f"{TRAJECTORY}{number}")
            kept.append({**episode, "episode_id": number})
        self.episodes = kept

    def describe(self) -> None:
        """Write the JSON file."""
        dump_json(self._json, {**self._about, "episodes": self.episodes}, indent=2)

    def close(self) -> None:
        """Write the JSON file and close the HDF5 file."""
        self.describe()
        self._file.close()


def described_episode(
    env: MsHabEnv, world: int, arrays: Mapping[str, Any], labelled: bool
) -> dict[str, Any]:
    """What the JSON file says of the episode that a world has just finished."""
    info = arrays["info"]
    success = info["success"]
    about: dict[str, Any] = {
        "episode_seed": env._episode_seed.tolist(),
        "build_config_idx": env.build_config_idxs[world],
        "task_plan_idx": int(env.task_plan_idxs[world]),
        "init_config_idx": env.init_config_idxs[world],
        "spawn_selection_idx": env.spawn_selection_idxs[world],
        "control_mode": env.control_mode,
        "elapsed_steps": len(success),
    }
    if labelled:
        label, events, verbose = get_episode_label_and_events(
            env.task_cfgs, success, info
        )
        about |= {"label": label, "events": events, "events_verbose": verbose}
        about["articulation_type"] = _furniture(env.task_plans[world].subtasks[0])
    return {
        **about,
        "reset_kwargs": {},
        "success": bool(success[-1:].any()),
        "success_once": bool(success.any()),
        "success_at_end": bool(success[-1:].any()),
        "fail": bool(info["fail"][-1:].any()),
    }


def _furniture(subtask: Any) -> str | None:
    """Kind of furniture of a subtask."""
    behind = getattr(subtask, "articulation_config", None) or subtask
    return getattr(behind, "articulation_type", None)


def _put(parent: h5py.Group, name: str, values: Any) -> None:
    """Write an array, or a dict of them as a group that keeps their order."""
    if isinstance(values, Mapping):
        group = parent.create_group(name, track_order=True)
        for key, value in values.items():
            _put(group, key, value)
        return
    squeeze = (
        {"compression": "gzip", "compression_opts": GZIP_LEVEL}
        if name in PICTURES
        else {}
    )
    parent.create_dataset(name, data=values, **squeeze)
