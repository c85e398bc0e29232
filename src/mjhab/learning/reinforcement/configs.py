"""Configurations of reinforcement learning: frozen dataclasses and the named presets.

Sources: "paper" is the MS-HAB paper (ICLR 2025) with its published configurations (mshab/configs, mshab/train_ppo.py,
mshab/train_sac.py). "squint" is arXiv 2602.21203, "rlpd" is arXiv 2302.02948, "rainbow" is arXiv 2603.27400.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from mjhab.config.env import TrainConfig
from mjhab.core.errors import UsageError, unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.checks import check, check_above, check_between, check_least
from mjhab.learning.configs import (
    BC,
    FLOAT32,
    GAUSSIAN,
    PAPER_LOG_STD,
    TEACHING,
    FromZero,
    InputConfig,
    NetworkConfig,
    StudentConfig,
    find_preset,
)
from mjhab.tasks.thresholds import STILLNESS

PPO = "ppo"
SAC = "sac"
RLPD = "rlpd"
ALGORITHMS = (PPO, SAC, RLPD)
ONCE = "once"
AT_END = "at_end"
LEAST_STD = 0.02
MOST_STD = 1.0
"""Limits of a state-dependent standard deviation of the actions, as fractions of the action range [-1, 1]."""
KEEP_BEST_BY = (ONCE, AT_END)
"""Which success of an episode chooses the best actor: at any control step, or at the last one."""


@dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimization (arXiv 1707.06347).

    rollout_steps: control steps per world in one rollout. minibatches, epochs: per update.
    gamma: discount per control step. gae_lambda, clip, value_coefficient, entropy_coefficient: as in the PPO paper.
    finite_horizon: use the advantage estimate of MS-HAB (`returns.finite_horizon_advantages`) instead of GAE.
    target_kl: an update stops early once an epoch exceeds this KL divergence; 0 disables the limit. stop_in_epoch: it
    stops before the first minibatch that exceeds it, as in MS-HAB, instead of after an epoch whose mean does.
    clip_norm: largest gradient norm, applied to actor and critic separately, or with clip_jointly to both together.
    learning_rate_end: factor on the learning rate at the end of training; it decreases linearly from 1.
    initial_std: standard deviation of the actions before training, as a fraction of the action range [-1, 1].
    desired_kl: the learning rate is adapted so that the KL divergence of an epoch stays near this value, but not below
    least_learning_rate, which wide networks need smaller than narrow ones; 0 disables the adaptation.
    critic_learning_rate: constant learning rate of the critic; 0 uses that of the actor.
    state_std: the standard deviation depends on the observation instead of being one learned constant.
    critic_updates: number of initial updates that train only the critic, used when the actor is not new.
    critic_images: whether the critic sees the images, too; without them it needs the privileged inputs.
    freeze_encoder: the encoder of the student that the run begins from keeps its weights, and encodes every
    observation once instead of in every epoch. Both make updates from images several times faster.
    demonstrations: number of expert episodes that the actor imitates first, in imitation_updates updates of
    imitation_batch samples. demonstration_style: of the expert in these episodes, see `Styles.parse`; the actor
    imitates the intended actions. imitation_coefficient: weight of the imitation loss in the PPO updates that follow;
    it decreases linearly to zero over imitation_samples samples.
    average: decay per update of a moving average of the actor's weights, which is what is evaluated and kept, while the
    newest weights act and learn on; 0 keeps the newest.
    """

    rollout_steps: int = 32
    minibatches: int = 8
    epochs: int = 5
    gamma: float = 0.97
    gae_lambda: float = 0.95
    finite_horizon: bool = False
    clip: float = 0.2
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.0
    target_kl: float = 0.05
    stop_in_epoch: bool = False
    clip_norm: float = 0.5
    clip_jointly: bool = False
    learning_rate: float = 3e-4
    critic_learning_rate: float = 0.0
    learning_rate_end: float = 1.0
    adam_epsilon: float = 1e-5
    initial_std: float = 0.6
    desired_kl: float = 0.0
    least_learning_rate: float = 1e-5
    state_std: bool = False
    critic_updates: FromZero = 0
    critic_images: bool = True
    freeze_encoder: bool = False
    demonstrations: FromZero = 0
    demonstration_style: Annotated[tuple[str, ...], Bound(empty=True)] = ()
    imitation_updates: FromZero = 3000
    imitation_batch: int = 256
    imitation_coefficient: float = 0.0
    imitation_samples: FromZero = 500_000
    average: float = 0.0

    def __post_init__(self) -> None:
        check(
            0.0 <= self.average < 1.0, "average", self.average, "at least 0 and below 1"
        )
        for name in ("rollout_steps", "minibatches", "epochs"):
            check_least(name, getattr(self, name), 1)
        check(0.0 < self.gamma <= 1.0, "gamma", self.gamma, "above 0 and at most 1")
        check_between("gae_lambda", self.gae_lambda, 0.0, 1.0)
        if self.desired_kl and not 0 < self.least_learning_rate <= self.learning_rate:
            raise wrong_value(
                "least_learning_rate",
                self.least_learning_rate,
                f"above 0 and at most learning_rate ({self.learning_rate})",
            )
        check_above("initial_std", self.initial_std, 0.0)
        if self.state_std and not LEAST_STD < self.initial_std < MOST_STD:
            raise wrong_value(
                "initial_std",
                self.initial_std,
                f"between {LEAST_STD} and {MOST_STD} with state_std",
            )


@dataclass(frozen=True)
class SacConfig:
    """Soft actor-critic (arXiv 1812.05905) with optional distributional critics and demonstrations.

    tau: step of the target networks towards the critics, per update. batch: transitions per update.
    updates_per_step: critic updates per control step of one world (update-to-data ratio); 0 means one update per
    step of the vector environment, as in MS-HAB.
    capacity: transitions in the replay buffer. warm_up: samples collected with random actions before the first update.
    atoms: number of atoms of a distributional critic (C51) over the returns [value_low, value_high]; 0 selects a
    scalar critic with the squared error. critics: size of the ensemble.
    policy_delay: critic updates per update of the actor and of the target networks.
    share_encoder: the actor uses the encoder that the critics train; otherwise it has its own. Of the encoder "strided"
    (MS-HAB's) they share the convolutions, and each has its own layers behind them.
    demonstrations: number of expert episodes in a separate demonstration buffer; demonstration_share: fraction of
    each batch drawn from it. imitation_coefficient: weight of the squared distance between the actor's actions and
    the demonstrated ones; it decreases linearly to 0 over imitation_samples. frozen_actor_samples: number of samples
    after warm_up in which only the critics learn, used when the actor comes from a checkpoint.
    """

    gamma: float = 0.95
    tau: float = 0.01
    batch: int = 256
    updates_per_step: float = 0.25
    capacity: int = 300_000
    warm_up: FromZero = 4000
    learning_rate: float = 3e-4
    adam_beta: float = 0.9
    initial_alpha: float = 0.1
    critics: int = 2
    atoms: FromZero = 101
    value_low: Annotated[float, Bound(-math.inf)] = 0.0
    value_high: Annotated[float, Bound(-math.inf)] = 20.0
    policy_delay: int = 2
    share_encoder: bool = True
    demonstrations: FromZero = 0
    demonstration_share: float = 0.5
    imitation_coefficient: float = 0.0
    imitation_samples: FromZero = 300_000
    frozen_actor_samples: FromZero = 0

    def __post_init__(self) -> None:
        check(0.0 < self.gamma < 1.0, "gamma", self.gamma, "between 0 and 1")
        if self.batch < 2 or self.capacity < self.batch:
            raise wrong_value(
                "capacity of the replay buffer",
                self.capacity,
                f"enough for a batch ({self.batch}) of at least 2",
            )
        check_least("updates_per_step", self.updates_per_step, 0)
        check_above("initial_alpha", self.initial_alpha, 0.0)
        check(
            0.0 <= self.adam_beta < 1.0,
            "adam_beta",
            self.adam_beta,
            "at least 0 and below 1",
        )
        if self.atoms == 1 or (self.atoms and not self.value_low < self.value_high):
            raise wrong_value(
                "atoms",
                self.atoms,
                "at least 2 over rising values, or 0 for a scalar critic",
                f"The values are from {self.value_low} to {self.value_high}.",
            )
        check(
            0.0 <= self.demonstration_share < 1.0,
            "demonstration_share",
            self.demonstration_share,
            "at least 0 and below 1",
        )


REST_TOLERANCES = ("ee_rest_tol", "arm_tol", "arm_tol_grasped")
"""The tolerances of `TaskConfig` that `ReinforcementConfig.rest_share` is about."""


@dataclass(frozen=True)
class ReinforcementConfig:
    """An agent and its training. A sample is one control step of one world.

    samples: total number of samples. worlds: number of parallel worlds; changing it changes the result.
    privileged_critic: the critic also receives simulator state that the actor does not observe, see
    `agent_encoder.PRIVILEGED`.
    horizon: control steps of a training episode; 0 takes the horizon of the profile. stagger: the first episodes have
    random lengths, so that the worlds do not all reset in the same step.
    episode_pool: number of start states that training episodes are drawn from; 0 takes the default of `TrainConfig`.
    Generating one start state takes as long as about a hundred samples.
    force_ends: a training episode terminates when its cumulative force exceeds the subtask's limit. force_cost: total
    reward subtracted over an episode whose cumulative force reaches the limit. The dense rewards of Open and Close
    have no force term: without these two options the reward does not tell the policy why it fails by force.
    reward_mode: of the training environment, see `EnvConfig`. success_ends: a training episode terminates at its first
    success. With reward_mode "sparse", which pays 1 per control step in success, the return is then gamma to the power
    of the control steps until success.
    paid_steps: the reward is paid in the last so many control steps of a training episode; 0 for all. Where every
    control step in success is paid, a policy gains more by being fast than by succeeding more often.
    stillness: of training episodes, see `TaskConfig.stillness`; "" takes that of the profile. That of the scene, if it
    names one, goes before. Where a joint that moves backwards counts as still ("published"), PPO learns to succeed
    while it moves so, and the policy does not come to rest. Evaluations during the run keep that of the profile.
    rest_share: tolerances of the rest of hand and arm in training episodes (REST_TOLERANCES), as a share of the task's.
    A policy that is paid for success alone comes to rest at the edge of what counts, and often just beside it.
    checkpoint_samples: samples between checkpoints. At a checkpoint all worlds start new episodes, so that a resumed
    run gives the same result as an uninterrupted one. eval_samples: samples between evaluations.
    keep_best_by: success that chooses the run's student among the evaluations on the way, one of KEEP_BEST_BY. "once"
    counts every episode that succeeds, "at_end" those that are in success at their last control step.
    """

    algorithm: str
    preset: str
    inputs: InputConfig = field(default_factory=InputConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PpoConfig | None = None
    sac: SacConfig | None = None
    samples: FromZero = 1_000_000
    worlds: int = 32
    privileged_critic: bool = True
    horizon: FromZero = 0
    stagger: bool = True
    episode_pool: FromZero = 0
    force_ends: bool = False
    force_cost: float = 0.0
    reward_mode: str = TrainConfig.reward_mode
    success_ends: bool = False
    paid_steps: FromZero = 0
    stillness: str = ""
    rest_share: Annotated[float, Bound(0.05, 1.0)] = 1.0
    checkpoint_samples: int = 50_000
    eval_samples: int = 100_000
    keep_best_by: str = ONCE

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise unknown_name("algorithm", self.algorithm, ALGORITHMS)
        if self.success_ends and self.algorithm == RLPD:
            raise wrong_value(
                "success_ends",
                True,
                "false with rlpd, whose demonstrations go on after success",
                "Take ppo or sac.",
            )
        if self.paid_steps and (self.success_ends or self.algorithm == RLPD):
            raise wrong_value(
                "paid_steps",
                self.paid_steps,
                "0 with success_ends and with rlpd, whose episodes end before they begin",
            )
        if self.stillness and self.stillness not in STILLNESS:
            raise unknown_name("stillness", self.stillness, STILLNESS)
        if self.keep_best_by not in KEEP_BEST_BY:
            raise unknown_name("keep_best_by", self.keep_best_by, KEEP_BEST_BY)
        if (self.ppo is None) == (self.sac is None):
            raise UsageError("a ReinforcementConfig needs exactly one of ppo and sac.")
        if self.sac is not None and self.network.precision != FLOAT32:
            raise wrong_value(
                "network.precision",
                self.network.precision,
                f"{FLOAT32} with sac and rlpd",
            )
        if self.ppo is not None:
            if not self.ppo.critic_images and not self.privileged_critic:
                raise wrong_value(
                    "critic_images",
                    False,
                    "true without the privileged critic",
                    "Leave out --no-privileged-critic.",
                )
            # A smaller last minibatch would weigh its samples more.
            rows = self.worlds * self.ppo.rollout_steps
            if rows % self.ppo.minibatches:
                raise wrong_value(
                    "minibatches",
                    self.ppo.minibatches,
                    f"such that {self.worlds} worlds x {self.ppo.rollout_steps} steps, {rows} samples, divide evenly",
                    f"The nearest that fit are {self._fitting()}.",
                )

    def _fitting(self) -> str:
        """The numbers of worlds, and of minibatches, nearest to those of the config that give equal minibatches."""
        assert self.ppo is not None
        parts, steps = self.ppo.minibatches, self.ppo.rollout_steps
        rows = self.worlds * steps
        unit = parts // math.gcd(parts, steps)
        below = self.worlds // unit * unit
        worlds = [str(number) for number in (below, below + unit) if number]
        fewer = next(number for number in range(parts, 0, -1) if rows % number == 0)
        more = next(
            (number for number in range(parts, rows + 1) if rows % number == 0), fewer
        )
        minibatches = [str(number) for number in sorted({fewer, more})]
        return f"--worlds {' or '.join(worlds)}, or --set ppo.minibatches={' or '.join(minibatches)}"

    @property
    def student(self) -> StudentConfig:
        """Config of the actor as a student policy, the form that a checkpoint stores and `mjhab eval` runs."""
        return StudentConfig(
            # The mean of PPO's actor is what is executed in an evaluation, which is a student of behaviour cloning.
            algorithm=BC if self.ppo is not None else GAUSSIAN,
            preset=self.preset,
            inputs=self.inputs,
            network=self.network,
            chunk=1,
            execute=1,
        )


STATE_INPUTS = InputConfig(
    cameras=(),
    image_size=0,
    previous_action=False,
    base_velocity=True,
    condition=True,
    shift=0,
)
"""The 42-D state and the base velocity; no images."""
LINK_INPUTS = dataclasses.replace(STATE_INPUTS, link_state=True)
"""STATE_INPUTS and the opening of the target's furniture link."""
DEPTH_INPUTS = InputConfig(
    image_size=32, previous_action=False, base_velocity=True, condition=True, shift=0
)
"""STATE_INPUTS with two depth images of 32 x 32 px."""
PAPER_INPUTS = InputConfig(
    image_size=128,
    previous_action=False,
    condition=False,
    normalize=False,
    shift=0,
    history=3,
    stack_state=False,
)
"""Inputs of the MS-HAB agents: two depth images of 128 x 128 px of three steps, and one unnormalized 42-D state."""

STATE_NETWORK = NetworkConfig(hidden=256, layers=3)

SCRATCH_PPO = ReinforcementConfig(
    PPO,
    "scratch",
    LINK_INPUTS,
    STATE_NETWORK,
    ppo=PpoConfig(
        rollout_steps=16,
        minibatches=4,
        gae_lambda=0.9,
        learning_rate=5e-4,
        critic_learning_rate=1e-3,
        desired_kl=0.03,
        target_kl=0.0,
        initial_std=0.5,
        entropy_coefficient=0.001,
        state_std=True,
    ),
    samples=3_000_000,
    worlds=128,
    horizon=100,
    episode_pool=256,
    force_ends=True,
    force_cost=5.0,
    checkpoint_samples=100_000,
    eval_samples=500_000,
)
"""From random weights."""
FAST_PPO = dataclasses.replace(
    SCRATCH_PPO,
    preset="fast",
    ppo=PpoConfig(
        rollout_steps=32,
        minibatches=8,
        learning_rate=5e-5,
        critic_learning_rate=1e-3,
        desired_kl=0.005,
        target_kl=0.0,
        initial_std=0.1,
        critic_updates=20,
        demonstrations=200,
        demonstration_style=TEACHING,
        imitation_updates=8000,
        imitation_coefficient=1.0,
        imitation_samples=1_000_000,
    ),
    worlds=64,
    horizon=0,
)
"""From an actor that imitates a disturbed expert."""

PAPER_PPO = ReinforcementConfig(
    PPO,
    "paper",
    PAPER_INPUTS,
    NetworkConfig("nature", (32, 64, 64), 256, 512, 1, state_features=256, norm=False),
    ppo=PpoConfig(
        rollout_steps=100,
        minibatches=16,
        epochs=8,
        gamma=0.95,
        gae_lambda=0.9,
        finite_horizon=True,
        target_kl=0.2,
        stop_in_epoch=True,
        clip_jointly=True,
        initial_std=0.6065,  # exp(-0.5)
    ),
    samples=15_000_000,
    worlds=192,  # 189 in MS-HAB, which its 16 minibatches do not divide
    privileged_critic=False,
    stagger=False,
    eval_samples=500_000,
)

PAPER_STATE_PPO = dataclasses.replace(
    PAPER_PPO,
    preset="paper_state",
    inputs=FAST_PPO.inputs,
    network=NetworkConfig(hidden=512, layers=1, state_features=256, norm=False),
)
"""The paper's hyper-parameters with the inputs of "fast", for a comparison at equal numbers of samples."""

FAST_SAC = ReinforcementConfig(
    SAC,
    "fast",
    DEPTH_INPUTS,
    NetworkConfig(hidden=256, layers=3),
    sac=SacConfig(),
    worlds=32,
)

PAPER_SAC = ReinforcementConfig(
    SAC,
    "paper",
    PAPER_INPUTS,
    NetworkConfig(
        "strided",
        (32, 64, 128, 256),
        50,
        256,
        3,
        state_features=50,
        norm=False,
        log_std=PAPER_LOG_STD,
    ),
    sac=SacConfig(
        gamma=0.95,
        tau=0.005,
        batch=512,
        updates_per_step=0.0,
        capacity=1_000_000,
        warm_up=5000,
        atoms=0,
        policy_delay=2,
    ),
    samples=25_000_000,
    worlds=63,
    privileged_critic=False,
    stagger=False,
    eval_samples=500_000,
)

DEMOS = dataclasses.replace(
    FAST_SAC,
    algorithm=RLPD,
    preset="demos",
    sac=SacConfig(
        demonstrations=200,
        imitation_coefficient=2.5,
        warm_up=1000,
        frozen_actor_samples=5000,
        share_encoder=False,
    ),
)


def _from_states(config: ReinforcementConfig) -> ReinforcementConfig:
    """The config with the state inputs of PPO's "fast" preset; episodes end when the force limit is exceeded."""
    return dataclasses.replace(
        config, preset="state", inputs=LINK_INPUTS, network=STATE_NETWORK, force_ends=True
    )


POLISHING = PpoConfig(
    epochs=3,
    gamma=0.99,
    learning_rate=2e-5,
    critic_learning_rate=1e-3,
    desired_kl=0.005,
    target_kl=0.03,
    initial_std=0.05,
    state_std=True,
    critic_updates=20,
)
POLISH_PPO = dataclasses.replace(
    SCRATCH_PPO,
    preset="polish",
    inputs=DEPTH_INPUTS,
    ppo=POLISHING,
    worlds=64,
    horizon=200,
    episode_pool=1000,
    force_cost=0.0,
    reward_mode="sparse",
    success_ends=True,
    stillness="absolute",
    checkpoint_samples=50_000,
    eval_samples=100_000,
)

REFINE_PPO = dataclasses.replace(
    POLISH_PPO,
    preset="refine",
    ppo=dataclasses.replace(
        POLISHING,
        epochs=2,
        rollout_steps=64,
        minibatches=8,
        learning_rate=2e-6,
        least_learning_rate=1e-6,
        desired_kl=0.008,
        average=0.95,
    ),
    force_cost=3.0,
    success_ends=False,
    paid_steps=60,
    rest_share=0.8,
    keep_best_by="at_end",
    checkpoint_samples=100_000,
    eval_samples=500_000,
)
"""For a policy that "polish" makes no better: it begins with a tenth of the learning rate, and what is paid is success
that lasts to the end, without force (docs/results/reinforcement.md)."""


PRESETS: dict[str, dict[str, ReinforcementConfig]] = {
    PPO: {
        "fast": FAST_PPO,
        "scratch": SCRATCH_PPO,
        "depth": dataclasses.replace(
            SCRATCH_PPO,
            preset="depth",
            inputs=DEPTH_INPUTS,
            network=NetworkConfig(hidden=256),
            worlds=64,
        ),
        "paper": PAPER_PPO,
        "paper_state": PAPER_STATE_PPO,
        "polish": POLISH_PPO,
        "refine": REFINE_PPO,
    },
    SAC: {
        "fast": FAST_SAC,
        "state": _from_states(FAST_SAC),
        "paper": PAPER_SAC,
    },
    RLPD: {
        "demos": DEMOS,
        "state": _from_states(DEMOS),
    },
}
"""Presets by algorithm and name; the first preset of an algorithm is its default."""


def reinforcement_preset(algorithm: str, name: str = "") -> ReinforcementConfig:
    """Return a preset of an algorithm; without a name, its default preset.

    Raises:
        UsageError: no such algorithm, or it has no such preset.
    """
    return find_preset(PRESETS, algorithm, name)


def changed(
    config: ReinforcementConfig, values: Mapping[str, Any]
) -> ReinforcementConfig:
    """Return a copy of the config with other values.

    Names that are not fields of `ReinforcementConfig` are set in its ``ppo`` or ``sac`` part. Values of None are
    ignored.

    Raises:
        UsageError: a value is out of range.
    """
    own = {part.name for part in dataclasses.fields(config)}
    given = {name: value for name, value in values.items() if value is not None}
    outer = {name: value for name, value in given.items() if name in own}
    inner = {name: value for name, value in given.items() if name not in own}
    if inner:
        part = "ppo" if config.ppo is not None else "sac"
        outer[part] = dataclasses.replace(getattr(config, part), **inner)
    return dataclasses.replace(config, **outer)
