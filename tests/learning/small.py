"""Tiny students and demonstrations for the tests."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mjhab.learning.configs import (
    ACT,
    BC,
    DIFFUSION,
    FLOW,
    GAUSSIAN,
    GAUSSIAN_ACTIONS,
    ImitationConfig,
    InputConfig,
    NetworkConfig,
    OptimizerConfig,
    StudentConfig,
)
from mjhab.learning.demos import Demonstrations
from mjhab.learning.observation.parts import SubtaskConditioning, code_of
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs.run import TrainingResult
from mjhab.learning.runs.specs import ImitationSpec
from mjhab.learning.train import train_spec

SIZE = 16
STATE = (("agent/qpos", 4), ("extra/is_grasped", 1))
ACTIONS = tuple(f"a{i}" for i in range(13))
CONTROL = ("pd_joint_delta_pos", "forward")
INPUTS = InputConfig(cameras=("fetch_head",), image_size=SIZE)
TARGETS = ("024_bowl", "kitchen_counter/drawer3")


def train_in(
    spec: ImitationSpec | ReinforcementSpec, out: Path, resume: bool = False
) -> TrainingResult:
    """Run a training in another folder."""
    return train_spec(dataclasses.replace(spec, out=out, resume=resume))


def layout(inputs: InputConfig = INPUTS) -> ObservationSpec:
    return ObservationSpec(inputs, STATE, ACTIONS, TARGETS, CONTROL)


def condition_of(
    told: ObservationSpec, kind: str, target: str, sentence: str = ""
) -> np.ndarray:
    return code_of(SubtaskConditioning(kind, target, sentence), told)


def config(
    algorithm: str = BC, inputs: InputConfig = INPUTS, **changes: Any
) -> StudentConfig:
    """A student that takes milliseconds."""
    networks = {
        BC: NetworkConfig(channels=(4, 8), image_features=8, hidden=16, layers=2),
        FLOW: NetworkConfig(channels=(4, 8), image_features=8, hidden=16, layers=2),
        ACT: NetworkConfig(channels=(4, 8), image_features=8, hidden=16, layers=1),
        GAUSSIAN: NetworkConfig(channels=(4, 8), image_features=8, hidden=16, layers=2),
        DIFFUSION: NetworkConfig(
            "paper_dp", channels=(4, 8), image_features=8, unet=(8, 16)
        ),
    }
    networks[GAUSSIAN_ACTIONS] = networks[GAUSSIAN]
    single = algorithm in (GAUSSIAN, GAUSSIAN_ACTIONS)
    steps = {FLOW: 3, DIFFUSION: 4}.get(algorithm, 0)
    student = StudentConfig(
        algorithm=algorithm,
        preset="tiny",
        inputs=inputs,
        network=networks[algorithm],
        optimizer=OptimizerConfig(batch=8, learning_rate=1e-2, warmup=2),
        chunk=1 if single else 4,
        execute=1 if single else 2,
        hold_steps=3,
        huber=0.0 if steps else 0.5,
        sampling_steps=steps,
        updates=4,
    )
    return dataclasses.replace(student, **changes)


def train_config(**changes: Any) -> ImitationConfig:
    return ImitationConfig(config(**changes))


def demonstrations(
    seed: int = 0,
    lengths: tuple[int, ...] = (7, 11, 5),
    told: ObservationSpec | None = None,
) -> Demonstrations:
    """Episodes whose first action is a line through the state, and the others 0.5."""
    told = told or layout()
    random = np.random.default_rng(seed)
    parts = []
    for length in lengths:
        vector = np.zeros((length, told.width), np.float32)
        vector[:, : told.measured_width] = random.normal(
            size=(length, told.measured_width)
        )
        vector[:, told.measured_width :] = condition_of(told, told.kinds[0], TARGETS[0])
        actions = np.full((length, len(ACTIONS)), 0.5, np.float32)
        actions[:, 0] = np.tanh(vector[:, 0])
        images = random.integers(
            0, 256, (length, len(told.image_keys), SIZE, SIZE), np.uint8
        )
        parts.append(
            Demonstrations(
                vector,
                images,
                actions,
                np.zeros(length, np.int64),
                np.full(length, length - 1),
                np.arange(length),
                1,
            )
        )
    return Demonstrations.join(parts)


def fake_env(worlds: int = 3, told: ObservationSpec | None = None) -> Any:
    """What a student asks of an environment."""
    told = told or layout()
    rows = [SimpleNamespace(key=key, shape=(width,)) for key, width in STATE]

    rows += [SimpleNamespace(key=key, shape=(SIZE, SIZE, 1)) for key in told.image_keys]
    return SimpleNamespace(
        num_envs=worlds,
        observer=SimpleNamespace(table=rows),
        action_table=[SimpleNamespace(name=name) for name in ACTIONS],
        single_observation_space={
            "state": SimpleNamespace(shape=(sum(width for _, width in STATE),))
        },
        config=SimpleNamespace(control_mode=CONTROL[0], base=CONTROL[1], stationary=()),
        layout=SimpleNamespace(roster=("024_bowl",), link_ids=("fridge/top_door",)),
    )
