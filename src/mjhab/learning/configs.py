"""Configurations of imitation learning: frozen dataclasses and the named presets.

Sources: "paper" is the MS-HAB paper (ICLR 2025) with its published configurations, mshab/configs/bc_pick.yml and
dp_pick.yml, and its agents, mshab/agents/bc/agent.py and mshab/agents/dp/agent.py.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from mjhab.core.conventions.images import RGB
from mjhab.core.errors import UsageError, shown, unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.checks import check, check_between
from mjhab.core.typed.options import read_record
from mjhab.robots.registry import robot_named

FromZero = Annotated[int, Bound(0)]
"""A whole number that may be 0."""
BC = "bc"
FLOW = "flow"
ACT = "act"
DIFFUSION = "diffusion"
DAGGER = "dagger"
GAUSSIAN = "gaussian"
GAUSSIAN_ACTIONS = "gaussian_actions"
DEPTH = "depth"
RGBD = "rgbd"
IMAGE_CONTENTS = {DEPTH: (DEPTH,), RGB: (RGB,), RGBD: (DEPTH, RGB)}
"""What images of a student can show."""
VIEWS = {"whole": (True, False), "target": (False, True), "both": (True, True)}
"""Values of `InputConfig.whole_views` and ``target_views``, by what they are called together."""
FLOAT32 = "float32"
BFLOAT16 = "bfloat16"
PRECISIONS = (FLOAT32, BFLOAT16)
"""Values of `NetworkConfig.precision`."""
HEADS = (BC, FLOW, ACT, DIFFUSION, GAUSSIAN, GAUSSIAN_ACTIONS)
"""Algorithms that map an observation to a chunk of actions."""


@dataclass(frozen=True)
class InputConfig:
    """Inputs of a student. Besides these it always receives the environment's state vector.

    cameras, image_size: square images, by default of the cameras of the default robot, and their side [px]; no
    cameras for the state only.
    images: what they show, one of IMAGE_CONTENTS: "depth", "rgb" (colours alone) or "rgbd".
    whole_views, target_views: images of the cameras as they are, and views from their places that are turned to the
    target of the active subtask and narrowed to it, of the same size, see `render.target_views`.
    history: number of observations, the current one included. stack_state: whether the history contains the state;
    False gives the images of all observations and the state of the current one.
    previous_action: the action executed in the previous control step.
    base_velocity: forward speed [m/s] and turning rate [rad/s] of the base, which the 42-D state of the paper lacks.
    link_state: of the active subtask's furniture link, the opening [fraction of its range], its speed [rad/s or m/s]
    and the heading of the link's frame in the base frame (cos, sin); zeros without a link. Privileged information:
    only a simulator provides it.
    target_in_hand: the target of the active subtask relative to the tcp in its axes, on three scales, see
    `observation.parts.TargetInHand`; a function of the state.
    condition: one-hot of the active subtask and of the type of its target.
    sentence: the instruction of the active subtask as a bag of words, see `observation.sentences.encode_sentence`.
    backbone: a pretrained image network, an ONNX file, whose features of the colour images of the cameras the student
    sees; they are computed once per image and stay as they are, see `observation.backbone`. Without whole_views and
    target_views they are all that it sees of the images.
    normalize: normalize to mean 0 and standard deviation 1 with the statistics of the first demonstrations.
    shift: largest random shift of training images [px].
    colour_shift: largest random change of the brightness of training images, and of each of their colours [share]:
    each channel of an image is multiplied by one number from 1 - colour_shift to 1 + colour_shift, twice.
    """

    cameras: Annotated[tuple[str, ...], Bound(empty=True)] = robot_named().camera_names
    image_size: int = 32
    images: str = DEPTH
    history: int = 1
    stack_state: bool = True
    previous_action: bool = True
    base_velocity: bool = False
    link_state: bool = False
    target_in_hand: bool = False
    whole_views: bool = True
    target_views: bool = False
    condition: bool = True
    sentence: bool = False
    backbone: str = field(default="", compare=False)
    """Where the file lies is no part of what a student sees: its hash is, in the layout."""
    normalize: bool = True
    shift: FromZero = 1
    colour_shift: Annotated[float, Bound(0.0, 0.9)] = 0.0

    def __post_init__(self) -> None:
        if self.images not in IMAGE_CONTENTS:
            raise unknown_name("images", self.images, IMAGE_CONTENTS)
        if self.cameras and not (self.whole_views or self.target_views or self.backbone):
            raise wrong_value(
                "inputs.cameras",
                self.cameras,
                "left out without inputs.whole_views, inputs.target_views and inputs.backbone",
                "Or switch one of these on.",
            )
        if self.backbone and not (self.cameras and self.image_size):
            raise wrong_value(
                "inputs.backbone",
                self.backbone,
                "left out without inputs.cameras",
                "It sees their images: take a preset that has some.",
            )

    def network_threads(self, threads: int) -> int:
        """Number of torch threads: ``threads`` with images, else 1.

        Small dense layers gain nothing from a second thread. On a machine whose cores other processes use, torch's
        threads wait for each other in spin loops: a rollout with its update then took nine times the CPU time.
        """
        return threads if self.cameras else 1


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks.

    encoder: of images, a name of `networks.CAMERA_ENCODERS`, or "paper_dp". channels: of its convolutions.
    image_features: features per camera. hidden, layers: width and number of the fully connected layers.
    state_features: features that a linear layer computes from the state before it joins the images' features; 0 joins
    the state unchanged. norm: layer norm between the fully connected layers. unet: channels per level of the diffusion
    policy's UNet. log_std: limits of the logarithm of the standard deviation of SAC's actor before squashing.
    """

    encoder: str = "small"
    channels: tuple[int, ...] = (32, 64)
    image_features: int = 128
    hidden: int = 384
    layers: FromZero = 3
    state_features: FromZero = 0
    norm: bool = True
    unet: tuple[int, ...] = (64, 128, 256)
    log_std: Annotated[tuple[float, float], Bound(-math.inf)] = (-5.0, 1.0)
    experts: Annotated[tuple[str, ...], Bound(empty=True)] = ()
    """Of a student that `mjhab policy join` made of several: which views each of them sees, one of VIEWS."""
    routes: Annotated[tuple[FromZero, ...], Bound(empty=True)] = ()
    """Of such a student: the number of the one that acts, for each request that it knows."""
    precision: str = field(default=FLOAT32, compare=False)
    """Of the products of matrices and the convolutions of an update, one of PRECISIONS; weights, and whatever acts, are
    float32. bfloat16 keeps 8 of 24 binary digits of every factor, and processors that have it (AVX512-BF16, AMX) take
    about two thirds of the time. With PPO it is for the critic and for imitation: the likelihoods of actions, whose
    ratios the actor learns from, need all digits. Not for SAC and RLPD."""

    def __post_init__(self) -> None:
        if len(self.log_std) != 2 or not self.log_std[0] < self.log_std[1]:
            raise wrong_value("network.log_std", self.log_std, "two rising numbers")
        if self.precision not in PRECISIONS:
            raise unknown_name("network.precision", self.precision, PRECISIONS)
        for views in self.experts:
            if views not in VIEWS:
                raise unknown_name("network.experts", views, VIEWS)
        if set(self.routes) != set(range(len(self.experts))):
            raise wrong_value(
                "network.routes",
                self.routes,
                f"numbers from 0 to below {len(self.experts)} (network.experts), each at least once",
            )


@dataclass(frozen=True)
class OptimizerConfig:
    """Optimizer settings (AdamW).

    schedule: of the learning rate after the linear warm-up, "constant" or "cosine" (to zero at the last update).
    warmup: in updates. clip_norm: largest gradient norm, 0 for no limit.
    """

    batch: int = 256
    learning_rate: float = 5e-4
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 1e-4
    schedule: str = "constant"
    warmup: FromZero = 200
    clip_norm: float = 1.0
    ema: float = 0.998
    """Decay of the moving average of the weights, which evaluations use; 0 uses the weights themselves."""

    def __post_init__(self) -> None:
        if len(self.betas) != 2 or not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise wrong_value(
                "optimizer.betas", self.betas, "two numbers from 0 to below 1"
            )
        check(0.0 <= self.ema < 1.0, "optimizer.ema", self.ema, "at least 0 and below 1")


@dataclass(frozen=True)
class StudentConfig:
    """A student and its training.

    algorithm: one of HEADS. chunk: number of predicted actions; execute: number of them executed before the next
    prediction. hold_steps: control steps of a demonstration kept after its first success; -1 keeps all.
    huber: width of the quadratic part of the Huber loss, in normalized actions; 0 uses the squared error.
    sampling_steps: of flow matching or diffusion.
    """

    algorithm: str = BC
    preset: str = "small"
    inputs: InputConfig = field(default_factory=InputConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    chunk: int = 8
    execute: int = 2
    hold_steps: Annotated[int, Bound(-1)] = 15
    huber: float = 0.5
    sampling_steps: FromZero = 0
    updates: int = 20_000
    demos: int = 500
    """Number of demonstrations to collect when no data are given."""
    style: Annotated[tuple[str, ...], Bound(empty=True)] = ()
    """Style options of the expert during collection. With ("noise=0..0.2",) it executes noisy actions and the student
    learns the intended ones (DART)."""

    def __post_init__(self) -> None:
        if self.algorithm not in HEADS:
            raise unknown_name("algorithm", self.algorithm, HEADS)
        check(
            1 <= self.execute <= self.chunk,
            "execute",
            self.execute,
            f"from 1 to chunk ({self.chunk})",
        )
        if self.algorithm in (FLOW, DIFFUSION) and self.sampling_steps < 1:
            raise wrong_value(
                "sampling_steps", self.sampling_steps, f"at least 1 for {self.algorithm}"
            )


@dataclass(frozen=True)
class DaggerConfig:
    """Take-over DAgger: in each round the student starts the episodes and the expert finishes them.

    rounds: number of rounds after the first one of the expert alone. episodes: per round. updates: per round.
    new_share: fraction of every batch that comes from the newest round.
    first_prefix, prefix_growth, max_prefix: in round r (from 1) the student acts for a uniform random number of control
    steps from 0 to first_prefix + (r - 1) * prefix_growth, at most max_prefix. It starts small because the expert
    cannot recover from a late take-over from a weak student. horizon: control steps of an episode of collection;
    longer than in evaluation, to leave the expert time after a late take-over. final_updates: updates after the last
    round, on all rounds in proportion to their size, with a learning rate that decreases to zero.
    """

    rounds: FromZero = 8
    episodes: int = 64
    updates: int = 1500
    new_share: float = 0.5
    first_prefix: FromZero = 25
    prefix_growth: FromZero = 20
    max_prefix: FromZero = 180
    horizon: FromZero = 320
    final_updates: FromZero = 0

    def __post_init__(self) -> None:
        check_between("dagger.new_share", self.new_share, 0.0, 1.0)

    def longest_prefix(self, round_number: int) -> int:
        """Largest number of control steps for which the student acts in a round; 0 in round 0."""
        # There is no student yet.
        if round_number == 0:
            return 0
        return min(
            self.max_prefix, self.first_prefix + (round_number - 1) * self.prefix_growth
        )


@dataclass(frozen=True)
class ImitationConfig:
    """Everything that determines the result of a run except the task, the data and the seed."""

    student: StudentConfig = field(default_factory=StudentConfig)
    dagger: DaggerConfig | None = None

    @property
    def algorithm(self) -> str:
        """Name of the algorithm as in `mjhab train ALGORITHM`."""
        return DAGGER if self.dagger is not None else self.student.algorithm

    @property
    def updates(self) -> int:
        """Number of updates of a whole run, all rounds of DAgger included."""
        updates = self.student.updates
        if self.dagger is not None:
            updates += self.dagger.rounds * self.dagger.updates
            updates += self.dagger.final_updates
        return updates


PAPER_INPUTS = InputConfig(
    image_size=128, previous_action=False, condition=False, normalize=False, shift=0
)
"""Inputs of the MS-HAB students: two depth images of 128 x 128 px and the 42-D state, not normalized."""

TEACHING = (
    "plan=rule",
    "waits=visible",
    "pull=arm",
    "open_further=0.08",
    "noise=0..0.2",
    "base_noise=0..0.2",
    "noise_kind=bursts",
)
"""Style of an expert that is imitated: a rule instead of a search, no waits that only a counter ends, drawers pulled by
the arm (a student cannot see how much room is behind it), doors opened with some margin; arm and base are disturbed
while the student learns what it intended (DART)."""

SMALL = StudentConfig(inputs=InputConfig(base_velocity=True), style=TEACHING)

PAPER_BC = StudentConfig(
    preset="paper",
    inputs=PAPER_INPUTS,
    network=NetworkConfig("paper", (24, 36, 48, 64, 64), 1024, 1024, 3),
    # 100 epochs of 1,000 whole demonstrations (200 control steps each) in batches of 512.
    optimizer=OptimizerConfig(
        batch=512, learning_rate=3e-4, weight_decay=0.0, warmup=0, clip_norm=0.0, ema=0.0
    ),
    chunk=1,
    execute=1,
    hold_steps=-1,
    huber=0.0,
    updates=39_000,
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

FLOW_SMALL = dataclasses.replace(
    SMALL, algorithm=FLOW, preset="flow", huber=0.0, sampling_steps=6
)

ACT_SMALL = dataclasses.replace(
    SMALL, algorithm=ACT, preset="act", network=NetworkConfig(hidden=128, layers=2)
)

QUICK = dataclasses.replace(SMALL, preset="quick", demos=200, updates=8000)

STATE = StudentConfig(
    preset="state",
    inputs=InputConfig(
        cameras=(), image_size=0, previous_action=False, base_velocity=True, shift=0
    ),
    network=NetworkConfig(hidden=384),
    optimizer=OptimizerConfig(learning_rate=1e-3, schedule="cosine"),
    chunk=1,
    execute=1,
    style=TEACHING,
)
"""No images: the 42-D state and the velocity of the base, from an expert disturbed by noise."""

PRESETS: dict[str, dict[str, ImitationConfig]] = {
    BC: {
        "small": ImitationConfig(SMALL),
        "quick": ImitationConfig(QUICK),
        "state": ImitationConfig(STATE),
        "paper": ImitationConfig(PAPER_BC),
    },
    FLOW: {
        "flow": ImitationConfig(FLOW_SMALL),
        "quick": ImitationConfig(
            dataclasses.replace(FLOW_SMALL, preset="quick", demos=200, updates=8000)
        ),
    },
    ACT: {
        "act": ImitationConfig(ACT_SMALL),
        "quick": ImitationConfig(
            dataclasses.replace(ACT_SMALL, preset="quick", demos=200, updates=8000)
        ),
    },
    DIFFUSION: {"paper_dp": ImitationConfig(PAPER_DP)},
    DAGGER: {
        "small": ImitationConfig(
            SMALL, DaggerConfig(rounds=10, episodes=200, updates=4000)
        ),
        "quick": ImitationConfig(
            dataclasses.replace(QUICK, updates=3000),
            DaggerConfig(
                rounds=5,
                episodes=96,
                updates=800,
                first_prefix=50,
                prefix_growth=35,
                final_updates=1500,
            ),
        ),
        "state": ImitationConfig(
            dataclasses.replace(STATE, demos=400, updates=10_000),
            DaggerConfig(
                rounds=5,
                episodes=150,
                updates=4000,
                first_prefix=80,
                prefix_growth=40,
                final_updates=20_000,
            ),
        ),
        "flow": ImitationConfig(
            FLOW_SMALL, DaggerConfig(rounds=10, episodes=200, updates=4000)
        ),
        "act": ImitationConfig(
            ACT_SMALL, DaggerConfig(rounds=10, episodes=200, updates=4000)
        ),
    },
}
"""Presets by algorithm and name; the first preset of an algorithm is its default."""


def preset_of(algorithm: str, name: str = "") -> ImitationConfig:
    """Return a preset of an algorithm; without a name, its default preset.

    Raises:
        UsageError: no such algorithm, or it has no such preset.
    """
    return find_preset(PRESETS, algorithm, name)


Preset = TypeVar("Preset")


def find_preset(
    known: Mapping[str, Mapping[str, Preset]], algorithm: str, name: str = ""
) -> Preset:
    """Look up a preset in a table by algorithm and name; without a name, return the algorithm's first preset.

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
    """A config as JSON data."""
    return dataclasses.asdict(config)


SIZES = {
    "image_size": 1024,
    "history": 64,
    "shift": 1024,
    "channels": 8192,
    "image_features": 16_384,
    "hidden": 16_384,
    "layers": 64,
    "state_features": 16_384,
    "unet": 8192,
    "routes": 15,
    "chunk": 1000,
    "sampling_steps": 1000,
}
"""Largest values of the fields of a student that a file describes; the presets stay far below."""
PAPER_LOG_STD = (-20.0, 2.0)
"""`NetworkConfig.log_std` in MS-HAB (mshab/agents/sac)."""
MAX_STAGES = 16
"""Most entries of ``channels`` and ``unet`` in a file."""


def student_from_plain(values: Mapping[str, Any]) -> StudentConfig:
    """Build a `StudentConfig` from the dict of ``to_plain``, also after a round trip through JSON.

    Raises:
        UsageError: a field is unknown to this version, is of another type, or is out of `SIZES`.
    """
    try:
        config: StudentConfig = read_record(
            StudentConfig, _with_log_std(values), "student"
        )
        for part in (config, config.inputs, config.network):
            for name, most in SIZES.items():
                _check_size(name, getattr(part, name, 0), most)
        if config.inputs.cameras and not config.inputs.image_size:
            raise ValueError("student.inputs: has cameras whose image_size is 0.")
    except ValueError as error:
        raise UsageError(
            f"the config of a student does not fit this version of mjhab: {error}"
        ) from error
    return config


def _with_log_std(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The values of a file; one without ``log_std`` is older than this field, and its encoder told the limits."""
    network = values.get("network")
    if (
        not isinstance(network, dict)
        or "log_std" in network
        or network.get("encoder") != "strided"
    ):
        return values
    return {**values, "network": {**network, "log_std": list(PAPER_LOG_STD)}}


def _check_size(name: str, value: int | tuple[int, ...], most: int) -> None:
    sizes = value if isinstance(value, tuple) else (value,)
    # A header of some bytes must not make torch allocate all memory.
    if len(sizes) > MAX_STAGES or not all(0 <= size <= most for size in sizes):
        raise ValueError(
            f"{name}: expected whole numbers from 0 to {most:,}, got {shown(value)}."
        )
