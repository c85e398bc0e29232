"""What follows from the specification of a run of reinforcement learning: the student it begins from, its record."""

from __future__ import annotations

import dataclasses
from typing import Any

from mjhab.core.errors import UsageError, fault
from mjhab.learning.checkpoint import load_student
from mjhab.learning.configs import BC, GAUSSIAN, GAUSSIAN_ACTIONS
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs import distributed
from mjhab.learning.runs.request import config_of
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.gaussian import gaussian_of
from mjhab.learning.students.student import Student


def start_of(spec: ReinforcementSpec) -> Student | None:
    """Load the student that the actor starts from; None if the run names none.

    Raises:
        UsageError: the file cannot be read, or its algorithm does not fit the one to train.
    """
    if not spec.start:
        return None
    student = load_student(spec.start)
    # Only the first action of a chunk is used; SAC squashes it, so a student of behaviour cloning is converted.
    known = (BC,) if spec.config.ppo is not None else (BC, GAUSSIAN, GAUSSIAN_ACTIONS)
    if student.config.algorithm not in known or student.config.inputs.history != 1:
        raise UsageError(
            f"{spec.config.algorithm} begins from a checkpoint of algorithm {' or '.join(known)} with a history of "
            f"1; {spec.start} has algorithm {student.config.algorithm} and history "
            f"{student.config.inputs.history}."
        )
    if spec.config.sac is not None and isinstance(student, BehaviourCloning):
        student = gaussian_of(student)
    student.config = dataclasses.replace(student.config, execute=1)
    return student.requires_grad_(True)


def check_start(spec: ReinforcementSpec) -> None:
    """Refuse a preset that keeps the actor at first, if that actor would be a new one.

    Raises:
        UsageError: names the options that give a trained actor.
    """
    ppo = spec.config.ppo
    if (
        ppo is not None
        and ppo.critic_updates
        and not ppo.demonstrations
        and not spec.start
    ):
        raise fault(
            f"preset {spec.config.preset}",
            "begins from a trained student: give --start CHECKPOINT, or train from "
            "random weights with --preset scratch.",
        )


def resolved_config(spec: ReinforcementSpec) -> dict[str, Any]:
    """Everything that determines the result of a run, as JSON data.

    Raises:
        UsageError: the student that the actor starts from cannot be read.
    """
    config = spec.config
    if spec.start:
        # The network of the preset stays: it is that of the critic.
        config = dataclasses.replace(
            config, inputs=load_student(spec.start).config.inputs
        )
    return {
        **config_of(spec, config),
        "start": str(spec.start or ""),
        "recompute_rewards": spec.recompute_rewards,
        "backend": spec.asked.backend,
        "processes": distributed.processes(),
    }
