"""What follows from the specification of a run of imitation learning: the layout of its student, and its record."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from mjhab.core.errors import UsageError
from mjhab.core.version import __version__
from mjhab.evaluation.resolve import open_policy
from mjhab.learning.checkpoint import load_checkpoint, student_of
from mjhab.learning.demos import goals_of_data, observation_spec_of_data
from mjhab.learning.observation.spec import (
    ObservationSpec,
    compare_specs,
    image_options,
    observation_spec_of,
)
from mjhab.learning.runs.collection import make_env
from mjhab.learning.runs.specs import ImitationSpec, Resources
from mjhab.learning.students.student import Student

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


def layout_for(spec: ImitationSpec) -> ObservationSpec:
    """Observation and action layout of the given data, or of the environment that demonstrations are collected in.

    Raises:
        UsageError: data or scene do not fit; then nothing was written.
    """
    inputs = spec.config.student.inputs
    scene = spec.scene
    if spec.data:
        layout = observation_spec_of_data(spec.data, inputs, spec.filter)
        if scene.profile and scene.profile != layout.profile:
            raise UsageError(
                f"the demonstrations are of profile {layout.profile}, not {scene.profile}. Leave out --profile, or "
                f"generate new data: mjhab generate --profile {scene.profile}"
            )
        # A student that is not told its target can be evaluated in any.
        if inputs.condition and (spec.round_episodes or spec.eval_episodes):
            _check_judged(spec)
        return layout
    layouts: list[ObservationSpec] = []
    for one in spec.scenes:
        # With its images, so that wrong cameras and sizes are told before anything is written.
        env = make_env(one, image_options(inputs), Resources(worlds=1, threads=1))
        layouts.append(observation_spec_of(env, inputs, _targets(env)))
    first = layouts[0]
    for other, one in zip(layouts, spec.scenes, strict=True):
        wrong = compare_specs(first, other.state, other.actions, other.control)
        if wrong:
            raise UsageError(
                f"one student cannot learn {scene.name} and {one.name}: {'; '.join(wrong)}."
            )
    # In the order of the scenes: the place of a target in the one-hot is part of the weights' meaning.
    known = dict.fromkeys(target for layout in layouts for target in layout.targets)
    return replace(first, targets=tuple(known))


def _targets(env: SequentialTaskEnv) -> tuple[str, ...]:
    """Types of targets that episodes of an environment are about."""
    from mjhab.episodes.starts import aims_of

    return tuple(aims_of(env.config, env.layout))


def _check_judged(spec: ImitationSpec) -> None:
    """Refuse demonstrations that lack a subtask or target in which the student is evaluated.

    Raises:
        UsageError: names what the demonstrations are about, and what is missing.
    """
    shown = goals_of_data(spec.data, spec.filter)
    wanted: list[tuple[str, str]] = []
    for scene in spec.scenes:
        if (scene.subtask, scene.target) in shown:
            continue
        env = make_env(scene, {}, Resources(worlds=1, threads=1))
        wanted += [(scene.subtask, target) for target in _targets(env)]
    missing = [goal for goal in wanted if goal not in shown]
    if missing:
        raise UsageError(
            f"the student is to be evaluated in {_spoken(missing)}, but the demonstrations are of {_spoken(shown)}. "
            "Name what they are about with --task, --subtask and --target, or leave out evaluations with "
            "--round-episodes 0 --eval-episodes 0."
        )


def _spoken(goals: Collection[tuple[str, str]]) -> str:
    return ", ".join(f"{subtask} {target}" for subtask, target in sorted(goals))


def start_of(spec: ImitationSpec, layout: ObservationSpec) -> Student | None:
    """Load the student that the run begins with; None for random weights.

    Raises:
        UsageError: the file cannot be read, or is of another algorithm, network or layout.
    """
    if spec.start is None:
        return None
    saved = load_checkpoint(spec.start)
    wanted = spec.config.student
    told = {
        "algorithm": (saved.config.algorithm, wanted.algorithm),
        "chunk": (saved.config.chunk, wanted.chunk),
        "network": (saved.config.network, wanted.network),
        "inputs": (saved.config.inputs, wanted.inputs),
        "layout": (saved.layout, layout),
    }
    wrong = [name for name, (theirs, ours) in told.items() if theirs != ours]
    if wrong:
        raise UsageError(
            f"the run cannot begin with {spec.start}, which has another {' and '.join(wrong)}: give a student that was "
            "trained with the same --preset, --set, subtasks and targets, or leave out --start."
        )
    return student_of(spec.start, saved)


def resolved_config(spec: ImitationSpec) -> dict[str, Any]:
    """Everything that determines the result of a run, as JSON data."""
    also = [scene.record() for scene in spec.scenes[1:]]
    return {
        **config_of(spec, spec.config),
        # Left out where empty, so that runs begun before these options can be resumed.
        **({"also": also} if also else {}),
        **({"per_target": spec.per_target} if spec.per_target else {}),
        **({"start": str(spec.start)} if spec.start else {}),
        **_teachers_of(spec),
    }


def _teachers_of(spec: ImitationSpec) -> dict[str, Any]:
    """Names and hashes of the teaching policies, if there are any."""
    facts = [open_policy(teacher).facts for teacher in spec.teachers if teacher]
    if not facts:
        return {}
    return {"teachers": [{"name": each.name, **each.identity} for each in facts]}


def config_of(spec: Any, config: Any) -> dict[str, Any]:
    """The part of a run's resolved config that all algorithms have.

    Args:
        spec: of the run, an `ImitationSpec` or a `ReinforcementSpec`.
        config: its preset with all changes.
    """
    return {
        "algorithm": config.algorithm,
        "config": asdict(config),
        "scene": spec.scene.record(),
        "seed": spec.seed,
        "data": [str(place) for place in spec.data],
        "where": spec.where or "",
        "eval_split": spec.final_split,
        "mjhab": __version__,
    }
