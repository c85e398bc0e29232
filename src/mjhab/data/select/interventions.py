"""Interventions: control steps in which a person, or in rounds of DAgger the expert, corrected a policy."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mjhab.core.action_notes import EXPERT, HUMAN, NOVICE, TAKE_OVER
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.reading import RecordedEpisode
from mjhab.rollout.policy import ZeroPolicy


def corrector_of(run: RunInfo, acted: Iterable[str]) -> str:
    """Name of the actor that corrected another one in an episode; "" if nobody did.

    Where the other one stood still (`ZeroPolicy`), the episode is a demonstration with a pause.

    Args:
        run: of the episode.
        acted: names of those who acted in it.
    """
    others = set(acted) - {ZeroPolicy.name}
    name = EXPERT if run.policy == TAKE_OVER else HUMAN
    return name if name in others and len(others) > 1 else ""


def intervention_steps(episode: RecordedEpisode) -> np.ndarray:
    """(N,) bool mask of the control steps of a recorded episode that are interventions."""
    actor = episode.array("actor")
    acted = [episode.actors[number] for number in np.unique(actor)]
    name = corrector_of(episode.run, acted)
    if not name:
        return np.zeros(episode.steps, bool)
    return actor == episode.actors.index(name)


def taught_steps(episode: RecordedEpisode) -> np.ndarray:
    """(N,) bool mask of the control steps of a recorded episode that imitation learns from.

    Where a person corrected, these are the person's steps, and the scripted expert's. Where a student and another
    policy acted, the student's steps are excluded. If the student acted alone, for instance in data of `mjhab generate
    --policy CHECKPOINT`, all steps are included.
    """
    actor = episode.array("actor")
    steps = intervention_steps(episode)
    if steps.any():
        # What the policy did before it was corrected is what it should not learn.
        return steps | (np.array(episode.actors)[actor] == EXPERT)
    if NOVICE not in episode.actors or len(episode.actors) == 1:
        return np.ones(episode.steps, bool)
    return actor != episode.actors.index(NOVICE)
