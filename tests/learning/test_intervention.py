"""Take-over: who acts when, what is told of it, and what is learned from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from mjhab.core.action_notes import ActionNotes
from mjhab.data.record.generation import generate
from mjhab.data.record.job import Job
from mjhab.data.record.pools import InlinePool
from mjhab.data.record.recorder import Recorder
from mjhab.data.record.workers import Stage, WorkerSpec
from mjhab.data.select.interventions import taught_steps
from mjhab.data.store.places import episodes
from mjhab.data.store.shard import ShardWriter
from mjhab.learning.configs import DaggerConfig, InputConfig
from mjhab.learning.demos import load_demonstrations, observation_spec_of_data
from mjhab.learning.runs.intervention import Intervention, prefix_length
from mjhab.rollout.loop import rollout
from tests.data.fake_world import FakeEnv
from tests.learning.test_demos import EVERY

NO_IMAGES = InputConfig(cameras=(), image_size=0)


class Steady:
    """Gives one number everywhere, and remembers which worlds it was reset in."""

    def __init__(self, name: str, value: float, worlds: int) -> None:
        self.name = name
        self.value = value
        self.resets: list[np.ndarray] = []
        self.asked = np.zeros(worlds, np.int64)

    def reset(self, mask: np.ndarray) -> None:
        self.resets.append(mask.copy())

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        return self.act_in(obs, info, np.ones(len(self.asked), bool))

    def act_in(self, obs: Any, info: Mapping[str, Any], mask: np.ndarray) -> np.ndarray:
        self.asked += mask
        return np.full((len(self.asked), 13), self.value, np.float32)

    def notes(self) -> ActionNotes:
        return ActionNotes.plain(
            np.full((len(self.asked), 13), self.value / 2, np.float32), self.name
        )

    def style(self, world: int) -> Mapping[str, Any]:
        return {}


def make(worlds: int, longest: int) -> tuple[Intervention, Steady, Steady]:
    student = Steady("student", -0.5, worlds)
    expert = Steady("expert", 0.5, worlds)
    return Intervention(student, expert, longest), student, expert


def roll(path: Path, worlds: int, longest: int, count: int = 5) -> tuple[Steady, Steady]:
    policy, student, expert = make(worlds, longest)
    env: Any = FakeEnv(worlds, subtask="pick", horizon=20)
    with ShardWriter(path) as writer:
        rollout(
            env,
            policy,
            list(range(count)),
            3,
            [Recorder(writer, env, {"name": policy.name})],
        )
    return student, expert


@pytest.mark.parametrize("worlds", [1, 3])
def test_the_student_acts_first_and_the_expert_from_the_drawn_step_on(
    worlds: int, tmp_path: Path
) -> None:
    _, expert = roll(tmp_path / "a.h5", worlds, 12)
    lengths = set()
    acted = 0
    for episode in episodes(tmp_path / "a.h5"):
        prefix = prefix_length(3, episode.record.index, 12)
        lengths.add(prefix)
        acted += episode.steps - prefix
        actions = episode.array("actions")
        intended = episode.array("actions_intended")
        assert (actions[:prefix] == -0.5).all() and (actions[prefix:] == 0.5).all()
        assert (intended[:prefix] == -0.5).all() and (intended[prefix:] == 0.25).all()
        names = [episode.actors[number] for number in episode.array("actor")]
        assert names == ["student"] * prefix + ["expert"] * (episode.steps - prefix)
        np.testing.assert_array_equal(
            taught_steps(episode), np.arange(episode.steps) >= prefix
        )
    assert len(lengths) > 1
    # The expert thinks about a world only when it acts there, and plans anew once per episode.
    assert expert.asked.sum() >= acted
    assert sum(int(mask.sum()) for mask in expert.resets) == 5


def test_prefixes_cover_their_range_and_depend_on_the_episode_alone() -> None:
    drawn = [prefix_length(0, index, 9) for index in range(300)]
    assert set(drawn) == set(range(10))
    assert drawn == [prefix_length(0, index, 9) for index in range(300)]
    assert prefix_length(0, 5, 0) == 0


def test_what_the_expert_intended_is_learned_from_the_take_over_on(
    tmp_path: Path,
) -> None:
    roll(tmp_path / "a.h5", 2, 12)
    told = observation_spec_of_data(tmp_path, NO_IMAGES, EVERY)
    data = load_demonstrations(tmp_path, told, -1, EVERY)
    assert (data.actions[data.usable] == 0.25).all()
    prefixes = [
        prefix_length(3, index, 12) for index in range(4)
    ]  # Episode 4 is tainted.
    assert len(data.usable) == len(data.actions) - sum(prefixes)


def test_a_student_alone_is_learned_from(tmp_path: Path) -> None:
    env: Any = FakeEnv(1, subtask="pick")
    with ShardWriter(tmp_path / "a.h5") as writer:
        rollout(
            env,
            Steady("student", 0.1, 1),
            [0],
            0,
            [Recorder(writer, env, {"name": "student"})],
        )
    assert all(taught_steps(episode).all() for episode in episodes(tmp_path / "a.h5"))


def test_prefixes_begin_short_and_grow() -> None:
    config = DaggerConfig(first_prefix=20, prefix_growth=30, max_prefix=90)
    assert [config.longest_prefix(number) for number in range(6)] == [
        0,
        20,
        50,
        80,
        90,
        90,
    ]


def test_a_worker_in_this_process_makes_what_a_job_asks_for(tmp_path: Path) -> None:
    policy, _, _ = make(2, 5)

    def build() -> Stage:
        return Stage(
            cast("Any", FakeEnv(2, subtask="pick")), policy, {"name": policy.name}
        )

    job = Job(WorkerSpec(build, 1), {"a": 1}, tmp_path / "out", 6, chunk=2)
    done = generate(job, InlinePool())
    assert done.complete and done.kept == done.written == 6
    again = generate(job, InlinePool(), resume=True)
    assert again.written == 0 and again.kept == 6
