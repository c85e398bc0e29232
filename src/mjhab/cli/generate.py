"""``mjhab generate``: data sets by several workers."""

from __future__ import annotations

import functools
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from mjhab.cli.data import read_filter
from mjhab.cli.doctor import cores
from mjhab.cli.generate_options import GenerateOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.cli.profiles import profile_options, resolved_profile
from mjhab.core.errors import UsageError
from mjhab.data.record.crew import ALL, Crew, ProcessCrew, Stage, WorkerSpec
from mjhab.data.record.generation import Job, Standing, generate
from mjhab.data.store.images import ImageFormat
from mjhab.evaluation.evaluate import EvalSpec, check_env_options
from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions, full_spec, inspect_policy, resolve_policy
from mjhab.tasks.style import Styles

TRIES_PER_EPISODE = 20
"""Without --episodes, so many episodes are tried per episode to keep before a quota is given up."""
MOST_TARGETS = 10
"""No task has more kinds of objects."""
NO_IMAGES = "none"
_NOT_IN_CONFIG = frozenset(
    {"out", "per_target", "per_label", "episodes", "workers", "worlds", "threads", "ray", "resume", "json", "starts"}
)


def run_generate(options: GenerateOptions) -> int:
    """Run the command; returns 0, 1 if a quota could not be filled, or 130 after Ctrl-C or SIGTERM."""
    job = make_job(options)
    crew = make_crew(options)
    begun = time.perf_counter()
    with stop_signals() as stopped, _progress(options, job) as tell:
        done = generate(job, crew, tell, stopped, options.resume)
    seconds = time.perf_counter() - begun
    numbers = {
        "written": done.written,
        "kept": done.kept,
        "labels": dict(done.labels.most_common()),
        "episodes_per_hour": round(done.written / seconds * 3600, 1),
        "bytes_per_episode": round(done.bytes / done.kept) if done.kept else 0,
        "tried": done.tried,
        "yield": round(done.passed / done.tried, 4) if done.tried else 0.0,
        "seconds": round(seconds, 1),
    }
    _tell(options, done, numbers, stopped())
    if stopped() and not done.complete:
        return 130
    return 1 if done.wanted and done.kept < done.wanted else 0


def make_job(options: GenerateOptions) -> Job:
    """Check the options and turn them into a job.

    Raises:
        UsageError: an unknown name, a number out of range, a filter that cannot be understood.
    """
    _check_episodes(options)
    options = replace(options, policy=full_spec(options.policy, options.task, options.subtask, options.target))
    facts = inspect_policy(options.policy)
    for name in ("per_target", "per_label", "threads"):
        at_least(name.replace("_", "-"), getattr(options, name), 0)
    for name in ("workers", "worlds"):
        at_least(name, getattr(options, name), 1)
    if options.episodes is None and not options.per_target:
        raise UsageError("say when to stop: --per-target N keeps N episodes of every target, --episodes N tries N.")
    keep = read_filter(options.keep, options.preset)
    images = None if options.images == NO_IMAGES else ImageFormat(options.rgb)
    _check_images(options)
    env_options(options, facts)
    config = {key: value for key, value in vars(options).items() if key not in _NOT_IN_CONFIG}
    of_policy = {name: facts.env_options[name] for name in ("profile", "stationary") if name in facts.env_options}
    config |= resolved_profile(
        options, task=options.task, subtask=options.subtask or "", cameras=options.cameras, **of_policy
    )
    # Without a style nothing is said of it: what was made before there were styles can be gone on with.
    config |= {"style": Styles.parse(options.style).words} if config.pop("style") else {}
    config = {key: str(value) if isinstance(value, Path) else value for key, value in config.items()}
    config |= {"policy": facts.name, **facts.identity}
    spec = WorkerSpec(
        functools.partial(build_stage, replace(options, threads=options.threads or max(1, cores() // options.workers))),
        options.seed, keep.text if keep else "", not options.no_states, images,
    )  # fmt: skip
    most = options.episodes or TRIES_PER_EPISODE * MOST_TARGETS * options.per_target
    # Episodes of one subtask all last to the horizon: one per world leaves no world idle. Chains end when they end.
    chunk = options.worlds if options.subtask else 2 * options.worlds
    return Job(spec, config, options.out, most, options.workers, chunk, options.per_target, options.per_label)


def make_crew(options: GenerateOptions) -> Crew:
    """Processes of this machine, or actors of a Ray cluster.

    Raises:
        UsageError: Ray is not installed, or the cluster cannot be reached.
    """
    if options.ray is None:
        return ProcessCrew()
    from mjhab.data.record.ray_crew import RayCrew

    return RayCrew(options.ray)


def build_stage(options: GenerateOptions) -> Stage:
    """What a worker acts in; called in the worker's process."""
    from mjhab.envs import make
    from mjhab.episodes.starts import valid_targets

    facts = inspect_policy(options.policy)
    env = make(
        **env_options(options, facts),
        task=options.task,
        subtask=options.subtask or "",
        target=options.target or "",
        num_envs=options.worlds,
        split=options.split,
        assets=options.assets,
        home=options.home or "",
        navigate=options.navigate,
        seed=options.seed,
        threads=options.threads,
        reward_mode=options.reward,
        autoreset="disabled",
    )
    targets = (ALL,)
    if options.subtask and options.subtask != "navigate":
        targets = (options.target,) if options.target else tuple(valid_targets(env.config, env.layout))
    policy = resolve_policy(options.policy, env, PolicyOptions(options.seed, options.style))
    return Stage(env, policy, about_policy(options, facts), targets, licence_of(options.assets))


def about_policy(options: GenerateOptions, facts: PolicyFacts) -> dict[str, Any]:
    """What is recorded of the policy: all that decides how it acts, as plain JSON data."""
    about: dict[str, Any] = {"name": facts.name, **facts.identity}
    if facts.env_options:
        about["env_options"] = dict(facts.env_options)
    if options.style:
        about["style"] = Styles.parse(options.style).words
    if options.policy == "random":
        about["seed"] = options.seed
    return about


def env_options(options: GenerateOptions, facts: PolicyFacts) -> dict[str, Any]:
    """Options of the environment that the images to store, or the policy, ask for.

    Raises:
        UsageError: the policy asks for an option that does not exist, or sees other images than those to store.
    """
    check_env_options(facts.env_options)
    needed = {**facts.env_options, **profile_options(options)}
    if options.images == NO_IMAGES:
        return needed
    sees = needed.pop("obs_mode", "")
    stored = {
        "obs_mode": "+".join(dict.fromkeys([*options.images.split("+"), *filter(None, sees.split("+"))])),
        "cameras": options.cameras,
        "camera_size": options.camera_size,
    }
    for name in ("cameras", "camera_size"):
        if sees and name in needed and needed[name] != stored[name]:
            raise UsageError(
                f"the policy {facts.name} sees images with {name} = {needed[name]!r}, but {stored[name]!r} is asked "
                f"for. Store those that it sees, or leave out --images: `mjhab replay --render` draws any others later."
            )
    return {**needed, **stored}


def licence_of(assets: str) -> str:
    """Terms of an asset pack that is one of the public data sets; "" for any other."""
    from mjhab.assets.sources import SOURCES

    folder = Path(assets.partition("?")[0])
    parts = (folder, folder / "replica_cad", folder.parent, folder.parent / "replica_cad")
    if assets == "builtin" or not any(SOURCES["replica_cad"].complete(part) for part in parts):
        return ""
    named = [SOURCES[name] for name in ("replica_cad", "ycb")]
    return "; ".join(f"{source.title.partition(':')[0]}: {source.licence}" for source in named)


@contextmanager
def stop_signals() -> Iterator[Any]:
    """While it is open, SIGTERM and Ctrl-C only make the function it gives say True; a second Ctrl-C interrupts."""
    seen: list[int] = []

    def note(number: int, frame: Any) -> None:
        if seen and number == signal.SIGINT:
            raise KeyboardInterrupt
        seen.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _progress(options: GenerateOptions, job: Job) -> Iterator[Any]:
    columns = (
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=20),
        TextColumn("{task.completed:.0f}/{task.total:.0f}{task.fields[what]}"), TimeRemainingColumn(),
    )  # fmt: skip
    begun = time.perf_counter()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        name = f"{options.task} {options.subtask or 'chain'}"
        task = bar.add_task(name, total=job.per_target or job.episodes, what="")

        def tell(now: Standing) -> None:
            done, total = (now.kept, now.wanted) if now.wanted else (now.tried, job.episodes)
            rate = now.written / (time.perf_counter() - begun) * 3600
            share = f", yield {100 * now.passed / now.tried:.0f} %" if now.tried else ""
            what = f"{share}, {rate:,.0f} episodes/h"
            bar.update(task, completed=done, total=max(total, 1), what=what)

        yield tell


def _tell(options: GenerateOptions, done: Standing, numbers: dict[str, Any], stopped: bool) -> None:
    if stopped and not done.complete:
        print(
            f"mjhab: stopped; {done.kept} episodes are kept in {options.out}. The same command with --resume goes on.",
            file=sys.stderr,
        )
    elif done.wanted and done.kept < done.wanted:
        print(
            f"mjhab: only {done.kept} of {done.wanted} episodes passed of {done.tried} that were tried. A larger "
            "--episodes with --resume tries more.",
            file=sys.stderr,
        )
    if options.json:
        print_json(numbers)
        return
    rows = [(label or "none", count) for label, count in numbers["labels"].items()]
    print_table(f"Episodes in {options.out}", ("label", "kept"), rows)
    print(
        f"{done.kept} episodes kept, {done.written} of them written now, {done.tried} tried; "
        f"{numbers['episodes_per_hour']:,.0f} episodes per hour, {numbers['bytes_per_episode']:,} bytes per episode"
    )


def _check_images(options: GenerateOptions) -> None:
    from mjhab.envs.observations import camera_names, image_size, mode_outputs

    if options.images != NO_IMAGES:
        mode_outputs(options.images)
        camera_names(options.cameras)
        image_size(options.camera_size)


def _check_episodes(options: GenerateOptions) -> None:
    """Refuse episodes that an evaluation would refuse, with its words."""
    EvalSpec(
        policy=options.policy,
        task=options.task,
        subtask=options.subtask,
        target=options.target,
        style=options.style,
        seed=options.seed,
        split=options.split,
        navigate=options.navigate,
        episodes=1 if options.episodes is None else options.episodes,
        env=profile_options(options),
    )
