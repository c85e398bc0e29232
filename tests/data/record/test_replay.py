"""Replay on the real environment: actions give the recorded states again; images are drawn from states alone."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.data.record.recorder import Recorder
from mjhab.data.record.render import FOLLOW, RenderRequest, render
from mjhab.data.record.verify import verify
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import merge
from mjhab.data.store.checking import check
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.hdf5 import dataset, group
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.shard import ShardWriter
from mjhab.envs import make, make_train
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from tests.refusals import refused

SIZE = 16
STEPS = 6
PNG = ImageFormat()


@pytest.fixture(scope="module")
def env() -> Any:
    return make(
        task="set_table",
        subtask="pick",
        num_envs=2,
        autoreset="disabled",
        obs_mode="rgbd",
        camera_size=SIZE,
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, env: Any) -> Path:
    """Three episodes with pictures of the hand; the last of another length."""
    path = tmp_path_factory.mktemp("replay") / "a.h5"
    with ShardWriter(path) as writer:
        for indices, steps in (([0, 1], STEPS), ([2], STEPS + 3)):
            recorder = Recorder(writer, env, {"name": "random"}, images=PNG)
            rollout(env, RandomPolicy(0), indices, 0, [recorder], max_steps=steps)
    return path


def given(env: Any) -> Callable[[RunInfo], Any]:
    return lambda run: env


def changed(
    source: Path, out: Path, change: Callable[[dict[str, np.ndarray]], None]
) -> Path:
    """A shard whose episodes have other arrays, with digests that fit them."""
    with ShardWriter(out) as writer:
        for episode in episodes(source):
            writer.append(altered(episode, change))
    return out


def altered(
    episode: RecordedEpisode, change: Callable[[dict[str, np.ndarray]], None]
) -> EpisodeData:
    arrays = {path: episode.array(path) for path in episode.paths if path != "record"}
    change(arrays)
    attributes = episode.attributes
    return EpisodeData(
        episode.record,
        episode.run,
        str(attributes["model"]),
        str(attributes["ending"]),
        arrays,
    )


def test_every_bit_comes_again_in_any_number_of_worlds(recorded: Path, env: Any) -> None:
    made: list[RunInfo] = []

    def one_world(run: RunInfo) -> Any:
        made.append(run)
        config = {
            key: tuple(v) if isinstance(v, list) else v
            for key, v in run.config["env"].items()
        }
        return make(**config, num_envs=1, autoreset="disabled")

    told: list[int] = []
    for maker in (given(env), one_world):
        found = verify(recorded, maker, tell=lambda: told.append(1))
        assert (found.episodes, found.exact, found.max_error) == (3, 3, 0.0)
        assert not found.wrong and not found.unlike and not found.moved
    assert len(made) == 1 and len(told) == 6
    assert (
        verify(
            recorded, given(env), Filter("index == 2 and (tainted or not tainted)")
        ).episodes
        == 1
    )


def test_a_single_bit_is_seen(recorded: Path, env: Any, tmp_path: Path) -> None:
    def one_bit(arrays: dict[str, np.ndarray]) -> None:
        qpos = arrays["states/qpos"]
        qpos[3, 0] = np.nextafter(qpos[3, 0], np.inf)

    found = verify(changed(recorded, tmp_path / "bit.h5", one_bit), given(env))
    assert found.exact == 0 and 0 < found.max_error < 1e-12
    assert set(found.wrong.values()) == {
        f"qpos differs from state 3 of {n} on" for n in (STEPS, STEPS + 3)
    }

    # The writer takes no such number: somebody else has put it there.
    path = changed(recorded, tmp_path / "nan.h5", lambda arrays: None)
    with h5py.File(path, "r+") as file:
        for episode in group(file, "episodes"):
            dataset(file, f"episodes/{episode}/states/qvel")[2, 4] = np.nan
    found = verify(path, given(env))
    assert (
        found.exact == 0
        and found.max_error == np.inf
        and "qvel differs from state 2" in str(found.wrong)
    )

    def action(arrays: dict[str, np.ndarray]) -> None:
        arrays["actions"][1, 0] *= 0.5

    found = verify(changed(recorded, tmp_path / "action.h5", action), given(env))
    assert (
        found.exact == 0
        and found.max_error > 1e-6
        and "differs from state 2" in str(found.wrong)
    )


def test_without_states_the_last_one_is_compared(
    recorded: Path, env: Any, tmp_path: Path
) -> None:
    def stateless(arrays: dict[str, np.ndarray]) -> None:
        del arrays["states/qpos"], arrays["states/qvel"]

    path = changed(recorded, tmp_path / "bare.h5", stateless)
    assert verify(path, given(env)).exact == 3

    def and_another_action(arrays: dict[str, np.ndarray]) -> None:
        stateless(arrays)
        arrays["actions"][1, 0] *= 0.5

    found = verify(
        changed(recorded, tmp_path / "other.h5", and_another_action), given(env)
    )
    assert found.exact == 0 and set(found.wrong.values()) == {
        "the last state is another one"
    }
    with refused(said="recorded without states"):
        render(
            RenderRequest(path, tmp_path / "never.h5", PNG, ["fetch_head"]), given(env)
        )


def test_another_start_is_replaced_by_the_recorded_one(
    recorded: Path, env: Any, tmp_path: Path
) -> None:
    """An episode that begins elsewhere here, as when a later version draws other starts, is replayed all the same."""
    with open_shard(recorded) as shard, ShardWriter(tmp_path / "a.h5") as writer:
        for episode in shard:
            state = episode.initial()
            home = episode.record.home
            mask = np.array([True, False])
            env.reset(
                seed=[0, None],
                options={"episode": np.array([episode.record.index]), "reset_mask": mask},
            )
            state["sim"]["qpos"][env.sim.addresses.robot_q[0]] += 0.01
            env.set_state(0, state)
            assert env.homes[0] == home
            writer.append(resimulated(env, episode))
    found = verify(tmp_path / "a.h5", given(env))
    assert (found.exact, found.max_error, len(found.moved)) == (3, 0.0, 3)


def resimulated(env: Any, episode: RecordedEpisode) -> EpisodeData:
    from mjhab.data.store.episode_data import to_bytes

    initial = env.get_state(0)
    rows = [env.sim.get_world(0)]
    for action in episode.array("actions"):
        env.step(np.stack([action, np.zeros_like(action)]))
        rows.append(env.sim.get_world(0))

    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays["states/initial"] = to_bytes(initial)
        arrays["states/qpos"] = np.stack([row["qpos"] for row in rows])
        arrays["states/qvel"] = np.stack([row["qvel"] for row in rows])

    data = altered(episode, change)
    return dataclasses.replace(
        data, record=dataclasses.replace(data.record, final_state=env.state_digest(0))
    )


def test_another_model_is_named(recorded: Path, env: Any, tmp_path: Path) -> None:
    with open_shard(recorded) as shard, ShardWriter(tmp_path / "a.h5") as writer:
        episode = next(iter(shard))
        writer.append(
            dataclasses.replace(altered(episode, lambda arrays: None), model="0" * 16)
        )
    found = verify(tmp_path / "a.h5", given(env))
    assert found.exact == 1 and len(found.unlike) == 1


def test_images_drawn_from_states_are_those_that_were_recorded(
    recorded: Path, env: Any, tmp_path: Path
) -> None:
    out = tmp_path / "again.h5"
    request = RenderRequest(recorded, out, PNG, ["fetch_head", "fetch_hand"])
    done = render(request, given(env))
    assert (done.episodes, done.frames, done.present) == (
        3,
        2 * (STEPS + 1) + STEPS + 4,
        0,
    ) and check(out).clean
    with open_shard(recorded) as before, open_shard(out) as after:
        assert before.names == after.names
        for old, new in zip(before, after, strict=True):
            assert old.paths == new.paths and old.record == new.record
            for path in old.paths:
                np.testing.assert_array_equal(
                    old.array(path), new.array(path), err_msg=path
                )
            assert old.columns("obs/state") == new.columns("obs/state") != {}
            assert new.run.config == old.run.config and new.run.options["rendered"][
                "camera_size"
            ] == [SIZE, SIZE]
    again = render(request, given(env))
    assert (again.episodes, again.present) == (0, 3)


def test_other_sizes_cameras_and_modalities(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "seg.h5"
    wanted = ("fetch_head", FOLLOW)
    other = make(
        task="set_table",
        subtask="pick",
        num_envs=4,
        autoreset="disabled",
        obs_mode="rgb+seg",
        cameras="fetch_head",
        camera_size=(24, 32),
    )
    one = Filter("index == 1 and (tainted or not tainted)")
    render(RenderRequest(recorded, out, ImageFormat("jpeg"), wanted, one), given(other))
    with open_shard(out) as shard:
        (episode,) = shard
        # The hand stays as it was; depth of the head in the old size would not fit the new picture.
        head = "fetch_head"
        hand = "fetch_hand"
        assert set(episode.images) == {
            (hand, "depth"),
            (hand, "rgb"),
            (head, "rgb"),
            (head, "seg"),
            (FOLLOW, "rgb"),
        }
        assert episode.frame("fetch_head", "seg", STEPS).shape == (
            24,
            32,
            1,
        ) and not episode_problems(episode)
        assert (
            episode.frame(FOLLOW, "rgb", 0).shape == (24, 32, 3)
            and episode.frame(FOLLOW, "rgb", 0).std() > 5
        )
        assert episode.frame("fetch_hand", "rgb", 0).shape == (SIZE, SIZE, 3)
        calibration = episode.run.layout["cameras"]
        assert {name: each["size"] for name, each in calibration.items()} == {
            head: [24, 32],
            hand: [SIZE, SIZE],
        }
        assert episode.array("obs/sensor_param/fetch_head/intrinsic_cv").shape == (
            STEPS + 1,
            3,
            3,
        )


def test_a_replay_of_nothing_is_refused(recorded: Path, env: Any, tmp_path: Path) -> None:
    nothing = Filter("index > 100")
    with refused(said="no episode passes"):
        verify(recorded, given(env), nothing)
    out = tmp_path / "none.h5"
    with refused(said="no episode passes"):
        render(RenderRequest(recorded, out, PNG, ["fetch_head"], nothing), given(env))
    assert not out.exists()


def test_a_shard_is_continued_with_the_same_images_alone(
    recorded: Path, env: Any, tmp_path: Path
) -> None:
    out = tmp_path / "head.h5"
    first = Filter("index == 0")
    render(RenderRequest(recorded, out, PNG, ["fetch_head"], first), given(env))
    before = out.read_bytes()
    with refused(where="head.h5", said="with other images"):
        render(RenderRequest(recorded, out, PNG, ["fetch_hand"]), given(env))
    assert out.read_bytes() == before
    done = render(RenderRequest(recorded, out, PNG, ["fetch_head"]), given(env))
    assert (done.episodes, done.present) == (2, 1)
    # Episodes that were never drawn, such as merged ones, are not taken for drawn ones.
    copy = tmp_path / "copy.h5"
    merge([recorded], copy)
    with refused(where="copy.h5", said="with other images"):
        render(RenderRequest(recorded, copy, PNG, ["fetch_head"]), given(env))


def test_what_is_replayed_is_never_written(recorded: Path, env: Any) -> None:
    with refused("out"):
        render(RenderRequest(recorded, recorded, PNG, ["fetch_head"]), given(env))
    inside = recorded.parent / "drawn" / "head.h5"
    request = RenderRequest(recorded.parent, inside, PNG, ["fetch_head"])
    with refused("out"):
        render(request, given(env))
    assert not inside.parent.exists()


def test_training_environments_are_built_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their arrangements come from a pool drawn with the seed of the environment: `make` would begin elsewhere."""
    path = tmp_path / "train.h5"
    env = make_train(
        task="set_table",
        subtask="open",
        num_envs=2,
        autoreset="disabled",
        seed=5,
        episode_pool=2,
    )
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, env, {"name": "random"})
        rollout(env, RandomPolicy(0), [0, 1, 2], 3, [recorder], max_steps=STEPS)
    assert (
        recorder.run.config["maker"] == "make_train"
        and recorder.run.config["env"]["seed"] == 5
    )
    assert main(["replay", str(path), "--verify", "--worlds", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["episodes"], found["exact"], found["moved"]) == (3, 3, 0)

    def without_pool(run: RunInfo) -> Any:
        return make(task="set_table", subtask="open", num_envs=2, autoreset="disabled")

    lost = verify(path, without_pool)
    assert (
        len(lost.moved) == 3
        and lost.exact < 3
        and "it cannot begin here: state: home must be" in str(lost.wrong)
    )
