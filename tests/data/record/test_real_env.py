"""The recorder on the real environment: what is stored is what the simulator went through, and can be put back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.data.record.recorder import Recorder
from mjhab.data.select.relabel import relabel
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.shard import ShardWriter
from mjhab.envs import make
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.sinks import Sink, StepView

SIZE = 16


class Digests(Sink):
    """Hash of the state of world 0 after every step."""

    def __init__(self) -> None:
        self.steps: list[str] = []

    def on_step(self, env: Any, step: StepView) -> None:
        self.steps.append(env.state_digest(0))


@pytest.fixture(scope="module")
def recorded(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Any, Path, list[Any], list[str]]:
    env = make(
        task="set_table",
        subtask="pick",
        num_envs=1,
        autoreset="disabled",
        obs_mode="rgbd",
        camera_size=SIZE,
        reward_mode="dense",
        seed=0,
    )
    path = tmp_path_factory.mktemp("real") / "a.h5"
    digests = Digests()
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, env, {"name": "random"}, images=ImageFormat())
        records = rollout(env, RandomPolicy(0), [2], 0, [digests, recorder], max_steps=12)
    return env, path, records, digests.steps


def test_stored_states_are_those_of_the_simulator(recorded: Any) -> None:
    import hashlib

    _, path, records, digests = recorded
    with open_shard(path) as shard:
        episode = next(iter(shard))
        assert episode.record == records[0] and not episode_problems(episode)
        qpos = episode.array("states/qpos")
        qvel = episode.array("states/qvel")
        assert len(qpos) == episode.steps + 1 == 13 and np.isfinite(qpos).all()
        stored = [
            hashlib.sha256(p.tobytes() + v.tobytes()).hexdigest()[:16]
            for p, v in zip(qpos, qvel, strict=True)
        ]
        assert stored[1:] == digests
        assert qpos.shape[1] == episode.run.layout["sizes"]["qpos"]
        joints = episode.run.layout["columns"]["robot_q"]
        np.testing.assert_allclose(
            episode.observation("agent/qpos"), qpos[:, joints][:, 3:], atol=1e-6
        )
        assert episode.run.config["env"][
            "subtask"
        ] == "pick" and episode.run.licence.startswith("Apache-2.0")
        assert (
            len(str(episode.attributes["model"])) == 16
            and episode.attributes["ending"] == "cut"
        )
        assert (
            len(episode.run.layout["actions"]) == episode.array("actions").shape[1] == 13
        )


def test_images_rewards_and_labels(recorded: Any) -> None:
    env, path, _, _ = recorded
    with open_shard(path) as shard:
        episode: RecordedEpisode = next(iter(shard))
        assert sorted(episode.images) == [
            (c, o) for c in ("fetch_hand", "fetch_head") for o in ("depth", "rgb")
        ]
        last = env.observer.observe(env.state, env.focus, env.signals, env.homes)
        for camera, output in episode.images:
            frame = episode.frame(camera, output, episode.steps)
            np.testing.assert_array_equal(
                frame, last[f"sensor_data/{camera}/{output}"][0]
            )
        terms = episode.table("reward/terms")
        assert terms
        np.testing.assert_allclose(
            sum(terms.values()), episode.array("reward/total"), atol=1e-9
        )
        assert relabel(episode) == (episode.record, [])


def test_the_first_state_and_the_actions_give_every_state_bit_by_bit(
    recorded: Any,
) -> None:
    env, path, _, _ = recorded
    with open_shard(path) as shard:
        episode = next(iter(shard))
        initial = episode.initial()
        actions = episode.array("actions")
        qpos = episode.array("states/qpos")
        qvel = episode.array("states/qvel")
    env.set_state(0, initial)
    for t in range(len(actions) + 1):
        state = env.sim.get_world(0)
        np.testing.assert_array_equal(state["qpos"], qpos[t], err_msg=f"state {t}")
        np.testing.assert_array_equal(state["qvel"], qvel[t], err_msg=f"state {t}")
        if t < len(actions):
            env.step(actions[t : t + 1])
