"""Making data sets: workers roll out episodes into shards of one folder until quotas are full.

generation.json    what is made: configuration, filter, seed; a resumed run must match it
tried.jsonl        one line per episode that was tried and not kept, so that a resumed run leaves it out
shard_000.h5 ...   the kept episodes, one shard per worker

The shards are the truth: what is in them is kept. A worker that dies is started again and does what it had not
finished; what it had written is found in its shard. So nothing is lost and nothing comes twice.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock, is_written
from mjhab.core.files.outputs import check_output
from mjhab.core.files.reading import parse_json, read_bytes, read_json_object, reason
from mjhab.data.export.folders import differences
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

CONFIG = "generation.json"
TRIED = "tried.jsonl"
_PATIENCE = 0.2
"""Seconds between looks at whether to stop."""
_MOST_DEATHS = 3
"""A worker that dies so often without finishing an episode in between will not get further."""


@dataclass(frozen=True)
class Job:
    """What to make.

    config: plain data that decides what is made, compared when a run is resumed. episodes: indices 0 to N-1 are tried
    at most. chunk: episodes that a worker takes at once. per_target, per_label: see `Quotas`.
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
    """How far a job is. ``written``: by this run; ``kept``, ``tried``, ``passed``: in all; ``wanted``: kept, in the
    end, 0 where there is no quota; ``labels``: of the kept ones."""

    written: int
    kept: int
    tried: int
    passed: int
    wanted: int
    labels: Counter[str]
    complete: bool = False
    bytes: int = 0


def generate(
    job: Job,
    crew: Crew,
    tell: Callable[[Standing], object] = bool,
    stopped: Callable[[], bool] = bool,
    resume: bool = False,
) -> Standing:
    """Make a data set. Which episodes are kept depends on the job alone, not on the number of workers or on kills.

    Args:
        job: what to make, and where.
        crew: of workers that are to be started; they are gone when this returns or raises.
        tell: called when something has changed.
        stopped: asked several times a second; when it says True the workers are stopped and finished episodes stay.
        resume: go on in a folder that a run of the same config has left; quotas and workers may differ.

    Raises:
        UsageError: the folder holds something else, or another process is at work in it.
        StorageError: the disk is full; the same job can be resumed.
        MjhabError: a worker failed.
    """
    lock = _open_folder(job, resume)
    try:
        run = _Run(job, crew, tell)
        try:
            while not run.finished and not stopped():
                run.step()
        finally:
            crew.stop()
        return run.standing(final=True)
    except OSError as error:
        raise StorageError(
            f"cannot write to {job.out}: {error.strerror or error}. Give the same command with --resume when that is "
            "mended. Every episode finished before is safe."
        ) from error
    finally:
        lock.release()


@dataclass
class _Member:
    """What a worker has been given. ``held``: finished episodes that it holds back."""

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
        """Indices that are to be kept whose data were lost with a worker."""
        self.again: list[int] = []
        self.next = self.written = 0
        self._take_stock()
        self.before = self.quotas.kept
        self.members: dict[int, _Member] = {}

    def _take_stock(self) -> None:
        """Take in what earlier runs left."""
        for path in sorted(self.job.out.glob("*.h5")):
            for outcome in self._stored(path):
                self.quotas.report(outcome, True)
        for outcome in _read_tried(self.job.out / TRIED):
            # A quota may have been raised since: then what was dropped for it is to be made again.
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
        taken = {member.shard for other, member in self.members.items() if other != number}
        names = (self.job.out / f"shard_{n:03d}.h5" for n in range(number, 1_000_000))
        shard = next(path for path in names if path not in taken and not is_written(path))
        self.members[number] = _Member(shard, deaths=deaths)
        self.crew.start(number, self.job.spec, shard)

    @property
    def finished(self) -> bool:
        """Whether everything that is to be kept is on the disk and nothing else can be kept."""
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
        """Give work to workers that have none, and hear what the others say."""
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
        # What is to be kept stays in the books until it is told to be on the disk.
        member.held -= {index for index, keep in member.decided.items() if not keep}
        member.decided = {index: True for index, keep in member.decided.items() if keep}
        self.crew.send(number, request)

    def _next_indices(self) -> list[int]:
        indices: list[int] = []
        if self.quotas.full:
            # Of what was lost only the promised ones, which the quotas count, are still wanted.
            self.again = sorted(self.promised.intersection(self.again))
        while len(indices) < self.job.chunk and self.again:
            indices.append(heapq.heappop(self.again))
        while len(indices) < self.job.chunk and not self.quotas.full and not self._none_left:
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
            case Report(outcome, stored):
                member.deaths = 0
                self._take(member, outcome, stored)
            case Stored(index):
                self._settle(member, index)
            case Done():
                member.busy = False
            case Failed(kind, text):
                if kind == "storage":
                    raise StorageError(f"{text} `mjhab generate` goes on with --resume.")
                raise (
                    UsageError(text) if kind == "usage" else MjhabError(f"a worker failed:\n{text}")
                )
            case Gone():
                self._bury(number, member)

    def _take(self, member: _Member, outcome: Outcome, stored: bool) -> None:
        index = outcome.index
        member.open.discard(index)
        self.quotas.report(outcome, True if stored else None)
        if stored:
            self.promised.discard(index)
            self.written += 1
        elif outcome.passes:
            member.held.add(index)
        else:
            self._log(outcome)

    def _settle(self, member: _Member, index: int) -> None:
        member.decided.pop(index, None)
        member.held.discard(index)
        self.written += 1

    def _reclaim(self, member: _Member) -> None:
        """Look in a worker's shard for what it was given and did not report."""
        missing = member.open | {index for index, keep in member.decided.items() if keep}
        if not missing:
            return
        for outcome in self._stored(member.shard):
            if outcome.index in member.open:
                self._take(member, outcome, True)
            elif outcome.index in missing:
                self._settle(member, outcome.index)

    def _bury(self, number: int, member: _Member) -> None:
        """A worker died: what it had not written goes to others, and another one takes its place."""
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
                f"{sorted(lost)}). Is there enough memory? Every episode finished before is safe."
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
            file.write(json.dumps(asdict(outcome), separators=(",", ":")) + "\n")

    def standing(self, final: bool = False) -> Standing:
        """How far it is; at the end, counted anew from what is on the disk."""
        outcomes = self.quotas.outcomes.values()
        wanted = self.job.per_target * len(self.quotas.targets)
        passed = sum(outcome.passes for outcome in outcomes)
        if not final:
            return Standing(
                self.written, self.quotas.kept, len(outcomes), passed, wanted, self.quotas.labels
            )
        paths = sorted(self.job.out.glob("*.h5"))
        stored = [outcome for path in paths for outcome in self._stored(path)]
        labels = Counter(outcome.label for outcome in stored)
        size = sum(path.stat().st_size for path in paths)
        # What was written when nobody listened any more counts as well.
        written = len(stored) - self.before
        return Standing(
            written, len(stored), len(outcomes), passed, wanted, labels, self.finished, size
        )


def _open_folder(job: Job, resume: bool) -> WriteLock:
    """Make the folder, or check that what is in it can be gone on with; returns the lock that keeps others out."""
    path = job.out / CONFIG
    config = json.loads(json.dumps(job.config))
    check_output(job.out)
    if job.out.exists() and not job.out.is_dir():
        raise UsageError(f"--out {job.out} is a file; give a folder.")
    there = job.out.is_dir() and any(job.out.iterdir())
    if there and not resume:
        raise UsageError(
            f"{job.out} is not empty; add --resume to go on with what is in it, or choose another --out."
        )
    if there and path.exists():
        other = differences(read_json_object(path), config)
        if other:
            raise UsageError(
                f"{job.out} was made with another {other}. Give the same options, or choose another --out."
            )
    elif there and any(job.out.glob("*.h5")):
        raise UsageError(
            f"{job.out} holds shards that `mjhab generate` has not made; choose another --out."
        )
    job.out.mkdir(parents=True, exist_ok=True)
    lock = WriteLock(path, job.out)
    if not path.exists():
        text = json.dumps(config, indent=2) + "\n"
        write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return lock


def _read_tried(path: Path) -> list[Outcome]:
    """What was tried and not kept. A line that a kill left half is dropped from the file."""
    if not path.exists():
        return []
    try:
        lines = read_bytes(path).decode("utf-8").splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is damaged ({reason(error)}); choose another --out.") from error
    whole = [line for line in lines if line.endswith("\n")]
    if whole != lines:
        write_atomic(path, lambda temporary: temporary.write_text("".join(whole), encoding="utf-8"))
    try:
        return [Outcome(**parse_json(line)) for line in whole]
    except (ValueError, TypeError) as error:
        raise UsageError(f"{path} is damaged ({reason(error)}); choose another --out.") from error
