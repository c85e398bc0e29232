"""Wrappers: frame stacks in every autoreset mode, state and pixels, normalised images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import mjhab.envs as envs
from mjhab.envs.wrappers import (
    FlattenStatePixels,
    FrameStack,
    NormalizeImages,
    denormalize_depth,
    normalize_depth,
)
from mjhab.robots.fetch.robot import ROBOT
from tests.refusals import refused

DEPTH, RGB, SEG = (f"sensor_data/cam/{output}" for output in ("depth", "rgb", "seg"))
SAME = AutoresetMode.SAME_STEP
NEXT = AutoresetMode.NEXT_STEP
DISABLED = AutoresetMode.DISABLED


class CountingEnv(VectorEnv):
    """Worlds whose depth is 1000 * world + 100 * episode + step, and whose episodes last 2, 3, ... steps."""

    def __init__(self, mode: AutoresetMode, num_envs: int = 2) -> None:
        self.num_envs = num_envs
        self.mode = mode
        self.metadata = {"autoreset_mode": mode}
        self.rows = spaces.Dict(
            {
                "state": spaces.Box(-np.inf, np.inf, (4,), np.float32),
                "sensor_param/cam/intrinsic_cv": spaces.Box(
                    -np.inf, np.inf, (3, 3), np.float32
                ),
                DEPTH: spaces.Box(0, 32767, (2, 3, 1), np.int16),
                RGB: spaces.Box(0, 255, (2, 3, 3), np.uint8),
                SEG: spaces.Box(0, 99, (2, 3, 1), np.int32),
            }
        )
        self.single_observation_space = self.rows
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.single_action_space = spaces.Discrete(2)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._step = np.zeros(num_envs, int)
        self._episode = np.full(num_envs, -1)
        self._ended = np.zeros(num_envs, bool)

    def _begin(self, mask: np.ndarray) -> None:
        self._step[mask] = 0
        self._episode[mask] += 1

    def _observe(self) -> dict[str, np.ndarray]:
        value = 1000 * np.arange(self.num_envs) + 100 * self._episode + self._step
        shape = (self.num_envs, 1, 1, 1)
        rgb = (
            np.zeros((self.num_envs, 2, 3, 3), np.uint8)
            + np.arange(18, dtype=np.uint8).reshape(2, 3, 3) * 14
        )
        return {
            "state": np.repeat(value[:, None], 4, axis=1).astype(np.float32),
            "sensor_param/cam/intrinsic_cv": np.tile(
                np.eye(3, dtype=np.float32), (self.num_envs, 1, 1)
            ),
            DEPTH: np.broadcast_to(value.reshape(shape), (self.num_envs, 2, 3, 1)).astype(
                np.int16
            ),
            RGB: rgb,
            SEG: np.full((self.num_envs, 2, 3, 1), 7, np.int32),
        }

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        self._begin(mask)
        self._ended[mask] = False
        return self._observe(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        again = self._ended if self.mode == NEXT else np.zeros(self.num_envs, bool)
        self._step += 1
        self._begin(again)
        done = (self._step >= np.arange(self.num_envs) + 2) & ~again
        info: dict[str, Any] = {}
        if self.mode == SAME and done.any():
            info = {"final_obs": self._observe(), "_final_obs": done}
            self._begin(done)
        self._ended = done.copy()
        return (
            self._observe(),
            np.ones(self.num_envs),
            done,
            np.zeros(self.num_envs, bool),
            info,
        )


class Frames:
    """Drives a FrameStack of 3 and reads each world's frames as lists of numbers."""

    def __init__(self, env: FrameStack) -> None:
        self.env = env
        self.info = dict[str, Any]()

    def reset(self, mask: list[bool] | None = None) -> list[list[int]]:
        options = None if mask is None else {"reset_mask": np.array(mask)}
        obs, self.info = self.env.reset(options=options)
        return self._read(obs)

    def step(self) -> list[list[int]]:
        obs, _, _, _, self.info = self.env.step(np.zeros(self.env.num_envs, int))
        return self._read(obs)

    def final(self) -> list[list[int]]:
        return self._read(self.info["final_obs"])

    def _read(self, obs: dict[str, np.ndarray]) -> list[list[int]]:
        assert self.env.observation_space.contains(obs)
        frames = obs[DEPTH]
        assert (frames == frames[:, :, :1, :1]).all()
        return frames[:, :, 0, 0, 0].tolist()


def stack(mode: AutoresetMode) -> Frames:
    return Frames(FrameStack(CountingEnv(mode), 3))


def test_frames_same_step():
    env = stack(SAME)
    assert env.reset() == [[0, 0, 0], [1000, 1000, 1000]]
    assert env.step() == [[0, 0, 1], [1000, 1000, 1001]]
    assert "final_obs" not in env.info
    assert env.step() == [[100, 100, 100], [1000, 1001, 1002]]  # world 0 ended
    assert env.final() == [[0, 1, 2], [1000, 1001, 1002]]
    assert env.info["_final_obs"].tolist() == [True, False]
    assert env.step() == [[100, 100, 101], [1100, 1100, 1100]]  # world 1 ended
    assert env.final() == [[100, 100, 101], [1001, 1002, 1003]]
    assert env.step() == [[200, 200, 200], [1100, 1100, 1101]]  # world 0 ended again
    assert env.final() == [[100, 101, 102], [1100, 1100, 1101]]


def test_frames_next_step():
    env = stack(NEXT)
    assert env.reset() == [[0, 0, 0], [1000, 1000, 1000]]
    assert env.step() == [[0, 0, 1], [1000, 1000, 1001]]
    assert env.step() == [[0, 1, 2], [1000, 1001, 1002]]  # world 0 ended: its last frames
    assert env.step() == [
        [100, 100, 100],
        [1001, 1002, 1003],
    ]  # it starts anew; world 1 ended
    assert env.step() == [[100, 100, 101], [1100, 1100, 1100]]
    assert env.step() == [[100, 101, 102], [1100, 1100, 1101]]
    assert "final_obs" not in env.info


def test_frames_next_step_with_a_reset_in_between():
    env = stack(NEXT)
    env.reset()
    env.step()
    assert env.step() == [[0, 1, 2], [1000, 1001, 1002]]  # world 0 ended
    assert env.reset([True, False]) == [[100, 100, 100], [1000, 1001, 1002]]
    assert env.step() == [
        [100, 100, 101],
        [1001, 1002, 1003],
    ]  # no second reset of world 0


def test_frames_disabled():
    env = stack(DISABLED)
    assert env.reset() == [[0, 0, 0], [1000, 1000, 1000]]
    env.step()
    assert env.step() == [[0, 1, 2], [1000, 1001, 1002]]  # world 0 ended and stays
    assert env.reset([True, False]) == [[100, 100, 100], [1000, 1001, 1002]]
    assert env.step() == [[100, 100, 101], [1001, 1002, 1003]]
    assert env.step() == [[100, 101, 102], [1002, 1003, 1004]]  # nobody resets world 1
    assert env.reset() == [[200, 200, 200], [1100, 1100, 1100]]


@pytest.mark.parametrize("mode", [SAME, NEXT, DISABLED])
def test_reset_by_mask_leaves_frames_of_other_worlds(mode):
    env = stack(mode)
    env.reset()
    env.step()
    before = env.env.get_frames(0)
    assert env.reset([False, True]) == [[0, 0, 1], [1100, 1100, 1100]]
    assert {k: v.tobytes() for k, v in env.env.get_frames(0).items()} == {
        k: v.tobytes() for k, v in before.items()
    }


def test_frames_are_the_callers_own_and_can_be_put_back():
    env = stack(DISABLED)
    env.reset()
    obs, *_ = env.env.step(np.zeros(2, int))
    saved = env.env.get_frames(1)
    obs[DEPTH][:] = 9
    assert env.step() == [[0, 1, 2], [1000, 1001, 1002]]
    env.env.set_frames(1, saved)
    assert env.step() == [[1, 2, 3], [1000, 1001, 1003]]


def test_only_the_keys_asked_for_are_stacked():
    env = FrameStack(CountingEnv(SAME), 2, keys=["state", RGB])
    obs, _ = env.reset()
    assert env.observation_space.contains(obs)
    assert (
        obs["state"].shape == (2, 2, 4)
        and obs[RGB].shape == (2, 2, 2, 3, 3)
        and obs[DEPTH].shape == (2, 2, 3, 1)
    )
    obs, *_, info = env.step(np.zeros(2, int))
    obs, *_, info = env.step(np.zeros(2, int))
    assert obs["state"][0, :, 0].tolist() == [100, 100] and info["final_obs"]["state"][
        0, :, 0
    ].tolist() == [1, 2]
    np.testing.assert_array_equal(info["final_obs"][DEPTH][:, 0, 0, 0], [2, 1002])


@pytest.mark.parametrize("mode", [SAME, NEXT, DISABLED])
def test_gymnasiums_statistics_agree_above_and_below(mode):
    for build in (
        lambda e: RecordEpisodeStatistics(FrameStack(e, 3)),
        lambda e: FrameStack(RecordEpisodeStatistics(e), 3),
    ):
        env = build(CountingEnv(mode))
        lengths = []
        env.reset()
        done = np.zeros(2, bool)
        for _ in range(12):
            if mode == DISABLED and done.any():
                env.reset(options={"reset_mask": done})
            _, _, done, _, info = env.step(np.zeros(2, int))
            assert ("episode" in info) == done.any()
            lengths += [
                (w, info["episode"]["l"][w], info["episode"]["r"][w])
                for w in np.flatnonzero(done)
            ]
        assert len(lengths) >= 6 and {(0, 2, 2.0), (1, 3, 3.0)} == set(lengths)


def test_flat_state_and_pixels_with_channels_first():
    env = FlattenStatePixels(CountingEnv(SAME))
    obs, _ = env.reset()
    assert env.observation_space.contains(obs) and set(obs) == {"state", "pixels"}
    assert {k: v.shape for k, v in obs["pixels"].items()} == {
        "cam_depth": (2, 1, 2, 3),
        "cam_rgb": (2, 3, 2, 3),
        "cam_seg": (2, 1, 2, 3),
    }
    assert obs["state"].shape == (2, 4) and obs["pixels"]["cam_depth"].dtype == np.int16
    assert obs["pixels"]["cam_rgb"][0, 2, 1, 0] == 14 * (3 * 3 + 2)


def test_flat_pixels_of_a_stack_in_the_final_observation_too():
    env = FlattenStatePixels(FrameStack(CountingEnv(SAME), 3))
    env.reset()
    env.step(np.zeros(2, int))
    obs, *_, info = env.step(np.zeros(2, int))
    for seen in (obs, info["final_obs"]):
        assert env.observation_space.contains(seen)
        assert seen["pixels"]["cam_depth"].shape == (2, 3, 1, 2, 3)
        assert seen["pixels"]["cam_rgb"].shape == (2, 3, 3, 2, 3)
    assert obs["pixels"]["cam_depth"][0, :, 0, 1, 2].tolist() == [100, 100, 100]
    assert info["final_obs"]["pixels"]["cam_depth"][0, :, 0, 1, 2].tolist() == [0, 1, 2]
    assert info["final_obs"]["state"][0].tolist() == [2, 2, 2, 2]


@pytest.mark.parametrize(
    "cameras", [("fetch_head", "fetch_hand"), ("fetch_hand", "fetch_head")]
)
def test_cameras_keep_the_order_asked_for(cameras: tuple[str, ...]):
    """Learners join images in the order in which they find them, in spaces as in observations."""
    env = envs.make(
        task="tidy_house",
        subtask="pick",
        num_envs=1,
        obs_mode="depth",
        cameras=cameras,
        camera_size=8,
        threads=1,
    )
    flat = FlattenStatePixels(NormalizeImages(FrameStack(env, 2)))
    obs, _ = flat.reset(seed=0)
    wanted = [f"{camera}_depth" for camera in cameras]
    for space in (
        flat.single_observation_space,
        flat.observation_space,
        NormalizeImages(flat).observation_space,
    ):
        assert isinstance(space, spaces.Dict)
        pixels = space["pixels"]
        assert isinstance(pixels, spaces.Dict) and list(pixels) == wanted
    assert list(obs["pixels"]) == wanted and flat.observation_space.contains(obs)
    env.close()


def test_depth_is_normalised_as_the_original_networks_do_and_comes_back():
    every = np.arange(32768).astype(np.int16)
    small = normalize_depth(every)
    assert small.dtype == np.float32 and small[0] == 1.0
    np.testing.assert_allclose(small, 1 - np.tanh(every / 1000), atol=2e-7)
    np.testing.assert_array_equal(denormalize_depth(small), every)
    linear = normalize_depth(every, "linear", 8.0)
    assert linear[4000] == pytest.approx(0.5) and linear[0] == 0 and linear.max() == 1.0
    np.testing.assert_array_equal(
        denormalize_depth(linear, "linear", 8.0), np.minimum(every, 8000)
    )


ORDERS = {
    "raw": lambda env, **how: NormalizeImages(env, **how),
    "stacked": lambda env, **how: NormalizeImages(FrameStack(env, 3), **how),
    "flat": lambda env, **how: NormalizeImages(
        FlattenStatePixels(FrameStack(env, 3)), **how
    ),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    "how",
    [{}, {"depth": "linear", "depth_clip": 5.0, "rgb": "imagenet"}, {"depth": "raw"}],
)
def test_images_are_normalised_and_come_back_wherever_the_wrapper_stands(order, how):
    env = ORDERS[order](CountingEnv(SAME), **how)
    seen = [env.reset()[0]]
    while len(seen) < 4:
        obs, *_, info = env.step(np.zeros(2, int))
        seen += [obs, info["final_obs"]] if "final_obs" in info else [obs]
    plain = env.env.reset()[0]
    for obs in seen:
        assert env.observation_space.contains(obs)
        back = env.inverse(obs)
        assert env.env.observation_space.contains(back)
        pairs = (
            [("cam_rgb", back["pixels"], plain["pixels"])]
            if order == "flat"
            else [(RGB, back, plain)]
        )
        for key, ours, theirs in pairs:
            np.testing.assert_array_equal(ours[key], theirs[key])
    final = env.inverse(seen[-1])
    depth = final["pixels"]["cam_depth"] if order == "flat" else final[DEPTH]
    newest = depth.reshape(2, -1)[:, -1]
    assert newest.tolist() == [2, 1002]


def test_numbers_of_normalised_images():
    env = NormalizeImages(CountingEnv(SAME), rgb="imagenet")
    obs, _ = env.reset()
    # Pixel (1, 2): bytes 14 * (15, 16, 17); mean and std of red, green, blue as torchvision has them.
    want = (14 * np.array([15, 16, 17]) / 255 - (0.485, 0.456, 0.406)) / (
        0.229,
        0.224,
        0.225,
    )
    np.testing.assert_allclose(obs[RGB][0, 1, 2], want, rtol=1e-5)
    assert (
        obs[DEPTH][1, 0, 0, 0] == pytest.approx(1 - np.tanh(1.0))
        and obs[SEG].dtype == np.int32
    )
    flat = NormalizeImages(FlattenStatePixels(CountingEnv(SAME)), rgb="imagenet")
    np.testing.assert_allclose(
        flat.reset()[0]["pixels"]["cam_rgb"][0, :, 1, 2], want, rtol=1e-5
    )
    unit = NormalizeImages(CountingEnv(SAME)).reset()[0][RGB]
    assert unit.dtype == np.float32 and unit[0, 1, 2, 2] == pytest.approx(14 * 17 / 255)


def test_frames_of_the_real_environment_under_a_partial_reset():
    env = FrameStack(
        envs.make(
            task="set_table", subtask="close", num_envs=2, autoreset="disabled", threads=1
        ),
        3,
        keys=["state"],
    )
    first = env.reset(seed=0)[0]["state"]
    assert first.shape == (2, 3, 42) and (first == first[:, :1]).all()
    actions = np.ones((2, ROBOT.action.dim), np.float32)
    second = env.step(actions)[0]["state"]
    third = env.step(actions)[0]["state"]
    np.testing.assert_array_equal(third[:, :2], second[:, 1:])
    assert (third[:, 2] != third[:, 1]).any(axis=1).all()
    obs = env.reset(options={"reset_mask": np.array([False, True])})[0]["state"]
    assert obs[0].tobytes() == third[0].tobytes()
    assert (obs[1] == obs[1, :1]).all() and (obs[1, 0] != third[1, 2]).any()


def test_bad_input_is_named():
    env = CountingEnv(SAME)
    with refused(
        "observation key", "sensor_data/cam/dept", expected="sensor_data/cam/depth"
    ):
        FrameStack(env, 3, keys=["sensor_data/cam/dept"])
    with refused("num_stack", 0, where="FrameStack"):
        FrameStack(env, 0)
    with refused(where="FrameStack", said="call reset"):
        FrameStack(env, 2).step(np.zeros(2, int))
    with refused("depth normalization", "tan", expected="tanh"):
        NormalizeImages(env, depth="tan")
    with refused("rgb normalization", "bytes"):
        NormalizeImages(env, rgb="bytes")
    with refused("depth_clip", 0.0, where="NormalizeImages"):
        NormalizeImages(env, depth_clip=0.0)
    for wrap in (FlattenStatePixels, lambda flat: FrameStack(flat, 2)):
        with refused(said="must come before FlattenStatePixels"):
            wrap(FlattenStatePixels(env))
    del env.rows.spaces["state"]
    with refused("observation key", "state"):
        FlattenStatePixels(env)
    for key in (DEPTH, RGB, SEG):
        del env.rows.spaces[key]
    with refused(where="NormalizeImages", said="no images"):
        NormalizeImages(env)
