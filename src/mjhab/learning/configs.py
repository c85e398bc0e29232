"""What is trained and how: frozen dataclasses, and the presets that have a name.

Sources: "paper" is the MS-HAB paper (ICLR 2025) with its published configurations, mshab/configs/bc_pick.yml and
dp_pick.yml, and its agents, mshab/agents/bc/agent.py and mshab/agents/dp/agent.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from mjhab.core.errors import UsageError, unknown_name

BC = "bc"
FLOW = "flow"
ACT = "act"
DIFFUSION = "diffusion"
DAGGER = "dagger"
GAUSSIAN = "gaussian"
HEADS = (BC, FLOW, ACT, DIFFUSION, GAUSSIAN)
"""Ways to turn what a student sees into a chunk of actions."""


@dataclass(frozen=True)
class InputConfig:
    """What a student sees.

    cameras, image_size: square depth images, rendered at that size [px]; no cameras for the state alone.
    history: observations that it sees, the present one and those before it. stack_state: False for images alone; of the
    state it then sees the present one only.
    previous_action: the executed action of the control step before.
    base_velocity: forward speed [m/s] and turning rate [rad/s] of the base. The 42-D state of the paper has none.
    link_state: how far the link of the active subtask is open [share of its range], how fast it opens [rad/s or m/s],
    and the heading of its frame in that of the base (cos, sin); zeros where there is none. Only a simulator knows them.
    condition: one-hot of the active subtask and of the type of its target.
    normalize: mean 0 and spread 1, by the statistics of the first demonstrations.
    shift: training images move by up to so many pixels.
    """

    cameras: tuple[str, ...] = ("fetch_head", "fetch_hand")
    image_size: int = 32
    history: int = 1
    stack_state: bool = True
    previous_action: bool = True
    base_velocity: bool = False
    link_state: bool = False
    condition: bool = True
    normalize: bool = True
    shift: int = 1


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks.

    encoder: of images, a name of `networks.CAMERA_ENCODERS`, or "paper_dp". image_features: numbers per camera.

    state_features: numbers that the state is turned into before it is joined with the images', 0 to join it as it is.
    norm: layer norm between the fully connected layers. unet: channels of the levels of a diffusion's UNet.
    """

    encoder: str = "small"
    channels: tuple[int, ...] = (32, 64)
    image_features: int = 128
    hidden: int = 384
    layers: int = 3
    state_features: int = 0
    norm: bool = True
    unet: tuple[int, ...] = (64, 128, 256)


@dataclass(frozen=True)
class OptimizerConfig:
    """How a network is trained. ``schedule``: "constant" or "cosine" (to zero over all updates), after ``warmup``."""

    batch: int = 256
    learning_rate: float = 5e-4
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 1e-4
    schedule: str = "constant"
    warmup: int = 200
    clip_norm: float = 1.0
    ema: float = 0.998
    """Decay of the moving average of the weights, which acts in evaluation; 0 for the weights themselves."""


@dataclass(frozen=True)
class StudentConfig:
    """A student and its training.

    algorithm: one of HEADS. chunk: control steps that are predicted; execute: those of them that are executed.
    hold_steps: control steps kept of a demonstration after its first success; -1 keeps all.
    huber: width of the quadratic part of the loss, in normalized actions; 0 for the squared error.
    sampling_steps: of a flow or of a diffusion.
    """

    algorithm: str = BC
    preset: str = "small"
    inputs: InputConfig = field(default_factory=InputConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    chunk: int = 8
    execute: int = 2
    hold_steps: int = 15
    huber: float = 0.5
    sampling_steps: int = 0
    updates: int = 20_000
    demos: int = 500
    """Demonstrations that are collected when no data are given."""
    style: tuple[str, ...] = ()
    """How the expert that is learned from acts, e.g. ("noise=0..0.2",): it acts with noise, and what it intended is
    learned (DART)."""

    def __post_init__(self) -> None:
        if self.algorithm not in HEADS:
            raise unknown_name("algorithm", self.algorithm, HEADS)
        if not 1 <= self.execute <= self.chunk:
            raise UsageError(f"execute must be from 1 to chunk ({self.chunk}), got {self.execute}.")


@dataclass(frozen=True)
class DaggerConfig:
    """Take-over DAgger: rounds in which the student begins an episode and the expert finishes it.

    rounds, episodes: so many rounds of so many episodes. updates: after every round. new_share: of every batch that
    comes from the newest round. first_prefix, prefix_growth: in round r (from 1) the student acts for a number of
    control steps drawn from 0 to first_prefix + (r - 1) * prefix_growth, at most max_prefix: late take-overs from a
    student that knows little cannot be saved. horizon: control steps of an episode of collection; more than in
    evaluation, so that the expert has the time to finish after a late take-over. final_updates: after the last round,
    from all rounds in equal parts, with a learning rate that falls to zero.
    """

    rounds: int = 8
    episodes: int = 64
    updates: int = 1500
    new_share: float = 0.5
    first_prefix: int = 25
    prefix_growth: int = 20
    max_prefix: int = 180
    horizon: int = 320
    final_updates: int = 0

    def longest_prefix(self, round_number: int) -> int:
        """Largest number of control steps that the student acts for in a round; 0 in round 0."""
        if round_number == 0:
            return 0
        return min(self.max_prefix, self.first_prefix + (round_number - 1) * self.prefix_growth)


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides what a run learns, apart from the task, the data and the seed."""

    student: StudentConfig = field(default_factory=StudentConfig)
    dagger: DaggerConfig | None = None

    @property
    def algorithm(self) -> str:
        """The name of the command that trains it."""
        return DAGGER if self.dagger is not None else self.student.algorithm


PAPER_INPUTS = InputConfig(
    image_size=128, previous_action=False, condition=False, normalize=False, shift=0
)
"""Inputs of the published students: two depth images of 128 pixels and the 42-D state as they are."""

SMALL = StudentConfig()

PAPER_BC = StudentConfig(
    preset="paper",
    inputs=PAPER_INPUTS,
    network=NetworkConfig("paper", (24, 36, 48, 64, 64), 1024, 1024, 3),
    # 100 epochs of 1,000 demonstrations (about 130,000 control steps) in batches of 512.
    optimizer=OptimizerConfig(
        batch=512, learning_rate=3e-4, weight_decay=0.0, warmup=0, clip_norm=0.0, ema=0.0
    ),
    chunk=1,
    execute=1,
    hold_steps=-1,
    huber=0.0,
    updates=25_000,
    demos=1000,
)

PAPER_DP = StudentConfig(
    algorithm=DIFFUSION,
    preset="paper_dp",
    inputs=dataclasses.replace(PAPER_INPUTS, history=2),
    network=NetworkConfig("paper_dp", (16, 32, 64, 128), 256, 0, 0),
    optimizer=OptimizerConfig(
        batch=256,
        learning_rate=1e-4,
        betas=(0.95, 0.999),
        weight_decay=1e-6,
        schedule="cosine",
        warmup=500,
        clip_norm=0.0,
        ema=0.9999,
    ),
    chunk=16,
    execute=8,
    hold_steps=15,
    huber=0.0,
    sampling_steps=100,
    updates=1_000_000,
    demos=1000,
)

FLOW_SMALL = dataclasses.replace(SMALL, algorithm=FLOW, preset="flow", huber=0.0, sampling_steps=6)

ACT_SMALL = dataclasses.replace(
    SMALL, algorithm=ACT, preset="act", network=NetworkConfig(hidden=128, layers=2)
)

QUICK = dataclasses.replace(SMALL, preset="quick", demos=128, updates=4000)

PRESETS: dict[str, dict[str, TrainConfig]] = {
    BC: {"small": TrainConfig(SMALL), "quick": TrainConfig(QUICK), "paper": TrainConfig(PAPER_BC)},
    FLOW: {
        "flow": TrainConfig(FLOW_SMALL),
        "quick": TrainConfig(
            dataclasses.replace(FLOW_SMALL, preset="quick", demos=128, updates=4000)
        ),
    },
    ACT: {
        "act": TrainConfig(ACT_SMALL),
        "quick": TrainConfig(
            dataclasses.replace(ACT_SMALL, preset="quick", demos=128, updates=4000)
        ),
    },
    DIFFUSION: {"paper_dp": TrainConfig(PAPER_DP)},
    DAGGER: {
        "small": TrainConfig(SMALL, DaggerConfig(rounds=10, episodes=200, updates=4000)),
        "quick": TrainConfig(dataclasses.replace(QUICK, updates=2000), DaggerConfig(updates=800)),
        "flow": TrainConfig(FLOW_SMALL, DaggerConfig(rounds=10, episodes=200, updates=4000)),
        "act": TrainConfig(ACT_SMALL, DaggerConfig(rounds=10, episodes=200, updates=4000)),
    },
}
"""Presets by algorithm; the first one is the default."""


def preset_of(algorithm: str, name: str = "") -> TrainConfig:
    """A preset of an algorithm, its first one if no name is given.

    Raises:
        UsageError: no such algorithm, or it has no such preset.
    """
    return find_preset(PRESETS, algorithm, name)


Preset = TypeVar("Preset")


def find_preset(
    known: Mapping[str, Mapping[str, Preset]], algorithm: str, name: str = ""
) -> Preset:
    """A preset of an algorithm from a table by algorithm and name, its first one if no name is given.

    Raises:
        UsageError: no such algorithm, or it has no such preset.
    """
    if algorithm not in known:
        raise unknown_name("algorithm", algorithm, known)
    presets = known[algorithm]
    if not name:
        return next(iter(presets.values()))
    if name not in presets:
        raise unknown_name(f"preset of {algorithm}", name, presets)
    return presets[name]


def to_plain(config: Any) -> dict[str, Any]:
    """A config as plain JSON data."""
    return dataclasses.asdict(config)


def student_from_plain(values: Mapping[str, Any]) -> StudentConfig:
    """Read what ``to_plain`` made of a `StudentConfig`, also after JSON.

    Raises:
        UsageError: a name that this version does not know, or one that is missing.
    """
    try:
        parts = {
            "inputs": InputConfig(**_tuples(values["inputs"])),
            "network": NetworkConfig(**_tuples(values["network"])),
            "optimizer": OptimizerConfig(**_tuples(values["optimizer"])),
        }
        return StudentConfig(**{**_tuples(values), **parts})
    except (KeyError, TypeError) as error:
        raise UsageError(
            f"the config of a student is not one of this version of mjhab: {error}."
        ) from error


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
    }
