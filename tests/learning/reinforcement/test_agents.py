"""PPO and SAC learn a toy problem, and their critics say what is right."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.core.errors import UsageError
from mjhab.learning.configs import BFLOAT16, preset_of
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder
from mjhab.learning.reinforcement.configs import (
    LEAST_STD,
    MOST_STD,
    PAPER_INPUTS,
    SacConfig,
    changed,
    reinforcement_preset,
)
from mjhab.learning.reinforcement.networks import Critics
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.reinforcement.ppo.learner import PpoLearner
from mjhab.learning.reinforcement.replay import ReplayBuffer, ReplayShape
from mjhab.learning.reinforcement.sac.agent import Sac
from mjhab.learning.reinforcement.sac.learner import SacLearner
from mjhab.learning.reinforcement.worlds import TrainingRules, Worlds
from mjhab.learning.runs.training import BrokenLossError
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.gaussian import START_STD, gaussian_of
from mjhab.learning.students.heads import make_student
from tests.learning.reinforcement.toy import (
    HORIZON,
    LAYOUT,
    PPO_TOY,
    SAC_TOY,
    Toy,
    encoder_of,
)
from tests.learning.small import config, demonstrations, layout
from tests.paper.ms_hab_checkpoints import (
    HAND,
    HEAD,
    bc_action,
    bc_shapes,
    ppo_shapes,
    sac_shapes,
)
from tests.refusals import refused

WORLDS = 16
torch.set_num_threads(1)


def worlds(privileged: bool = False, terminates: bool = False) -> tuple[Worlds, int]:
    """The toy's worlds, and the numbers that only a critic sees."""
    env = Toy(WORLDS, terminates)
    encoder = encoder_of(env, LAYOUT, privileged)
    return Worlds(env, encoder, 0), encoder.privileged_width


def reward_of(policy: object, steps: int = 5 * HORIZON) -> float:
    """Mean reward of a policy that takes what is seen and gives actions."""
    place, _ = worlds()
    total = 0.0
    for _ in range(steps):
        with torch.no_grad():
            total += float(place.step(policy(place.seen)).reward.mean())  # type: ignore[operator]
    return total / steps


def test_networks_may_be_on_another_device_than_the_worlds() -> None:
    """Device meta keeps shapes alone, so whatever still lies on the CPU shows."""
    elsewhere = torch.device("meta")
    env: Any = Toy(WORLDS)
    encoder = AgentEncoder(env, LAYOUT, True, elsewhere)
    place = Worlds(env, encoder, 0, TrainingRules(longest_first=HORIZON))
    for _ in range(2 * HORIZON):
        step = place.step(torch.zeros(WORLDS, 1))
        seen = (step.next_seen, place.seen)
        given = [tensor for one in seen for tensor in vars(one).values()]
        given += [step.reward, step.terminated, step.ended, step.succeeded]
        assert {tensor.device for tensor in given} == {elsewhere}


@pytest.mark.parametrize(("privileged", "state_std"), [(False, False), (True, True)])
def test_ppo_learns_the_toy(privileged: bool, state_std: bool) -> None:
    place, width = worlds(privileged)
    config = changed(PPO_TOY, {"state_std": state_std})
    agent = Ppo(config, LAYOUT, width, seed=0)
    learner = PpoLearner(agent, place, config, seed=0)
    before = reward_of(agent.mean)
    for number in range(25):
        rollout = learner.collect()
        learner.update(rollout, number / 25)
        learner.normalize(rollout.seen)
    assert before < 0.65
    assert reward_of(agent.mean) > 0.8


def test_actor_and_critic_learn_the_same_at_the_same_time() -> None:
    changes = {"critic_updates": 1, "entropy_coefficient": 0.01, "clip_jointly": True}
    config = changed(PPO_TOY, changes)
    learned = []
    for threads in (1, 2):
        place, width = worlds(True)
        agent = Ppo(config, LAYOUT, width, seed=0)
        learner = PpoLearner(agent, place, config, seed=0, threads=threads)
        told = [learner.update(learner.collect(), 0.0) for _ in range(3)]
        learned.append((told, agent.state_dict()))
    (told, one), (others, two) = learned
    assert told == others and all(torch.equal(one[name], two[name]) for name in one)


def test_a_critic_of_bfloat16_leaves_the_actor_its_digits() -> None:
    network = dataclasses.replace(PPO_TOY.network, precision=BFLOAT16)
    told = []
    for own in (PPO_TOY, changed(PPO_TOY, {"network": network})):
        place, width = worlds()
        learner = PpoLearner(Ppo(own, LAYOUT, width, seed=0), place, own, seed=0)
        rollout = learner.collect()
        assert rollout.returns.dtype == torch.float32
        told.append((rollout, learner.update(rollout, 0.0)))
    (exact, losses), (rounded, others) = told
    assert torch.equal(exact.actions, rounded.actions)
    assert torch.equal(exact.log_probabilities, rounded.log_probabilities)
    assert losses["value_loss"] != others["value_loss"]
    assert others["value_loss"] == pytest.approx(losses["value_loss"], rel=0.05)


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_of_the_critic_ends_an_update(threads: int) -> None:
    place, width = worlds()
    agent = Ppo(PPO_TOY, LAYOUT, width, seed=0)
    learner = PpoLearner(agent, place, PPO_TOY, seed=0, threads=threads)
    rollout = learner.collect()
    broken = dataclasses.replace(rollout, returns=rollout.returns * torch.nan)
    before = [value.clone() for value in agent.parameters()]
    with pytest.raises(BrokenLossError, match="the loss became nan in update 1"):
        learner.update(broken, 0.0)
    assert all(map(torch.equal, before, agent.parameters()))


def test_ppo_imitates_demonstrations_first() -> None:
    config = changed(
        PPO_TOY, {"demonstrations": 1, "imitation_updates": 200, "critic_updates": 1}
    )
    place, width = worlds()
    shape = ReplayShape(WORLDS, 3 * HORIZON, 1, (0, 0, 0), width, 1)
    shown = ReplayBuffer(shape, place.device)
    for _ in range(2 * HORIZON):
        seen = place.seen
        actions = (-seen.vector / 0.3).clamp(-1.0, 1.0)
        happened = place.step(actions)
        shown.add(seen, actions, happened.reward, happened.terminated)
        ended = torch.nonzero(happened.ended).flatten()
        if len(ended):
            shown.close(ended, happened.next_seen.rows(ended))
    agent = Ppo(config, LAYOUT, width, seed=0)
    learner = PpoLearner(agent, place, config, 0, shown)
    assert learner.imitate() < 0.01
    assert reward_of(agent.mean) > 0.85
    # The critic learns alone at first, and the rate of the actor waits.
    imitated = [value.clone() for value in agent.acting_parameters()]
    rollout = learner.collect()
    told = learner.update(rollout, 0.0)
    assert told["learning_rate"] == config.ppo.learning_rate  # type: ignore[union-attr]
    assert all(map(torch.equal, imitated, agent.acting_parameters()))
    rollout = learner.collect()
    learner.update(rollout, 0.0)
    assert not all(map(torch.equal, imitated, agent.acting_parameters()))


def test_the_critic_has_a_learning_rate_of_its_own() -> None:
    place, width = worlds()
    config = changed(PPO_TOY, {"critic_learning_rate": 1e-9})
    agent = Ppo(config, LAYOUT, width, seed=0)
    learner = PpoLearner(agent, place, config, seed=0)
    before = [value.clone() for value in agent.value.parameters()]
    rollout = learner.collect()
    learner.update(rollout, 0.0)
    after = list(agent.value.parameters())
    assert all(
        torch.allclose(a, b, atol=1e-6) for a, b in zip(before, after, strict=True)
    )


@pytest.mark.parametrize(("inside", "steps"), [(True, 1), (False, 4)])
def test_too_much_divergence_ends_an_update_within_or_after_an_epoch(
    inside: bool, steps: int
) -> None:
    """The first minibatch of the first epoch has no divergence yet, so it is always taken."""
    place, width = worlds()
    config = changed(PPO_TOY, {"target_kl": 1e-12, "stop_in_epoch": inside})
    assert config.ppo is not None and config.ppo.minibatches == 4
    agent = Ppo(config, LAYOUT, width, seed=0)
    learner = PpoLearner(agent, place, config, seed=0)
    rollout = learner.collect()
    learner.update(rollout, 0.0)
    taken = learner.optimizer.state[next(agent.value.parameters())]["step"]
    assert int(taken) == steps


def test_a_gradient_that_is_not_finite_ends_the_run() -> None:
    place, width = worlds()
    agent = Ppo(PPO_TOY, LAYOUT, width, seed=0)
    learner = PpoLearner(agent, place, PPO_TOY, seed=0)
    rollout = learner.collect()
    for value in agent.parameters():
        value.register_hook(lambda gradient: gradient * torch.inf)
    before = [value.clone() for value in agent.parameters()]
    with pytest.raises(
        BrokenLossError, match=r"gradient became (nan|inf) in update 1\. The student"
    ):
        learner.update(rollout, 0.0)
    assert all(map(torch.equal, before, agent.parameters()))


def test_a_replay_buffer_larger_than_the_disk_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = ReplayShape(WORLDS, 64, 4, (0, 0, 0), 0, 1)
    nearly_full = SimpleNamespace(free=shape.total_bytes)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: nearly_full)
    with refused(said="free on the disk of"):
        ReplayBuffer(shape, torch.device("cpu"), tmp_path / "replay")
    assert not any(tmp_path.iterdir())
    monkeypatch.undo()
    ReplayBuffer(shape, torch.device("cpu"), tmp_path / "replay")
    # Files that are there need no room.
    monkeypatch.setattr(shutil, "disk_usage", lambda place: nearly_full)
    ReplayBuffer(shape, torch.device("cpu"), tmp_path / "replay")


@pytest.mark.parametrize("atoms", [0, 31])
def test_sac_learns_the_toy(atoms: int) -> None:
    config = changed(SAC_TOY, {"atoms": atoms})
    place, width = worlds()
    agent = Sac(config, LAYOUT, width, seed=0)
    learner = SacLearner(agent, config, seed=0)
    seen = place.seen
    shape = ReplayShape(WORLDS, 256, seen.vector.shape[1], (0, 0, 0), width, 1)
    buffer = ReplayBuffer(shape, place.device)
    random = torch.Generator().manual_seed(0)
    for step in range(110):
        with torch.no_grad():
            features = agent.actor.features(place.seen.vector, place.seen.images)
            actions, _ = agent.actor.sample(features, random)
        seen = place.seen
        happened = place.step(actions)
        buffer.add(seen, actions, happened.reward, happened.terminated)
        ended = torch.nonzero(happened.ended).flatten()
        if len(ended):
            buffer.close(ended, happened.next_seen.rows(ended))
        if step > 4:
            for _ in range(4):
                learner.update(learner.batch(buffer, None), 0, 0.0, False)
    act = lambda now: agent.actor.chunk(now.vector, now.images, now.vector)[:, 0]  # noqa: E731
    assert reward_of(act) > 0.8


def test_the_last_observation_of_an_episode_is_what_follows_its_last_step() -> None:
    place, _ = worlds()
    for step in range(HORIZON):
        before = place.seen.vector.clone()
        happened = place.step(torch.full((WORLDS, 1), 0.5))
        assert torch.allclose(happened.next_seen.vector, before + 0.15, atol=1e-6)
        assert bool(happened.ended.all()) == (step == HORIZON - 1)
    assert not torch.allclose(place.seen.vector, happened.next_seen.vector)


def test_first_episodes_end_at_different_times_and_as_by_time() -> None:
    env = Toy(WORLDS, terminates=True)
    place = Worlds(env, encoder_of(env), 0, TrainingRules(longest_first=HORIZON))
    ends = []
    for _ in range(HORIZON - 1):
        happened = place.step(torch.zeros(WORLDS, 1))
        assert not bool(happened.terminated.any())
        ends.append(int(happened.ended.sum()))
    assert sum(ends) >= WORLDS - 4 and max(ends) < WORLDS - 4


def test_too_much_force_ends_an_episode_and_every_force_costs() -> None:
    env = Toy(2)
    env.force = np.array([300.0, 0.0])
    rules = TrainingRules(
        force_limit=1000.0, force_ends=True, force_cost=5.0, conditions=("force_ok",)
    )
    place = Worlds(env, encoder_of(env), 0, rules)
    free = Worlds(Toy(2), encoder_of(env), 0)
    for step in range(1, 5):
        happened = place.step(torch.zeros(2, 1))
        usual = free.step(torch.zeros(2, 1))
        assert happened.terminated.tolist() == [step == 4, False]
        assert torch.equal(happened.terminated, happened.ended)
        paid = usual.reward - happened.reward
        assert paid.tolist() == pytest.approx([1.5, 0.0], abs=1e-5)
    assert place.held() == {"force_ok": pytest.approx(7 / 8)}
    assert place.held() == {"force_ok": 0.0}


def test_only_the_last_steps_of_an_episode_may_be_paid() -> None:
    env = Toy(2)
    place = Worlds(env, encoder_of(env), 0, TrainingRules(paid_steps=3))
    free = Worlds(Toy(2), encoder_of(env), 0)
    for step in range(1, HORIZON + 1):
        paid = place.step(torch.zeros(2, 1)).reward
        usual = free.step(torch.zeros(2, 1)).reward
        assert usual.all()
        assert torch.equal(paid, usual if step > HORIZON - 3 else torch.zeros(2))


def test_a_success_may_end_an_episode() -> None:
    env = Toy(2)
    place = Worlds(env, encoder_of(env), 0, TrainingRules(success_ends=True))
    env.place[:] = 0.0, 1.0
    happened = place.step(torch.zeros(2, 1))
    assert happened.succeeded.tolist() == [True, False]
    assert happened.terminated.tolist() == [True, False]
    assert torch.equal(happened.terminated, happened.ended)


def test_demonstrations_do_not_end_with_success() -> None:
    with refused("success_ends", True):
        changed(reinforcement_preset("rlpd", "demos"), {"success_ends": True})


def test_a_wrong_stillness_lists_the_names() -> None:
    with refused("paid_steps", 9):
        changed(reinforcement_preset("rlpd"), {"paid_steps": 9})
    with refused("stillness", "still"):
        changed(reinforcement_preset("ppo", "polish"), {"stillness": "still"})


def test_the_spread_depends_on_what_is_seen() -> None:
    config = changed(PPO_TOY, {"state_std": True, "initial_std": 0.3})
    agent = Ppo(config, LAYOUT, 0, seed=0)
    place, _ = worlds()
    before = agent.distribution(place.seen).log_std.exp()
    assert torch.allclose(before, torch.full_like(before, 0.3), atol=1e-5)
    assert agent.spread.weight is not None
    torch.nn.init.normal_(
        agent.spread.weight, std=0.1, generator=torch.Generator().manual_seed(0)
    )
    after = agent.distribution(place.seen).log_std.exp()
    assert after.std().item() > 1e-3
    assert (
        float(after.min()) >= LEAST_STD - 1e-6 and float(after.max()) <= MOST_STD + 1e-6
    )


class ToyInPictures(Toy):
    """The toy with a camera; the pictures are the same everywhere."""

    def _obs(self) -> dict:
        picture = np.full((self.num_envs, 16, 16, 1), 800, np.int16)
        return super()._obs() | {"sensor_data/fetch_head/depth": picture}


def in_pictures(**changes: object) -> tuple[PpoLearner, Ppo]:
    """An agent that begins from a student with a camera, and its learner."""
    inputs = dataclasses.replace(PPO_TOY.inputs, cameras=("fetch_head",), image_size=16)
    network = dataclasses.replace(PPO_TOY.network, channels=(4, 8), image_features=8)
    config = dataclasses.replace(
        changed(PPO_TOY, changes), inputs=inputs, network=network
    )
    told = dataclasses.replace(LAYOUT, inputs=inputs)
    encoder = encoder_of(ToyInPictures(WORLDS), told, True)
    place = Worlds(encoder._env, encoder, 0)
    start = make_student(config.student, told, 3)
    agent = Ppo(config, told, encoder.privileged_width, 0, start)
    return PpoLearner(agent, place, config, seed=0), agent


def _trunk(agent: Ppo) -> Trunk:
    trunk = agent.actor.trunk
    assert isinstance(trunk, Trunk)
    return trunk


def test_a_frozen_encoder_keeps_its_weights_and_changes_no_number() -> None:
    rollouts = []
    for frozen in (False, True):
        learner, agent = in_pictures(freeze_encoder=frozen)
        encoder = [value.clone() for value in _trunk(agent).encoder.parameters()]
        layers = [value.clone() for value in _trunk(agent).layers.parameters()]
        rollout = learner.collect()
        rollouts.append(rollout)
        learner.update(rollout, 0.0)
        kept = map(torch.equal, encoder, _trunk(agent).encoder.parameters())
        assert all(kept) == frozen
        assert not all(map(torch.equal, layers, _trunk(agent).layers.parameters()))
    free, kept = rollouts
    assert free.encoded is None and kept.encoded is not None
    assert torch.equal(free.actions, kept.actions)
    assert torch.allclose(kept.encoded, agent.encoded(kept.seen), atol=1e-6)


def test_a_frozen_encoder_needs_a_student() -> None:
    config = changed(PPO_TOY, {"freeze_encoder": True})
    with refused("freeze_encoder", True, advice="give one with --start"):
        Ppo(config, LAYOUT, 0, seed=0)


def test_a_critic_without_images_sees_the_rest() -> None:
    learner, agent = in_pictures(critic_images=False)
    assert agent.value.encoder.cameras == 0 and _trunk(agent).encoder.cameras == 1
    seen = learner.worlds.seen
    values = agent.value(seen)
    other = dataclasses.replace(seen, images=255 - seen.images)
    assert torch.equal(values, agent.value(other))
    nearer = dataclasses.replace(seen, privileged=seen.privileged + 1.0)
    assert not torch.equal(values, agent.value(nearer))
    with refused("critic_images", False):
        dataclasses.replace(learner.run, privileged_critic=False)


def test_the_learning_rate_follows_the_divergence() -> None:
    rates = []
    for wanted, least in ((1e-6, 1e-5), (1e-6, 3e-3), (10.0, 1e-5), (0.0, 1e-5)):
        place, width = worlds()
        config = changed(PPO_TOY, {"desired_kl": wanted, "least_learning_rate": least})
        learner = PpoLearner(Ppo(config, LAYOUT, width, seed=0), place, config, seed=0)
        rollout = learner.collect()
        rates.append(learner.update(rollout, 0.0)["learning_rate"])
    first = 3e-3
    assert rates[0] < first and rates[1:] == [first, first, first]


def test_a_shifted_distribution_keeps_its_mean() -> None:
    sac = SacConfig(atoms=21, value_low=0.0, value_high=10.0)
    critics = Critics(SAC_TOY.student, sac, 1, 0, 1)
    probabilities = torch.softmax(
        torch.randn(5, 21, generator=torch.Generator().manual_seed(0)), 1
    )
    targets = 1.3 + 0.7 * critics.support[None].expand(5, -1)
    projected = critics.project(probabilities, targets)
    assert torch.allclose(projected.sum(dim=1), torch.ones(5), atol=1e-5)
    wanted = (probabilities * targets).sum(dim=1)
    assert torch.allclose((projected * critics.support).sum(dim=1), wanted, atol=1e-4)


def test_actions_are_as_likely_as_the_actor_says() -> None:
    agent = Sac(SAC_TOY, LAYOUT, 0, seed=0)
    features = torch.zeros(200_000, agent.actor.trunk.encoder.width)
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        actions, density = agent.actor.sample(features, random)
    near = (actions[:, 0] - actions.median()).abs() < 0.005
    share = float(near.float().mean()) / 0.01
    assert float(density[near].exp().mean()) == pytest.approx(share, rel=0.05)


def test_an_actor_of_sac_begins_with_the_first_action_of_a_student() -> None:
    student = make_student(config("bc", chunk=4), layout(), seed=3)
    assert isinstance(student, BehaviourCloning)
    data = demonstrations(lengths=(60,))
    student.fit_normalizers(data)
    torch.nn.init.normal_(
        student.head.bias, std=0.5, generator=torch.Generator().manual_seed(0)
    )
    actor = gaussian_of(student)
    vector, images = torch.from_numpy(data.vector), torch.from_numpy(data.images)
    nothing = torch.zeros(len(vector), 0)
    with torch.no_grad():
        wanted = student.chunk(vector, images, nothing)[:, :1].clamp(-0.98, 0.98)
        acts = actor.chunk(vector, images, nothing)
        _, log_std = actor.distribution(actor.features(vector, images))
    assert float(wanted.std()) > 0.1
    assert torch.allclose(acts, wanted, atol=1e-5)
    assert torch.allclose(log_std.exp(), torch.full_like(log_std, START_STD), atol=1e-4)
    # The gradient passes the limit of the actions.
    actor.chunk(vector, images, nothing).sum().backward()
    assert actor.mean.bias.grad is not None and bool(
        torch.all(actor.mean.bias.grad > 0.0)
    )
    paper = preset_of("bc", "paper").student
    with refused(said="preset paper"):
        gaussian_of(BehaviourCloning(paper, layout(paper.inputs)))


def linear_shapes(*parts: torch.nn.Module) -> list[tuple[int, ...]]:
    """Shapes of the weights of all linear and convolutional layers, sorted."""
    kinds = (torch.nn.Linear, torch.nn.Conv2d)
    layers = [
        layer for part in parts for layer in part.modules() if isinstance(layer, kinds)
    ]
    return sorted(tuple(layer.weight.shape) for layer in layers)


def published(
    shapes: dict[str, tuple[int, ...]], *prefixes: str
) -> list[tuple[int, ...]]:
    """Shapes of the same kind in a checkpoint of MS-HAB, of the parts with the prefixes."""
    return sorted(
        shape
        for name, shape in shapes.items()
        if name.startswith(prefixes) and name.endswith("weight") and len(shape) > 1
    )


STATE_42 = ObservationSpec(
    PAPER_INPUTS,
    (("state", 42),),
    tuple(f"a{i}" for i in range(13)),
    (),
    ("pd_joint_delta_pos", "forward"),
)


def test_the_published_presets_have_the_published_layers() -> None:
    ppo = Ppo(reinforcement_preset("ppo", "paper"), STATE_42, 0, seed=0)
    shapes = ppo_shapes()
    assert linear_shapes(ppo.actor) == published(shapes, "feature_net.", "actor_mean.")
    assert linear_shapes(ppo.value) == published(shapes, "feature_net.", "critic.")
    hidden = ppo.actor.trunk.layers[0].weight.detach()  # type: ignore[union-attr]
    assert torch.allclose(hidden @ hidden.T, 2.0 * torch.eye(512), atol=1e-4)
    assert float(ppo.spread.bias[0].detach()) == pytest.approx(-0.5, abs=1e-4)
    sac = Sac(reinforcement_preset("sac", "paper"), STATE_42, 0, seed=0)
    shapes = sac_shapes()
    # The original has mean and spread in one layer.
    found = linear_shapes(sac.actor)
    assert found.count((13, 256)) == 2
    joined = sorted([shape for shape in found if shape != (13, 256)] + [(26, 256)])
    assert joined == published(shapes, "actor.")
    assert linear_shapes(sac.judge) == published(shapes, "critic.")
    assert sac.actor.log_std_limits == (-20.0, 2.0)
    acting, judging = sac.actor.trunk.encoder, sac.judge.encoder
    for one, other in zip(acting.encoders, judging.encoders, strict=True):
        assert one.convolutions is other.convolutions and one.head is not other.head
    learned = set(SacLearner(sac, reinforcement_preset("sac", "paper"), 0).acting)
    assert learned.isdisjoint(judging.parameters())
    assert learned.issuperset(acting.encoders[0].head.parameters())  # type: ignore[union-attr]
    assert learned.issuperset(acting.state.parameters())
    # Orthogonal layers, and convolutions that begin as orthogonal maps of their middle pixel.
    for rows in (sac.judge.critics.heads[1][0].weight.T, sac.actor.mean.weight):  # type: ignore[index]
        assert torch.allclose(rows @ rows.T, torch.eye(len(rows)), atol=1e-4)
    kernel = acting.encoders[0].convolutions[2].weight.detach()  # type: ignore[index]
    middle = kernel[:, :, 1, 1]
    assert torch.allclose(middle.T @ middle, 2.0 * torch.eye(32), atol=1e-4)
    assert torch.equal(kernel.sum(dim=(2, 3)), middle)
    paper = preset_of("bc", "paper").student
    bc = make_student(paper, dataclasses.replace(STATE_42, inputs=paper.inputs))
    assert linear_shapes(bc) == published(bc_shapes(), "")


def test_the_published_students_act_like_the_original() -> None:
    """The weights of our network of preset paper, under the original's names, in plain functions."""
    paper = preset_of("bc", "paper").student
    student = make_student(
        paper, dataclasses.replace(STATE_42, inputs=paper.inputs), seed=1
    )
    ours = [
        value for name, value in student.state_dict().items() if "normalizer" not in name
    ]
    by_shape: dict[tuple[int, ...], list[torch.Tensor]] = {}
    for value in ours:
        by_shape.setdefault(tuple(value.shape), []).append(value)
    state = torch.randn(1, 42, generator=torch.Generator().manual_seed(0))
    images = torch.zeros(1, 2, 128, 128, dtype=torch.uint8)
    with torch.no_grad():
        acts = student.chunk(state, images, torch.zeros(1, 0))[0, 0]
        # Same order of equal shapes in both: biases of 64 and 1024 come encoder by encoder.
        weights = {name: by_shape[shape].pop(0) for name, shape in bc_shapes().items()}
        far = {name: torch.full((1, 128, 128), 1e6) for name in (HEAD, HAND)}
        wanted = bc_action(weights, far, state)
    assert torch.allclose(acts, wanted, atol=1e-5)


def test_an_environment_that_resets_itself_is_refused() -> None:
    env = Toy(2)
    env.config.autoreset = "same_step"
    with refused("autoreset", "same_step", expected="'disabled'"):
        Worlds(env, encoder_of(env), 0)


def test_worlds_that_do_not_divide_into_minibatches_are_refused() -> None:
    paper = reinforcement_preset("ppo", "paper")
    told = r"--worlds 4 or 8, or --set ppo.minibatches=14 or 20\."
    with pytest.raises(UsageError, match=told):
        changed(paper, {"worlds": 7})
    for numbers in ({"worlds": 4}, {"worlds": 8}, {"worlds": 7, "minibatches": 14}):
        assert changed(
            paper, {"minibatches": 16} | numbers if len(numbers) == 1 else numbers
        )


@pytest.mark.parametrize(
    ("name", "value"), [("gamma", 7.0), ("gamma", 0.0), ("gae_lambda", 1.5)]
)
def test_discounts_lie_between_0_and_1(name: str, value: float) -> None:
    with refused(said=f"{name} must"):
        changed(PPO_TOY, {name: value})


def test_unknown_presets_are_told() -> None:
    with refused("preset of ppo", "fst", expected="fast"):
        reinforcement_preset("ppo", "fst")


def test_the_published_presets_have_the_published_numbers() -> None:
    ppo = reinforcement_preset("ppo", "paper").ppo
    sac = reinforcement_preset("sac", "paper").sac
    assert ppo is not None and sac is not None and ppo.stop_in_epoch
    assert (ppo.rollout_steps, ppo.minibatches, ppo.clip, ppo.target_kl) == (
        100,
        16,
        0.2,
        0.2,
    )
    assert (sac.batch, sac.tau, sac.capacity, sac.atoms) == (512, 0.005, 1_000_000, 0)
    assert sac.updates_per_step == 0.0
