"""Entries of `info`: signals, progress, faults of the simulation, and the description of every world's episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjhab.config.env import EnvConfig
from mjhab.core.frozen import FrozenMap
from mjhab.episodes.generator import Episode
from mjhab.episodes.narration import Narrator
from mjhab.layout.layout import Layout
from mjhab.tasks.instructions import with_teleports
from mjhab.tasks.plan import TaskPlan

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
"""Signals of the active subtask that `info` contains under their own names, (W,) bool."""


class Reporter:
    """Describes the episodes of W worlds, each once.

    Args:
        num_worlds: W.
        layout: of the worlds.
        config: of the environment.
    """

    def __init__(self, num_worlds: int, layout: Layout, config: EnvConfig) -> None:
        self._narrator = Narrator(layout)
        self._config = config
        self._described: list[TaskPlan | None] = [None] * num_worlds
        self._descriptions: list[Mapping[str, Any]] = [{} for _ in range(num_worlds)]

    def describe(
        self, world: int, episode: Episode | None, plan: TaskPlan
    ) -> Mapping[str, Any] | None:
        """The episode a world is in: see `describe_episode`; None for no episode."""
        if episode is None:
            return None
        if self._described[world] is not plan:
            self._described[world] = plan
            self._descriptions[world] = describe_episode(
                episode, plan, self._config, self._narrator
            )
        return self._descriptions[world]


def describe_episode(
    episode: Episode, plan: TaskPlan, config: EnvConfig, narrator: Narrator
) -> Mapping[str, Any]:
    """Description of an episode in `info`: name, home, plan and instructions, read-only.

    Args:
        episode: which one.
        plan: the subtasks that are asked for.
        config: of the environment: what is done alone, and whether it navigates by teleport.
        narrator: gives "instruction", the sentence for the whole episode, and "instructions", one per subtask.
    """
    entries = ({"kind": s.name, "target": s.target, "goal": s.goal_pos} for s in plan.subtasks)
    sentences = narrator.instructions(episode, plan, alone=bool(config.subtask))
    if config.teleports:
        sentences = with_teleports(sentences, [s.name for s in plan.subtasks])
    # The same object is in every info until the next episode; it is read-only, so that callers cannot change it.
    return FrozenMap(
        {
            "seed": episode.seed,
            "index": episode.index,
            "home": episode.home,
            "task": episode.task,
            "split": episode.split,
            "subtask": config.subtask or None,
            "plan": tuple(FrozenMap(entry) for entry in entries),
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
