"""The JSON file beside a trajectory file: what it says of the environment, and of every trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.core.conventions.hand_turns import AS_MANISKILL
from mjhab.core.conventions.names import OBJECT_AXES, SCAN_AXES
from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.imports.ms_hab_layout import (
    SOURCE_TYPE,
    dataset_name,
    to_events,
    to_verbose,
)
from mjhab.data.select.describing import navigates_by_teleport
from mjhab.data.select.facts import target_of
from mjhab.data.store.episode_data import OLDER_ROBOT, last_label
from mjhab.data.store.reading import RecordedEpisode
from mjhab.rollout.records import Event
from mjhab.tasks.labelling.legacy import legacy_events
from mjhab.tasks.subtasks.registry import number_of

_OF_MANISKILL = {own: name for name, own in AS_MANISKILL.items()}
_PICTURES = {"rgb": "rgb", "depth": "depth", "seg": "segmentation"}
"""Outputs of cameras, and their names in ManiSkill's observation modes."""


def file_info(
    runs: Mapping[str, Mapping[str, Any]], episodes: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """What the file says.

    Args:
        runs: of the trajectories, fields of `RunInfo` by name of the run; the first one stands for the environment.
        episodes: of `episode_info`.
    """
    # Gymnasium ends episodes at this number, so that it must hold the longest trajectory.
    steps = max(each["elapsed_steps"] for each in episodes)
    return {
        "env_info": {
            **_made_with(next(iter(runs.values())), episodes[0]),
            "max_episode_steps": steps,
        },
        "commit_info": {"mjhab": [run["commit"] for run in runs.values()]},
        "source_type": SOURCE_TYPE,
        "source_desc": "recorded by mjhab (MuJoCo), not by ManiSkill",
        "conventions": CONVENTIONS,
        "runs": runs,
        # ManiSkillTrajectoryDataset(success_only=True) cannot begin with an episode that it leaves out.
        "episodes": sorted(episodes, key=lambda each: not each["success"]),
    }


def _made_with(run: Mapping[str, Any], first: Mapping[str, Any]) -> dict[str, Any]:
    """MS-HAB's id of an environment, and the arguments with which ``gymnasium.make`` makes it."""
    env = run["config"].get("env", {})
    subtask = env.get("subtask")
    layout = run["layout"]
    kwargs: dict[str, Any] = {
        "obs_mode": "+".join(_PICTURES[name] for name in first["pictures"]) or "state",
        "reward_mode": "normalized_dense",
        "control_mode": first["control_mode"],
        "robot_uids": layout.get("robot", OLDER_ROBOT),
        "num_envs": 1,
        # ManiSkill's replay makes the environment from these; a CPU is there on every machine.
        "sim_backend": "physx_cpu",
        "add_event_tracker_info": True,
    }
    if env.get("task"):
        kwargs["scene_builder_cls"] = dataset_name(env["task"], first["split"])
    sizes = {tuple(each["size"]) for each in layout.get("cameras", {}).values()}
    # ManiSkill's sensor_configs sets one size for all cameras.
    if len(sizes) == 1:
        height, width = sizes.pop()
        kwargs["sensor_configs"] = {"width": width, "height": height}
    kind = f"{subtask.capitalize()}SubtaskTrain" if subtask else "SequentialTask"
    return {"env_id": f"{kind}-v0", "env_kwargs": kwargs}


def control_mode(episode: RecordedEpisode) -> str:
    """Control mode of the run of an episode."""
    env = episode.run.config.get("env", {})
    return env.get("control_mode", "pd_joint_delta_pos")


def _axes_of(episode: RecordedEpisode) -> str:
    """Axes of the pose of the object in an exported episode."""
    # Without the headings of the scans, poses cannot be turned and stay as they were recorded.
    is_ours = episode.conventions.object_axes == OBJECT_AXES
    return OBJECT_AXES if is_ours and episode.scan_yaws is None else SCAN_AXES


def episode_info(number: int, episode: RecordedEpisode, steps: int) -> dict[str, Any]:
    """Metadata of the first ``steps`` control steps of an episode; labels are those of all of it."""
    record = episode.record
    # What came after the cut is not in the trajectory.
    events = [event for event in _events(episode) if event[0] <= steps]
    # MS-HAB names the articulation, not the link, and one file holds all its links.
    link = target_of(record).rpartition("/")[0]
    info = {
        "episode_id": number,
        "episode_seed": [record.seed],
        # Indices into MS-HAB's asset files have no counterpart; home and index identify the episode.
        **dict.fromkeys(
            (
                "build_config_idx",
                "task_plan_idx",
                "init_config_idx",
                "spawn_selection_idx",
            )
        ),
        "home": record.home,
        "episode_index": record.index,
        "control_mode": _OF_MANISKILL.get(control_mode(episode), control_mode(episode)),
        "elapsed_steps": steps,
        "navigation": "teleport" if navigates_by_teleport(episode) else "drive",
        "pictures": [name for name in _PICTURES if name in _outputs(episode)],
        "actors": list(episode.actors),
        "lacks": list(episode.lacks),
        "object_axes": _axes_of(episode),
        "joint_angles": episode.conventions.joint_angles,
        "label": last_label(record),
        "legacy_label": record.subtasks[-1].legacy_label if record.subtasks else None,
        "target": record.subtasks[-1].target
        if record.subtasks
        else record.plan[0].target,
        "split": record.split,
        "ending": str(episode.attributes["ending"]),
        "events": to_events(record.subtask, events)
        if record.subtask
        else [name for _, name in events],
        "events_verbose": to_verbose(events, record.force[:steps]),
        "articulation_type": link or None,
        "reset_kwargs": {},
        "success_once": record.success_once,
        "success_at_end": record.success_at_end,
        "fail": record.fail,
        # Last, because it replaces the outcome of the whole episode.
        **(_outcome_at(episode, steps) if steps < episode.steps else {}),
    }
    # ManiSkill's readers filter by it: whether the episode is successful in the end.
    return {**info, "success": info["success_at_end"]}


def _events(episode: RecordedEpisode) -> Sequence[Event]:
    """Events of an episode: those of one subtask count as if nothing had held before its first action, as in MS-HAB."""
    record = episode.record
    if not record.subtask or "signals/checks" in episode.run.absent:
        return record.events
    _, history = episode.history(0)
    return legacy_events(number_of(record.subtask), history)[0]


def _outputs(episode: RecordedEpisode) -> set[str]:
    """What the cameras of an episode recorded."""
    return {output for _, output in episode.images}


def _outcome_at(episode: RecordedEpisode, steps: int) -> dict[str, Any]:
    """Outcome of an episode that is cut after ``steps`` control steps."""
    success = episode.array("reward/success")[:steps].astype(bool)
    return {
        "ending": "cut",
        "success_once": bool(success.any()),
        "success_at_end": bool(success[-1]),
        "fail": bool(episode.array("reward/fail")[steps - 1]),
    }
