"""The learners on the device environment: the same code, with everything as tensors on the device."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from mjhab.learning.checkpoint import load_student
from mjhab.learning.configs import InputConfig, NetworkConfig
from mjhab.learning.reinforcement.configs import (
    PPO,
    SAC,
    PpoConfig,
    ReinforcementConfig,
    SacConfig,
)
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.reinforcement.train import train_reinforcement
from mjhab.learning.students.heads import make_student
from tests.missing import need_warp

need_warp()

SCENE = {
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "profile": "ms_hab",
}
TINY = ReinforcementConfig(
    PPO,
    "tiny",
    InputConfig(cameras=(), image_size=0, base_velocity=True, link_state=True, shift=0),
    NetworkConfig(hidden=16, layers=1),
    ppo=PpoConfig(rollout_steps=8, minibatches=2, epochs=1),
    samples=32,
    worlds=2,
    episode_pool=2,
    checkpoint_samples=16,
)
TINY_SAC = dataclasses.replace(
    TINY,
    algorithm=SAC,
    ppo=None,
    sac=SacConfig(batch=8, warm_up=8, capacity=96, updates_per_step=0.25, critics=2),
)


def train(config: ReinforcementConfig, out: Path, backend: str) -> list[dict[str, float]]:
    """Train without evaluations; returns the metrics of every update."""
    torch.set_num_threads(1)
    device = "cpu" if backend == "warp" else ""
    spec = ReinforcementSpec.of(
        out=out,
        preset=config,
        **SCENE,
        threads=1,
        eval_episodes=0,
        round_episodes=0,
        films=0,
        backend=backend,
        device=device,
    )
    train_reinforcement(spec)
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def test_ppo_is_rewarded_as_on_the_cpu(tmp_path: Path) -> None:
    """Both engines start the same episodes, and new actors of one seed act alike."""
    wanted = train(TINY, tmp_path / "cpu", "cpu")
    found = train(TINY, tmp_path / "warp", "warp")
    assert [row["samples"] for row in found] == [row["samples"] for row in wanted]
    assert found[0]["reward"] == pytest.approx(wanted[0]["reward"], abs=0.01)
    assert found[0]["value_loss"] == pytest.approx(wanted[0]["value_loss"], rel=0.05)


def test_sac_learns_on_the_device(tmp_path: Path) -> None:
    rows = train(TINY_SAC, tmp_path, "warp")
    assert (
        json.loads((tmp_path / "summary.json").read_text())["samples"] == TINY_SAC.samples
    )
    assert all(math.isfinite(value) for row in rows for value in row.values())
    student = load_student(tmp_path / "student.safetensors")
    assert student.layout.profile == SCENE["profile"]
    untrained = make_student(TINY_SAC.student, student.layout, seed=0)
    trained = student.state_dict()
    assert any(
        not torch.equal(value, trained[name])
        for name, value in untrained.state_dict().items()
    )
