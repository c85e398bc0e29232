"""What `mjhab.train` and ``mjhab train`` are asked for with the algorithms of reinforcement learning."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

from mjhab.core.errors import wrong_value
from mjhab.core.machine import cores
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.flags import Flag
from mjhab.learning.changes import Sets
from mjhab.learning.reinforcement.configs import (
    PPO,
    RLPD,
    SAC,
    ReinforcementConfig,
    reinforcement_preset,
)
from mjhab.learning.runs.specs import Number, TrainSpec, check_data, env_options

OF_REINFORCEMENT = env_options("backend", "device")


@dataclass(frozen=True, kw_only=True)
class ReinforcementSpec(TrainSpec):
    """Options of all algorithms of reinforcement learning.

    Raises:
        UsageError: a name is unknown, a number out of range, or options exclude each other.
    """

    env: Annotated[Mapping[str, Any], OF_REINFORCEMENT] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`."""
    samples: Annotated[Number, Sets("samples")] = None
    """Total number of samples (control steps of single worlds). With PPO's preset fast 0 stops after imitation."""
    worlds: Annotated[Number, Sets("worlds")] = None
    """Number of parallel worlds; it changes the result."""
    network_device: Annotated[str, Flag(metavar="DEVICE")] = ""
    """Device of the networks and their updates with backend cpu, which simulates on the cores meanwhile: cuda,
    cuda:N, auto (the first GPU if there is one) or cpu; "" for that of the worlds. The last bits of the weights depend
    on it."""
    start: Annotated[Path | None, Flag(metavar="CHECKPOINT", shown="default: none")] = (
        None
    )
    """Start the actor from this checkpoint of `mjhab train`, e.g. a student to fine-tune."""
    privileged_critic: Annotated[
        bool | None, Flag(shown="default: that of the preset"), Sets("privileged_critic")
    ] = None
    """Whether the critic receives simulator state such as forces, velocities and remaining time; the policy never
    does."""
    data: Annotated[tuple[Path, ...], Flag(hidden=True)] = ()
    """With rlpd: recorded demonstrations, see `RlpdSpec`."""
    where: Annotated[str | None, Flag(hidden=True)] = None
    """With rlpd: which of them."""
    recompute_rewards: Annotated[bool, Flag(hidden=True)] = False
    """With rlpd: accept those with other rewards."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_data(self.data, self.where)
        if self.network_device and self.asked.backend == "warp":
            raise wrong_value(
                "network_device",
                self.network_device,
                "left out with backend 'warp'",
                "Networks are where the worlds are, on --device.",
            )
        config = self.config
        if self.data and config.algorithm != RLPD:
            raise wrong_value(
                "data",
                self.data,
                f"left out with {config.algorithm}",
                "Train rlpd with recorded demonstrations.",
            )
        # Imitation alone is a training, too.
        begins = config.ppo is not None and config.ppo.demonstrations
        if config.samples < 1 and not begins:
            raise wrong_value("samples", config.samples, "at least 1")

    @cached_property
    def config(self) -> ReinforcementConfig:
        """The preset with the changes of the options, with the cameras of the scene's robot."""
        # Here: the help of a command does not wait for layouts.
        from mjhab.learning.observation.spec import inputs_of_robot

        config: ReinforcementConfig = self._chosen(
            ReinforcementConfig, reinforcement_preset
        )
        inputs = inputs_of_robot(config.inputs, self.scene.robot)
        return dataclasses.replace(config, inputs=inputs)

    @property
    def threads(self) -> int:
        """Threads of physics and networks."""
        return self.asked.threads or cores()


@dataclass(frozen=True, kw_only=True)
class PpoSpec(ReinforcementSpec):
    """Proximal policy optimization. Presets: fast (states), scratch (states, from random weights),
    depth, polish (of a student), refine (of a polished one), paper, paper_state (the same from states).

    `mjhab train ppo --task set_table --subtask close --target kitchen_counter/drawer3 --preset fast
    --budget-minutes 20 --out runs/ppo`

    `torchrun --nproc-per-node 2 -m -- mjhab.cli.main train ppo ...` trains with two processes.
    """

    ALGORITHM: ClassVar[str] = PPO


@dataclass(frozen=True, kw_only=True)
class SacSpec(ReinforcementSpec):
    """Soft actor-critic with distributional critics. Presets: fast (32 px depth), state, paper."""

    ALGORITHM: ClassVar[str] = SAC

    capacity: Annotated[Number, Sets("sac.capacity")] = None
    """Control steps in the replay buffer."""


@dataclass(frozen=True, kw_only=True)
class RlpdSpec(SacSpec):
    """Soft actor-critic with demonstrations of the expert in half of every batch. Presets: demos, state."""

    ALGORITHM: ClassVar[str] = RLPD

    demonstrations: Annotated[Number, Sets("sac.demonstrations"), Bound(1)] = None
    """Number of expert episodes."""
    data: Annotated[
        tuple[Path, ...], Flag(metavar="PATH ...", shown="default: none")
    ] = ()
    """Use recorded demonstrations: shards or folders of them. If absent, the expert generates demonstrations."""
    where: Annotated[
        str | None, Flag(metavar="FILTER", shown="default: the successful ones")
    ] = None
    """With --data: which episodes, as in `mjhab data query`."""
    recompute_rewards: bool = False
    """With --data: accept episodes recorded with another profile or other rewards. Their actions are simulated again
    from the recorded first state, with the profile and the rewards of this run."""
