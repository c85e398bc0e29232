"""The network of every algorithm, by name."""

from __future__ import annotations

import dataclasses

import torch

from mjhab.core.errors import UsageError, wrong_value
from mjhab.core.files.reading import reason
from mjhab.learning.configs import (
    ACT,
    BC,
    DIFFUSION,
    FLOW,
    GAUSSIAN,
    GAUSSIAN_ACTIONS,
    StudentConfig,
    student_from_plain,
    to_plain,
)
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.act import ActionTransformer
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.diffusion import DiffusionPolicy
from mjhab.learning.students.flow import FlowMatching
from mjhab.learning.students.gaussian import ActionGaussian, SquashedGaussian
from mjhab.learning.students.student import Student

HEADS_BY_ALGORITHM: dict[str, type[Student]] = {
    BC: BehaviourCloning,
    FLOW: FlowMatching,
    ACT: ActionTransformer,
    DIFFUSION: DiffusionPolicy,
    GAUSSIAN: SquashedGaussian,
    GAUSSIAN_ACTIONS: ActionGaussian,
}


def make_student(
    config: StudentConfig, layout: ObservationSpec, seed: int = 0
) -> Student:
    """Build the network of a config with initial weights drawn from ``seed``.

    Raises:
        UsageError: the layout has no inputs.
    """
    if not layout.width:
        raise UsageError("a student needs at least one input: its layout has no entries.")
    # The caller's generator is left as it was.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return HEADS_BY_ALGORITHM[config.algorithm](config, layout)


def check_student(config: StudentConfig, layout: ObservationSpec) -> None:
    """Refuse a config whose sizes do not fit together, or do not fit its images; takes no memory for the weights.

    Raises:
        UsageError: the network cannot be made, or cannot act; a checkpoint of it could not be read; or it has a gate,
            which training does not change.
    """
    if config.network.routes:
        raise wrong_value(
            "network.routes",
            config.network.routes,
            "left out: no training fits a gate",
            "`mjhab policy join` makes such students of trained ones; polish one with mjhab train ppo --start.",
        )
    # As a checkpoint would be read: what could not be loaded again is not trained.
    student_from_plain(to_plain(config))
    inputs = config.inputs
    channels = inputs.history * sum(layout.image_channels)
    side = inputs.image_size if channels else 0
    # All steps of sampling are alike.
    config = dataclasses.replace(config, sampling_steps=min(config.sampling_steps, 1))
    try:
        with torch.device("meta"):
            student = make_student(config, layout)
            # Run once: convolutions that shrink an image to nothing are told by no shape of weights.
            student.chunk(
                torch.zeros(1, inputs.history * layout.width),
                torch.zeros(1, channels, side, side, dtype=torch.uint8),
                torch.zeros(1, student.draws, config.chunk, len(layout.actions)),
            )
    # What torch says about sizes that do not fit together differs from layer to layer.
    except (RuntimeError, ValueError, TypeError, AssertionError, LookupError) as error:
        raise UsageError(
            f"the fields of preset {config.preset} give no network that can act ({reason(error)}). Check chunk, inputs "
            "and network of --set."
        ) from error
