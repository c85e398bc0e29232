"""Intended actions and who acted: from the policy into shards, windows and exports, and shards without them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from mjhab.cli.main import main
from mjhab.core.action_notes import ActionNotes
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.record.recorder import Recorder
from mjhab.data.select.dataset import Normalization, Window, WindowDataset
from mjhab.data.select.interventions import intervention_steps, taught_steps
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import merge, select
from mjhab.data.store.checking import check, repair
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import VERSION
from mjhab.data.store.shard import ShardWriter
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from tests.data.export.exporting import to_lerobot, to_maniskill
from tests.data.fake_world import FakeEnv
from tests.data.make import make_older, record
from tests.refusals import refused

NO_FILMS = FilmTools(
    lambda path, fps: pytest.fail("there is nothing to film"), lambda paths, out: None
)


class Takeover(RandomPolicy):
    """A student that acts with noise; in even episodes another one takes over from the second subtask on."""

    name = "takeover"

    def __init__(self, seed: int, other: str = "expert") -> None:
        super().__init__(seed)
        self.actors = ("student", other)

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        actions = super().act(obs, info)
        even = np.array([spec["index"] % 2 == 0 for spec in info["episode_spec"]])
        expert = even & (info["pointer"] > 0)
        self._notes = ActionNotes(0.5 * actions, expert.astype(np.uint8), self.actors)
        return actions

    def notes(self) -> ActionNotes:
        return self._notes


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "takeover.h5"
    env: Any = FakeEnv(2)
    with ShardWriter(path) as writer:
        rollout(
            env, Takeover(0), range(6), 3, [Recorder(writer, env, {"name": "takeover"})]
        )
    return path


def test_intended_actions_and_actors_are_stored(source: Path) -> None:
    seen = set()
    with open_shard(source) as shard:
        for episode in shard:
            assert (
                not episode_problems(episode)
                and episode.schema == VERSION
                and episode.lacks == ()
            )
            assert episode.actors == ("student", "expert")
            np.testing.assert_array_equal(
                episode.array("actions_intended"), 0.5 * episode.array("actions")
            )
            wanted = (episode.array("subtasks/active")[:-1] > 0) & (
                episode.record.index % 2 == 0
            )
            np.testing.assert_array_equal(episode.array("actor"), wanted)
            seen |= set(episode.array("actor").tolist())
    assert seen == {0, 1}


def test_a_policy_that_says_nothing_means_what_it_does(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", range(2))
    with open_shard(tmp_path / "a.h5") as shard:
        for episode in shard:
            assert episode.actors == ("random",) and not episode.array("actor").any()
            np.testing.assert_array_equal(
                episode.array("actions_intended"), episode.array("actions")
            )


@pytest.mark.parametrize(
    ("intended", "actor", "message"),
    [
        (np.zeros((2, 13)), np.zeros(3, np.uint8), r"actor must be \(2,\) uint8"),
        (np.zeros((2, 13)), np.zeros(2, np.int64), "got .* int64"),
        (np.zeros((2, 13)), np.array([0, 2], np.uint8), "actor 2 has no name"),
    ],
)
def test_notes_that_do_not_fit_are_refused(
    intended: np.ndarray, actor: np.ndarray, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ActionNotes(intended, actor, ("student", "expert"))


def test_intended_actions_of_another_shape_are_refused() -> None:
    class Narrow(RandomPolicy):
        def notes(self) -> ActionNotes:
            return ActionNotes.plain(np.zeros((2, 7), np.float32), self.name)

    with pytest.raises(
        ValueError, match=r"gives actions \(2, 13\) and intended ones \(2, 7\)"
    ):
        rollout(FakeEnv(2), Narrow(0), [0, 1], 0)


def test_actors_without_names_are_refused_and_found(source: Path) -> None:
    with open_shard(source) as shard:
        episode = next(iter(shard))
        arrays = {path: episode.array(path) for path in episode.paths if path != "record"}
        with pytest.raises(
            ValueError, match="actor has the number 1, and there are 1 names"
        ):
            EpisodeData(
                episode.record, episode.run, "m", "success", arrays, actors=("student",)
            )
        with pytest.raises(ValueError, match=r"actions_intended has \d+ columns, not 13"):
            narrow = {**arrays, "actions_intended": arrays["actions"][:, :7]}
            EpisodeData(
                episode.record, episode.run, "m", "success", narrow, actors=episode.actors
            )


def test_shards_of_schema_1_are_read_with_what_stands_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "old.h5"
    record(path, range(3))
    make_older(path)
    with open_shard(path) as shard:
        for episode in shard:
            assert episode.schema == 1 and episode.lacks == ("actions_intended", "actor")
            assert episode.actors == ("random",) and episode.array("actor").shape == (
                episode.steps,
            )
            np.testing.assert_array_equal(
                episode.array("actions_intended"), episode.array("actions")
            )
            assert (
                episode.array("actor").dtype == np.uint8
                and not episode.array("actor").any()
            )
    assert (
        check(path).clean
        and dict(check(path).schemas) == {1: 3}
        and repair(path).kept == 3
    )
    assert main(["data", "check", str(path)]) == 0
    assert "3 episodes are of an older schema" in capsys.readouterr().out


def test_new_episodes_in_an_old_shard(tmp_path: Path) -> None:
    old = tmp_path / "old.h5"
    new = tmp_path / "new.h5"
    merged = tmp_path / "merged.h5"
    record(old, range(2))
    make_older(old)
    record(new, range(2, 4))
    merge([old, new], merged)
    record(old, range(2, 4))
    for path in (old, merged):
        report = check(path)
        assert report.clean and dict(report.schemas) == {1: 2, VERSION: 2}
        with open_shard(path) as shard:
            assert [bool(episode.lacks) for episode in shard] == [
                True,
                True,
                False,
                False,
            ]
        with h5py.File(path) as file:
            assert file.attrs["schema"] == VERSION


def test_an_episode_that_lost_its_intended_actions_is_damaged(
    source: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(source.read_bytes())
    with h5py.File(path, "r+") as file:
        name = min(file["episodes"])  # type: ignore[type-var]
        del file[f"episodes/{name}/actions_intended"]
    assert list(check(path).damaged.values()) == [["actions_intended is missing"]]
    with (
        open_shard(path) as shard,
        refused("dataset", "actions_intended", expected="actions"),
    ):
        shard.episode(str(name)).array("actions_intended")


def test_windows_take_either_actions_for_labels(source: Path, tmp_path: Path) -> None:
    record(tmp_path / "b.h5", range(6, 8), seed=3)
    places = [source, tmp_path / "b.h5"]
    cache = tmp_path / "stats.npz"
    executed = WindowDataset(
        places, Window(chunk=2), normalization=Normalization(cache=cache)
    )
    intended = WindowDataset(
        places,
        Window(chunk=2, labels="intended"),
        normalization=Normalization(cache=cache),
    )
    assert executed.actors == intended.actors == ("student", "expert", "random")
    assert executed.statistics.fingerprint != intended.statistics.fingerprint
    seen = set()
    for i in range(len(executed)):
        a = executed[i]
        b = intended[i]
        halved = a["episode"] < 6
        assert (b["action"] == (0.5 if halved else 1.0) * a["action"]).all()
        assert a["actor"].shape == (2,) and (a["actor"] == 2).all() == (not halved)
        seen |= set(a["actor"].tolist())
    assert seen == {0, 1, 2}
    with refused("labels", "intent", expected="intended"):
        WindowDataset(places, Window(labels="intent"))


def test_exports_hold_both(source: Path, tmp_path: Path) -> None:
    old = tmp_path / "old.h5"
    record(old, range(6, 8), seed=3)
    make_older(old)
    places = [source, old]
    found = [episode for path in places for episode in _read(path)]

    files = to_maniskill(places, tmp_path / "maniskill").files
    told = json.loads(files[0].with_suffix(".json").read_text())["episodes"]
    # Successful episodes are listed first.
    said = {each["episode_id"]: each for each in told}
    with h5py.File(files[0]) as file:
        for number, (actions, intended, actor, actors) in enumerate(found):
            trajectory: Any = file[f"traj_{number}"]
            np.testing.assert_array_equal(trajectory["actions"], actions)
            np.testing.assert_array_equal(trajectory["actions_intended"], intended)
            np.testing.assert_array_equal(trajectory["actor"], actor)
            assert tuple(said[number]["actors"]) == actors
            assert said[number]["lacks"] == (
                ["actions_intended", "actor"] if actors == ("random",) else []
            )

    for version, table in (
        ("3.0", "data/chunk-000/file-000.parquet"),
        ("2.1", "data/chunk-000/episode_000000.parquet"),
    ):
        out = tmp_path / version
        to_lerobot(places, out, NO_FILMS, version=version)
        rows = pq.read_table(out / table)
        count = len(found[0][0])
        np.testing.assert_array_equal(
            rows["intended_action"][:count].to_pylist(), found[0][1]
        )
        np.testing.assert_array_equal(rows["action"][:count].to_pylist(), found[0][0])
        assert rows["actor_index"][:count].to_pylist() == found[0][2].tolist()
        features = json.loads((out / "meta/info.json").read_text())["features"]
        assert (
            features["intended_action"] == features["action"]
            and features["actor_index"]["dtype"] == "int64"
        )
    names = [
        json.loads(line)
        for line in (tmp_path / "2.1/meta/actors.jsonl").read_text().splitlines()
    ]
    assert [row["actor"] for row in names] == ["student", "expert", "random"]
    rows = pq.read_table(tmp_path / "3.0/data/chunk-000/file-000.parquet")
    assert set(rows["actor_index"].to_pylist()) == {0, 1, 2}
    meta = pq.read_table(tmp_path / "3.0/meta/episodes/chunk-000/file-000.parquet")
    assert meta["lacks"].to_pylist() == [""] * 6 + ["actions_intended,actor"] * 2


@pytest.mark.parametrize(
    ("policy", "other"), [("human", "human"), ("take_over", "expert"), ("mine", "expert")]
)
def test_corrections_are_found_filtered_and_exported(
    tmp_path: Path, policy: str, other: str
) -> None:
    """Of a person, and of the expert in rounds of DAgger; an expert that does a subtask by itself corrects nobody."""
    path = tmp_path / "a.h5"
    env: Any = FakeEnv(1)
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, env, {"name": policy})
        rollout(env, Takeover(0, other), range(2), 3, [recorder])
    corrected = policy != "mine"
    marks = []
    with open_shard(path) as shard:
        for episode in shard:
            mask = episode.array("actor") == 1
            np.testing.assert_array_equal(intervention_steps(episode), mask & corrected)
            np.testing.assert_array_equal(taught_steps(episode), mask)
            assert episode.record.actors.get(other, 0) == mask.sum()
            marks += (mask & corrected).tolist()
    assert any(marks) == corrected
    found = select(path, Filter("interventions > 0"))
    assert len(found.matched) == int(corrected)
    assert len(select(path, Filter(f"'{other}' in actors")).matched) == 1 + (
        policy == other
    )

    out = tmp_path / "lerobot"
    to_lerobot([path], out, NO_FILMS)
    rows = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert rows["intervention"].to_pylist() == marks
    said = f"marks the {sum(marks)} frames of 1 episodes"
    assert (said in (out / "README.md").read_text()) == corrected
    files = to_maniskill([path], tmp_path / "maniskill").files
    with h5py.File(files[0]) as file:
        told: list[Any] = [file[f"traj_{k}/intervention"][:] for k in range(2)]  # type: ignore[index]
    assert np.concatenate(told).tolist() == marks


def _read(path: Path) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]]:
    with open_shard(path) as shard:
        return [
            (e.array("actions"), e.array("actions_intended"), e.array("actor"), e.actors)
            for e in shard
        ]
