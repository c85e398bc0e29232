"""The network of every algorithm, by name."""

from __future__ import annotations

import torch

from mjhab.core.errors import UsageError
from mjhab.learning.configs import (
    ACT,
    BC,
    DIFFUSION,
    FLOW,
    GAUSSIAN,
    GAUSSIAN_ACTIONS,
    StudentConfig,
)
from mjhab.learning.layout import Layout
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


def make_student(config: StudentConfig, layout: Layout, seed: int = 0) -> Student:
    """Build the network of a config with initial weights drawn from ``seed``.

    Raises:
        UsageError: the layout has no inputs.
    """
    if not layout.width:
        raise UsageError("a student needs at least one input: its layout has no entries.")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return HEADS_BY_ALGORITHM[config.algorithm](config, layout)
