"""Files that are not ours, not of this version, cut, rotten: clear errors, and repair saves what can be saved."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.data.select.sets import select
from mjhab.data.store.checking import check, repair
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.episode_data import episode_digest, from_bytes, run_id, to_bytes
from mjhab.data.store.episode_files import EpisodeFiles
from mjhab.data.store.hdf5 import dataset, group, read_arrays
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes, shard_paths
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.schema import (
    ATTRIBUTES,
    FIELDS,
    FORCES,
    STORED_CHECKS,
    VERSION,
    DamagedError,
    field_of,
)
from mjhab.data.store.shard import ShardWriter
from mjhab.tasks.label_state import History
from mjhab.tasks.signals import Signals
from tests.data.fake_world import FakeEnv
from tests.data.make import numbered, one_episode, record
from tests.refusals import refused

DOCS = Path(__file__).parents[3] / "docs" / "data" / "format.md"


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    record(tmp_path / "a.h5", range(4))
    return tmp_path / "a.h5"


def spoil(path: Path, data: str) -> str:
    """Turn a byte of a dataset of the second episode; returns the name of that episode."""
    with h5py.File(path) as file:
        name = sorted(group(file, "episodes"))[1]
    return spoil_in(path, name, data)


def spoil_in(path: Path, name: str, data: str) -> str:
    """Turn a byte of a dataset of an episode; returns the name of the episode."""
    with h5py.File(path) as file:
        item = dataset(file, f"episodes/{name}/{data}")
        at = item.id.get_chunk_info(0).byte_offset + item.id.get_storage_size() // 2
    with open(path, "r+b") as raw:
        raw.seek(at)
        byte = raw.read(1)
        raw.seek(at)
        raw.write(bytes([byte[0] ^ 0x55]))
    return name


def contents(path: Path) -> dict[str, tuple[dict[str, Any], bytes]]:
    """Attributes and actions of the episodes of a shard."""
    return {e.name: (e.attributes, e.array("actions").tobytes()) for e in episodes(path)}


def test_foreign_files(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("hello")
    (tmp_path / "empty.h5").write_bytes(b"")
    with h5py.File(tmp_path / "other.h5", "w", libver="latest") as file:
        file.create_group("traj_0")
    with h5py.File(tmp_path / "old.h5", "w") as file:
        file.create_group("traj_0")
    for name, message in (
        ("text", "not an HDF5 file"),
        ("empty", "not an HDF5 file"),
        ("other", "holds no episodes of mjhab (it holds traj_0)"),
        ("old", "of a kind that mjhab does not write"),
    ):
        path = tmp_path / f"{name}.h5"
        before = path.read_bytes()
        for act in (open_shard, repair, ShardWriter):
            with pytest.raises(DamagedError, match=re.escape(message)):
                act(path)
        assert path.read_bytes() == before
    report = check(tmp_path)
    assert len(report.unreadable) == 4 and not report.clean and report.episodes == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "empty.h5",
        "old.h5",
        "other.h5",
        "text.h5",
    ]


@pytest.mark.parametrize("version", [0, VERSION + 6])
def test_other_versions(shard: Path, version: int) -> None:
    with h5py.File(shard, "r+") as file:
        file.attrs["schema"] = version
        file.attrs["mjhab"] = "9.8"
    how = (
        "Update mjhab to 9.8 or later" if version > VERSION else "Read it with mjhab 9.8"
    )
    before = shard.read_bytes()
    for act in (open_shard, ShardWriter, repair, check):
        with refused(where=shard, said=f"reads schema 1 to {VERSION}. {how}"):
            act(shard)
    assert shard.read_bytes() == before


def test_what_a_later_version_adds_is_passed_over(shard: Path) -> None:
    """Names that this version does not know do no harm: that is the rule by which they need no other schema version."""
    with h5py.File(shard, "r+") as file:
        runs = group(file, "runs")
        episode = group(file, f"episodes/{min(group(file, 'episodes'))}")
        run = min(runs)
        values = {**from_bytes(dataset(runs, run)[()]), "weather": "rain"}
        record_ = {**from_bytes(dataset(episode, "record")[()]), "mood": "good"}
        del episode["record"]
        episode["record"] = to_bytes(record_)
        episode["audio/left"] = np.zeros(5)
        runs[run_id(values)] = to_bytes(values)
        episode.attrs["run"] = run_id(values)
        episode.attrs["colour"] = "red"
        episode.attrs["digest"] = episode_digest(read_arrays(episode))
    assert check(shard).clean and repair(shard).kept == 4
    with open_shard(shard) as opened:
        first = next(iter(opened))
        assert first.record.steps == first.steps and first.run.config["policy"] == {
            "name": "random"
        }
        assert (
            first.array("audio/left").shape == (5,)
            and first.attributes["colour"] == "red"
        )


def test_places(tmp_path: Path, shard: Path) -> None:
    deep = tmp_path / "pick" / "bowl"
    deep.mkdir(parents=True)
    record(deep / "b.h5", range(1), seed=1)
    assert (
        shard_paths(tmp_path)
        == shard_paths([shard, tmp_path, deep])
        == [shard, deep / "b.h5"]
    )
    assert len(list(episodes(tmp_path))) == 5
    (tmp_path / "none").mkdir()
    with refused(said="no shards (*.h5) in"):
        shard_paths(tmp_path / "none")
    for act in (open_shard, shard_paths, repair):
        with refused(where="nowhere.h5", said="does not exist"):
            act(tmp_path / "nowhere.h5")
    with (
        open_shard(shard) as opened,
        refused(
            f"episode in {shard}",
            opened.names[0][:-1] + "9",
            expected=opened.names[0],
        ),
    ):
        opened.episode(opened.names[0][:-1] + "9")


@pytest.mark.parametrize("data", ["states/qpos", "states/qvel", "record", "actions"])
def test_a_rotten_byte_is_found_and_the_rest_is_saved(shard: Path, data: str) -> None:
    before = {e.name: e.attributes for e in episodes(shard)}
    name = spoil(shard, data)
    report = check(shard)
    assert (
        list(report.damaged) == [(shard, name)]
        and report.ok == 3
        and report.episodes == 4
    )
    done = repair(shard)
    assert (
        done.kept == 3
        and list(done.lost) == [name]
        and done.kept_as == shard.with_name("a.h5.damaged")
    )
    assert check(shard).clean
    assert {e.name: e.attributes for e in episodes(shard)} == {
        k: v for k, v in before.items() if k != name
    }
    assert sorted(p.name for p in shard.parent.iterdir()) == ["a.h5", "a.h5.damaged"]
    assert repair(shard).kept_as is None
    spoil(shard, data)
    assert repair(shard).kept_as == shard.with_name("a.h5.damaged1")


def test_a_cut_file(shard: Path) -> None:
    size = shard.stat().st_size
    os.truncate(shard, size - 3000)
    message = r"cannot be read: it is cut off, [\d,]+ of its [\d,]+ bytes.*Copy it again"
    for act in (open_shard, repair, ShardWriter):
        with pytest.raises(DamagedError, match=message):
            act(shard)
    report = check(shard)
    assert list(report.unreadable) == [shard] and not report.clean
    assert shard.stat().st_size == size - 3000


def test_a_damaged_episode_file_is_put_aside(tmp_path: Path) -> None:
    files = EpisodeFiles(tmp_path / "episodes")
    template = one_episode(tmp_path / "one")
    for index in range(3):
        files.append(numbered(template, index))
    path = files.path_of(sorted(files.names)[1])
    name = spoil_in(path, path.stem, "states/qpos")
    assert list(check(files.folder).damaged) == [(path, name)]
    done = repair(path)
    assert done.kept == 0 and list(done.lost) == [name]
    assert done.kept_as == path.with_name(f"{path.name}.damaged") and not path.exists()
    assert check(files.folder).ok == len(select(files.folder).matched) == 2


def test_bytes_turned_anywhere_never_pass_unseen(tmp_path: Path) -> None:
    """A flip is either found or hits bytes that nothing reads; what is read as good is what was written."""
    path = tmp_path / "a.h5"
    record(path, range(3), FakeEnv(1, "pick", horizon=6))
    good = path.read_bytes()
    truth = contents(path)
    rng = np.random.default_rng(0)
    found = 0
    for at in rng.integers(0, len(good), 80):
        path.write_bytes(
            good[:at] + bytes([good[at] ^ (1 << int(rng.integers(8)))]) + good[at + 1 :]
        )
        try:
            report = check(path)
        except UsageError as error:
            assert "schema" in str(error)
            continue
        found += not report.clean
        if report.clean:
            assert contents(path) == truth
    assert found > 55


def test_text_lies_where_checksums_are(tmp_path: Path) -> None:
    """Text of variable length lies in a heap without checksum, where one turned bit sends HDF5 round for ever."""
    record(tmp_path / "a.h5", range(1))
    assert b"GCOL" not in (tmp_path / "a.h5").read_bytes()


def test_episodes_may_be_kept_longer_than_their_shard_is_open(tmp_path: Path) -> None:
    for part in range(2):
        record(
            tmp_path / f"{part}.h5",
            range(2 * part, 2 * part + 2),
            FakeEnv(1, images=True),
            images=ImageFormat(),
        )
    kept = list(episodes(tmp_path))
    for episode, now in zip(kept, episodes(tmp_path), strict=True):
        assert (episode.record, episode.attributes, episode.run) == (
            now.record,
            now.attributes,
            now.run,
        )
        assert episode.paths == now.paths and episode.columns("obs/state") == now.columns(
            "obs/state"
        )
        assert (
            episode.nbytes == now.nbytes
            and episode.images == now.images
            and not episode_problems(episode)
        )
        for key in ("state", "agent/qpos", "sensor_data/fetch_head/depth"):
            np.testing.assert_array_equal(episode.observation(key), now.observation(key))
        before_places = episode.frame_places("fetch_head", "rgb")
        places = now.frame_places("fetch_head", "rgb")
        assert before_places is not None and places is not None
        assert before_places[0] == places[0]
        np.testing.assert_array_equal(
            episode.history(0)[1].success, now.history(0)[1].success
        )
    kept[0].shard.path.unlink()
    with refused(where="0.h5", said="does not exist"):
        kept[0].array("actions")


def test_doubled_episodes_are_found(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", range(3))
    record(tmp_path / "b.h5", range(2, 5))
    report = check(tmp_path)
    assert report.ok == 6 and len(report.doubled) == 1 and not report.clean


def test_the_schema_names_what_labels_need() -> None:
    assert set(History.__dataclass_fields__) <= set(STORED_CHECKS)
    assert {*STORED_CHECKS, *FORCES, "kind"} == set(Signals.__dataclass_fields__)
    for path in ("obs/agent/qpos", "images/fetch_head/rgb/ends", "states/qpos"):
        assert field_of(path) is not None
    assert field_of("images/fetch_head/ends") is None and field_of("extra") is None


def test_files_hold_what_the_schema_says(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", range(1), FakeEnv(1, images=True), images=ImageFormat())
    with open_shard(tmp_path / "a.h5") as shard:
        episode: RecordedEpisode = next(iter(shard))
        assert {field.path for path in episode.paths if (field := field_of(path))} == {
            f.path for f in FIELDS
        }
        assert set(episode.attributes) == set(ATTRIBUTES)


def test_docs_show_the_schema() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for field in FIELDS:
        path = f"`{field.path}`" + (" (optional)" if field.optional else "")
        assert (
            f"| {path} | {field.shape} | {field.dtype} | {field.unit} | {field.meaning} |"
            in text
        )
    for name, meaning in ATTRIBUTES.items():
        assert f"| `{name}` | {meaning} |" in text
    assert f"schema {VERSION}" in text
