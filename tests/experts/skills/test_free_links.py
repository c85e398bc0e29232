"""What nothing brakes stays open when the expert has let go of it."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import pytest

import mjhab
from mjhab.experts import make_expert
from mjhab.experts.skills import leaving
from mjhab.rollout.loop import rollout
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink


class Kept(Sink):
    """The records of the episodes, and how far the link was open at their ends [m or rad]."""

    def __init__(self) -> None:
        self.records: list[EpisodeRecord] = []
        self.opening = 0.0

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        self.records.append(record)
        self.opening = env.view(world).link_q(env.config.target)


@pytest.mark.parametrize(
    ("target", "episode"),
    [
        # The door drifted shut at 0.05 rad/s, with which the hand had let go of it.
        ("fridge/top_door", 26),
        # Open fingers touched the drawer on the way to rest, which flew shut at 0.5 m/s.
        ("kitchen_counter/drawer3", 9),
    ],
)
def test_doors_and_drawers_stay_open(target: str, episode: int) -> None:
    env = mjhab.make(
        task="set_table",
        subtask="open",
        target=target,
        split="val",
        profile="ms_hab",
        num_envs=1,
        threads=1,
        autoreset="disabled",
    )
    kept = Kept()
    rollout(env, make_expert(env), [episode], 0, [kept])
    (record,) = kept.records
    assert record.success_once and record.success_at_end
    full = env.view(0).home.links[target].range[1]
    env.close()
    # The door is let go of at 0.75 of its range, while it opens; the drawer is pulled to 0.95 and left.
    assert kept.opening > 0.94 * full


@pytest.mark.parametrize(
    ("opening", "speed", "free", "stays"),
    [
        (1.8, 0.0, True, True),
        (1.8, -0.3, True, True),
        (1.2, 0.3, True, True),
        (1.2, 0.05, True, False),
        (1.2, -0.3, True, False),
        (1.2, 0.3, False, False),
    ],
)
def test_a_free_link_that_opens_counts_as_open(
    opening: float, speed: float, free: bool, stays: bool
) -> None:
    view = Mock(links_run_free=free)
    view.link_q.return_value = opening
    view.link_speed.return_value = speed
    assert leaving.stays_open(view, Mock(id="door"), enough=1.7) == stays
