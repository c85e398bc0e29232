"""What a run of imitation learning is asked: algorithm, scenes, data, resources; and the layout of its student."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.core.errors import UsageError
from mjhab.core.version import __version__
from mjhab.data.select.query import Filter
from mjhab.learning.configs import TrainConfig
from mjhab.learning.demos import goals_of_data, layout_of_data
from mjhab.learning.devices import CPU
from mjhab.learning.layout import (
    Layout,
    compare_layouts,
    image_options,
    inputs_of_robot,
    layout_of,
)
from mjhab.learning.runs.collection import Means, Scene, make_env
from mjhab.learning.runs.defaults import FILMED_EPISODES

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


@dataclass(frozen=True)
class Request:
    """A training run: algorithm, scenes, data and resources.

    scene: what the student learns. also: further scenes that the same student learns; they differ from ``scene`` in
    task, subtask and target only. data: shards, or folders of shards; without any, demonstrations are collected.
    where: filter on their episodes. per_target: number of demonstrations of every target, 0 for all. budget_seconds:
    wall time of the whole run [s], 0 for no limit. eval_episodes: episodes of the final evaluation, round_episodes: of
    the evaluations during training, 0 for none; of every scene. torch_threads: threads of the network, 0 for torch's
    default. films: episodes of every scene to film in the first and the last evaluation. ray: see `Collector`. device:
    of the network's training, see `training_device`; policies act on the CPU. eval_split: homes of the final
    evaluation, "" for those of the scene, in which those on the way are.

    The cameras that presets name are replaced by those of the scene's robot, see `inputs_of_robot`.

    Raises:
        UsageError: the scene names an unknown robot.
    """

    config: TrainConfig
    scene: Scene
    means: Means
    seed: int = 0
    data: tuple[Path, ...] = ()
    where: str = ""
    budget_seconds: float = 0.0
    eval_episodes: int = 100
    round_episodes: int = 32
    torch_threads: int = 0
    films: int = FILMED_EPISODES
    ray: str = ""
    also: tuple[Scene, ...] = ()
    device: str = CPU
    per_target: int = 0
    eval_split: str = ""

    def __post_init__(self) -> None:
        student = self.config.student
        inputs = inputs_of_robot(student.inputs, self.scene.robot)
        config = replace(self.config, student=replace(student, inputs=inputs))
        object.__setattr__(self, "config", config)

    @property
    def judged_split(self) -> str:
        """Split of the homes of the final evaluation."""
        return self.eval_split or self.scene.split

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """All scenes."""
        return (self.scene, *self.also)

    @property
    def filter(self) -> Filter | None:
        """Filter on the episodes of ``data``; None takes the default."""
        return Filter(self.where) if self.where else None


def layout_for(request: Request) -> Layout:
    """Observation and action layout of the given data, or of the environment that demonstrations are collected in.

    Raises:
        UsageError: data or scene do not fit; then nothing was written.
    """
    inputs = request.config.student.inputs
    scene = request.scene
    if request.data:
        layout = layout_of_data(request.data, inputs, request.filter)
        if scene.profile and scene.profile != layout.profile:
            raise UsageError(
                f"the demonstrations are of profile {layout.profile}, not {scene.profile}. Leave out --profile, or "
                f"generate new data: mjhab generate --profile {scene.profile}"
            )
        if inputs.condition and (request.round_episodes or request.eval_episodes):
            _check_judged(request)
        return layout
    layouts: list[Layout] = []
    for one in request.scenes:
        # With its images, so that wrong cameras and sizes are told before anything is written.
        env = make_env(one, image_options(inputs), Means(worlds=1, threads=1))
        layouts.append(layout_of(env, inputs, _targets(env)))
    first = layouts[0]
    for other, one in zip(layouts, request.scenes, strict=True):
        wrong = compare_layouts(first, other.state, other.actions, other.control)
        if wrong:
            raise UsageError(
                f"one student cannot learn {scene.name} and {one.name}: {'; '.join(wrong)}."
            )
    known = dict.fromkeys(target for layout in layouts for target in layout.targets)
    return replace(first, targets=tuple(known))


def _targets(env: SequentialTaskEnv) -> tuple[str, ...]:
    """Types of targets that episodes of an environment are about."""
    from mjhab.episodes.starts import aims_of

    return tuple(aims_of(env.config, env.layout))


def _check_judged(request: Request) -> None:
    """Refuse demonstrations that lack a subtask or target in which the student is evaluated.

    Raises:
        UsageError: names what the demonstrations are about, and what is missing.
    """
    shown = goals_of_data(request.data, request.filter)
    wanted: list[tuple[str, str]] = []
    for scene in request.scenes:
        if (scene.subtask, scene.target) in shown:
            continue
        env = make_env(scene, {}, Means(worlds=1, threads=1))
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


def resolved_config(request: Request) -> dict[str, Any]:
    """Everything that determines the result of a run, as JSON data."""
    also = [asdict(scene) for scene in request.also]
    return {
        "algorithm": request.config.algorithm,
        "config": asdict(request.config),
        "scene": asdict(request.scene),
        **({"also": also} if also else {}),
        **({"per_target": request.per_target} if request.per_target else {}),
        "seed": request.seed,
        "data": [str(place) for place in request.data],
        "where": request.where,
        "eval_split": request.judged_split,
        "mjhab": __version__,
    }
