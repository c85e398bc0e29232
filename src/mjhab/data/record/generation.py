"""Generation of data sets: workers roll out episodes into files of one folder until quotas are full.

generation.json    configuration, filter and seed; a resumed run must match it
tried.jsonl        one line per episode that was tried and not kept, so that a resumed run skips it
episodes           the kept episodes, a file each, and a table of them (`store.episode_files`)

What is in the folder, in files or packed into shards, decides which episodes are kept. A worker that dies is started
again; the episodes that it had written are found by their names, and the others are simulated again. So no episode is
lost or stored twice.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from mjhab.core.errors import MjhabError, UsageError, fault
from mjhab.data.record.job import (
    TRIED,
    DataFolder,
    Job,
    Standing,
    read_tried,
)
from mjhab.data.record.messages import (
    EpisodeDone,
    EpisodeStored,
    Message,
    Request,
    RequestDone,
    WorkerExited,
    WorkerFailed,
    WorkerReady,
)
from mjhab.data.record.pools import PATIENCE, WorkerPool
from mjhab.data.record.quotas import Outcome, Quotas
from mjhab.data.record.workers import MOST_DEATHS, outcome_of
from mjhab.data.store.episode_data import RunInfo, last_label
from mjhab.data.store.episode_files import (
    EPISODE_FOLDER,
    EpisodeEntry,
    EpisodeFiles,
)
from mjhab.data.store.hdf5 import drop_unfinished
from mjhab.data.store.places import entries, has_shards
from mjhab.data.store.reading import open_shard
from mjhab.data.store.storage import StorageError
from mjhab.rollout.records import skip_counts


def generate(
    job: Job,
    pool: WorkerPool,
    tell: Callable[[Standing], object] = bool,
    stopped: Callable[[], bool] = bool,
    resume: bool = False,
) -> Standing:
    """Generate a data set. The kept episodes depend on the job only, not on the number of workers or on interruptions.

    Args:
        job: the data set.
        pool: its workers are started here, and have ended when this returns or raises.
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
            return _fill(job, pool, tell, stopped)
        except OSError as error:
            raise StorageError(
                f"cannot write to {job.out}: {error.strerror or error}. Fix that and run the same command with "
                "--resume. Every episode finished before is safe."
            ) from error


def _fill(
    job: Job,
    pool: WorkerPool,
    tell: Callable[[Standing], object],
    stopped: Callable[[], bool],
) -> Standing:
    """Generate until the quotas are filled or ``stopped`` says so; the workers have ended when this is left."""
    run = _Run(job, pool, tell)
    try:
        while not run.finished and not stopped():
            run.step()
    finally:
        # Also after an error: workers left alone would go on writing into the folder.
        pool.stop()
    return run.standing(final=True)


@dataclass
class _Member:
    """Bookkeeping of a worker.

    open: indices in progress. held: finished episodes that it holds back in memory. decided: decisions to send to it.
    deaths: since its last finished episode.
    """

    ready: bool = False
    busy: bool = True
    open: set[int] = field(default_factory=set)
    held: set[int] = field(default_factory=set)
    decided: dict[int, bool] = field(default_factory=dict)
    deaths: int = 0


class _Run:
    """State of one call of ``generate``."""

    def __init__(
        self, job: Job, pool: WorkerPool, tell: Callable[[Standing], object]
    ) -> None:
        self.job = job
        self.pool = pool
        self.tell = tell
        # One file per episode: workers and a killed coordinator never share an open file.
        self.files = EpisodeFiles(job.out / EPISODE_FOLDER)
        # The first worker that is ready tells the targets.
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
        self.run: RunInfo | None = None

    def _take_stock(self) -> None:
        """Load the episodes of earlier runs."""
        # Earlier workers are dead, so that no temporary file has a writer.
        drop_unfinished(self.files.folder)
        for entry in self._stored():
            self.configs.add(entry.run.config_id)
            self.quotas.report(outcome_of(entry.record, True), True)
        for outcome in read_tried(self.job.out / TRIED):
            # If the quota has been raised since, episodes dropped because of it must be simulated again.
            if not outcome.passes or self.quotas.would_drop(outcome):
                self.quotas.report(outcome, False)

    def _stored(self) -> list[EpisodeEntry]:
        """The episodes that are in the folder."""
        return list(entries(self.job.out)) if has_shards(self.job.out) else []

    def _start(self, number: int, deaths: int) -> None:
        self.members[number] = _Member(deaths=deaths)
        self.pool.start(number, self.job.spec, self.files.folder)

    @property
    def finished(self) -> bool:
        """Whether all episodes to keep are on the disk and no further one can be kept."""
        # The quotas count decisions, so that they may be full while an episode is still unwritten.
        if self.promised or any(
            keep for member in self.members.values() for keep in member.decided.values()
        ):
            return False
        # A full quota does not wait for running episodes, as none of them can be kept.
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
            # All at once at the first step: workers take seconds to make their environment.
            self._start(number, 0)
        for number, member in self.members.items():
            # A worker takes one request at a time, so that its death loses a known set of indices.
            if member.ready and not member.busy:
                self._assign(number, member)
        # The wait is short so that ``stopped`` is asked several times per second.
        found = self.pool.messages(PATIENCE)
        for number, message in found:
            self._hear(number, message)
        if found:
            self._decide()
            self.tell(self.standing())

    def _assign(self, number: int, member: _Member) -> None:
        indices = self._next_indices()
        # Decisions go out even when there is nothing to roll out: the worker holds their arrays in memory.
        if not indices and not member.decided:
            return
        # Told with the request, so that most episodes are written at once and not held back.
        guaranteed = self.quotas.guaranteed(max(indices, default=0))
        request = Request(
            tuple(indices),
            # They were decided once, and must be kept although the quota counts them already.
            frozenset(self.promised.intersection(indices)),
            guaranteed,
            dict(member.decided),
        )
        member.open.update(indices)
        member.busy = True
        # An episode to keep stays in ``held`` until the worker reports it as stored.
        member.held -= {index for index, keep in member.decided.items() if not keep}
        member.decided = {index: True for index, keep in member.decided.items() if keep}
        self.pool.send(number, request)

    def _next_indices(self) -> list[int]:
        indices: list[int] = []
        if self.quotas.full:
            # Of the lost episodes only the promised ones, which the quotas count, are still needed.
            self.again = sorted(self.promised.intersection(self.again))
        while len(indices) < self.job.chunk and self.again:
            # Lost episodes first and the lowest of them, since decisions wait for lower indices.
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
            case WorkerReady(run, targets):
                assert run is not None, "a worker that records tells its run"
                # Checked when the first worker is ready, as only it knows the versions of what it has loaded.
                if self.configs - {run.config_id}:
                    raise fault(
                        self.job.out,
                        "holds episodes of another configuration (made by another version of mjhab, or "
                        "with other options); choose another --out.",
                    )
                self.run = run
                self.quotas.targets = targets
                member.ready = True
                member.busy = False
            case EpisodeDone(outcome, stored, error):
                # Only deaths in a row count: a machine short of memory kills now and then.
                member.deaths = 0
                self._take(member, outcome, stored, error)
            case EpisodeStored(index):
                self._settle(member, index)
            case RequestDone():
                member.busy = False
            case WorkerFailed(kind, text):
                if kind == "storage":
                    # A full disk fails for all workers, so that none is started again.
                    raise StorageError(f"{text} Continue with `mjhab generate --resume`.")
                raise (
                    UsageError(text)
                    if kind == "usage"
                    else MjhabError(f"a worker failed:\n{text}")
                )
            case WorkerExited():
                self._bury(number, member)
            case _:
                raise AssertionError(f"{message} is none of a generation")

    def _take(
        self, member: _Member, outcome: Outcome, stored: bool, error: str = ""
    ) -> None:
        index = outcome.index
        member.open.discard(index)
        # None leaves the decision to the rule; what is on the disk is kept.
        self.quotas.report(outcome, True if stored else None)
        if stored:
            self.promised.discard(index)
            self.written += 1
        elif outcome.passes:
            member.held.add(index)
        elif error:
            # It is not logged as tried: what the policy would do in it is not known.
            self.errors[error] += 1
            # No worker will make it, and a run that waited for it would never end.
            self.promised.discard(index)
        else:
            self._log(outcome)

    def _settle(self, member: _Member, index: int) -> None:
        member.decided.pop(index, None)
        member.held.discard(index)
        self.written += 1

    def _reclaim(self, member: _Member) -> None:
        """Find episodes of a dead worker that are on the disk but were not reported."""
        decided = {index for index, keep in member.decided.items() if keep}
        for index in sorted(member.open | decided) if self.run else ():
            assert self.run is not None
            path = self.files.path_of(self.run.episode_name(self.job.spec.seed, index))
            # Episode files are renamed into place, so that one that exists is whole.
            if not path.exists():
                continue
            if index in member.open:
                # The message that told its outcome died with the worker, but the file holds the record.
                with open_shard(path) as shard:
                    record = next(iter(shard)).record
                self._take(member, outcome_of(record, True), True)
            else:
                self._settle(member, index)

    def _bury(self, number: int, member: _Member) -> None:
        """Handle a dead worker: its unwritten episodes go to other workers, and it is started again."""
        # First, so that nothing on the disk is simulated again.
        self._reclaim(member)
        lost = set(member.open)
        for index in member.held:
            # Undecided ones are open again; those decided to be dropped need no data.
            if self.quotas.forget(index):
                lost.add(index)
            elif member.decided.get(index):
                lost.add(index)
                self.promised.add(index)
        # A heap, because they go out by lowest index.
        for index in lost:
            heapq.heappush(self.again, index)
        if member.deaths + 1 >= MOST_DEATHS:
            raise MjhabError(
                f"worker {number} died {MOST_DEATHS} times without finishing an episode (its episodes: "
                f"{sorted(lost)}). Check that there is enough memory. Every episode finished before is safe."
            )
        self._start(number, member.deaths + 1)

    def _decide(self) -> None:
        for index, keep in self.quotas.decide().items():
            for member in self.members.values():
                # The quotas do not know which worker holds an episode.
                if index in member.held:
                    member.decided[index] = keep
            if not keep:
                self._log(self.quotas.outcomes[index])

    def _log(self, outcome: Outcome) -> None:
        # A line per episode and no rewriting: after a kill only the last line can be incomplete.
        with open(self.job.out / TRIED, "a", encoding="utf-8") as file:
            file.write(json.dumps(outcome.to_dict(), separators=(",", ":")) + "\n")

    def standing(self, final: bool = False) -> Standing:
        """Progress of the job; if ``final``, counted from the files on the disk."""
        outcomes = self.quotas.outcomes.values()
        # 0 without a quota, and then no total can be told.
        wanted = self.job.per_target * len(self.quotas.targets)
        passed = sum(outcome.passes for outcome in outcomes)
        # Counting files reads every header; while it runs, the counters are enough.
        if not final:
            return Standing(
                self.written,
                self.quotas.kept,
                len(outcomes),
                passed,
                wanted,
                self.quotas.labels,
            )
        stored = self._stored()
        labels = Counter(last_label(entry.record) for entry in stored)
        # A set, because packed shards hold many episodes in a file.
        size = sum(path.stat().st_size for path in {entry.path for entry in stored})
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
