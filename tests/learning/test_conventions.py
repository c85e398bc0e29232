"""What networks see of a box, on every path from an environment or a file to them: byte by byte the same.

train -> eval, export -> clone -> eval, import -> eval, and checkpoints and shards of versions that knew our axes only.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mjhab.config.profiles import unbound
from mjhab.core.conventions.names import PUBLISHED, Conventions
from mjhab.data.imports.ms_hab import import_ms_hab
from mjhab.data.record.recorder import Recorder
from mjhab.data.select.dataset import WindowDataset
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.hdf5 import dataset, group
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.run_entries import SCAN_YAWS
from mjhab.data.store.shard import ShardWriter
from mjhab.envs import make
from mjhab.learning.checkpoint import load_student, save_student
from mjhab.learning.configs import InputConfig
from mjhab.learning.demos import observation_spec_of_data, read_episode
from mjhab.learning.observation.encoder import ObservationEncoder
from mjhab.learning.observation.spec import ObservationSpec, observation_spec_of
from mjhab.learning.policy import StudentPolicy
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder
from mjhab.learning.students.heads import make_student
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from tests.data.export.exporting import to_maniskill
from tests.learning.small import config
from tests.refusals import refused

BOXES = (
    "010_potted_meat_can",
    "008_pudding_box",
    "009_gelatin_box",
    "004_sugar_box",
)
STATE_ALONE = InputConfig(
    cameras=(), image_size=0, previous_action=False, base_velocity=False, condition=False
)
EVERY = Filter("steps > 0")
STEPS = 3
POSE = slice(31, 38)


def environment(target: str, profile: str = "ms_hab", **more: Any) -> Any:
    options = {
        "task": "tidy_house",
        "subtask": "pick",
        "target": target,
        "home": "builtin_m0_00",
        "threads": 1,
        "autoreset": "disabled",
        "profile": profile,
        **more,
    }
    return make(**options)


class Watch:
    """A sink that keeps what the environment observed."""

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def on_begin(self, env: Any, episodes: Any) -> None: ...

    def on_reset(self, env: Any, info: Any, mask: np.ndarray) -> None:
        self.seen.append(env.state_as(env.config.conventions)[0].copy())

    def on_step(self, env: Any, step: Any) -> None:
        self.seen.append(np.asarray(step.obs["state"])[0].copy())

    def on_episode_end(self, env: Any, world: int, record: Any) -> None: ...

    def close(self) -> None: ...


def recorded(env: Any, folder: Path) -> np.ndarray:
    """Record one short episode into a shard; returns the states (N+1, 42) that the environment observed."""
    watch = Watch()
    with ShardWriter(folder / "a.h5") as writer:
        sinks = [Recorder(writer, env, {"name": "random"}), watch]
        rollout(env, RandomPolicy(0), [0], 0, sinks, STEPS)
    return np.stack(watch.seen)


def older(folder: Path, out: Path, **changes: Any) -> RecordedEpisode:
    """The episode of a shard as a version before schema 3 wrote it in profile ms_hab, in our axes."""
    (episode,) = episodes(folder)
    arrays, columns = episode.contents()
    del arrays["record"]
    told = {k: v for k, v in episode.run.options.items() if k != "object_axes"}
    env = {**episode.run.config["env"], "profile": "ms_hab"}
    del env["joint_angles"]
    run = dataclasses.replace(
        episode.run, config={**episode.run.config, "env": env}, options=told, **changes
    )
    with ShardWriter(out / "old.h5") as writer:
        writer.append(
            EpisodeData(
                episode.record,
                run,
                str(episode.attributes["model"]),
                str(episode.attributes["ending"]),
                arrays,
                {path: tuple(names) for path, names in columns.items() if names},
                episode.actors,
                2,
            )
        )
    (old,) = episodes(out)
    return old


def inputs_of(layout: ObservationSpec, env: Any) -> np.ndarray:
    """(42,) what a policy and an agent of a layout are given in the present state of an environment."""
    obs = {"state": env.state_as(env.config.conventions)}
    info = env.info() | {"episode_spec": [env.episode_spec(0)]}
    encoder = AgentEncoder(env, layout, False)
    seen = encoder.see(obs, info).vector[0].numpy()
    acting = ObservationEncoder(env, layout).encode(obs, info).vector[0]
    np.testing.assert_array_equal(acting, seen)
    policy = StudentPolicy(make_student(config(inputs=STATE_ALONE), layout), env)
    policy.reset(np.ones(1, bool))
    assert policy.act(obs, info).shape == (1, 13)
    return acting


@pytest.fixture(params=BOXES)
def box(request: pytest.FixtureRequest) -> Iterator[str]:
    return request.param


def test_train_then_eval(box: str, tmp_path: Path) -> None:
    env = environment(box)
    env.reset(seed=0)
    trained = observation_spec_of(env, STATE_ALONE, (box,))
    assert trained.conventions == PUBLISHED and trained.profile == "ms_hab"
    path = tmp_path / "student.safetensors"
    save_student(path, make_student(config(inputs=STATE_ALONE), trained), {})
    kept = load_student(path).layout
    assert kept.conventions == PUBLISHED
    np.testing.assert_array_equal(inputs_of(kept, env), env.state_as(PUBLISHED)[0])
    # Judged under our rules it still sees what it was trained on.
    ours = environment(box, "mjhab")
    ours.reset(seed=0)
    ours.set_state(0, env.get_state(0))
    np.testing.assert_array_equal(inputs_of(kept, ours), env.state_as(PUBLISHED)[0])


def test_checkpoints_of_older_versions_see_our_axes(box: str) -> None:
    env = environment(box)
    env.reset(seed=0)
    trained = observation_spec_of(env, STATE_ALONE, (box,))
    plain = trained.to_plain()
    del plain["object_axes"], plain["joint_angles"]
    old = ObservationSpec.from_plain(STATE_ALONE, plain)
    assert old.conventions == Conventions("object", "unwrapped")
    seen = inputs_of(old, env)
    ours = environment(box, "mjhab")
    ours.reset(seed=0)
    ours.set_state(0, env.get_state(0))
    np.testing.assert_array_equal(seen, ours.state_as(ours.config.conventions)[0])
    assert np.abs(seen[POSE] - env.state_as(PUBLISHED)[0, POSE]).max() > 1e-3


def test_export_then_clone_then_eval_and_import_then_eval(
    box: str, tmp_path: Path
) -> None:
    env = environment(box)
    seen = recorded(env, tmp_path / "shards")
    (episode,) = episodes(tmp_path / "shards")
    assert episode.conventions == PUBLISHED
    np.testing.assert_array_equal(episode.array("obs/state"), seen)
    (file,) = to_maniskill(tmp_path / "shards", tmp_path / "exported").files
    with h5py.File(file) as exported:
        pose = dataset(group(exported, "traj_0"), "obs/extra/obj_pose_wrt_base")[()]
    np.testing.assert_array_equal(pose, seen[:, POSE])
    import_ms_hab(file, tmp_path / "imported")
    for folder in (tmp_path / "shards", tmp_path / "imported"):
        layout = observation_spec_of_data(folder, STATE_ALONE, EVERY)
        assert layout.conventions == PUBLISHED and layout.profile == "ms_hab"
        (one,) = episodes(folder)
        np.testing.assert_array_equal(read_episode(one, layout, -1).vector, seen[:-1])
        np.testing.assert_array_equal(
            WindowDataset(folder)[STEPS - 1]["state"][0], seen[-2]
        )
        np.testing.assert_array_equal(inputs_of(layout, env), seen[-1])


def test_an_export_of_our_profile_is_in_the_axes_of_the_scan(
    box: str, tmp_path: Path
) -> None:
    env = environment(box, "mjhab")
    seen = recorded(env, tmp_path / "shards")
    published = env.state_as(PUBLISHED)[0]
    (file,) = to_maniskill(tmp_path / "shards", tmp_path / "exported").files
    told = json.loads(file.with_suffix(".json").read_text())["episodes"][0]
    assert told["object_axes"] == "scan"
    with h5py.File(file) as exported:
        pose = dataset(group(exported, "traj_0"), "obs/extra/obj_pose_wrt_base")[()]
    np.testing.assert_array_equal(pose[-1], published[POSE])
    import_ms_hab(file, tmp_path / "imported")
    (back,) = episodes(tmp_path / "imported")
    assert back.conventions == env.config.conventions
    np.testing.assert_allclose(back.array("obs/state"), seen, atol=1e-6)


def test_shards_of_older_versions_are_read_in_the_axes_of_their_profile(
    box: str, tmp_path: Path
) -> None:
    asked = unbound({"profile": "ms_hab", "object_axes": "object"}, "pick", trains=False)
    env = environment(box, **asked)
    recorded(env, tmp_path / "new")
    old = older(tmp_path / "new", tmp_path / "old")
    assert old.conventions == PUBLISHED and old.schema == 2
    np.testing.assert_array_equal(old.array("obs/state")[-1], env.state_as(PUBLISHED)[0])
    np.testing.assert_array_equal(
        old.observation("extra/obj_pose_wrt_base")[-1], env.state_as(PUBLISHED)[0, POSE]
    )
    layout = observation_spec_of_data(tmp_path / "old", STATE_ALONE, EVERY)
    assert layout.conventions == PUBLISHED
    told = read_episode(old, layout, -1).vector
    np.testing.assert_array_equal(told, old.array("obs/state")[:-1])
    # A run that an older version began keeps its axes.
    kept = layout.in_conventions(Conventions())
    ours = old.contents()[0]["obs/state"]
    np.testing.assert_allclose(read_episode(old, kept, -1).vector, ours[:-1], atol=1e-6)
    # Without the headings nothing can be turned: the shard is read as it is, and says so.
    (new,) = episodes(tmp_path / "new")
    bare = {k: v for k, v in new.run.layout.items() if k != SCAN_YAWS}
    plain = older(tmp_path / "new", tmp_path / "bare", layout=bare)
    assert plain.conventions == Conventions()
    np.testing.assert_array_equal(plain.array("obs/state"), ours)
    with refused(where="old.h5", said="does not hold the headings of the scans"):
        read_episode(plain, layout, -1)
