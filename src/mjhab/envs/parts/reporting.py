"""Entries of `info`: signals, progress, faults of the simulation, and the description of every world's episode."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.config.perturbing import described
from mjhab.core.arrays import may_hold
from mjhab.core.typed.frozen import FrozenMap
from mjhab.envs.parts.perturbing import in_other_words
from mjhab.episodes.episode import Episode
from mjhab.episodes.narration import InstructionGenerator
from mjhab.layout.layout import Layout
from mjhab.robots.registry import robot_named
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
    """Describes the episodes of W worlds; each description is made once.

    Args:
        num_worlds: W.
        layout: layout of the worlds.
        config: options of the environment.
    """

    def __init__(self, num_worlds: int, layout: Layout, config: EnvConfig) -> None:
        self._narrator = InstructionGenerator(layout)
        self._config = config
        self._described: list[TaskPlan | None] = [None] * num_worlds
        self._descriptions: list[Mapping[str, Any]] = [{} for _ in range(num_worlds)]
        # The last result of `entries`; most worlds have the same plan and pointer in the next step.
        self._reported: list[TaskPlan | None] = [None] * num_worlds
        self._pointer = np.full(num_worlds, -1, np.int64)
        self._specs = np.full(num_worlds, None, object)
        self._sentences = np.full(num_worlds, "", object)
        self._paid = np.full(num_worlds, config.reward, object)
        # The same array is in every info.
        self._paid.setflags(write=False)

    def describe(
        self, world: int, episode: Episode | None, plan: TaskPlan
    ) -> Mapping[str, Any] | None:
        """Description of a world's episode, see `describe_episode`; None without an episode."""
        if episode is None:
            return None
        # By identity: every episode has a plan of its own.
        if self._described[world] is not plan:
            self._described[world] = plan
            self._descriptions[world] = describe_episode(
                episode, plan, self._config, self._narrator
            )
        return self._descriptions[world]

    def wordings(self, episode: Episode, plan: TaskPlan) -> tuple[tuple[str, ...], ...]:
        """All wordings of each subtask of an episode, see `InstructionGenerator.wordings`."""
        return self._narrator.wordings(episode, plan)

    def entries(
        self,
        episodes: Sequence[Episode | None],
        plans: Sequence[TaskPlan],
        pointer: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Make the entries "episode_spec", "instruction" and "reward_mode" of `info`.

        Args:
            episodes: (W,) episodes.
            plans: (W,) plans.
            pointer: (W,) int64 index of the active subtask.

        Returns:
            (W,) arrays of objects: descriptions of the episodes, sentences of the active subtasks, and the mode of the
            reward that is paid.
        """
        moved = pointer != self._pointer
        if may_hold(moved) or not all(map(operator.is_, plans, self._reported)):
            for world, plan in enumerate(plans):
                if moved[world] or self._reported[world] is not plan:
                    self._tell(world, episodes[world], plan, int(pointer[world]))
            # The environment may write into its own.
            self._pointer = pointer.copy()
        return {
            # Copies, as arrays that were returned are never modified.
            "instruction": self._sentences.copy(),
            "episode_spec": self._specs.copy(),
            "reward_mode": self._paid,
        }

    def _tell(
        self, world: int, episode: Episode | None, plan: TaskPlan, pointer: int
    ) -> None:
        """Set the description and the sentence of a world to those of an episode at ``pointer``."""
        spec = self.describe(world, episode, plan)
        self._specs[world] = spec
        self._sentences[world] = active_instruction(spec, pointer)
        # Without an episode it must be told once there is one.
        self._reported[world] = plan if spec is not None else None


def describe_episode(
    episode: Episode, plan: TaskPlan, config: EnvConfig, narrator: InstructionGenerator
) -> Mapping[str, Any]:
    """Describe an episode for `info`: seed, index, home, plan and instructions, read-only.

    "skipped_homes", names of homes without room in whose place its home was taken, is there only if there are any;
    "perturbation", what was drawn by axis (`perturbing.described`), only if something is perturbed.

    Args:
        episode: the episode.
        plan: its subtasks.
        config: options of the environment; gives the single subtask.
        narrator: makes "instruction", the sentence for the whole episode, and "instructions", one per subtask.
    """
    entries = (
        {"kind": s.name, "target": s.target, "goal": s.goal_pos} for s in plan.subtasks
    )
    sentences = narrator.instructions(episode, plan, alone=bool(config.subtask))
    robot = robot_named(config.robot)
    drawn = config.perturbations.drawn(episode.seed, episode.index, robot)
    sentences = in_other_words(drawn, sentences)
    told = described(drawn, episode.perturbed)
    perturbed = FrozenMap({axis: FrozenMap(values) for axis, values in told.items()})
    skipped = episode.skipped_homes
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
            **({"skipped_homes": skipped} if skipped else {}),
            **({"perturbation": perturbed} if perturbed else {}),
        }
    )


def active_instruction(episode: Mapping[str, Any] | None, pointer: int) -> str:
    """The instruction of the subtask at ``pointer`` of a described episode; "" without an episode."""
    if episode is None:
        return ""
    sentences = episode["instructions"]
    # A finished plan keeps its last sentence.
    return sentences[min(pointer, len(sentences) - 1)]
