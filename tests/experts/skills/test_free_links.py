"""What nothing brakes stays open when the expert has let go of it."""

from __future__ import annotations

from typing import Any

import pytest

import mjhab
from mjhab.experts import make_expert
from mjhab.rollout.loop import rollout
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink


class Kept(Sink):
    """The records of the episodes."""

    def __init__(self) -> None:
        self.records: list[EpisodeRecord] = []

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        self.records.append(record)


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
    env.close()
