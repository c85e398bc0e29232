"""What the recorder writes is what happened: states, actions, signals, records, images."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from mjhab.data.record.provenance import describe_run, model_hash
from mjhab.data.record.recorder import Recorder
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.episode_data import EpisodeData, from_bytes, to_bytes
from mjhab.data.store.images import ImageFormat, decode, encode
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import STORED_CHECKS
from mjhab.data.store.shard import ShardWriter
from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.sinks import Sink, StepView
from mjhab.scenes.packs import open_pack
from tests.data.fake_world import NQ, FakeEnv
from tests.data.make import POLICY, record
from tests.refusals import refused


class Witness(Sink):
    """Writes down, in its own way, what the recorder should store."""

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, list[Any]]] = {}
        self.index: dict[int, int] = {}

    def _note(self, env: Any, w: int, obs: Any) -> None:
        notes = self.rows[self.index[w]]
        notes.setdefault("qpos", []).append(env.worlds[w].qpos.copy())
        notes.setdefault("state", []).append(obs["state"][w].copy())
        notes.setdefault("grasped", []).append(env.outcome_signals.is_grasped[w])
        notes.setdefault("force", []).append(env.outcome_signals.robot_force[w])
        if env.images:
            notes.setdefault("depth", []).append(
                obs["sensor_data/fetch_head/depth"][w].copy()
            )
            notes.setdefault("rgb", []).append(
                obs["sensor_data/fetch_head/rgb"][w].copy()
            )

    def on_reset(self, env: Any, info: Any, mask: np.ndarray) -> None:
        for w in np.flatnonzero(mask).tolist():
            self.index[w] = info["episode_spec"][w]["index"]
            self.rows[self.index[w]] = {"actions": []}
            self._note(env, w, env.observer.observe())

    def on_step(self, env: Any, step: StepView) -> None:
        for w in np.flatnonzero(step.active).tolist():
            self.rows[self.index[w]]["actions"].append(step.actions[w].copy())
            self._note(env, w, step.obs)


def test_everything_is_stored_as_it_was(tmp_path: Path) -> None:
    env: Any = FakeEnv(3, images=True)
    witness = Witness()
    path = tmp_path / "a.h5"
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, env, POLICY, images=ImageFormat())
        records = rollout(env, RandomPolicy(0), range(7), 5, [witness, recorder])
    assert recorder.kept == recorder.seen == 7 and sum(recorder.labels.values()) == 7
    with open_shard(path) as shard:
        assert len(shard) == 7
        for episode, expected in zip(shard, records, strict=True):
            seen = {
                name: np.array(rows)
                for name, rows in witness.rows[expected.index].items()
            }
            assert episode.record == expected and episode.steps == expected.steps == len(
                seen["actions"]
            )
            assert not episode_problems(episode)
            np.testing.assert_array_equal(episode.array("actions"), seen["actions"])
            np.testing.assert_array_equal(episode.array("states/qpos"), seen["qpos"])
            assert len(seen["qpos"]) == expected.steps + 1
            np.testing.assert_array_equal(episode.observation("state"), seen["state"])
            np.testing.assert_array_equal(
                episode.observation("agent/qpos"), seen["state"][:, :4]
            )
            np.testing.assert_array_equal(
                episode.table("signals/checks")["is_grasped"], seen["grasped"]
            )
            np.testing.assert_array_equal(
                episode.table("signals/forces")["robot_force"], seen["force"]
            )
            np.testing.assert_array_equal(
                episode.observation("sensor_data/fetch_head/depth"), seen["depth"]
            )
            np.testing.assert_array_equal(
                episode.frame("fetch_head", "rgb", 1), seen["rgb"][1]
            )
            assert episode.table("reward/terms")["reach"].tolist() == list(
                range(1, expected.steps + 1)
            )
            assert episode.observation("sensor_param/fetch_head/intrinsic_cv").shape == (
                expected.steps + 1,
                3,
                3,
            )
            np.testing.assert_array_equal(
                episode.initial()["sim"]["qpos"], seen["qpos"][0]
            )


def test_worlds_do_not_change_a_byte_of_an_episode(tmp_path: Path) -> None:
    for worlds in (1, 4):
        record(
            tmp_path / f"{worlds}.h5",
            range(6),
            FakeEnv(worlds, images=True),
            images=ImageFormat(),
        )
    one, four = (
        [(e.name, e.attributes) for e in episodes(tmp_path / f"{n}.h5")] for n in (1, 4)
    )
    assert one == four


def test_subtasks_begin_where_the_record_says(tmp_path: Path) -> None:
    records, _ = record(tmp_path / "a.h5", range(8))
    assert max(len(r.subtasks) for r in records) > 2
    for episode, expected in zip(episodes(tmp_path / "a.h5"), records, strict=True):
        starts = episode.array("subtasks/step").tolist()
        assert starts[: len(expected.subtasks)] == [
            entry.start_step for entry in expected.subtasks
        ]
        assert episode.array("subtasks/index").tolist() == [
            entry.index for entry in expected.subtasks
        ]
        for k, entry in enumerate(expected.subtasks):
            index, history = episode.history(k)
            assert index == entry.index and history.success.shape == (
                entry.end_step - entry.start_step + 1,
                1,
            )
        active = episode.array("subtasks/active")
        assert active[0] == 0 and (np.diff(active) >= 0).all()


@pytest.mark.parametrize(
    ("max_steps", "endings"),
    [(None, {"success", "force_exceeded", "timeout", "place_broken"}), (1, {"cut"})],
)
def test_endings(tmp_path: Path, max_steps: int | None, endings: set[str]) -> None:
    record(tmp_path / "a.h5", range(12), max_steps=max_steps)
    found = {str(e.attributes["ending"]) for e in episodes(tmp_path / "a.h5")}
    assert found <= endings and (max_steps is None or found == endings)
    for episode in episodes(tmp_path / "a.h5"):
        assert episode.terminated == (
            episode.attributes["ending"] in ("success", "force_exceeded", "place_broken")
        )
        assert (episode.attributes["ending"] == "success") == (
            episode.record.success_at_end
        )


def test_one_subtask_runs_to_its_horizon(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", range(3), FakeEnv(2, "pick"))
    for episode in episodes(tmp_path / "a.h5"):
        assert episode.steps == 20 and episode.attributes["ending"] == "timeout"
        assert (
            episode.run.config["env"]["subtask"] == "pick"
            and episode.run.config["policy"] == POLICY
        )


def test_failures_are_kept_unless_told_otherwise(tmp_path: Path) -> None:
    records, recorder = record(tmp_path / "all.h5", range(12))
    assert 0 < sum(r.success_once for r in records) < 12 and recorder.kept == 12
    _, recorder = record(
        tmp_path / "good.h5", range(12), keep=lambda record, run: record.success_once
    )
    assert recorder.seen == 12 and recorder.kept == sum(r.success_once for r in records)


def test_without_states_nothing_can_be_rendered_and_the_message_says_so(
    tmp_path: Path,
) -> None:
    record(tmp_path / "a.h5", range(1), states=False)
    with open_shard(tmp_path / "a.h5") as shard:
        episode = next(iter(shard))
        assert not episode_problems(episode) and episode.initial()["sim"][
            "qpos"
        ].shape == (NQ,)
        with refused(said="recorded without states"):
            episode.array("states/qpos")
        with refused(said="no rgb images of fetch_head (it has: none)"):
            episode.frame("fetch_head", "rgb", 0)
        with refused("dataset", "action", expected="actions"):
            episode.array("action")
        with refused("observation", "extra/grasped", expected="extra/is_grasped"):
            episode.observation("extra/grasped")


def test_states_and_actions_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", range(1))
    with open_shard(tmp_path / "a.h5") as shard:
        episode = next(iter(shard))
        arrays = {path: episode.array(path) for path in episode.paths if path != "record"}
        good = EpisodeData(episode.record, episode.run, "m", "success", arrays)
    cases: list[tuple[str, Any, str]] = [
        (
            "states/qpos",
            arrays["states/qpos"][1:],
            r"states/qpos has \d+ rows, not \d+ \(N\+1 with N = \d+ actions\)",
        ),
        ("actions", arrays["actions"][1:], r"actions has \d+ rows"),
        ("actions", arrays["actions"].astype(float), "actions is float64, not float32"),
        (
            "signals/checks",
            arrays["signals/checks"][:, 2:],
            f"not {len(STORED_CHECKS)} columns",
        ),
        ("subtasks/step", arrays["subtasks/step"] + 1, "must begin with 0"),
        ("obs/state", None, "obs/state is missing"),
        ("states/forces", arrays["actions"], "not part of the schema"),
    ]
    for path, array, message in cases:
        changed = (
            {**arrays, path: array}
            if array is not None
            else {k: v for k, v in arrays.items() if k != path}
        )
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(good, arrays=changed)


def test_plain_data_comes_back_as_it_was() -> None:
    value = {
        "sim": {
            "qpos": np.array([1e-300, np.pi, -0.0, np.inf]),
            "none": np.zeros((0, 3), np.float32),
        },
        "flag": np.bool_(True),
        "mask": np.array([[True, False]]),
        "list": [1, "a", None],
        "count": np.int64(3),
        "small": np.array([0.1], np.float32),
    }
    back = from_bytes(to_bytes(value))
    for path in (("sim", "qpos"), ("sim", "none")):
        a = value[path[0]][path[1]]
        b = back[path[0]][path[1]]
        assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    assert (
        back["small"].tobytes() == value["small"].tobytes() and back["mask"].dtype == bool
    )
    assert back["list"] == [1, "a", None] and back["flag"] is True and back["count"] == 3
    with pytest.raises(TypeError, match="cannot be kept"):
        to_bytes({"a": object()})


def test_provenance() -> None:
    run = describe_run(cast("Any", FakeEnv(3, "pick")), POLICY)
    assert re.fullmatch(r"([0-9a-f]{40}(\+changes)?)?", run.commit)
    assert (
        run.versions["mujoco"]
        and run.versions["mjhab"]
        and run.machine
        and "Apache-2.0" in run.licence
    )
    assert "num_envs" not in run.config["env"]
    for view in ("obs_mode", "handle_points"):
        assert view in run.options and view not in run.config["env"]
    assert run.layout["actions"][:2] == ["a0", "a1"] and run.layout["columns"][
        "robot_q"
    ] == [
        0,
        1,
        2,
    ]
    again = describe_run(cast("Any", FakeEnv(1, "pick", images=True)), POLICY)
    assert again == run and again.id == run.id
    other = describe_run(
        cast("Any", FakeEnv(3, "pick")),
        {"name": "random", "noise": 0.1},
        licence="CC BY 4.0",
    )
    assert other.config_id != run.config_id and other.licence == "CC BY 4.0"
    a, b = (
        model_hash(FakeEnv(1).sim.model(home))
        for home in ("builtin_m0_00", "builtin_m0_000")
    )
    assert a != b and a == model_hash(FakeEnv(2).sim.model("builtin_m0_00"))


def test_images() -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (9, 7, 3)).astype(np.uint8)
    depth = rng.integers(0, 32768, (9, 7, 1)).astype(np.int16)
    seg = rng.integers(0, 65536, (9, 7, 1)).astype(np.int32)
    for image, output in ((rgb, "rgb"), (depth, "depth"), (seg, "seg")):
        back = decode(encode(image, output, ImageFormat()), output)
        assert back.dtype == image.dtype and np.array_equal(back, image)
    smooth = np.tile(np.arange(0, 240, 8, dtype=np.uint8)[:, None, None], (1, 30, 3))
    near = decode(encode(smooth, "rgb", ImageFormat("jpeg")), "rgb")
    assert near.shape == smooth.shape and np.abs(near.astype(int) - smooth).max() < 12
    with pytest.raises(ValueError, match="0 to 65535"):
        encode(seg + 65536, "seg", ImageFormat())
    with refused("image format", "jpg", expected="jpeg"):
        ImageFormat("jpg")
    with refused("quality", 100):
        ImageFormat(quality=100)


def test_a_model_is_the_same_from_a_cold_and_from_a_warm_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    pack = open_pack("builtin")
    layout = Layout(pack, ())
    cold, warm = (model_hash(compile_home(layout, pack.homes[0])) for _ in range(2))
    assert cold == warm
