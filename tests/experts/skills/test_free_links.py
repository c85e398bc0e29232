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
    """The records of the episodes, and the share of its range by which the link was open at the end."""

    def __init__(self) -> None:
        self.records: list[EpisodeRecord] = []
        self.share_open = 0.0

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        self.records.append(record)
        view = env.view(world)
        link = view.home.links[env.config.target]
        self.share_open = view.link_q(link.id) / link.range[1]


def opened(target: str, episode: int, **options: Any) -> tuple[EpisodeRecord, float]:
    """The record of an episode of Open with the published joints, and how far the link is open at its end."""
    env = mjhab.make(
        task="set_table",
        subtask="open",
        target=target,
        split="val",
        profile="ms_hab",
        num_envs=1,
        threads=1,
        autoreset="disabled",
        **options,
    )
    kept = Kept()
    rollout(env, make_expert(env), [episode], 0, [kept])
    (record,) = kept.records
    env.close()
    return record, kept.share_open


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
    record, share_open = opened(target, episode)
    assert record.success_once and record.success_at_end
    # The door is let go of at 0.75 of its range, while it opens; the drawer is pulled to 0.95 and left.
    assert share_open > 0.94


def test_a_door_swings_on_where_a_wall_leaves_no_room_for_the_hand() -> None:
    record, share_open = opened("fridge/top_door", 1, home="builtin_m3_20")
    assert record.success_once and record.success_at_end
    assert 0.75 < share_open < 0.85


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
