"""What follows from the specification of a run of imitation learning: the layout of its student, and its record."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mjhab.core.errors import UsageError
from mjhab.core.version import __version__
from mjhab.evaluation.resolve import open_policy
from mjhab.learning.checkpoint import Checkpoint, load_checkpoint, student_of
from mjhab.learning.configs import StudentConfig
from mjhab.learning.demos import goals_of_data, observation_spec_of_data
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.observation.spec import (
    ObservationSpec,
    compare_specs,
    image_options,
    observation_spec_of,
)
from mjhab.learning.runs.collection import make_env, wordings_of
from mjhab.learning.runs.specs import ImitationSpec, Resources, Scene
from mjhab.learning.students.bc import BehaviourCloning, PaperTrunk
from mjhab.learning.students.carried import carried
from mjhab.learning.students.members import (
    VIEW_NAMES,
    Member,
    inputs_alone,
    layout_alone,
    loses_images,
    network_alone,
    views_of,
)
from mjhab.learning.students.routed import RoutedTrunk
from mjhab.learning.students.student import Student

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

START_EPISODES = 32
"""Episodes whose sentences choose the network of a joined student that a run begins with."""


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
    """The student that the run begins with, of its layout; None for random weights.

    Raises:
        UsageError: the file cannot be read, or does not fit, see `fitting`.
    """
    if spec.start is None:
        return None
    wanted = spec.config.student
    saved = load_checkpoint(spec.start)
    found, differs = fitting(spec.start, saved, wanted, layout, spec.scenes, spec.seed)
    if found is None:
        raise UsageError(
            f"the run cannot begin with {spec.start}, which has another {differs}: give a student that was "
            "trained with the same --preset and --set, or leave out --start."
        )
    return found


def fitting(
    path: Path,
    saved: Checkpoint,
    wanted: StudentConfig,
    layout: ObservationSpec,
    scenes: Sequence[Scene],
    like: BehaviourCloning | int = 0,
) -> tuple[Student | None, str]:
    """A student of a configuration and a layout that acts as that of a checkpoint and its file, and "".

    One of behaviour cloning may know other targets, see fewer views and give another chunk, and may be a joined one,
    of which the network is taken that its gate chooses for the sentences of ``scenes``; see `students.carried`, also
    for ``like``.

    Returns:
        None and what differs, if the student does not fit.

    Raises:
        UsageError: the weights are damaged.
    """
    student = student_of(path, saved)
    told = {
        "algorithm": (saved.config.algorithm, wanted.algorithm),
        "chunk": (saved.config.chunk, wanted.chunk),
        "network": (saved.config.network, wanted.network),
        "inputs": (saved.config.inputs, wanted.inputs),
        "layout": (saved.layout, layout),
    }
    if not (differs := _differing(told)):
        return student, ""
    # Networks of other kinds are not taken apart.
    if not isinstance(student, BehaviourCloning) or isinstance(student.trunk, PaperTrunk):
        return None, differs
    del told["chunk"]
    told |= {
        "network": (network_alone(saved.config.network), wanted.network),
        "inputs": (inputs_alone(saved.config.inputs), inputs_alone(wanted.inputs)),
        "layout": (layout_alone(saved.layout), layout_alone(layout)),
    }
    if differs := _differing(told):
        return None, differs
    member, route = Member(student), 0
    if isinstance(student.trunk, RoutedTrunk):
        if not wanted.inputs.condition:
            return None, "inputs.condition: a joined student's are told their task"
        route = _route(student.trunk, saved, scenes)
        member = Member(student, student.trunk.routes[route])
    if loses_images(member.sees, views_of(wanted.inputs)):
        here = VIEW_NAMES.get(views_of(wanted.inputs), "none")
        return None, f"choice of views ({member.views}; {here} here)"
    return carried(member, wanted, layout, route, like), ""


def _route(trunk: RoutedTrunk, saved: Checkpoint, scenes: Sequence[Scene]) -> int:
    """The route that the gate of a joined student chooses for most sentences of some scenes."""
    said = [
        sentence
        for scene in scenes
        for sentence in wordings_of(scene, scene.target, START_EPISODES)
    ]
    known = (saved.about.get("scene", {}), *saved.about.get("also", ()))
    asked = {scene.subtask for scene in scenes}
    # A gate does not know sentences of other tasks, and might take a request to place for one to close.
    among = [n for n, scene in enumerate(known) if scene.get("subtask") in asked]
    vectors = torch.stack([torch.tensor(encode_sentence(one)) for one in said])
    return int(trunk.route(vectors, among).mode().values)


def _differing(told: Mapping[str, tuple[Any, Any]]) -> str:
    """Names of the pairs that are not equal, with the fields in which they differ."""
    found = []
    for name, (theirs, ours) in told.items():
        if theirs == ours:
            continue
        wrong = [
            field.name
            for field in (fields(theirs) if is_dataclass(theirs) else ())
            # The inputs of a layout are a pair of their own.
            if field.name != "inputs"
            and getattr(theirs, field.name) != getattr(ours, field.name)
        ]
        if wrong:
            found.append(f"{name} ({', '.join(wrong)})")
        elif not isinstance(theirs, ObservationSpec):
            found.append(name)
    return " and ".join(found)


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
