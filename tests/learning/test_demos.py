"""Demonstrations: truncation, chunks, batches, images, and what is read from shards."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mjhab.core.errors import UsageError
from mjhab.core.seeding import stream
from mjhab.data.select.query import Filter
from mjhab.data.select.until import Until
from mjhab.data.store.places import episodes
from mjhab.learning.batches import (
    BatchSampler,
    shift_colours,
    shift_images,
    take_chunks,
)
from mjhab.learning.configs import InputConfig
from mjhab.learning.demos import (
    load_demonstrations,
    observation_spec_of_data,
)
from mjhab.learning.observation.depth import nearness
from mjhab.learning.observation.parts import base_velocity
from tests.data.fake_world import SIZE
from tests.data.make import record_pictures
from tests.learning.small import INPUTS, condition_of, demonstrations


@given(st.lists(st.booleans(), min_size=1, max_size=30), st.integers(-1, 20))
def test_a_demonstration_ends_some_steps_after_its_first_success(
    success: list[bool], hold: int
) -> None:
    kept = Until(hold).steps(np.array(success, np.uint8))
    if hold < 0 or not any(success):
        assert kept == len(success)
    else:
        assert kept == min(len(success), success.index(True) + 1 + hold)


@given(st.integers(1, 9), st.integers(1, 4), st.integers(0, 100))
def test_chunks_stay_in_their_episode(chunk: int, history: int, seed: int) -> None:
    lengths = (7, 11, 5)
    data = demonstrations(seed, lengths)
    taken = take_chunks(data, data.usable, chunk, history)
    starts = np.cumsum([0, *lengths])
    for row in data.usable.tolist():
        episode = int(np.searchsorted(starts, row, side="right")) - 1
        left = starts[episode + 1] - row
        assert taken.valid[row].tolist() == [k < left for k in range(chunk)]
        np.testing.assert_array_equal(
            taken.actions[row][: min(chunk, left)], data.actions[row : row + chunk][:left]
        )
        seen = taken.vector[row].reshape(history, -1)
        np.testing.assert_array_equal(seen[-1], data.vector[row])
        np.testing.assert_array_equal(
            seen[0], data.vector[max(row - history + 1, starts[episode])]
        )
    assert taken.images.shape[1] == history


def test_demonstrations_without_images_make_chunks() -> None:
    data = demonstrations(0, (7,))
    blind = dataclasses.replace(
        data, images=np.zeros((len(data.vector), 0, 0, 0), np.uint8)
    )
    taken = take_chunks(blind, data.usable, 2, history=3)
    assert taken.images.shape == (len(data.usable), 0, 0, 0)
    assert taken.vector.shape == (len(data.usable), 3 * data.vector.shape[1])


def test_batches_mix_old_and_new_and_depend_on_seed_and_number_alone() -> None:
    sources = [demonstrations(seed) for seed in range(3)]
    sampler, again = (BatchSampler(sources, 40, 0.5, seed=3) for _ in range(2))
    batch = sampler.batch(7, 4, InputConfig())
    np.testing.assert_array_equal(batch.images, again.batch(7, 4, InputConfig()).images)
    assert (batch.vector != sampler.batch(8, 4, InputConfig()).vector).any()
    rows = sampler.rows(7)
    assert rows[0][0] is sources[-1] and len(rows[0][1]) == 20
    assert sum(len(part) for _, part in rows) == 40
    old = np.concatenate(
        [
            np.concatenate([part for s, part in sampler.rows(k) if s is sources[0]])
            for k in range(40)
        ]
    )
    assert set(old.tolist()) == set(sources[0].usable.tolist())
    assert len(BatchSampler(sources[:1], 40, 0.5, 0).rows(0)[0][1]) == 40


def test_colours_change_and_depth_stays() -> None:
    inputs = InputConfig(cameras=("a",), images="rgbd", colour_shift=0.2, history=2)
    random = np.random.default_rng(0)
    images = random.integers(90, 140, (3, 8, 4, 4), dtype=np.uint8)
    changed = shift_colours(images, inputs, stream(0, "colours", 0))
    depth, colours = [0, 4], [1, 2, 3, 5, 6, 7]
    np.testing.assert_array_equal(changed[:, depth], images[:, depth])
    gains = changed[:, colours] / images[:, colours]
    assert 0.6 < gains.min() < 0.95 and 1.05 < gains.max() < 1.5
    # One change in all images of a sample, another in the next sample.
    whole = gains.mean(axis=(2, 3))
    np.testing.assert_allclose(whole[:, :3], whole[:, 3:], atol=0.01)
    assert np.ptp(whole, axis=0).min() > 0.02
    again = shift_colours(torch.as_tensor(images), inputs, stream(0, "colours", 0))
    np.testing.assert_array_equal(again.numpy(), changed)


def test_batches_on_a_device_are_those_of_numpy() -> None:
    sources = [demonstrations(seed) for seed in range(3)]
    batch = BatchSampler(sources, 40, 0.5, seed=3).batch(7, 4, InputConfig(history=2))
    there = [source.on(torch.device("cpu")) for source in sources]
    same = BatchSampler(there, 40, 0.5, seed=3).batch(7, 4, InputConfig(history=2))
    for name in ("vector", "images", "actions", "valid"):
        assert isinstance(getattr(same, name), torch.Tensor)
        np.testing.assert_array_equal(getattr(same, name).numpy(), getattr(batch, name))


def test_only_usable_steps_are_drawn() -> None:
    data = demonstrations()
    data.usable[:] = 3
    assert set(BatchSampler([data], 16, 1.0, 0).rows(0)[0][1].tolist()) == {3}


@given(st.integers(1, 3), st.integers(0, 50))
def test_shifted_images_are_crops_with_the_edge_repeated(most: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    images = random.integers(0, 256, (3, 2, 6, 6), np.uint8)
    moved = shift_images(images, most, random)
    padded = np.pad(images, ((0, 0), (0, 0), (most, most), (most, most)), mode="edge")
    for image, out in zip(padded, moved, strict=True):
        crops = [
            image[:, y : y + 6, x : x + 6]
            for y in range(2 * most + 1)
            for x in range(2 * most + 1)
        ]
        assert any((crop == out).all() for crop in crops)


def test_near_things_are_bright() -> None:
    assert nearness(np.array([0, 500, 1000, 32767], np.int16)).tolist() == [
        255,
        137,
        61,
        0,
    ]


def test_base_velocity_is_along_the_base() -> None:
    q = np.array([[0.0, 0.0, np.pi / 2], [0.0, 0.0, np.pi]])
    qd = np.array([[0.0, 2.0, 0.5], [1.0, 0.0, -1.0]])
    np.testing.assert_allclose(
        base_velocity(q, qd), [[2.0, 0.5], [-1.0, -1.0]], atol=1e-7
    )


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demos")
    record_pictures(folder / "picks.h5", range(4))
    return folder


EVERY = Filter("success or not success")


def test_what_is_read_is_what_was_recorded(source: Path) -> None:
    told = observation_spec_of_data(source, INPUTS, EVERY)
    assert told.targets == ("024_bowl",) and told.state == (
        ("agent/qpos", 4),
        ("extra/is_grasped", 1),
    )
    data = load_demonstrations(source, told, -1, EVERY)
    at = 0
    for episode in episodes(source):
        n = episode.steps
        rows = slice(at, at + n)
        actions = episode.array("actions")
        state = data.vector[rows, :5]
        last = data.vector[rows, 5:18]
        np.testing.assert_array_equal(state, episode.array("obs/state")[:n])
        np.testing.assert_array_equal(last[1:], actions[:-1])
        assert not last[0].any()
        assert (data.vector[rows, 18:] == condition_of(told, "pick", "024_bowl")).all()
        np.testing.assert_array_equal(data.actions[rows], actions)
        frame = episode.frame("fetch_head", "depth", 2)[..., 0]
        np.testing.assert_array_equal(data.images[at + 2, 0], nearness(frame))
        at += n
    assert at == len(data.vector) and data.episodes == 4
    assert data.vector.shape[1] == told.width


def test_several_processes_read_the_same(source: Path, tmp_path: Path) -> None:
    shutil.copy(source / "picks.h5", tmp_path / "some.h5")
    record_pictures(tmp_path / "more.h5", range(4, 6))
    told = observation_spec_of_data(tmp_path, INPUTS, EVERY)
    one, two = (
        load_demonstrations(tmp_path, told, -1, EVERY, workers) for workers in (1, 2)
    )
    assert one.episodes > 4
    for name in ("vector", "images", "actions", "first", "last", "usable"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_data_that_do_not_fit_are_refused_with_what_to_do(
    source: Path, tmp_path: Path
) -> None:
    larger = InputConfig(cameras=("fetch_head",), image_size=2 * SIZE)
    with pytest.raises(
        UsageError,
        match=f"16x16 px; the preset needs 32x32 px.*replay.*--camera-size {2 * SIZE}",
    ):
        observation_spec_of_data(source, larger, EVERY)
    hand = InputConfig(cameras=("fetch_hand",), image_size=SIZE)
    with pytest.raises(UsageError, match=r"no depth images of fetch_hand.*mjhab replay"):
        observation_spec_of_data(source, hand, EVERY)
    with pytest.raises(UsageError, match="no episode passes"):
        observation_spec_of_data(source, INPUTS, Filter("steps > 1000"))
    told = observation_spec_of_data(source, INPUTS, EVERY)
    record_pictures(tmp_path / "other.h5", range(1), "close")
    with pytest.raises(
        UsageError, match="unknown target of this student 'kitchen_counter/drawer3'"
    ):
        load_demonstrations(tmp_path, told, 3, EVERY)
