"""``make_env(EnvConfig(...))``: an environment in all its wrappers, as MS-HAB's scripts make it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium

from mjhab.compat.mshab.files.plans import plan_data_from_file
from mjhab.compat.mshab.wrappers.action import FetchActionWrapper
from mjhab.compat.mshab.wrappers.observation import (
    DEPTH_KEYS,
    DepthFrameStack,
    FetchDepthObservationWrapper,
    StackedDictObservationWrapper,
)
from mjhab.compat.mshab.wrappers.record import RecordEpisode
from mjhab.compat.mshab.wrappers.statistics import VectorRecordEpisodeStatistics
from mjhab.compat.mshab.wrappers.vector import ManiSkillVectorEnv
from mjhab.core.errors import warn_once

_WORDS = {"None": None, "True": True, "False": False}
_LIST = ("<list>", "</list>")
VIDEO_FPS = 20


def recursive_fix_env_kwargs(env_kwargs: Any, inplace: bool = False) -> Any:
    """Texts of a command line as values: "None", "True", "False", and ``<list>a, b</list>`` as ``["a", "b"]``."""
    if isinstance(env_kwargs, dict):
        fixed = {
            key: recursive_fix_env_kwargs(value) for key, value in env_kwargs.items()
        }
        if not inplace:
            return fixed
        env_kwargs.update(fixed)
        return env_kwargs
    if not isinstance(env_kwargs, str):
        return env_kwargs
    if all(mark in env_kwargs for mark in _LIST):
        inside = env_kwargs.replace(_LIST[0], "").replace(_LIST[1], "")
        return [item.strip() for item in inside.split(",")]
    return _WORDS.get(env_kwargs, env_kwargs)


@dataclass
class MsHabEnvConfig:
    """What `make_env` makes.

    Attributes:
        env_id, num_envs, max_episode_steps: as ``gymnasium.make`` takes them.
        make_env: kept for the configuration files of scripts; nothing reads it.
        obs_mode, render_mode, shader_dir, sim_backend: arguments of the environment.
        continuous_task: only time ends an episode.
        cat_state, cat_pixels: of `FetchDepthObservationWrapper`.
        frame_stack: frames of depth that are stacked below "pixels"; None: ``stack`` frames of all entries.
        stationary_base, stationary_torso, stationary_head: of `FetchActionWrapper`.
        task_plan_fp, spawn_data_fp: files of plans and of their starts.
        record_video, save_video_freq, info_on_video: films of all worlds, of every so manieth episode, with numbers.
        debug_video, debug_video_gen: films with numbers, too.
        extra_stat_keys: of `VectorRecordEpisodeStatistics`.
        env_kwargs: further arguments of the environment.
    """

    env_id: str
    num_envs: int
    max_episode_steps: int
    make_env: bool = True
    obs_mode: str = "depth"
    render_mode: str = "all"
    shader_dir: str = "minimal"
    sim_backend: str = "gpu"
    continuous_task: bool = True
    cat_state: bool = True
    cat_pixels: bool = False
    frame_stack: int | None = 3
    stack: int | None = None
    stationary_base: bool = False
    stationary_torso: bool = False
    stationary_head: bool = True
    task_plan_fp: str | None = None
    spawn_data_fp: str | None = None
    record_video: bool = True
    debug_video: bool = False
    debug_video_gen: bool = False
    save_video_freq: int | None = None
    info_on_video: bool = True
    extra_stat_keys: list[str] | str = field(default_factory=list)
    env_kwargs: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.extra_stat_keys = recursive_fix_env_kwargs(self.extra_stat_keys)
        self.env_kwargs = recursive_fix_env_kwargs(self.env_kwargs)


EnvConfig = MsHabEnvConfig
"""The name by which scripts import it."""


def make_env(
    env_cfg: MsHabEnvConfig,
    video_path: str | Path | None = None,
    wrappers: Sequence[Callable[[gymnasium.Env], gymnasium.Env]] = (),
) -> VectorRecordEpisodeStatistics:
    """Make an environment in its wrappers.

    Args:
        env_cfg: what to make.
        video_path: folder of the films.
        wrappers: put around the bare environment, before all others.

    Raises:
        UsageError: files or arguments do not fit.
    """
    env = gymnasium.make(
        env_cfg.env_id,
        max_episode_steps=env_cfg.max_episode_steps,
        obs_mode=env_cfg.obs_mode,
        reward_mode="normalized_dense",
        control_mode="pd_joint_delta_pos",
        render_mode=env_cfg.render_mode,
        shader_dir=env_cfg.shader_dir,
        robot_uids="fetch",
        num_envs=env_cfg.num_envs,
        sim_backend=env_cfg.sim_backend,
        **_file_arguments(env_cfg),
    )
    for wrapper in wrappers:
        env = wrapper(env)
    env = _observed(env, env_cfg)
    if env_cfg.record_video:
        env = _filmed(env, env_cfg, video_path)
    env = FetchActionWrapper(
        env,
        stationary_base=env_cfg.stationary_base,
        stationary_torso=env_cfg.stationary_torso,
        stationary_head=env_cfg.stationary_head,
    )
    vector = ManiSkillVectorEnv(env, ignore_terminations=env_cfg.continuous_task)
    return VectorRecordEpisodeStatistics(
        vector,
        extra_stat_keys=env_cfg.extra_stat_keys,
        max_episode_steps=env_cfg.max_episode_steps,
    )


def _file_arguments(config: MsHabEnvConfig) -> dict[str, Any]:
    """Arguments of the environment, with the plans of the file for those that are not given."""
    given = dict(config.env_kwargs)
    if config.task_plan_fp is not None:
        plans = plan_data_from_file(Path(config.task_plan_fp).expanduser())
        given.setdefault("task_plans", plans.plans)
        given.setdefault("scene_builder_cls", plans.dataset)
    if config.spawn_data_fp is not None:
        given["spawn_data_fp"] = Path(config.spawn_data_fp).expanduser()
    return given


def _observed(env: gymnasium.Env, config: MsHabEnvConfig) -> gymnasium.Env:
    env = FetchDepthObservationWrapper(
        env, cat_state=config.cat_state, cat_pixels=config.cat_pixels
    )
    if config.frame_stack is not None:
        keys = ("all_depth",) if config.cat_pixels else DEPTH_KEYS
        return DepthFrameStack(env, config.frame_stack, keys)
    if config.stack is not None:
        return StackedDictObservationWrapper(env, config.stack)
    return env


def _filmed(
    env: gymnasium.Env, config: MsHabEnvConfig, folder: str | Path | None
) -> gymnasium.Env:
    if config.debug_video:
        warn_once("debug_video: films are those of record_video with info_on_video.")
    steps = config.max_episode_steps
    every = config.save_video_freq
    return RecordEpisode(
        env,
        output_dir=folder or ".",
        save_trajectory=False,
        max_steps_per_video=steps,
        save_video_trigger=None
        if every is None
        else lambda step: step // steps % every == 0,
        avoid_overwriting_video=True,
        video_fps=VIDEO_FPS,
        info_on_video=config.info_on_video or config.debug_video,
    )
