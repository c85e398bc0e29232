"""How fast reinforcement collects and learns, beside its environment alone: ``python -m benchmarks.learner``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.core.errors import UsageError
from mjhab.core.machine import cores
from mjhab.learning.configs import FLOAT32
from mjhab.learning.observation.spec import ObservationSpec, observation_spec_of
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder, AgentObs
from mjhab.learning.reinforcement.configs import (
    PPO,
    SAC,
    ReinforcementConfig,
    changed,
    reinforcement_preset,
)
from mjhab.learning.reinforcement.environments import training_env
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.reinforcement.ppo.learner import PpoLearner
from mjhab.learning.reinforcement.replay import ReplayBuffer, ReplayShape
from mjhab.learning.reinforcement.sac.agent import Sac
from mjhab.learning.reinforcement.sac.learner import SacLearner
from mjhab.learning.reinforcement.worlds import Worlds
from mjhab.learning.runs.specs import Scene

SCENE = Scene("set_table", "close", "kitchen_counter/drawer3")
SAC_PRESETS = {"state": "state", "two depth images of 32 px": "fast"}
"""What SAC sees, and the preset that sees it."""
BUFFER_STEPS = 256
BUFFER_WORLDS = 16
"""Made-up control steps that batches are drawn from."""


@dataclass(frozen=True)
class LearnerSpec:
    """Measure reinforcement learning: control steps/s of PPO and of its environment alone, updates/s of SAC."""

    worlds: int | None = None
    """Worlds of PPO; those of preset fast if absent."""
    batches: tuple[int, ...] = (256, 512)
    """Batch sizes of SAC, measured one after the other."""
    rounds: int = 3
    """Rollouts with their updates, each followed by as many control steps of the environment alone; the results are
    medians."""
    updates: int = 20
    """Number of timed updates of SAC."""
    threads: int = 0
    """Threads of physics and networks; 0 takes all cores."""
    seed: int = 0
    """Seed of weights and actions."""
    precision: str = FLOAT32
    """Of PPO's network, see `NetworkConfig.precision`; of SAC it is always float32."""
    in_turn: bool = False
    """Let PPO's critic learn after its actor, and not at the same time."""
    json: bool = False
    """Print one line of JSON instead of tables."""


def measure_learner(spec: LearnerSpec) -> dict[str, Any]:
    """Measure PPO from states beside its environment, and the updates of SAC.

    Returns:
        "threads"; "ppo": see `measure_ppo`; "sac": rows of "inputs", "batch" and "updates_per_second".
    """
    return {
        "threads": spec.threads or cores(),
        "ppo": measure_ppo(spec),
        "sac": [
            {
                "inputs": inputs,
                "batch": batch,
                "updates_per_second": measure_sac(preset, batch, spec),
            }
            for inputs, preset in SAC_PRESETS.items()
            for batch in spec.batches
        ],
    }


def measure_ppo(spec: LearnerSpec) -> dict[str, Any]:
    """Time rollouts with their updates, and the environment alone under the same kind of actions, in turn.

    Returns:
        "worlds"; "ppo_sps", "env_sps" [control steps/s over all worlds]: medians of ``rounds``; "ratio" of the two;
        "env_share", "learner_share": of the time of a rollout with its update.
    """
    config = reinforcement_preset(PPO, "fast")
    network = replace(config.network, precision=spec.precision)
    config = changed(config, {"network": network})
    if spec.worlds:
        config = changed(config, {"worlds": spec.worlds})
    assert config.ppo is not None
    worlds, layout, privileged = _worlds(config, spec.threads)
    agent = Ppo(config, layout, privileged, spec.seed)
    threads = 1 if spec.in_turn else spec.threads or cores()
    learner = PpoLearner(agent, worlds, config, spec.seed, threads=threads)
    # In the first updates the critic learns alone.
    learner.updates = config.ppo.critic_updates
    random = torch.Generator().manual_seed(spec.seed)
    steps = config.ppo.rollout_steps
    rows: list[tuple[float, float, float, float]] = []
    for number in range(spec.rounds + 1):
        begun = worlds.seconds
        collecting, rollout = _timed(learner.collect)
        within = worlds.seconds - begun
        updating, _ = _timed(lambda: learner.update(rollout, 0.0))  # noqa: B023 (called at once)
        shape = (steps, config.worlds, len(layout.actions))
        actions = config.ppo.initial_std * torch.randn(shape, generator=random)
        # In turns with the learner, so that a busier machine slows both.
        alone, _ = _timed(lambda: _step_alone(worlds, actions))  # noqa: B023
        if number:  # the first round compiles and warms up
            rows.append((collecting + updating, within, updating, alone))
    whole, within, updating, alone = (
        median(column) for column in zip(*rows, strict=True)
    )
    samples = steps * config.worlds
    return {
        "worlds": config.worlds,
        "ppo_sps": round(samples / whole, 1),
        "env_sps": round(samples / alone, 1),
        "ratio": round(alone / whole, 3),
        "env_share": round(within / whole, 3),
        "learner_share": round(updating / whole, 3),
    }


def measure_sac(preset: str, batch: int, spec: LearnerSpec) -> float:
    """Updates per second of a preset of SAC with batches of a size, drawing them from the replay buffer included."""
    config = changed(reinforcement_preset(SAC, preset), {"batch": batch, "worlds": 1})
    worlds, layout, privileged = _worlds(config, spec.threads)
    learner = SacLearner(Sac(config, layout, privileged, spec.seed), config, spec.seed)
    buffer = _buffer(worlds.seen, len(layout.actions))

    def update() -> None:
        learner.update(learner.batch(buffer, None), 0, 0.0, False)

    assert config.sac is not None
    # The first update of the actor comes so late, and kernels are chosen in it.
    for _ in range(config.sac.policy_delay):
        update()
    seconds, _ = _timed(lambda: [update() for _ in range(spec.updates)])
    return round(spec.updates / seconds, 2)


def _worlds(
    config: ReinforcementConfig, threads: int
) -> tuple[Worlds, ObservationSpec, int]:
    """Worlds of the scene, the layout of what is seen in them, and how much only a critic sees.

    Networks get as many threads as in a run.
    """
    torch.set_num_threads(config.inputs.network_threads(threads or cores()))
    env = training_env(SCENE, config.inputs, config.worlds, threads, 0)
    layout = observation_spec_of(env, config.inputs, (SCENE.target,))
    encoder = AgentEncoder(env, layout, config.privileged_critic)
    return Worlds(env, encoder, 0), layout, encoder.privileged_width


def _step_alone(worlds: Worlds, actions: Tensor) -> None:
    """Step the environment under actions (T, W, A), with resets but without an agent."""
    for action in actions:
        worlds.step(action)


def _buffer(like: AgentObs, actions: int) -> ReplayBuffer:
    """A replay buffer of random numbers in the shapes of an observation."""
    channels, height, width = like.images.shape[1:]
    shape = ReplayShape(
        worlds=BUFFER_WORLDS,
        steps=BUFFER_STEPS,
        vector=like.vector.shape[1],
        images=(int(channels), int(height), int(width)),
        privileged=like.privileged.shape[1],
        actions=actions,
    )
    random = torch.Generator().manual_seed(0)
    rows = BUFFER_WORLDS
    buffer = ReplayBuffer(shape, like.vector.device)
    for _ in range(BUFFER_STEPS):
        seen = AgentObs(
            torch.randn(rows, shape.vector, generator=random),
            torch.randint(
                256, (rows, *shape.images), generator=random, dtype=torch.uint8
            ),
            torch.randn(rows, shape.privileged, generator=random),
        )
        acted = 2.0 * torch.rand(rows, actions, generator=random) - 1.0
        reward = torch.rand(rows, generator=random)
        buffer.add(seen, acted, reward, torch.zeros(rows, dtype=torch.bool))
    return buffer


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Wall time of a call [s], and what it returns."""
    began = time.perf_counter()
    result = work()
    return time.perf_counter() - began, result


def bench_learner(spec: LearnerSpec) -> int:
    """Print the results of `measure_learner`.

    Raises:
        UsageError: there is no batch size.
    """
    if not spec.batches:
        raise UsageError("--batches: give at least one size, for instance --batches 256.")
    found = measure_learner(spec)
    ppo = found["ppo"]
    names = {
        "ppo_sps": "PPO from states [control steps/s]",
        "env_sps": "its environment alone [control steps/s]",
        "ratio": "PPO / environment",
        "env_share": "share of the time in the environment",
        "learner_share": "share of the time in updates",
    }
    rows = [(text, ppo[name]) for name, text in names.items()]
    title = f"PPO, {ppo['worlds']} worlds, {found['threads']} threads"
    updates = [list(row.values()) for row in found["sac"]]
    report(
        spec.json,
        found,
        Listing(title, ("what", "value"), rows),
        Listing("SAC", ("inputs", "batch", "updates/s"), updates),
    )
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(
        "learner",
        LearnerSpec,
        bench_learner,
        words,
        {"worlds": 1, "rounds": 1, "updates": 1, "batches": 2},
    )


if __name__ == "__main__":
    sys.exit(main())
