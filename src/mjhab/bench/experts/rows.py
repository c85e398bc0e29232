"""The rows of the table of experts: what is measured, and what comes out of the episodes of a row."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mjhab.bench.specs import ExpertsSpec
from mjhab.config.env import NAVIGATE_MODES, SPLITS, EnvConfig
from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import UsageError, unknown_name
from mjhab.data.store.episode_data import last_label
from mjhab.episodes.rosters import roster
from mjhab.episodes.starts import valid_targets
from mjhab.layout.layout import Layout
from mjhab.reports.dataset_forces import SAFE_FORCE_N
from mjhab.reports.metrics import wilson
from mjhab.reports.paper import paper_row
from mjhab.rollout.records import EpisodeRecord
from mjhab.scenes.packs import open_pack
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.progressive import progressive
from mjhab.tasks.subtasks.registry import SUBTASKS

CHAIN = "chain"
ALL = "all"
PAPER_POLICY = "RL-Per"
"""One policy per object, trained by reinforcement learning: the best of the MS-HAB paper."""
ASKED_CHAINS = {"set_table": 0.5, "prepare_groceries": 0.4, "tidy_house": 0.4}
ASKED_SUBTASKS = ("pick", "place", "open", "close")
ASKED = 0.9
ASKED_INSIDE = 0.8
ASKED_CRACKER_BOX = 0.85
"""Success rates the project asks of its experts: in the open; picking out of drawer and fridge; for the large box."""


@dataclass(frozen=True)
class ExpertRow:
    """What one row measures. ``pack``: short name of the assets; ``subtask``: a kind or CHAIN; ``target``: object type
    or link, "" for chains and Navigate; ``navigate``: of chains, else ""; ``episodes``: how many."""

    pack: str
    assets: str
    task: str
    subtask: str
    target: str
    navigate: str
    episodes: int

    @property
    def name(self) -> str:
        """Path of the row in the folder of the run; it names the row for machines, too."""
        words = (self.task, self.subtask, self.target.replace("/", "-"), self.navigate)
        return f"{self.pack}/{'_'.join(filter(None, words))}"

    @property
    def asked(self) -> float | None:
        """Success rate the project asks for; None for Navigate, for ALL targets together and for what plugins add."""
        if self.subtask == CHAIN:
            return ASKED_CHAINS.get(self.task)
        if self.subtask not in ASKED_SUBTASKS or self.target == ALL:
            return None
        if self.target == "003_cracker_box":
            return ASKED_CRACKER_BOX
        # SetTable picks out of the drawer and the fridge, PrepareGroceries out of and into the fridge.
        inside = self.task == "prepare_groceries" or (
            self.task == "set_table" and self.subtask == "pick"
        )
        return ASKED_INSIDE if inside else ASKED


@dataclass(frozen=True)
class MeasuredEpisode:
    """What the table takes from an episode: one line of episodes.jsonl.

    ``last`` and ``label``: kind and label of the last subtask that ended. Forces [N], sums [N x control steps];
    ``force_to_success``: sum up to the first success, None without one.
    """

    index: int
    home: str
    last: str
    label: str
    success_once: bool
    success_at_end: bool
    force_to_success: float | None
    cumulative_force: float
    peak_force: float
    steps: int
    completed: int
    planned: int
    taint: tuple[str, ...]

    @classmethod
    def of(cls, record: EpisodeRecord) -> MeasuredEpisode:
        """Take it from a record."""
        first = record.steps_to_success or record.steps
        return cls(
            record.index,
            record.home,
            record.subtasks[-1].kind if record.subtasks else "",
            last_label(record),
            record.success_once,
            record.success_at_end,
            round(ordered_sum(record.force[:first]), 1) if record.success_once else None,
            record.cumulative_force,
            record.peak_force,
            record.steps,
            record.completed,
            len(record.plan),
            record.taint,
        )

    @property
    def gentle(self) -> bool:
        """Whether it would have succeeded if the sum of forces were limited to 1,400 N."""
        return self.force_to_success is not None and self.force_to_success < SAFE_FORCE_N


@dataclass(frozen=True)
class RowResult:
    """A row of the table; rates in 0..1. ``row`` names what was measured, ``error`` why it could not be.

    gentle: success once with less than 1,400 N x control steps up to then. gentle_peak: success once, and never 1,400 N
    in a step. labels: counts of the last label; failures: of the episodes without success, in a chain with the kind of
    the subtask before it. paper: success once of the paper's RL-Per. progressive: of a chain, the share of episodes
    that completed at least 1, 2, ... subtasks.
    """

    pack: str
    task: str
    subtask: str
    target: str
    navigate: str
    split: str
    episodes: int
    wanted: int
    homes: int
    successes: int
    success_once: float | None
    interval: tuple[float, float]
    success_at_end: float | None
    gentle: float | None
    gentle_peak: float | None
    tainted: int
    labels: dict[str, int]
    failures: dict[str, int]
    asked: float | None
    paper: float | None
    paper_table: int | None
    progressive: tuple[float, ...]
    error: str

    @property
    def met(self) -> bool | None:
        """Whether as much succeeded as is asked; None where nothing is asked or measured."""
        return (
            None
            if self.asked is None or self.success_once is None
            else self.success_once >= self.asked
        )

    @property
    def over_paper(self) -> float | None:
        """Ours minus the paper's, in points of percent."""
        if self.paper is None or self.success_once is None:
            return None
        return round(100 * (self.success_once - self.paper), 2)


def make_rows(spec: ExpertsSpec) -> list[ExpertRow]:
    """The rows that are asked for.

    Raises:
        UsageError: a name or an asset folder that cannot work, or nothing is left to measure.
    """
    _check(spec)
    rows: list[ExpertRow] = []
    targets: set[str] = set()
    for pack, assets in _packs(spec).items():
        for task in [task for task in TASKS if task in (spec.task or TASKS)]:
            for subtask in (*TASKS[task].subtasks, CHAIN):
                if subtask in (spec.subtask or (subtask,)):
                    found = _rows_of(spec, pack, assets, task, subtask)
                    targets |= {row.target for row in found if row.target}
                    rows += [
                        row
                        for row in found
                        if row.episodes and row.target in (spec.target or (row.target,))
                    ]
    for target in spec.target:
        if target not in targets:
            raise unknown_name("target of these rows", target, targets)
    if not rows:
        raise UsageError(
            "there is nothing to measure: no row fits --task, --subtask, --target, --episodes and --chains together."
        )
    return rows


def _rows_of(
    spec: ExpertsSpec, pack: str, assets: str, task: str, subtask: str
) -> list[ExpertRow]:
    if subtask == CHAIN:
        modes = dict.fromkeys(spec.navigate)
        return [
            ExpertRow(pack, assets, task, subtask, "", mode, spec.chains)
            for mode in modes
        ]
    targets = [""]
    if not SUBTASKS[subtask].navigates:
        layout = Layout(open_pack(assets), roster(task))
        targets = valid_targets(EnvConfig(task=task, subtask=subtask), layout)
    return [
        ExpertRow(pack, assets, task, subtask, target, "", spec.episodes)
        for target in targets
    ]


def _check(spec: ExpertsSpec) -> None:
    for kind, given, valid in (
        ("task", spec.task, TASKS),
        ("subtask", spec.subtask, (*SUBTASKS, CHAIN)),
        ("navigate mode", spec.navigate, NAVIGATE_MODES),
        ("split", (spec.asked.split,), SPLITS),
    ):
        for name in given:
            if name not in valid:
                raise unknown_name(kind, name, valid)


def _packs(spec: ExpertsSpec) -> dict[str, str]:
    """Short name of every asset pack, and how it was given."""
    packs: dict[str, str] = {}
    for assets in spec.assets:
        pack = open_pack(assets)
        if pack.name in packs:
            raise UsageError(
                f"--assets {packs[pack.name]} and {assets} are both {pack.name!r}; measure them in two folders."
            )
        if not any(home.split == spec.asked.split for home in pack.homes):
            raise UsageError(
                f"--assets {assets} has no homes of the split {spec.asked.split!r}; choose another --split."
            )
        packs[pack.name] = assets
    return packs


def row_folder(out: Path, row: ExpertRow) -> Path:
    """Where the episodes of a row are recorded."""
    return out / "rows" / row.name


def result_of(
    row: ExpertRow, split: str, episodes: Sequence[MeasuredEpisode], error: str = ""
) -> RowResult:
    """The table's row for the episodes measured so far; ``error``: why there are no more."""
    once = sum(episode.success_once for episode in episodes)
    chain = row.subtask == CHAIN
    paper = (
        None
        if chain
        else paper_row(row.task, row.subtask, split, row.target, PAPER_POLICY)
    )
    curve: tuple[float, ...] = ()
    if chain and episodes:
        counts = [episode.completed for episode in episodes]
        plan = max(episode.planned for episode in episodes)
        curve = tuple(progressive(counts, plan).round(4).tolist())
    failed = (
        f"{e.last} {e.label}".strip() if chain else e.label
        for e in episodes
        if not e.success_once
    )
    return RowResult(
        row.pack,
        row.task,
        row.subtask,
        row.target,
        row.navigate,
        split,
        episodes=len(episodes),
        wanted=row.episodes,
        homes=len({episode.home for episode in episodes}),
        successes=once,
        success_once=_share(episode.success_once for episode in episodes),
        interval=wilson(once, len(episodes)),
        success_at_end=_share(episode.success_at_end for episode in episodes),
        gentle=None if chain else _share(episode.gentle for episode in episodes),
        gentle_peak=_share(
            episode.success_once and episode.peak_force < SAFE_FORCE_N
            for episode in episodes
        ),
        tainted=sum(bool(episode.taint) for episode in episodes),
        labels=_counts(episode.label for episode in episodes),
        failures=_counts(failed),
        asked=row.asked,
        paper=round(paper.success_once / 100, 6) if paper else None,
        paper_table=paper.table if paper else None,
        progressive=curve,
        error=error,
    )


def together(
    measured: Sequence[tuple[ExpertRow, Sequence[MeasuredEpisode]]], split: str
) -> list[RowResult]:
    """One row for all targets of every (pack, task, subtask), as in the paper's Tables 6 to 9."""
    groups: dict[
        tuple[str, str, str, str], list[tuple[ExpertRow, Sequence[MeasuredEpisode]]]
    ] = {}
    for row, episodes in measured:
        if row.subtask != CHAIN:
            groups.setdefault((row.pack, row.assets, row.task, row.subtask), []).append(
                (row, episodes)
            )
    found = []
    for names, members in groups.items():
        every = [episode for _, episodes in members for episode in episodes]
        found.append(
            result_of(
                ExpertRow(*names, ALL, "", sum(row.episodes for row, _ in members)),
                split,
                every,
            )
        )
    return found


def _counts(labels: Iterable[str]) -> dict[str, int]:
    """How often each label occurs, the most frequent first."""
    counts = Counter(label or "none" for label in labels)
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _share(values: Iterable[bool]) -> float | None:
    values = list(values)
    return round(ordered_sum(values) / len(values), 4) if values else None


def result_dict(result: RowResult) -> dict[str, Any]:
    """A row as plain data for results.json."""
    return {**asdict(result), "over_paper": result.over_paper}
