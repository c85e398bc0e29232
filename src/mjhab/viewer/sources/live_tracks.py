"""Tracks of running worlds: begun at resets, extended by control steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.data.record.recorder import signal_rows
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.rollout.records import PlanEntry
from mjhab.rollout.sinks import StepView
from mjhab.viewer.sources.track import Moment, Track, force_limits


def begin_tracks(
    tracks: list[Track | None],
    env: SequentialTaskEnv,
    info: Mapping[str, Any],
    mask: np.ndarray,
) -> None:
    """Replace the tracks of the worlds ``mask`` (W,) bool, which were reset, by tracks with their first state."""
    checks, _ = signal_rows(env.signals)
    for w in np.flatnonzero(mask).tolist():
        track = _new_track(env, info["episode_spec"][w])
        track.moments.append(_moment(env, info, w, checks[w]))
        tracks[w] = track


def extend_tracks(
    tracks: list[Track | None], env: SequentialTaskEnv, step: StepView
) -> None:
    """Append state, events and endings of a control step to the tracks of the worlds that made it."""
    checks, _ = signal_rows(env.outcome_signals)
    for w in np.flatnonzero(step.active).tolist():
        track = tracks[w]
        assert track is not None
        now = int(step.steps[w])
        track.events += [(now, str(name)) for name in step.info["events"][w]]
        ended = step.info["ended"][w]
        if ended is not None:
            track.ended[int(ended["index"])] = str(ended["label"] or "")
        terms = step.info.get("reward_terms", {})
        moment = dataclasses.replace(
            _moment(env, step.info, w, checks[w]),
            reward=float(step.reward[w]),
            terms={name: float(values[w]) for name, values in terms.items()},
            actor=step.notes.actors[int(step.notes.actor[w])],
        )
        track.moments.append(moment)


def _new_track(env: SequentialTaskEnv, episode: Mapping[str, Any]) -> Track:
    plan = tuple(
        PlanEntry(str(entry["kind"]), str(entry["target"]), entry["goal"])
        for entry in episode["plan"]
    )
    what = episode["subtask"] or episode["task"]
    title = f"{what}, episode {episode['index']} of seed {episode['seed']}"
    return Track(
        title,
        str(episode["home"]),
        int(episode["index"]),
        plan,
        force_limits(plan, env.task_config),
        str(episode["instruction"]),
        tuple(episode["instructions"]),
    )


def _moment(
    env: SequentialTaskEnv, info: Mapping[str, Any], world: int, checks: np.ndarray
) -> Moment:
    return Moment(
        env.sim.qpos[world].copy(),
        int(info["pointer"][world]),
        float(info["robot_force"][world]),
        float(info["cumulative_force"][world]),
        checks,
    )
