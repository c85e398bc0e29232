"""What `info` tells: signals, progress, faults, and what the episode of every world is."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from mjhab.envs.parts.worlds import Worlds
from mjhab.episodes.generator import Episode
from mjhab.episodes.narration import Narrator
from mjhab.tasks.plan import KIND_NAMES, TaskPlan

CHECKERS = (
    "is_grasped",
    "at_goal",
    "ee_rest",
    "robot_rest",
    "is_static",
    "force_ok",
    "opened",
    "closed",
    "near",
    "oriented",
    "contact",
    "touch",
    "ee_contact",
)
"""Signals of the active subtask that info carries under their own names, (W,) bool."""


class Reporter:
    """Builds the info of an environment; descriptions of episodes are made once per episode."""

    def __init__(self, env: Worlds) -> None:
        self._env = env
        self._narrator = Narrator(env.layout)
        self._described: list[TaskPlan | None] = [None] * env.num_envs
        self._descriptions: list[Mapping[str, Any]] = [{} for _ in range(env.num_envs)]

    def info(self, events: list[list[str]], ended: list[dict[str, Any] | None]) -> dict[str, Any]:
        """Arrays (W,) that stay as they are, whatever the environment does next.

        "pointer", "kind" of the active subtask, "steps_left", "robot_force" [N], "cumulative_force" [N x steps],
        "success", "fail", "taint" (bits of `taint_names`), "nan_resets" so far, "spawn_fallback", the CHECKERS,
        "reward_terms" (name to (W,)); and lists of W: "events" of this step, "ended" (record of the subtask that
        ended in this step, or None), "instruction" (what the active subtask asks for, as a sentence; the last subtask
        once the plan is finished), "episode_spec" (the episode each world is in; not "episode", where Gymnasium's
        RecordEpisodeStatistics writes).
        """
        env = self._env
        s = env.signals
        p = env.progress
        assert s is not None
        info: dict[str, Any] = {
            "pointer": p.pointer,
            "kind": env.focus.kind,
            "steps_left": p.steps_left,
            "robot_force": s.robot_force,
            "cumulative_force": s.cumulative_force,
            "success": env.success.copy(),
            "fail": env.fail.copy(),
            "taint": env.sim.taint(),
            "nan_resets": env.nan_resets.copy(),
            "spawn_fallback": env.fallback.copy(),
            "reward_terms": env.reward_terms,
        }
        for name in CHECKERS:
            info[name] = getattr(s, name)
        info["events"] = events
        info["ended"] = ended
        info["episode_spec"] = [self.describe(w) for w in range(env.num_envs)]
        info["instruction"] = [
            active_instruction(episode, pointer)
            for episode, pointer in zip(info["episode_spec"], p.pointer.tolist(), strict=True)
        ]
        return info

    def nothing(self) -> tuple[list[list[str]], list[dict[str, Any] | None]]:
        """Events and ended subtasks of a step in which none came."""
        return [[] for _ in range(self._env.num_envs)], [None] * self._env.num_envs

    def describe(self, world: int) -> Mapping[str, Any] | None:
        """The episode a world is in: see `describe_episode`; None before the first reset."""
        env = self._env
        episode = env.episodes_now[world]
        if episode is None:
            return None
        plan = env.tables.plans[world]
        if self._described[world] is not plan:
            self._described[world] = plan
            self._descriptions[world] = describe_episode(
                episode, plan, env.config.subtask, self._narrator
            )
        return self._descriptions[world]


def describe_episode(
    episode: Episode, plan: TaskPlan, subtask: str, narrator: Narrator
) -> Mapping[str, Any]:
    """What `info` tells of an episode: its name, home, plan and instructions, read-only.

    Args:
        episode: which one.
        plan: the subtasks that are asked for.
        subtask: the kind that is done alone, or "".
        narrator: gives "instruction", the sentence for the whole episode, and "instructions", one per subtask.
    """
    entries = (
        {"kind": KIND_NAMES[s.kind], "target": s.target, "goal": s.goal_pos} for s in plan.subtasks
    )
    sentences = narrator.instructions(episode, plan, alone=bool(subtask))
    # The same object goes into every info until the next episode, so nobody may write into it.
    return MappingProxyType(
        {
            "seed": episode.seed,
            "index": episode.index,
            "home": episode.home,
            "task": episode.task,
            "split": episode.split,
            "subtask": subtask or None,
            "plan": tuple(MappingProxyType(entry) for entry in entries),
            "instruction": sentences.task,
            "instructions": sentences.subtasks,
        }
    )


def active_instruction(episode: Mapping[str, Any] | None, pointer: int) -> str:
    """The instruction of the subtask at ``pointer`` of a described episode; "" without an episode."""
    if episode is None:
        return ""
    sentences = episode["instructions"]
    return sentences[min(pointer, len(sentences) - 1)]
