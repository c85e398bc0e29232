"""What a run of SAC stores between and across checkpoints, in the toy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from mjhab.learning.reinforcement.configs import ReinforcementConfig, changed
from mjhab.learning.reinforcement.sac.run import SacRun
from mjhab.learning.reinforcement.session import Standing
from mjhab.learning.reinforcement.sight import Sight
from mjhab.learning.reinforcement.worlds import TrainingRules, Transition, Worlds
from tests.learning.reinforcement.toy import LAYOUT, SAC_TOY, Toy

WORLDS = 16
STEP = 0.3
torch.set_num_threads(1)


class Session:
    """What a run asks of a session; a checkpoint only begins new episodes."""

    def __init__(self, config: ReinforcementConfig, folder: Path, rules: Any) -> None:
        env = Toy(config.worlds)
        sight = Sight(env, LAYOUT, False)
        self.config = config
        self.worlds = Worlds(env, sight, 0, rules)
        self.layout = LAYOUT
        self.privileged_width = sight.privileged_width
        self.request = SimpleNamespace(seed=0, round_episodes=0)
        self.seed = 0
        self.start = None
        self.saved: Any = None
        self.training_file = folder / "training.safetensors"
        self.folder = SimpleNamespace(path=folder)
        self.log = SimpleNamespace(say=bool)
        self.standing = Standing()

    def note(self, transition: Transition) -> None:
        self.standing.samples += self.worlds.count

    def save(self, actor: object, tensors: object) -> None:
        self.standing.checkpoints += 1
        self.worlds.begin(self.standing.checkpoints)


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
