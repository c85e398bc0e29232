"""Whole runs in the real environment: what they leave, and that a killed one resumes to the same weights."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.multiprocessing.spawn import ProcessExitedException, spawn

from mjhab.learning.changes import with_changes
from mjhab.learning.checkpoint import load_checkpoint, load_student
from mjhab.learning.configs import InputConfig, NetworkConfig
from mjhab.learning.reinforcement import algorithm, train
from mjhab.learning.reinforcement import session as sessions
from mjhab.learning.reinforcement.configs import (
    PPO,
    RLPD,
    SAC,
    PpoConfig,
    ReinforcementConfig,
    SacConfig,
)
from mjhab.learning.reinforcement.ppo.learner import PpoLearner
from mjhab.learning.reinforcement.ppo.run import PpoRun
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.request import resolved_config
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.reinforcement.worlds import Worlds
from mjhab.learning.runs import budget
from mjhab.learning.runs import session as runs
from mjhab.learning.runs.evaluation import Evaluations
from mjhab.learning.runs.run import Logbook
from mjhab.learning.runs.session import OutOfTime
from mjhab.learning.runs.time_budget import TimeBudget
from mjhab.learning.runs.training import BrokenLossError
from mjhab.tasks.thresholds import TaskConfig
from tests.learning.small import train_in
from tests.refusals import refused

SCENE = {
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "profile": "ms_hab",
}
INPUTS = InputConfig(
    cameras=(),
    image_size=0,
    previous_action=True,
    base_velocity=True,
    link_state=True,
    shift=0,
)
NETWORK = NetworkConfig(hidden=16, layers=1)
TINY = ReinforcementConfig(
    PPO,
    "tiny",
    INPUTS,
    NETWORK,
    ppo=PpoConfig(
        rollout_steps=8, minibatches=2, epochs=1, desired_kl=0.01, state_std=True
    ),
    samples=64,
    worlds=2,
    checkpoint_samples=32,
    force_ends=True,
    force_cost=1.0,
)
TINY_IMITATING = dataclasses.replace(
    TINY,
    ppo=PpoConfig(
        rollout_steps=8,
        minibatches=2,
        epochs=1,
        demonstrations=1,
        imitation_updates=2,
        imitation_coefficient=1.0,
        imitation_samples=48,
    ),
)
AVERAGE = 0.75
TINY_AVERAGING = dataclasses.replace(
    TINY, ppo=PpoConfig(rollout_steps=8, minibatches=2, epochs=1, average=AVERAGE)
)
TINY_RLPD = dataclasses.replace(
    TINY,
    algorithm=RLPD,
    ppo=None,
    sac=SacConfig(
        batch=8,
        warm_up=8,
        capacity=96,
        updates_per_step=0.25,
        demonstrations=1,
        critics=2,
    ),
)


LONG_ROLLOUTS = dataclasses.replace(
    TINY,
    ppo=PpoConfig(rollout_steps=40, minibatches=2, epochs=1),
    samples=80,
    checkpoint_samples=80,
)
"""The first update comes after 40 control steps."""


class Killed(Exception):
    """What stands for kill -9: nothing is saved after it."""


def request(config: ReinforcementConfig, **options: Any) -> ReinforcementSpec:
    """A run without evaluations."""
    torch.set_num_threads(1)
    told: dict[str, Any] = {
        "out": "unused",
        "preset": config,
        **SCENE,
        "threads": 1,
        "eval_episodes": 0,
        "round_episodes": 0,
        "films": 0,
    }
    return ReinforcementSpec.of(**(told | options))


@pytest.mark.parametrize(
    "config",
    [TINY, TINY_IMITATING, TINY_AVERAGING],
    ids=["ppo", "imitating", "averaging"],
)
def test_a_killed_run_ends_with_the_weights_of_one_that_was_not(
    config: ReinforcementConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if it was begun as a shorter one, by a version without one of today's options."""
    whole = train_in(request(config), tmp_path / "whole")
    assert whole.summary["samples"] == config.samples
    check = sessions.ReinforcementSession.check_time

    def killed(self: sessions.ReinforcementSession) -> None:
        if self.state.samples >= 40:
            raise Killed
        check(self)

    with monkeypatch.context() as patch:
        patch.setattr(sessions.ReinforcementSession, "check_time", killed)
        with pytest.raises(Killed):
            shorter = dataclasses.replace(config, samples=48)
            train_in(request(shorter), tmp_path / "killed")
    begun = tmp_path / "killed" / "config.json"
    told = json.loads(begun.read_text())
    del told["config"]["keep_best_by"], told["config"]["ppo"]["freeze_encoder"]
    begun.write_text(json.dumps(told))
    saved = load_checkpoint(tmp_path / "killed" / "training.safetensors").about["samples"]
    assert 0 < saved < 40
    train_in(request(config), tmp_path / "killed", resume=True)
    wanted = load_checkpoint(tmp_path / "whole" / "training.safetensors").tensors
    found = load_checkpoint(tmp_path / "killed" / "training.safetensors").tensors
    assert set(wanted) == set(found)
    for name, value in wanted.items():
        assert torch.equal(value, found[name]), name


def test_the_student_is_the_moving_average_of_the_actors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dict[str, Tensor]] = []
    update = PpoLearner.update

    def noted(self: PpoLearner, *told: Any) -> dict[str, float]:
        numbers = update(self, *told)
        actor = self.agent.actor.state_dict()
        seen.append({name: value.clone() for name, value in actor.items()})
        return numbers

    monkeypatch.setattr(PpoLearner, "update", noted)
    train_in(request(TINY_AVERAGING), tmp_path / "run")
    student = load_student(tmp_path / "run" / "student.safetensors").state_dict()
    assert len(seen) == 4
    for name, value in student.items():
        wanted = seen[0][name]
        for newer in seen[1:]:
            wanted = AVERAGE * wanted + (1.0 - AVERAGE) * newer[name]
        if "normalizer" not in name:
            assert torch.allclose(value, wanted, atol=1e-6), name
    assert not torch.equal(student["head.weight"], seen[-1]["head.weight"])


@pytest.mark.parametrize("slow", ["collect_demonstrations", "_imitation_loss"])
def test_a_budget_that_ends_before_learning_leaves_a_run_to_begin_with(
    slow: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_time(*_: object) -> None:
        raise OutOfTime

    owner = PpoLearner if slow == "_imitation_loss" else algorithm
    with monkeypatch.context() as patch:
        patch.setattr(owner, slow, out_of_time)
        early = train_in(request(TINY_IMITATING), tmp_path / "early")
    assert not early.summary["trained"] and early.summary["checkpoint"] is None
    train_in(request(TINY_IMITATING), tmp_path / "early", resume=True)
    train_in(request(TINY_IMITATING), tmp_path / "whole")
    wanted, found = (
        load_checkpoint(tmp_path / name / "training.safetensors").tensors
        for name in ("whole", "early")
    )
    assert all(torch.equal(value, found[name]) for name, value in wanted.items())


def test_demonstrations_end_by_the_rules_of_training(tmp_path: Path) -> None:
    """As they are paid; but the expert closes this drawer without a force that would cost."""
    told = request(dataclasses.replace(TINY_IMITATING, success_ends=True))
    with train.open_reinforcement(dataclasses.replace(told, out=tmp_path)) as session:
        assert isinstance(session.run, PpoRun)
        shown = session.run.demonstrations(1)
        drawn = shown.draw(500, torch.Generator().manual_seed(0))
    assert bool(drawn.terminated.any()) and not bool(drawn.terminated.all())


def _train_and_kill(rank: int, out: Path) -> None:
    """Train in a process that kills itself after the first checkpoint, as ``kill -9`` does."""
    check = sessions.ReinforcementSession.check_time

    def killed(self: sessions.ReinforcementSession) -> None:
        if self.state.samples >= 40:
            os.kill(os.getpid(), signal.SIGKILL)
        check(self)

    sessions.ReinforcementSession.check_time = killed  # type: ignore[method-assign]
    train_in(request(TINY_RLPD), out)


def test_a_run_that_was_sent_sigkill_resumes(tmp_path: Path) -> None:
    with pytest.raises(ProcessExitedException, match="SIGKILL"):
        spawn(_train_and_kill, (tmp_path / "killed",))
    train_in(request(TINY_RLPD), tmp_path / "whole")
    train_in(request(TINY_RLPD), tmp_path / "killed", resume=True)
    wanted, found = (
        load_checkpoint(tmp_path / name / "training.safetensors").tensors
        for name in ("whole", "killed")
    )
    assert all(torch.equal(value, found[name]) for name, value in wanted.items())


def test_a_broken_loss_leaves_the_student_of_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update = PpoLearner.update

    def breaks(self: PpoLearner, rollout: object, progress: float) -> dict[str, float]:
        if self.updates == 3:
            with torch.no_grad():
                for value in self.agent.parameters():
                    value.fill_(torch.nan)
        return update(self, rollout, progress)  # type: ignore[arg-type]

    monkeypatch.setattr(PpoLearner, "update", breaks)
    with pytest.raises(BrokenLossError, match="update 4"):
        train_in(request(TINY), tmp_path)
    kept = load_checkpoint(tmp_path / "student.safetensors")
    assert kept.about["samples"] == TINY.checkpoint_samples
    assert all(torch.isfinite(value).all() for value in kept.tensors.values())


def test_a_run_leaves_a_policy_that_eval_takes_and_a_report(tmp_path: Path) -> None:
    told = dataclasses.replace(
        request(dataclasses.replace(TINY, samples=16)),
        eval_episodes=1,
        budget_minutes=10.0,
    )
    result = train_in(told, tmp_path / "run")
    assert result.summary["episodes"] == 1 and result.summary["algorithm"] == "ppo"
    shares = result.summary["time_shares"]
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3) and shares["env"] > 0.0
    assert (
        load_student(tmp_path / "run" / "student.safetensors").layout.profile == "ms_hab"
    )
    judged = tmp_path / "run" / "evaluations" / "latest" / "config.json"
    assert json.loads(judged.read_text(encoding="utf-8"))["profile"] == "ms_hab"
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert 'id="loss-plot"' in page
    # What PPO has left another run may begin from.
    start = str(tmp_path / "run" / "student.safetensors")
    again = dataclasses.replace(
        request(dataclasses.replace(TINY, samples=16)), start=start, network_device="cpu"
    )
    polished = train_in(again, tmp_path / "polished")
    assert polished.summary["samples"] == 16
    # It sees what its student sees, whatever its preset says, and the config tells so.
    depth = dataclasses.replace(TINY, inputs=InputConfig())
    told = resolved_config(dataclasses.replace(request(depth), start=start))
    assert told["config"]["inputs"]["image_size"] == 0
    # An actor of SAC takes over its trunk and its actions.
    other = train_in(
        dataclasses.replace(
            request(dataclasses.replace(TINY_RLPD, samples=16)),
            start=start,
            eval_episodes=1,
        ),
        tmp_path / "other",
    )
    kept = load_student(Path(other.summary["checkpoint"]))
    assert kept.config.algorithm == "gaussian_actions" and other.summary["episodes"] == 1
    with refused(said="of algorithm bc with"):
        train_in(
            dataclasses.replace(request(TINY), start=other.summary["checkpoint"]),
            tmp_path / "ppo",
        )


def test_the_student_is_the_best_evaluated_actor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Success falls after the second of four evaluations."""
    rates = iter([0.1, 0.6, 0.4, 0.2])
    monkeypatch.setattr(
        sessions.ReinforcementSession, "_judge", lambda self, episodes, last: next(rates)
    )
    config = dataclasses.replace(TINY, samples=48, eval_samples=16)
    result = train_in(
        dataclasses.replace(request(config), round_episodes=1), tmp_path / "run"
    )
    student = load_checkpoint(tmp_path / "run" / "student.safetensors")
    assert result.summary["student_samples"] == student.about["samples"] == 16
    assert result.summary["samples"] == 48 and next(rates, None) is None


def test_a_killed_run_keeps_the_best_actor_of_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is killed after the evaluation and the checkpoint of 32 samples."""
    rates = {0: 0.1, 32: 0.6, 64: 0.4}
    monkeypatch.setattr(
        sessions.ReinforcementSession,
        "_judge",
        lambda self, episodes, last: rates[self.state.samples],
    )
    told = dataclasses.replace(
        request(dataclasses.replace(TINY, eval_samples=32)), round_episodes=1
    )
    check = sessions.ReinforcementSession.check_time

    def killed(self: sessions.ReinforcementSession) -> None:
        if self.state.samples >= 32:
            raise Killed
        check(self)

    with monkeypatch.context() as patch:
        patch.setattr(sessions.ReinforcementSession, "check_time", killed)
        with pytest.raises(Killed):
            train_in(told, tmp_path / "killed")
    result = train_in(told, tmp_path / "killed", resume=True)
    assert result.summary["samples"] == 64 and result.summary["student_samples"] == 32
    student = load_checkpoint(tmp_path / "killed" / "student.safetensors")
    assert student.about["samples"] == 32


@pytest.mark.parametrize(("by", "kept"), [("once", 16), ("at_end", 32)])
def test_the_success_that_chooses_the_student_can_be_told(
    by: str, kept: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The actor after 16 samples succeeds most often, that after 32 stays in success most often."""
    rates = iter([(2, 0), (9, 1), (6, 5), (6, 4)])

    def pretended(self: Evaluations, *_: object) -> SimpleNamespace:
        once, at_end = next(rates)
        records = [
            SimpleNamespace(success_once=index < once, success_at_end=index < at_end)
            for index in range(10)
        ]
        return SimpleNamespace(records=records)

    monkeypatch.setattr(Evaluations, "run", pretended)
    config = with_changes(
        dataclasses.replace(TINY, samples=48, eval_samples=16), (f"keep_best_by={by}",)
    )
    # The page shows real records.
    monkeypatch.setattr(runs, "render_training_report", lambda *_: "")
    result = train_in(
        dataclasses.replace(request(config), round_episodes=10), tmp_path / "run"
    )
    student = load_checkpoint(tmp_path / "run" / "student.safetensors")
    assert result.summary["student_samples"] == student.about["samples"] == kept
    lines = (tmp_path / "run" / "metrics.jsonl").read_text("utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    found = [row["success_at_end"] for row in rows if "success_at_end" in row]
    assert found == [0.0, 0.1, 0.5, 0.4]


def test_a_device_of_networks_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with refused("device", "cuda:9", expected="cpu"):
        train_in(request(TINY, network_device="cuda:9"), tmp_path)
    with refused("network_device", "cpu", expected="left out with backend 'warp'"):
        request(TINY, network_device="cpu", env={"backend": "warp"})


def test_an_unknown_success_that_chooses_is_refused() -> None:
    with refused("keep_best_by", "at_ent", expected="at_end"):
        with_changes(TINY, ("keep_best_by=at_ent",))


def test_horizon_and_success_of_training_may_differ_from_the_profile(
    tmp_path: Path,
) -> None:
    polishing = dataclasses.replace(
        TINY,
        horizon=200,
        reward_mode="sparse",
        success_ends=True,
        stillness="absolute",
        rest_share=0.5,
    )
    with train.open_reinforcement(request(polishing, out=tmp_path)) as session:
        assert session.env.task_config.stillness == "absolute"
        assert session.env.task_config.arm_tol == 0.5 * TaskConfig.arm_tol
        assert session.env.task_config.limits["close"].horizon == 200
        assert session.env.config.reward_mode == "sparse"
        assert session.layout.profile == "ms_hab"


def test_a_stillness_of_the_command_goes_before_that_of_the_preset(
    tmp_path: Path,
) -> None:
    told = request(dataclasses.replace(TINY, stillness="absolute"), stillness="published")
    with train.open_reinforcement(dataclasses.replace(told, out=tmp_path)) as session:
        assert session.env.task_config.stillness == "published"


def test_the_split_told_is_that_of_the_episodes_behind_the_rate(tmp_path: Path) -> None:
    told = dataclasses.replace(
        request(dataclasses.replace(TINY, samples=16)), round_episodes=1, eval_split="val"
    )
    summary = train_in(told, tmp_path / "run").summary
    judged = tmp_path / "run" / "evaluations" / "latest" / "config.json"
    assert (
        summary["split"]
        == json.loads(judged.read_text(encoding="utf-8"))["split"]
        == "train"
    )
    assert summary["episodes"] == 1 and summary["evaluated_samples"] == 16
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "1 episodes in homes of split train" in page


def test_ctrl_c_before_the_first_checkpoint_keeps_the_actor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: sessions.ReinforcementSession) -> None:
        if self.state.samples >= 16:
            raise KeyboardInterrupt

    monkeypatch.setattr(sessions.ReinforcementSession, "check_time", interrupted)
    result = train_in(request(TINY), tmp_path / "run")
    assert result.interrupted and result.summary["trained"]
    kept = load_checkpoint(Path(result.summary["checkpoint"]))
    assert kept.about["samples"] == result.summary["student_samples"] == 16
    monkeypatch.setattr(PpoLearner, "collect", ctrl_c)
    early = train_in(request(TINY), tmp_path / "early")
    assert early.interrupted and early.summary["checkpoint"] is None
    assert not early.summary["trained"] and early.summary["split"] is None


def ctrl_c(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("slow", ["demonstrations", "imitation"])
def test_the_budget_holds_for_demonstrations_and_imitation(
    slow: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that only demonstrations, or only imitation, let pass."""
    now = [0.0]
    monkeypatch.setattr(Logbook, "seconds", property(lambda log: now[0]))
    owner, name = {
        "demonstrations": (ReplayBuffer, "add"),
        "imitation": (PpoLearner, "_imitation_loss"),
    }[slow]
    work = getattr(owner, name)

    def passes(self: object, *given: object) -> object:
        now[0] += 10.0
        return work(self, *given)

    monkeypatch.setattr(owner, name, passes)
    # The expert's episodes take real time, which must not decide here.
    monkeypatch.setattr(TimeBudget, "estimate_evaluation", lambda *_: None)
    config = dataclasses.replace(TINY_IMITATING, samples=64)
    assert config.ppo is not None
    config = dataclasses.replace(
        config, ppo=dataclasses.replace(config.ppo, imitation_updates=1000)
    )
    told = dataclasses.replace(
        request(config), budget_minutes=1.5, eval_episodes=1, round_episodes=100
    )
    summary = train_in(told, tmp_path / "run").summary
    # Half of the budget is reserved for evaluations that nobody has measured.
    assert now[0] == 50.0 and summary["samples"] == 0
    assert summary["trained"] is (slow == "imitation")
    # Random weights are not judged.
    assert summary["episodes"] == summary["trained"]


@pytest.mark.parametrize("config", [LONG_ROLLOUTS, TINY_RLPD], ids=["ppo", "rlpd"])
def test_a_budget_that_covers_no_update_is_refused_by_the_first_steps(
    config: ReinforcementConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A control step takes a second, the rate is kept for the next run."""
    now = [0.0]
    monkeypatch.setattr(Logbook, "seconds", property(lambda log: now[0]))
    monkeypatch.setattr(budget, "_file", lambda: tmp_path / "rates.json")
    step = Worlds.step

    def passes(self: Worlds, actions: torch.Tensor) -> object:
        now[0] += 1.0
        return step(self, actions)

    monkeypatch.setattr(Worlds, "step", passes)
    told = dataclasses.replace(request(config), budget_minutes=0.4)
    if config.sac is not None:
        sac = dataclasses.replace(config.sac, warm_up=80, capacity=256, demonstrations=0)
        config = dataclasses.replace(
            config, algorithm=SAC, sac=sac, samples=90, checkpoint_samples=90
        )
        told = dataclasses.replace(told, preset=config)
    early = train_in(told, tmp_path / "run").summary
    assert "control steps of 2 worlds take" in early["shortage"] and now[0] == 11.0
    assert "--budget-minutes 2 or more" in early["shortage"]
    assert not early["trained"] and early["checkpoint"] is None
    assert not (tmp_path / "run" / "training.safetensors").exists()
    now[0] = 0.0
    again = train_in(told, tmp_path / "again").summary
    assert again["shortage"] == early["shortage"] and now[0] == 0.0
    more = dataclasses.replace(told, budget_minutes=20.0)
    done = train_in(more, tmp_path / "run", resume=True).summary
    assert done["samples"] == config.samples and "shortage" not in done
