"""``mjhab train``: convert options to a training request, train, print the results."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.cli.interrupts import sigterm_interrupts
from mjhab.cli.options.policies.train import (
    ReinforcementOptions,
    RunOptions,
    TrainActOptions,
    TrainBcOptions,
    TrainDaggerOptions,
    TrainDiffusionOptions,
    TrainFlowOptions,
    TrainOptions,
    TrainPpoOptions,
    TrainRlpdOptions,
    TrainSacOptions,
)
from mjhab.cli.output import at_least, print_json
from mjhab.config.env import SPLITS
from mjhab.config.profile_choice import profile_options
from mjhab.config.profiles import DEFAULT_PROFILE, profile_named
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.machine import cores
from mjhab.learning.require import require_learn
from mjhab.learning.runs.run import TRAINING
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.style import Styles
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from mjhab.learning.configs import TrainConfig
    from mjhab.learning.reinforcement.session import ReinforcementRequest
    from mjhab.learning.runs.collection import Scene
    from mjhab.learning.runs.request import Request
    from mjhab.learning.runs.train import TrainingResult

ALGORITHMS: dict[type[TrainOptions], str] = {
    TrainBcOptions: "bc",
    TrainFlowOptions: "flow",
    TrainActOptions: "act",
    TrainDiffusionOptions: "diffusion",
    TrainDaggerOptions: "dagger",
}
REINFORCEMENT: dict[type[ReinforcementOptions], str] = {
    TrainPpoOptions: "ppo",
    TrainSacOptions: "sac",
    TrainRlpdOptions: "rlpd",
}
DAGGER_NUMBERS = {
    "rounds": ("rounds", 0),
    "round_updates": ("updates", 1),
    "takeovers": ("episodes", 1),
    "first_prefix": ("first_prefix", 0),
    "prefix_growth": ("prefix_growth", 0),
    "final_updates": ("final_updates", 0),
}
"""Field of `DaggerConfig` that an option sets, and its least value."""
SECONDS_PER_MINUTE = 60.0
UNTRAINED = (
    "the network was not trained: the budget ended before its first update. The same command with --resume and a "
    "larger --budget-minutes goes on."
)
HELD_OUT = "val"
"""Split of the homes that nothing is trained in and policies are judged in."""


def run_train(options: RunOptions) -> int:
    """Run the command.

    Returns:
        0; 130 after Ctrl-C or SIGTERM (a checkpoint is kept, if training had begun); 1 if the network was never
        updated.
    """
    require_learn()
    with sigterm_interrupts():
        result = _train(options)
    _tell(options, result)
    if result.interrupted:
        return 130
    return 0 if result.summary["trained"] else 1


def _train(options: RunOptions) -> TrainingResult:
    if isinstance(options, ReinforcementOptions):
        from mjhab.learning.reinforcement.train import train_reinforcement

        return train_reinforcement(
            reinforcement_request(options), options.out, options.resume
        )
    assert isinstance(options, TrainOptions)
    from mjhab.learning.runs.train import train

    return train(make_request(options), options.out, options.resume)


def make_scene(options: RunOptions) -> Scene:
    """Check the options that all algorithms share and convert them to a scene.

    Raises:
        UsageError: a name is unknown, or a number out of range.
    """
    from mjhab.learning.runs.collection import Scene

    TASKS.check(options.task)
    SUBTASKS.check(options.subtask)
    for name in (
        "eval_episodes",
        "round_episodes",
        "films",
        "seed",
        "threads",
        "budget_minutes",
    ):
        at_least(name.replace("_", "-"), getattr(options, name), 0)
    profile_named(options.profile or DEFAULT_PROFILE)
    return Scene(
        task=options.task,
        subtask=options.subtask,
        target=options.target or "",
        split=options.split,
        assets=options.assets,
        home=options.home or "",
        **profile_options(options),
    )


def eval_split(options: RunOptions) -> str:
    """Homes of the final evaluation: those of split val, unless the options name others.

    Raises:
        UsageError: there is no such split.
    """
    if options.eval_split is None:
        return options.split if options.home else HELD_OUT
    if options.eval_split not in SPLITS:
        raise unknown_name("split", options.eval_split, SPLITS)
    return options.eval_split


def check_data(data: Sequence[Path], where: str | None, demos: int | None) -> None:
    """Check the options about recorded demonstrations before anything is read or written.

    Args:
        data: shards or folders; empty if the expert generates demonstrations.
        where: filter on the episodes of ``data``; None if absent.
        demos: number of episodes that the expert tries; None if absent.

    Raises:
        UsageError: the filter cannot be read, or an option would have no effect.
    """
    from mjhab.data.select.query import Filter

    if where is not None:
        Filter(where)
        if not data:
            raise UsageError("--where filters recorded demonstrations: give --data.")
    if data and demos is not None:
        raise UsageError(
            "--demos is about demonstrations that the expert generates, but --data names recorded ones: leave one out."
        )


def reinforcement_request(options: ReinforcementOptions) -> ReinforcementRequest:
    """Check the options and turn them into a request.

    Raises:
        UsageError: an unknown name, or a number out of range.
    """
    from mjhab.learning.changes import with_fields
    from mjhab.learning.reinforcement.configs import reinforcement_preset
    from mjhab.learning.reinforcement.session import ReinforcementRequest

    scene = make_scene(options)
    data: tuple[Path, ...] = getattr(options, "data", ())
    where: str | None = getattr(options, "where", None)
    check_data(data, where, demos=None)
    preset = reinforcement_preset(REINFORCEMENT[type(options)], options.preset)
    part = "sac" if preset.ppo is None else "ppo"
    fields = {
        "samples": "samples",
        "worlds": "worlds",
        "privileged_critic": "privileged_critic",
        "capacity": "sac.capacity",
        "demonstrations": f"{part}.demonstrations",
    }
    given = {name: getattr(options, name, None) for name in fields}
    given = {name: value for name, value in given.items() if value is not None}
    for name, value in given.items():
        if name != "privileged_critic":
            at_least(name, value, 0 if name == "samples" else 1)
    # Together, because a config is checked as a whole.
    words = [f"{fields[name]}={str(value).lower()}" for name, value in given.items()]
    config = with_fields(preset, (*options.set, *words))
    if config.ppo is None or not config.ppo.demonstrations:
        at_least("samples", config.samples, 1)
    return ReinforcementRequest(
        config=config,
        scene=scene,
        seed=options.seed,
        start=str(options.start or ""),
        threads=options.threads or cores(),
        budget_seconds=SECONDS_PER_MINUTE * options.budget_minutes,
        eval_episodes=options.eval_episodes,
        round_episodes=options.round_episodes,
        films=options.films,
        backend=options.backend,
        device=options.device,
        data=data,
        where=where or "",
        recompute_rewards=getattr(options, "recompute_rewards", False),
        eval_split=eval_split(options),
    )


def make_request(options: TrainOptions) -> Request:
    """Check the options and turn them into a request.

    Raises:
        UsageError: an unknown name, or a number out of range.
    """
    from mjhab.learning.runs.collection import Means
    from mjhab.learning.runs.request import Request

    scene = make_scene(options)
    for name in ("worlds", "workers", "demos", "updates"):
        if getattr(options, name) is not None:
            at_least(name, getattr(options, name), 1)
    check_data(options.data, options.where, options.demos)
    at_least("per-target", options.per_target, 0)
    if options.per_target and not options.data:
        raise UsageError(
            "--per-target chooses among recorded demonstrations: give --data, or --demos."
        )
    return Request(
        config=resolved(options),
        scene=scene,
        means=Means(
            options.worlds,
            options.workers,
            options.threads or max(1, cores() // options.workers),
        ),
        seed=options.seed,
        data=options.data,
        where=options.where or "",
        budget_seconds=SECONDS_PER_MINUTE * options.budget_minutes,
        eval_episodes=options.eval_episodes,
        round_episodes=options.round_episodes,
        torch_threads=options.threads,
        films=options.films,
        ray=options.ray or "",
        also=tuple(also_scene(scene, text) for text in options.also),
        device=options.device,
        per_target=options.per_target,
        eval_split=eval_split(options),
    )


def also_scene(like: Scene, text: str) -> Scene:
    """The scene that ``TASK/SUBTASK`` or ``TASK/SUBTASK/TARGET`` names, with the other options of ``like``.

    Raises:
        UsageError: the text has another form, or a name is unknown.
    """
    task, _, rest = text.partition("/")
    subtask, _, target = rest.partition("/")
    if not task or not subtask:
        raise UsageError(
            f"--also takes TASK/SUBTASK or TASK/SUBTASK/TARGET, for instance set_table/open/fridge/top_door; got "
            f"{text!r}."
        )
    TASKS.check(task)
    SUBTASKS.check(subtask)
    return dataclasses.replace(like, task=task, subtask=subtask, target=target)


def resolved(options: TrainOptions) -> TrainConfig:
    """The preset with the changes of the options."""
    from mjhab.learning.changes import with_changes
    from mjhab.learning.configs import preset_of

    config = with_changes(
        preset_of(ALGORITHMS[type(options)], options.preset), options.set
    )
    words = tuple(Styles.parse(options.style).words) or None
    student = _changed(
        config.student, demos=options.demos, updates=options.updates, style=words
    )
    dagger = config.dagger
    if isinstance(options, TrainDaggerOptions) and dagger is not None:
        changes: dict[str, int] = {}
        for option, (name, least) in DAGGER_NUMBERS.items():
            given = getattr(options, option)
            if given is not None:
                at_least(option.replace("_", "-"), given, least)
                changes[name] = given
        dagger = _changed(dagger, **changes)
    return dataclasses.replace(config, student=student, dagger=dagger)


def _changed(config: Any, **values: Any) -> Any:
    return dataclasses.replace(
        config, **{name: value for name, value in values.items() if value is not None}
    )


def _tell(options: RunOptions, result: TrainingResult) -> None:
    summary = result.summary
    if result.interrupted:
        print(f"mjhab: interrupted; {_kept(options.out, summary)}", file=sys.stderr)
    elif not summary["trained"]:
        print(f"mjhab: {summary.get('shortage', UNTRAINED)}", file=sys.stderr)
    if options.json:
        print_json(summary)
        return
    success = summary["success_once"]
    if success is not None:
        low, high = summary["interval"]
        interval = f"95 % interval {100 * low:.0f} to {100 * high:.0f} %"
        minutes = summary["seconds"] / SECONDS_PER_MINUTE
        print(
            f"success once {100 * success:.1f} % of {summary['episodes']} episodes in homes of split "
            f"{summary['split']} ({interval}), at end {100 * summary['success_at_end']:.1f} %, "
            f"{minutes:.1f} minutes"
        )
    print(f"student: {summary['checkpoint'] or 'no checkpoint yet'}")
    print(f"report: {result.report}")


def _kept(out: Path, summary: Mapping[str, Any]) -> str:
    """What an interrupted run has left, and what --resume makes of it."""
    if (out / TRAINING).is_file():
        return f"the last checkpoint is kept in {out}. The same command with --resume continues."
    kept = (
        f"the policy is kept in {out}"
        if summary["checkpoint"]
        else "there is no checkpoint yet"
    )
    return f"{kept}. The same command with --resume trains from the beginning."
