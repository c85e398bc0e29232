"""Demonstrations, acting policies and agents of reinforcement see the same numbers, whatever they see."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.core.conventions.names import Conventions
from mjhab.core.errors import UsageError
from mjhab.core.rotations import quat_rotate
from mjhab.data.record.recorder import Recorder
from mjhab.data.record.render import RenderRequest, render
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.reading import open_shard
from mjhab.data.store.shard import ShardWriter
from mjhab.envs import make
from mjhab.experts import make_expert
from mjhab.learning.batches import take_chunks
from mjhab.learning.checkpoint import load_checkpoint
from mjhab.learning.configs import (
    ACT,
    BC,
    DIFFUSION,
    PRESETS,
    InputConfig,
    preset_of,
)
from mjhab.learning.demos import read_episode
from mjhab.learning.observation.encoder import EncodedObs, ObservationEncoder
from mjhab.learning.observation.parts import IMAGE_PARTS, VECTOR_PARTS, image_parts
from mjhab.learning.observation.spec import ObservationSpec, observation_spec_of
from mjhab.learning.policy_kind import joined, members
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder
from mjhab.learning.reinforcement.configs import PRESETS as AGENT_PRESETS
from mjhab.learning.runs.intervention import Intervention
from mjhab.learning.shipped_kind import shipped
from mjhab.learning.students.heads import check_student
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import Policy, RandomPolicy
from tests.onnx_file import HAS_ONNX, tiny_backbone
from tests.refusals import refused

SIZE = 16
FROZEN = "frozen features"
STEPS = 9
WORLDS = 2
TARGET = "kitchen_counter/drawer3"


def all_inputs() -> dict[str, InputConfig]:
    """Inputs of every preset and shipped checkpoint, and with every option on, by name; images of 16 px."""
    found = {
        f"{algorithm}/{name}": preset.student.inputs
        for algorithm, presets in PRESETS.items()
        for name, preset in presets.items()
    }
    found |= {
        f"{algorithm}/{name}": preset.inputs
        for algorithm, presets in AGENT_PRESETS.items()
        for name, preset in presets.items()
    }
    found |= {
        f"shipped/{name}": load_checkpoint(members(spec)[0]).config.inputs
        for name, spec in shipped().items()
    }
    found["everything"] = InputConfig(
        history=3,
        base_velocity=True,
        target_in_hand=True,
        target_views=True,
        sentence=True,
    )
    found["colours alone"] = InputConfig(images="rgb", target_views=True)
    found["colours and depth"] = InputConfig(history=2, images="rgbd", target_views=True)
    found["views of the target alone"] = InputConfig(whole_views=False, target_views=True)
    if HAS_ONNX:
        found[FROZEN] = InputConfig(
            history=2, whole_views=False, condition=True, backbone="tiny.onnx"
        )
    small = {
        name: dataclasses.replace(inputs, image_size=SIZE if inputs.cameras else 0)
        for name, inputs in found.items()
    }
    return {name: inputs for name, inputs in small.items() if not inputs.link_state}


INPUTS = all_inputs()


class InTorch:
    """An environment whose arrays are tensors, as on a device."""

    def __init__(self, env: Any) -> None:
        self.num_envs = env.num_envs
        self.config = env.config
        self._env = env

    @property
    def state(self) -> Any:
        state = self._env.state
        return SimpleNamespace(
            robot_q=torch.as_tensor(state.robot_q),
            robot_qd=torch.as_tensor(state.robot_qd),
        )

    def link_state(self) -> torch.Tensor:
        return torch.as_tensor(self._env.link_state())

    def state_as(self, conventions: Conventions) -> torch.Tensor:
        return torch.as_tensor(self._env.state_as(conventions))


class Watching:
    """Lets another policy act, and keeps what encoders of all inputs make of it."""

    name = "watching"

    def __init__(
        self, env: Any, specs: Mapping[str, ObservationSpec], acting: Policy
    ) -> None:
        self.specs = specs
        self.acting = acting
        self.numpy = {n: ObservationEncoder(env, spec) for n, spec in specs.items()}
        tensors: Any = InTorch(env)
        self.torch = {n: ObservationEncoder(tensors, spec) for n, spec in specs.items()}
        self.agents = {
            n: AgentEncoder(env, spec, privileged=False) for n, spec in specs.items()
        }
        self.seen: dict[str, list[list[Any]]] = {n: [] for n in specs}

    def reset(self, mask: np.ndarray) -> None:
        self.acting.reset(mask)
        for name in self.numpy:
            self.numpy[name].begin(mask)
            self.torch[name].begin(torch.from_numpy(mask.copy()))
            self.agents[name].begin(torch.from_numpy(mask.copy()))

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        tensors = {
            key: torch.as_tensor(value)
            for key, value in obs.items()
            if isinstance(value, np.ndarray)
        }
        actions = self.acting.act(obs, info)
        for name, kept in self.seen.items():
            kept.append(
                [
                    self.numpy[name].encode(obs, info),
                    self.torch[name].encode(tensors, info),
                    self.agents[name].see(obs, info),
                ]
            )
            self.numpy[name].executed(actions)
            self.torch[name].executed(torch.as_tensor(actions))
            self.agents[name].executed(torch.as_tensor(actions))
        return actions


@pytest.fixture(scope="module", params=["random", "take_over"])
def watched(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Watching, Path, Any]:
    """Episodes at random, or begun at random and finished by the expert; recorded with images and without."""
    env: Any = make(
        task="set_table",
        subtask="open",
        target=TARGET,
        home="builtin_m0_00",
        split="train",
        obs_mode="rgbd+target_depth+target_rgb",
        camera_size=SIZE,
        num_envs=WORLDS,
        threads=1,
        autoreset="disabled",
    )
    backbone = str(tiny_backbone(tmp_path_factory.mktemp("frozen") / "tiny.onnx"))
    specs = {
        name: observation_spec_of(
            env,
            dataclasses.replace(inputs, backbone=backbone) if name == FROZEN else inputs,
            (TARGET,),
        )
        for name, inputs in INPUTS.items()
    }
    acting: Policy = RandomPolicy(3)
    if request.param == "take_over":
        acting = Intervention(acting, make_expert(env), STEPS - 2)
    policy = Watching(env, specs, acting)
    path = tmp_path_factory.mktemp("watched") / "a.h5"
    with ShardWriter(path) as writer, ShardWriter(path.with_name("bare.h5")) as bare:
        recorders = [
            Recorder(writer, env, {"name": "random"}, images=ImageFormat()),
            Recorder(bare, env, {"name": "random"}),
        ]
        rollout(env, policy, list(range(WORLDS)), 0, recorders, max_steps=STEPS)
    return policy, path, env


@pytest.mark.parametrize("name", INPUTS)
def test_all_ways_to_an_observation_give_the_same_bits(
    name: str, watched: tuple[Watching, Path, Any]
) -> None:
    policy, path, _ = watched
    spec = policy.specs[name]
    with open_shard(path) as shard:
        recorded = sorted(shard, key=lambda episode: episode.record.index)
        for world, episode in enumerate(recorded):
            data = read_episode(episode, spec, hold_steps=-1)
            chunks = take_chunks(data, np.arange(STEPS), 1, spec.inputs.history)
            for step, ways in enumerate(policy.seen[name]):
                for seen in ways:
                    vector = np.asarray(seen.vector[world])
                    images = np.asarray(seen.images[world])
                    np.testing.assert_array_equal(vector, chunks.vector[step])
                    np.testing.assert_array_equal(images, chunks.images[step])
                    assert vector.dtype == np.float32 and images.dtype == np.uint8
    assert chunks.vector.shape[1] == spec.inputs.history * spec.width


def test_views_of_the_target_are_rendered_from_states_to_the_bit(
    watched: tuple[Watching, Path, Any], tmp_path: Path
) -> None:
    policy, path, env = watched
    out = tmp_path / "rendered.h5"
    request = RenderRequest(path.with_name("bare.h5"), out, ImageFormat())
    render(request, lambda _: env)
    spec = policy.specs["colours and depth"]
    with open_shard(path) as drawn, open_shard(out) as rendered:
        for name in drawn.names:
            old, new = (
                read_episode(shard.episode(name), spec, hold_steps=-1)
                for shard in (drawn, rendered)
            )
            assert old.images.any()
            np.testing.assert_array_equal(old.images, new.images)


def test_a_shard_without_views_of_the_target_says_how_to_get_them(
    watched: tuple[Watching, Path, Any],
) -> None:
    policy, path, _ = watched
    spec = policy.specs["views of the target alone"]
    with (
        open_shard(path.with_name("bare.h5")) as shard,
        pytest.raises(UsageError, match="--render target_depth --camera-size 16"),
    ):
        read_episode(next(iter(shard)), spec, hold_steps=-1)


def test_images_are_one_per_camera_view_and_content(
    watched: tuple[Watching, Path, Any],
) -> None:
    policy, _, env = watched
    spec = policy.specs["colours and depth"]
    assert spec.image_channels == (1, 1, 1, 1, 3, 3, 3, 3)
    outputs = [key.rpartition("/")[2] for key in spec.image_keys[::2]]
    assert outputs == ["depth", "target_depth", "rgb", "target_rgb"]
    spec.check_env(env)
    seen = policy.seen["colours and depth"][-1][0]
    assert seen.images.shape == (WORLDS, 2 * sum(spec.image_channels), SIZE, SIZE)
    config = dataclasses.replace(preset_of("bc", "quick").student, inputs=spec.inputs)
    for algorithm in (BC, DIFFUSION, ACT):
        check_student(
            dataclasses.replace(config, algorithm=algorithm, sampling_steps=2), spec
        )


def test_unknown_contents_of_images_are_refused() -> None:
    with refused("images", "depht", said="depth"):
        InputConfig(images="depht")


def test_cameras_without_any_view_are_refused() -> None:
    with refused("inputs.cameras", advice="switch one of these on"):
        InputConfig(whole_views=False)
    assert InputConfig(cameras=(), image_size=0, whole_views=False).image_size == 0


def test_policies_of_other_views_act_together() -> None:
    whole = {"obs_mode": "depth", "camera_size": 32}
    target = {"obs_mode": "depth+target_depth", "camera_size": 64}
    assert joined("both", [("a", whole), ("b", target)]) == target


def test_the_presets_use_every_part_but_those_that_a_recording_lacks() -> None:
    pictured = {part for inputs in INPUTS.values() for part in image_parts(inputs)}
    assert pictured == {*IMAGE_PARTS}
    used = {
        part.name
        for part in VECTOR_PARTS
        if any(part.used(inputs) for inputs in INPUTS.values())
    }
    lacking = {"link_state"} if HAS_ONNX else {"link_state", "backbone"}
    assert {part.name for part in VECTOR_PARTS} - used == lacking


def test_conditioning_parts_follow_the_normalized_ones() -> None:
    """`Normalizer.fit` measures the first columns only."""
    flags = [part.normalized for part in VECTOR_PARTS]
    assert flags == sorted(flags, reverse=True)


def test_the_target_in_the_hand_is_the_handle_seen_from_the_tcp(
    watched: tuple[Watching, Path, Any],
) -> None:
    policy, _, _ = watched
    spec = policy.specs["everything"]
    seen: EncodedObs = policy.seen["everything"][-1][0]
    now = seen.vector[:, -spec.width :]
    columns: dict[str, np.ndarray] = {}
    at = 0
    for key, width in spec.entries:
        columns[key] = now[:, at : at + width].astype(np.float64)
        at += width
    tcp = columns["extra/tcp_pose_wrt_base"]
    hand = columns["target_in_hand/position"]
    goal = columns["extra/goal_pos_wrt_base"]
    np.testing.assert_allclose(
        tcp[:, :3] + quat_rotate(tcp[:, 3:], hand), goal, atol=1e-5
    )
    np.testing.assert_allclose(
        columns["target_in_hand/near"], np.tanh(hand / 0.1), atol=1e-5
    )
    np.testing.assert_allclose(
        columns["target_in_hand/close"], np.tanh(hand / 0.02), atol=1e-5
    )


def test_the_target_in_the_hand_needs_the_tasks_state() -> None:
    inputs = InputConfig(cameras=(), image_size=0, target_in_hand=True)
    spec = ObservationSpec(
        inputs, (("agent/qpos", 4),), ("a0",), (TARGET,), ("pd", "forward")
    )
    env = SimpleNamespace(num_envs=1, config=SimpleNamespace())
    obs = {"state": np.zeros((1, 4), np.float32)}
    plan = ({"kind": "open", "target": TARGET},)
    info = {"episode_spec": [{"plan": plan}], "pointer": np.zeros(1, int)}
    with pytest.raises(UsageError, match="extra/tcp_pose_wrt_base"):
        ObservationEncoder(env, spec).encode(obs, info)  # type: ignore[arg-type]
