"""``mjhab eval``: episodes, records, films, numbers, report."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import mjhab
from mjhab.cli.options import EvalOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.cli.profiles import profile_options, resolved_profile
from mjhab.core.errors import UsageError, unknown_name
from mjhab.rollout.films import FilmSink
from mjhab.rollout.loop import rollout
from mjhab.rollout.metrics import AloneRates, SubtaskRow, alone_rates, rows_by_kind, rows_by_position, summarize
from mjhab.rollout.policy import Policy, RandomPolicy, ZeroPolicy
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.report import render_report
from mjhab.rollout.sinks import Sink, StepView
from mjhab.rollout.store import RunFolder, StoreSink, check_folder, read_records
from mjhab.tasks.plan import KIND_NAMES, TASKS
from mjhab.tasks.style import Styles

POLICIES = ("expert", "random", "zero")
NAVIGATE_MODES = ("teleport", "drive")
SPLITS = ("train", "val", "test")
FILM_QUALITY = 27
"""x264 rate factor: a film of a whole chain stays at a few MB, since the report carries it."""
NOT_IN_CONFIG = frozenset({"out", "resume", "overwrite", "json", "alone"})


def run_eval(options: EvalOptions) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C (finished episodes are kept and reported)."""
    check_options(options)
    config = resolved_config(options)
    path = options.out or default_out(options)
    check_folder(path, config, resume=options.resume, overwrite=options.overwrite)
    alone = read_alone(options.alone)
    env = None
    if options.overwrite or _anything_left(path, options):
        env = make_env(options)
    folder = RunFolder.open(path, config, resume=options.resume, overwrite=options.overwrite)
    started, earlier = time.perf_counter(), folder.earlier_seconds()
    films = FilmSink(range(options.films), folder.film_path, _open_film)
    interrupted = False
    try:
        if env is not None:
            _run(env, options, folder, films)
    except KeyboardInterrupt:
        interrupted = True
    seconds = earlier + time.perf_counter() - started
    summary = finish(folder, seconds, films.problem, alone)
    _tell(options, folder, summary, films.problem, interrupted)
    return 130 if interrupted else 0


def check_options(options: EvalOptions) -> None:
    """Refuse what cannot work before anything is built.

    Raises:
        UsageError: an unknown name, or a number out of range.
    """
    for kind, given, valid in (
        ("task", options.task, TASKS),
        ("subtask", options.subtask, KIND_NAMES),
        ("policy", options.policy, POLICIES),
        ("split", options.split, SPLITS),
        ("navigate mode", options.navigate, NAVIGATE_MODES),
    ):
        if given is not None and given not in valid:
            raise unknown_name(kind, given, valid)
    resolved_profile(options, task=options.task, subtask=options.subtask or "")
    if options.style and options.policy != "expert":
        raise UsageError(f"--style is for --policy expert: {options.policy} has no style.")
    Styles.parse(options.style)
    if options.target is not None and options.subtask is None:
        raise UsageError("--target needs --subtask: a whole task has its targets in its plan.")
    at_least("episodes", options.episodes, 1)
    at_least("worlds", options.worlds, 1)
    at_least("seed", options.seed, 0)
    at_least("threads", options.threads, 0)
    at_least("films", options.films, 0)


def resolved_config(options: EvalOptions) -> dict[str, Any]:
    """Everything that decides what happens in the episodes, with the versions that simulate them."""
    chosen = {key: value for key, value in asdict(options).items() if key not in NOT_IN_CONFIG}
    for name in ("style", "starts"):
        chosen.pop(name)
    chosen |= resolved_profile(options, task=options.task, subtask=options.subtask or "")
    if options.style:
        chosen["style"] = Styles.parse(options.style).words
    if options.spawns:
        from mjhab.envs.spawn_sets import SpawnSet

        # A path says little: what the set holds and its hash are what fixes the episodes.
        chosen["spawns"] = SpawnSet.read(Path(options.spawns)).describe()
    return {**chosen, "mjhab": mjhab.__version__, "mujoco": version("mujoco")}


def default_out(options: EvalOptions) -> Path:
    """The folder used when none is given."""
    driven = "drive" if options.navigate == "drive" and not options.subtask else None
    words = (options.task, options.subtask, (options.target or "").replace("/", "-"), driven, options.policy)
    return Path("runs") / "_".join([*filter(None, words), f"seed{options.seed}"])


def read_alone(folders: Sequence[Path]) -> dict[tuple[str, str], float]:
    """Read the success rates of single-subtask runs.

    Raises:
        UsageError: a folder holds no run, or none of a single subtask.
    """
    records: list[EpisodeRecord] = []
    for folder in folders:
        found = read_records(folder)
        if not any(record.subtask for record in found):
            raise UsageError(f"--alone {folder}: this folder holds no run with --subtask.")
        records += found
    return alone_rates(records)


def make_env(options: EvalOptions) -> Any:
    """Build the environment the options ask for; no more worlds than episodes."""
    from mjhab.envs import make

    return make(
        task=options.task,
        subtask=options.subtask or "",
        target=options.target or "",
        num_envs=min(options.worlds, options.episodes),
        split=options.split,
        assets=options.assets,
        home=options.home or "",
        episodes_file=options.episodes_file or "",
        spawns=options.spawns or "",
        navigate=options.navigate,
        seed=options.seed,
        threads=options.threads,
        autoreset="disabled",
        **profile_options(options),
    )


def make_policy(options: EvalOptions, env: Any) -> Policy:
    """Build the policy the options name."""
    if options.policy == "zero":
        return ZeroPolicy()
    if options.policy == "random":
        return RandomPolicy(options.seed)
    from mjhab.experts import make_expert

    return make_expert(env, Styles.parse(options.style)) if options.style else make_expert(env)


def finish(folder: RunFolder, seconds: float, film_problem: str | None, alone: AloneRates | None) -> dict[str, Any]:
    """Write summary.json and report.html from the records in the folder; returns the summary for machines."""
    records = folder.records
    summary = {"profile": folder.config.get("profile"), **summarize(records, seconds, alone)}
    rows = {"along_the_plan": rows_by_position(records), "by_kind": rows_by_kind(records)}
    folder.write_summary({**summary, **{name: [asdict(row) for row in table] for name, table in rows.items()}})
    folder.write_report(render_report(records, folder.config, seconds, folder.film_path, film_problem, alone))
    return summary


def _anything_left(path: Path, options: EvalOptions) -> bool:
    if not options.resume:
        return True
    done = {record.index for record in read_records(path)}
    return any(index not in done for index in range(options.episodes))


def _open_film(path: Path, fps: int) -> Any:
    from mjhab.sim.film import FilmWriter

    return FilmWriter(path, fps, FILM_QUALITY)


def _run(env: Any, options: EvalOptions, folder: RunFolder, films: FilmSink) -> None:
    missing = folder.missing(options.episodes)
    with Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}{task.fields[success]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
    ) as bar:
        sinks: list[Sink] = [films, StoreSink(folder), ProgressSink(bar, options, len(missing))]
        rollout(env, make_policy(options, env), missing, options.seed, sinks)


class ProgressSink(Sink):
    """Shows episodes done, control steps per second and the success rate so far."""

    REFRESH = 0.25
    """Seconds between updates."""

    def __init__(self, bar: Progress, options: EvalOptions, total: int) -> None:
        self._bar = bar
        name = f"{options.task} {options.subtask or ''}".strip()
        already = options.episodes - total
        self._task = bar.add_task(name, total=options.episodes, completed=already, rate="", success="")
        self._started = self._shown = time.perf_counter()
        self._steps = self._done = self._won = 0

    def on_step(self, env: Any, step: StepView) -> None:
        """Count control steps and show the rate now and then."""
        self._steps += int(step.active.sum())
        now = time.perf_counter()
        if now - self._shown > self.REFRESH:
            self._shown = now
            self._bar.update(self._task, rate=f"{self._steps / (now - self._started):,.0f} steps/s")

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        """Move the bar."""
        self._done += 1
        self._won += record.success_once
        self._bar.update(self._task, advance=1, success=f", {100 * self._won / self._done:.0f} % success")


def _tell(
    options: EvalOptions, folder: RunFolder, summary: Mapping[str, Any], problem: str | None, interrupted: bool
) -> None:
    if problem:
        print(f"mjhab: films stopped, the evaluation went on: {problem}", file=sys.stderr)
    if interrupted:
        print(
            f"mjhab: interrupted; {summary['episodes']} of {options.episodes} episodes are kept in {folder.path}. "
            "The same command with --resume (and without --overwrite) continues.",
            file=sys.stderr,
        )
    if options.json:
        print_json(summary)
        return
    if options.subtask:
        _print_rows("Success per target", rows_by_kind(folder.records))
    else:
        _print_rows("Success along the plan", rows_by_position(folder.records))
    print(
        f"{summary['episodes']} episodes: success once {100 * summary['success_once']:.1f} %, at end "
        f"{100 * summary['success_at_end']:.1f} %, tainted {summary['tainted']}, {summary['seconds']:.0f} s"
    )
    print(f"report: {folder.path / 'report.html'}")


def _print_rows(title: str, rows: Sequence[SubtaskRow]) -> None:
    columns = ("#", "subtask", "target", "reached", "success once", "95 % interval", "at end")
    print_table(title, columns, [_cells(row) for row in rows])


def _cells(row: SubtaskRow) -> tuple[object, ...]:
    head = ("" if row.position is None else row.position + 1, row.kind, row.target, row.reached)
    if not row.reached:
        return (*head, "-", "-", "-")
    low, high = row.interval
    interval = f"{100 * low:.0f} to {100 * high:.0f} %"
    return (*head, f"{100 * row.success_once:.1f} %", interval, f"{100 * row.success_at_end:.1f} %")
