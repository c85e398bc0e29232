"""Windows for torch: contents, edges, normalization, workers, order."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import BatchSampler, DataLoader

from mjhab.data.record.recorder import Recorder
from mjhab.data.select.dataset import Normalization, SeededSampler, Window, WindowDataset
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import merge
from mjhab.data.select.statistics import Statistics
from mjhab.data.select.until import Until
from mjhab.data.store.episode_files import EpisodeFiles
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes
from mjhab.data.store.schema import DamagedError
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from tests.data.fake_world import SIZE, FakeEnv
from tests.data.make import record, record_pictures
from tests.refusals import refused

DEPTH = "fetch_head/depth"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    for part in range(2):
        env = FakeEnv(subtask="pick", images=True)
        record(
            folder / f"{part}.h5",
            range(3 * part, 3 * part + 3),
            env,
            images=ImageFormat(),
        )
    return folder


def test_windows_hold_what_was_before_and_what_comes(source: Path) -> None:
    data = WindowDataset(source, Window(history=3, chunk=4, images=(DEPTH,)))
    lengths = [episode.steps for episode in episodes(source)]
    assert len(data) == sum(lengths)
    for k, episode in enumerate(episodes(source)):
        state = episode.array("obs/state")
        actions = episode.array("actions")
        for t in (0, 1, 5, episode.steps - 2, episode.steps - 1):
            item = data[sum(lengths[:k]) + t]
            assert (item["episode"], item["step"]) == (k, t)
            np.testing.assert_array_equal(
                item["state"], state[[max(t - 2, 0), max(t - 1, 0), t]]
            )
            ahead = np.arange(t, t + 4)
            np.testing.assert_array_equal(
                item["action"], actions[np.minimum(ahead, episode.steps - 1)]
            )
            assert item["action_is_pad"].tolist() == (ahead >= episode.steps).tolist()
            assert (
                item[DEPTH].shape == (3, 1, SIZE, SIZE)
                and item[DEPTH].dtype == torch.int16
            )
            np.testing.assert_array_equal(
                item[DEPTH][2, 0], episode.frame("fetch_head", "depth", t)[..., 0]
            )
            np.testing.assert_array_equal(
                item[DEPTH][0, 0],
                episode.frame("fetch_head", "depth", max(t - 2, 0))[..., 0],
            )
    with pytest.raises(IndexError):
        data[len(data)]


def test_normalized_numbers_have_mean_zero_and_come_back(
    source: Path, tmp_path: Path
) -> None:
    plain = WindowDataset(source)
    data = WindowDataset(
        source, normalization=Normalization("spread", cache=tmp_path / "stats.npz")
    )
    actions = torch.cat([data[i]["action"] for i in range(len(data))]).numpy()
    np.testing.assert_allclose(actions.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(actions.std(axis=0), 1, atol=1e-4)
    known = Statistics.load(tmp_path / "stats.npz")
    np.testing.assert_allclose(
        known.restore("action", actions[7]), plain[7]["action"][0], atol=1e-5
    )
    assert (
        known.low["state"].shape == (5,)
        and (known.high["state"] >= known.low["state"]).all()
    )


def test_normalized_to_a_range(source: Path) -> None:
    plain = WindowDataset(source)
    data = WindowDataset(source, normalization=Normalization("range"))
    actions = torch.cat([data[i]["action"] for i in range(len(data))]).numpy()
    np.testing.assert_allclose(actions.min(axis=0), -1, atol=1e-5)
    np.testing.assert_allclose(actions.max(axis=0), 1, atol=1e-5)
    back = data.statistics.restore("action", actions[7], "range")
    np.testing.assert_allclose(back, plain[7]["action"][0], atol=1e-5)
    with refused("way to normalize", "rang", expected="range"):
        WindowDataset(source, normalization=Normalization("rang"))


def test_windows_of_episode_files_are_those_of_their_shard(tmp_path: Path) -> None:
    files: Any = EpisodeFiles(tmp_path / "episodes")
    env: Any = FakeEnv(subtask="pick", images=True)
    recorder = Recorder(files, env, {"name": "random"}, images=ImageFormat())
    rollout(env, RandomPolicy(0), [0, 1, 2], 0, [recorder])
    merge([tmp_path], tmp_path.with_name("merged.h5"))
    for frames in ("memory", "decode"):
        apart = WindowDataset(tmp_path, Window(images=(DEPTH,)), frames=frames)
        whole = WindowDataset(
            tmp_path.with_name("merged.h5"), Window(images=(DEPTH,)), frames=frames
        )
        assert len(apart) == len(whole)
        for t in (0, len(whole) // 2, len(whole) - 1):
            for key, values in whole[t].items():
                np.testing.assert_array_equal(apart[t][key], values)


def test_a_file_that_was_replaced_is_told(source: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    record_pictures(path, range(1))
    data = WindowDataset(path, Window(images=(DEPTH,)))
    path.write_bytes(bytes(path.stat().st_size))
    with pytest.raises(
        DamagedError,
        match=r"image 3 of fetch_head depth .* The file may have been replaced",
    ):
        data[3]


def test_statistics_are_computed_once_for_the_same_data(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "stats.npz"
    first = WindowDataset(source, normalization=Normalization(cache=cache)).statistics
    monkeypatch.setattr(Statistics, "of", lambda *a, **k: pytest.fail("computed again"))
    again = WindowDataset(source, normalization=Normalization(cache=cache)).statistics
    np.testing.assert_array_equal(again.mean["action"], first.mean["action"])
    monkeypatch.undo()
    other = WindowDataset(
        source, where=Filter("index < 2"), normalization=Normalization(cache=cache)
    ).statistics
    assert (
        other.fingerprint != first.fingerprint
        and Statistics.load(cache).fingerprint == other.fingerprint
    )
    assert (
        WindowDataset(source, normalization=Normalization(statistics=first)).statistics
        is first
    )
    cache.write_bytes(b"no statistics")
    with refused(where="stats.npz", said="delete it"):
        WindowDataset(source, normalization=Normalization(cache=cache))


def test_workers_read_the_same(source: Path) -> None:
    data = WindowDataset(
        source, Window(history=2, images=(DEPTH,)), where=Filter("index < 4")
    )
    alone = [data[i] for i in range(len(data))]
    batches = list(
        DataLoader(data, batch_size=16, num_workers=2, multiprocessing_context="fork")
    )
    for key in ("state", "action", DEPTH):
        together = torch.cat([batch[key] for batch in batches])
        assert torch.equal(together, torch.stack([item[key] for item in alone]))
    # What a spawned worker is given: no open files.
    sent = pickle.loads(pickle.dumps(data))
    assert torch.equal(sent[5][DEPTH], alone[5][DEPTH])


def test_order_is_a_function_of_seed_and_epoch(source: Path) -> None:
    data = WindowDataset(source)
    sampler = SeededSampler(len(data), seed=3)
    other = SeededSampler(len(data), seed=3)
    first = list(sampler)
    second = list(sampler)
    assert sorted(first) == list(range(len(data))) == sorted(second) and first != second
    other.set_epoch(1)
    assert list(other) == second and list(SeededSampler(len(data), seed=4)) != first


def test_filter_and_bad_input(source: Path) -> None:
    chosen = WindowDataset(source, where=Filter("index in (0, 5)"))
    assert {chosen[i]["episode"] for i in range(len(chosen))} == {0, 1}
    with refused(said="no episode passes"):
        WindowDataset(source, where=Filter("index > 99"))
    with refused(said="replay --render"):
        WindowDataset(source, Window(images=("fetch_hand/rgb",)))
    with refused("history and chunk", (0, 1)):
        WindowDataset(source, Window(history=0))


@pytest.mark.parametrize("place", ["memory", "decode", "folder"])
def test_a_batch_is_its_windows(source: Path, tmp_path: Path, place: str) -> None:
    frames = tmp_path if place == "folder" else place
    data = WindowDataset(
        source, Window(history=2, chunk=3, images=(DEPTH,)), frames=frames
    )
    order = [len(data) - 1, 0, 20, 21, 0]
    for _ in range(2):
        batch = data[order]
        for k, index in enumerate(order):
            for key, value in data[index].items():
                assert torch.equal(batch[key][k], torch.as_tensor(value)), key
    sampler = BatchSampler(SeededSampler(len(data)), 16, drop_last=False)
    whole = torch.cat(
        [each["step"] for each in DataLoader(data, sampler=sampler, batch_size=None)]
    )
    assert len(whole) == len(data)
    assert not list(tmp_path.iterdir())
    with pytest.raises(IndexError):
        data[[0, len(data)]]


def test_windows_end_some_steps_after_success(
    source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = WindowDataset(source, Window(images=(DEPTH,)))
    kept = 7
    monkeypatch.setattr(
        Until, "steps", lambda self, ok: len(ok) if self.is_whole else kept
    )
    data = WindowDataset(source, Window(images=(DEPTH,)), until="success+2")
    assert len(data) == kept * len(list(episodes(source))) < len(whole)
    assert data.statistics.fingerprint != whole.statistics.fingerprint
    last = data[kept - 1]
    assert last["step"] == kept - 1 and torch.equal(last[DEPTH], whole[kept - 1][DEPTH])
    assert (data[kept]["episode"], data[kept]["step"]) == (1, 0)


def test_until_is_read_and_counts_from_the_first_success() -> None:
    success = np.array([0, 0, 1, 0, 1, 1, 1], np.uint8)
    assert [
        Until.parse(text).steps(success) for text in ("", "success", "success+2")
    ] == [7, 3, 5]
    assert Until.parse("success+90").steps(success) == Until(0).steps(success * 0) == 7
    for wrong in ("success+", "success-1", "succes+3", "success+1e3"):
        with refused("until"):
            Until.parse(wrong)
