"""What a run of SAC stores between and across checkpoints, in the toy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjhab.learning.reinforcement.configs import ReinforcementConfig, changed
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.sac.run import SacRun
from mjhab.learning.reinforcement.worlds import TrainingRules, Transition, Worlds
from mjhab.learning.runs.session import TrainState
from tests.learning.reinforcement.toy import LAYOUT, SAC_TOY, Toy, encoder_of

WORLDS = 16
STEP = 0.3
torch.set_num_threads(1)


class Session:
    """What a run asks of a session; a checkpoint only begins new episodes."""

    def __init__(self, config: ReinforcementConfig, folder: Path, rules: Any) -> None:
        folder.mkdir(exist_ok=True)
        env = Toy(config.worlds)
        encoder = encoder_of(env)
        self.config = config
        self.worlds = Worlds(env, encoder, 0, rules)
        self.layout = LAYOUT
        self.privileged_width = encoder.privileged_width
        self.spec = SimpleNamespace(seed=0, round_episodes=0)
        self.seed = 0
        self.start = None
        self.saved: Any = None
        self.training_file = folder / "training.safetensors"
        self.folder = SimpleNamespace(path=folder)
        self.log = SimpleNamespace(say=bool, show=bool)
        self.state = TrainState()
        self.learner_seconds = 0.0

    def note(self, transition: Transition) -> None:
        self.state.samples += self.worlds.count

    def due(self, every: int, before: int) -> bool:
        return False

    def check_time(self) -> None:
        """There is no budget."""

    def expect_work(self, *_: object, **__: object) -> None:
        """There is no budget."""

    def report(self, numbers: dict[str, float]) -> None:
        """Nobody reads it."""

    def save(self, actor: object, tensors: object) -> None:
        self.state.checkpoints += 1
        self.worlds.begin(self.state.checkpoints)


class InMemory(SacRun):
    """A run whose buffer lies in memory, as it does on a GPU."""

    def buffer(self, name: str, worlds: int, capacity: int) -> ReplayBuffer:
        made = super().buffer(name, worlds, capacity)
        return ReplayBuffer(made.shape, made.device)


def run_of(folder: Path, rules: TrainingRules | None = None, **changes: Any) -> SacRun:
    """A run that never updates; ``changes`` are fields of its config."""
    config = changed(dataclasses.replace(SAC_TOY, worlds=WORLDS), changes)
    return SacRun(Session(config, folder, rules))  # type: ignore[arg-type]


def test_no_transition_leads_from_one_side_of_a_checkpoint_to_the_other(
    tmp_path: Path,
) -> None:
    run = run_of(tmp_path)
    for steps in (3, 8, 5):
        for _ in range(steps):
            run._step()
        run.save()
    drawn = run.online.draw(2000, torch.Generator().manual_seed(0))
    expected = drawn.seen.vector + STEP * drawn.actions
    torch.testing.assert_close(drawn.next_seen.vector, expected)


def test_a_resumed_run_draws_what_the_killed_one_drew(tmp_path: Path) -> None:
    steps = 16
    run = run_of(
        tmp_path,
        TrainingRules(success_ends=True),
        checkpoint_samples=steps * WORLDS,
        capacity=160 * WORLDS,
    )
    while int(run.online.position.min()) < 160:
        run._step()
    run.save()
    saved = run.online.position.clone()
    wanted = run.online.draw(2000, torch.Generator().manual_seed(0))
    for _ in range(steps):
        run._step()
    # More than these steps, because an entry with the last observation closes each of many episodes.
    assert int((run.online.position - saved).max()) > steps + 2
    run.online.position.copy_(saved)
    found = run.online.draw(2000, torch.Generator().manual_seed(0))
    assert torch.equal(wanted.seen.vector, found.seen.vector)
    assert torch.equal(wanted.next_seen.vector, found.next_seen.vector)


@pytest.mark.parametrize("warm_up", [0, 1, WORLDS])
def test_updates_begin_as_soon_as_there_are_transitions(
    warm_up: int, tmp_path: Path
) -> None:
    run = run_of(tmp_path, warm_up=warm_up, samples=4 * WORLDS)
    run.learn()
    assert run.learner.updates == 3 * WORLDS * SAC_TOY.sac.updates_per_step  # type: ignore[union-attr]
    assert run.actor.normalizer.mean.any()


@pytest.mark.parametrize("kind", [SacRun, InMemory])
def test_a_run_whose_buffer_is_gone_fills_it_before_it_goes_on(
    kind: type[SacRun], tmp_path: Path
) -> None:
    run = run_of(tmp_path / "run", warm_up=64, samples=96)
    run.learn()
    session = Session(run.config, tmp_path / "moved", None)
    session.config = changed(run.config, {"samples": 224})
    session.saved = SimpleNamespace(tensors=run.tensors())
    session.state = dataclasses.replace(run.session.state)
    again = kind(session)  # type: ignore[arg-type]
    before = again.learner.updates
    normalizer = again.actor.normalizer.mean.clone()
    assert before and torch.equal(normalizer, run.actor.normalizer.mean)
    again.learn()
    # 64 of the 128 further samples fill the buffer; the last of them allows the first update.
    assert again.learner.updates == before + 5 * WORLDS * 0.25
    assert torch.equal(normalizer, again.actor.normalizer.mean)
