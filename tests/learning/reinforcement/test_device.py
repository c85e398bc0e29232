"""The learners on the device environment: the same code, with everything as tensors on the device."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from mjhab.learning.checkpoint import load_checkpoint, load_student
from mjhab.learning.configs import InputConfig, NetworkConfig
from mjhab.learning.reinforcement.configs import (
    PPO,
    SAC,
    PpoConfig,
    ReinforcementConfig,
    SacConfig,
)
from mjhab.learning.reinforcement.session import ReinforcementSession
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.reinforcement.train import train_reinforcement
from mjhab.learning.reinforcement.worlds import Worlds
from mjhab.learning.students.heads import make_student
from tests.missing import need_warp
from tests.warp_device import TEST_DEVICE, check_repeated

need_warp()

from mjhab.envs.device import pool  # noqa: E402
from mjhab.envs.device.env import DeviceEnv  # noqa: E402

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


@dataclass
class Watched:
    """What was seen of a training on the device: its pools, and the starts of its worlds after each checkpoint."""

    out: Path
    pools: list[pool.StartPool] = field(default_factory=list)
    begun: list[list[int]] = field(default_factory=list)
    metrics: list[dict[str, float]] = field(default_factory=list)

    def tensors(self) -> Mapping[str, torch.Tensor]:
        """All that its last checkpoint holds."""
        return load_checkpoint(self.out / "training.safetensors").tensors


@contextmanager
def watched(out: Path) -> Iterator[Watched]:
    """Trainings have a small pool, and are looked at."""
    seen = Watched(out)
    begin = Worlds.begin

    def begin_and_tell(self: Worlds, seed: int) -> Any:
        obs = begin(self, seed)
        if isinstance(self.env, DeviceEnv):
            seen.pools.append(self.env.pool)
            seen.begun.append(self.env.start_row.tolist())
        return obs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "LEAST", 8)
        patch.setattr(Worlds, "begin", begin_and_tell)
        yield seen


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """A training with PPO on the device."""
    with watched(tmp_path_factory.mktemp("whole")) as seen:
        seen.metrics = train(TINY, seen.out, "warp")
    return seen


def train(
    config: ReinforcementConfig, out: Path, backend: str, resume: bool = False
) -> list[dict[str, float]]:
    """Train without evaluations; returns the metrics of every update."""
    torch.set_num_threads(1)
    device = TEST_DEVICE if backend == "warp" else ""
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
        resume=resume,
    )
    train_reinforcement(spec)
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def test_ppo_is_rewarded_as_on_the_cpu(tmp_path: Path, whole: Watched) -> None:
    """Both engines start much the same episodes, and new actors of one seed act alike."""
    wanted = train(TINY, tmp_path / "cpu", "cpu")
    found = whole.metrics
    assert [row["samples"] for row in found] == [row["samples"] for row in wanted]
    assert found[0]["reward"] == pytest.approx(wanted[0]["reward"], abs=0.01)
    assert found[0]["value_loss"] == pytest.approx(wanted[0]["value_loss"], rel=0.05)


def test_a_checkpoint_draws_other_starts_of_the_same_pool(whole: Watched) -> None:
    # A pool is thousands of starts that the host makes; one for every checkpoint took most of the time of a training.
    assert len(whole.begun) > 2 and whole.pools[0].seed == 0
    assert all(each is whole.pools[0] for each in whole.pools)
    assert all(one != other for one, other in pairwise(whole.begun))


class Killed(Exception):
    """What stands for kill -9: nothing is saved after it."""


def killed_after_a_checkpoint(session: ReinforcementSession) -> None:
    if session.state.samples >= TINY.checkpoint_samples:
        raise Killed


def test_a_killed_run_ends_as_one_that_was_not(tmp_path: Path, whole: Watched) -> None:
    with watched(tmp_path) as seen:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ReinforcementSession, "check_time", killed_after_a_checkpoint)
            with pytest.raises(Killed):
                train(TINY, tmp_path, "warp")
        saved = load_checkpoint(tmp_path / "training.safetensors").about["samples"]
        assert 0 < saved < TINY.samples
        train(TINY, tmp_path, "warp", resume=True)
    assert seen.begun[-1] == whole.begun[-1]
    found = seen.tensors()
    assert found.keys() == whole.tensors().keys()
    for name, value in whole.tensors().items():
        check_repeated(found[name], value, name)


def test_sac_learns_on_the_device(tmp_path: Path) -> None:
    with watched(tmp_path):
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
