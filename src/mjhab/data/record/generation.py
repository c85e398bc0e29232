"""Generation of data sets: workers roll out episodes into the shards of one folder until quotas are full.

generation.json    configuration, filter and seed; a resumed run must match it
tried.jsonl        one line per episode that was tried and not kept, so that a resumed run skips it
shard_000.h5 ...   the kept episodes, one shard per worker

The content of the shards decides which episodes are kept. A worker that dies is started again; the episodes that it had
written are found in its shard, and the others are simulated again. So no episode is lost or stored twice.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import is_written
from mjhab.core.files.reading import parse_json, read_bytes, reason
from mjhab.core.files.run_folder import RunFolder
from mjhab.data.record.crew import (
    Crew,
    Done,
    Failed,
    Gone,
    Message,
    Ready,
    Report,
    Request,
    Stored,
    WorkerSpec,
    outcome_of,
)
from mjhab.data.record.quotas import Outcome, Quotas
from mjhab.data.store.reading import open_shard
from mjhab.data.store.shard import StorageError
from mjhab.rollout.records import skip_counts

CONFIG = "generation.json"
TRIED = "tried.jsonl"
_PATIENCE = 0.2
"""Longest time to wait for messages before checking whether to stop [s]."""
_MOST_DEATHS = 3
"""Number of deaths of a worker, without a finished episode in between, after which generation fails."""


class DataFolder(RunFolder):
    """The folder of a data set that is generated."""

    CONFIG_FILE = CONFIG
    WORK = ("*.h5", TRIED)


@dataclass(frozen=True)
class Job:
    """A data set to generate.

    spec: of the workers. config: JSON data that determines the data set, compared when a run is resumed. out: folder.
    episodes: largest number N of episodes to try, with indices 0 to N-1. workers: their number. chunk: episodes per
    request to a worker. per_target, per_label: see `Quotas`.
    """

    spec: WorkerSpec
    config: Mapping[str, Any]
    out: Path
    episodes: int
    workers: int = 1
    chunk: int = 8
    per_target: int = 0
    per_label: int = 0


@dataclass(frozen=True)
class Standing:
    """Progress of a job, in episodes.

    written: by this run. kept, tried, passed: in total; passed counts those that pass the filter. wanted: number to
    keep, 0 without a quota. labels: of the kept episodes. complete: the job is finished. bytes: size of the shards.
    errors: of this run, episodes that the policy could not finish by reason; a resumed run tries them again.
    skipped_homes: in how many of the tried episodes each home had no room and was skipped.
    """

    written: int
    kept: int
    tried: int
    passed: int
    wanted: int
    labels: Counter[str]
    complete: bool = False
    bytes: int = 0
    errors: Mapping[str, int] = field(default_factory=dict)
    skipped_homes: Mapping[str, int] = field(default_factory=dict)


def generate(
    job: Job,
    crew: Crew,
    tell: Callable[[Standing], object] = bool,
    stopped: Callable[[], bool] = bool,
    resume: bool = False,
) -> Standing:
    """Generate a data set. The kept episodes depend on the job only, not on the number of workers or on interruptions.

    Args:
        job: the data set.
        crew: its workers are started here, and have ended when this returns or raises.
        tell: called with the progress after every change.
        stopped: called several times per second; when it returns True the workers stop and finished episodes are kept.
        resume: continue in the folder of a run with the same config; quotas and workers may differ.

    Raises:
        UsageError: the folder holds other data, or another process is writing to it.
        StorageError: the disk is full; the same job can be resumed.
        MjhabError: a worker failed.
    """
    with DataFolder.open(job.out, job.config, resume=resume):
        try:
            return _fill(job, crew, tell, stopped)
        except OSError as error:
            raise StorageError(
                f"cannot write to {job.out}: {error.strerror or error}. Fix that and run the same command with "
                "--resume. Every episode finished before is safe."
            ) from error


def _fill(
    job: Job,
    crew: Crew,
    tell: Callable[[Standing], object],
    stopped: Callable[[], bool],
) -> Standing:
    """Generate until the quotas are filled or ``stopped`` says so; the workers have ended when this is left."""
    run = _Run(job, crew, tell)
    try:
        while not run.finished and not stopped():
            run.step()
    finally:
        crew.stop()
    return run.standing(final=True)


@dataclass
class _Member:
    """Bookkeeping of a worker.

    open: indices in progress. held: finished episodes that it holds back in memory. decided: decisions to send to it.
    deaths: since its last finished episode.
    """

    shard: Path
    ready: bool = False
    busy: bool = True
    open: set[int] = field(default_factory=set)
    held: set[int] = field(default_factory=set)
    decided: dict[int, bool] = field(default_factory=dict)
    deaths: int = 0


class _Run:
    """State of one call of ``generate``."""

    def __init__(self, job: Job, crew: Crew, tell: Callable[[Standing], object]) -> None:
        self.job = job
        self.crew = crew
        self.tell = tell
        self.quotas = Quotas((), job.per_target, job.per_label)
        self.configs: set[str] = set()
        self.promised: set[int] = set()
        """Indices that were decided to be kept, but whose data were lost with a worker."""
        self.errors: Counter[str] = Counter()
        self.again: list[int] = []
        self.next = self.written = 0
        self._take_stock()
        self.before = self.quotas.kept
        self.members: dict[int, _Member] = {}

    def _take_stock(self) -> None:
        """Load the episodes of earlier runs."""
        for path in sorted(self.job.out.glob("*.h5")):
            for outcome in self._stored(path):
                self.quotas.report(outcome, True)
        for outcome in _read_tried(self.job.out / TRIED):
            # If the quota has been raised since, episodes dropped because of it must be simulated again.
            if not outcome.passes or self.quotas.would_drop(outcome):
                self.quotas.report(outcome, False)

    def _stored(self, path: Path) -> Iterator[Outcome]:
        """The episodes in a shard."""
        if not path.exists():
            return
        with open_shard(path) as shard:
            for episode in shard:
                self.configs.add(episode.run.config_id)
                yield outcome_of(episode.record, True)

    def _start(self, number: int, deaths: int) -> None:
        taken = {
            member.shard for other, member in self.members.items() if other != number
        }
        names = (self.job.out / f"shard_{n:03d}.h5" for n in range(number, 1_000_000))
        shard = next(path for path in names if path not in taken and not is_written(path))
        self.members[number] = _Member(shard, deaths=deaths)
        self.crew.start(number, self.job.spec, shard)

    @property
    def finished(self) -> bool:
        """Whether all episodes to keep are on the disk and no further one can be kept."""
        if self.promised or any(
            keep for member in self.members.values() for keep in member.decided.values()
        ):
            return False
        return self.quotas.full or (
            self._none_left and not any(m.open or m.held for m in self.members.values())
        )

    @property
    def _none_left(self) -> bool:
        while self.next < self.job.episodes and not self.quotas.is_open(self.next):
            self.next += 1
        return not self.again and self.next >= self.job.episodes

    def step(self) -> None:
        """Send requests to idle workers and process new messages."""
        for number in range(self.job.workers if not self.members else 0):
            self._start(number, 0)
        for number, member in self.members.items():
            if member.ready and not member.busy:
                self._assign(number, member)
        found = self.crew.messages(_PATIENCE)
        for number, message in found:
            self._hear(number, message)
        if found:
            self._decide()
            self.tell(self.standing())

    def _assign(self, number: int, member: _Member) -> None:
        indices = self._next_indices()
        if not indices and not member.decided:
            return
        sure = self.quotas.surety(max(indices, default=0))
        request = Request(
            tuple(indices),
            frozenset(self.promised.intersection(indices)),
            sure,
            dict(member.decided),
        )
        member.open.update(indices)
        member.busy = True
        # An episode to keep stays in ``held`` until the worker reports it as stored.
        member.held -= {index for index, keep in member.decided.items() if not keep}
        member.decided = {index: True for index, keep in member.decided.items() if keep}
        self.crew.send(number, request)

    def _next_indices(self) -> list[int]:
        indices: list[int] = []
        if self.quotas.full:
            # Of the lost episodes only the promised ones, which the quotas count, are still needed.
            self.again = sorted(self.promised.intersection(self.again))
        while len(indices) < self.job.chunk and self.again:
            indices.append(heapq.heappop(self.again))
        while (
            len(indices) < self.job.chunk and not self.quotas.full and not self._none_left
        ):
            indices.append(self.next)
            self.next += 1
        return indices

    def _hear(self, number: int, message: Message) -> None:
        member = self.members[number]
        match message:
            case Ready(run, targets):
                if self.configs - {run.config_id}:
                    raise UsageError(
                        f"{self.job.out} holds episodes of another configuration (made by another version of mjhab, or "
                        "with other options); choose another --out."
                    )
                self.quotas.targets = targets
                member.ready = True
                member.busy = False
            case Report(outcome, stored, error):
                member.deaths = 0
                self._take(member, outcome, stored, error)
            case Stored(index):
                self._settle(member, index)
            case Done():
                member.busy = False
            case Failed(kind, text):
                if kind == "storage":
                    raise StorageError(f"{text} Continue with `mjhab generate --resume`.")
                raise (
                    UsageError(text)
                    if kind == "usage"
                    else MjhabError(f"a worker failed:\n{text}")
                )
            case Gone():
                self._bury(number, member)

    def _take(
        self, member: _Member, outcome: Outcome, stored: bool, error: str = ""
    ) -> None:
        index = outcome.index
        member.open.discard(index)
        self.quotas.report(outcome, True if stored else None)
        if stored:
            self.promised.discard(index)
            self.written += 1
        elif outcome.passes:
            member.held.add(index)
        elif error:
            # It is not logged as tried: what the policy would do in it is not known.
            self.errors[error] += 1
            self.promised.discard(index)
        else:
            self._log(outcome)

    def _settle(self, member: _Member, index: int) -> None:
        member.decided.pop(index, None)
        member.held.discard(index)
        self.written += 1

    def _reclaim(self, member: _Member) -> None:
        """Find episodes of a dead worker that are in its shard but were not reported."""
        missing = member.open | {index for index, keep in member.decided.items() if keep}
        if not missing:
            return
        for outcome in self._stored(member.shard):
            if outcome.index in member.open:
                self._take(member, outcome, True)
            elif outcome.index in missing:
                self._settle(member, outcome.index)

    def _bury(self, number: int, member: _Member) -> None:
        """Handle a dead worker: its unwritten episodes go to other workers, and it is started again."""
        self._reclaim(member)
        lost = set(member.open)
        for index in member.held:
            if self.quotas.forget(index):
                lost.add(index)
            elif member.decided.get(index):
                lost.add(index)
                self.promised.add(index)
        for index in lost:
            heapq.heappush(self.again, index)
        if member.deaths + 1 >= _MOST_DEATHS:
            raise MjhabError(
                f"worker {number} died {_MOST_DEATHS} times without finishing an episode (its episodes: "
                f"{sorted(lost)}). Check that there is enough memory. Every episode finished before is safe."
            )
        self._start(number, member.deaths + 1)

    def _decide(self) -> None:
        for index, keep in self.quotas.decide().items():
            for member in self.members.values():
                if index in member.held:
                    member.decided[index] = keep
            if not keep:
                self._log(self.quotas.outcomes[index])

    def _log(self, outcome: Outcome) -> None:
        with open(self.job.out / TRIED, "a", encoding="utf-8") as file:
            file.write(json.dumps(outcome.to_dict(), separators=(",", ":")) + "\n")

    def standing(self, final: bool = False) -> Standing:
        """Progress of the job; if ``final``, counted from the shards on the disk."""
        outcomes = self.quotas.outcomes.values()
        wanted = self.job.per_target * len(self.quotas.targets)
        passed = sum(outcome.passes for outcome in outcomes)
        if not final:
            return Standing(
                self.written,
                self.quotas.kept,
                len(outcomes),
                passed,
                wanted,
                self.quotas.labels,
            )
        paths = sorted(self.job.out.glob("*.h5"))
        stored = [outcome for path in paths for outcome in self._stored(path)]
        labels = Counter(outcome.label for outcome in stored)
        size = sum(path.stat().st_size for path in paths)
        # Episodes written after the last processed message count as well.
        written = len(stored) - self.before
        return Standing(
            written,
            len(stored),
            len(outcomes),
            passed,
            wanted,
            labels,
            self.finished,
            size,
            self.errors,
            skip_counts(outcome.skipped_homes for outcome in outcomes),
        )


def tried_in(folder: Path) -> int:
    """Number of episodes that earlier runs of a job have tried in its folder, kept or not."""
    tried = len(_read_tried(folder / TRIED))
    for path in folder.glob("*.h5"):
        with open_shard(path) as shard:
            tried += len(shard)
    return tried


def _read_tried(path: Path) -> list[Outcome]:
    """Read the episodes that were tried and not kept. An incomplete last line is removed from the file."""
    if not path.exists():
        return []
    try:
        lines = read_bytes(path).decode("utf-8").splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise UsageError(
            f"{path} is damaged ({reason(error)}); choose another --out."
        ) from error
    whole = [line for line in lines if line.endswith("\n")]
    if whole != lines:
        write_atomic(
            path, lambda temporary: temporary.write_text("".join(whole), encoding="utf-8")
        )
    try:
        return [Outcome.from_dict(parse_json(line)) for line in whole]
    except (ValueError, TypeError) as error:
        raise UsageError(
            f"{path} is damaged ({reason(error)}); choose another --out."
        ) from error
