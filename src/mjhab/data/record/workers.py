"""Workers that record episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from mjhab.data.record.messages import (
    EpisodeDone,
    EpisodeStored,
    Message,
    Request,
    RequestDone,
    WorkerReady,
)
from mjhab.data.record.quotas import Outcome
from mjhab.data.record.recorder import Recorder
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.facts import target_of
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import EpisodeData, RunInfo, last_label
from mjhab.data.store.episode_files import EPISODE_FOLDER, EpisodeFiles
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.storage import not_written
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.tasks.subtasks.registry import SUBTASKS

# A lack of memory may pass; an episode that kills its worker does so every time.
MOST_DEATHS = 3
"""Number of deaths of a worker, without a finished episode in between, after which its run fails."""
ALL = "all"
"""Name of the only target of whole tasks and Navigate in quotas."""


@dataclass(frozen=True)
class Stage:
    """Environment and policy of a worker.

    env: with autoreset "disabled". about: description of the policy as JSON data. targets: all targets that quotas
    count. licence: of the assets, see `provenance.describe_run`.
    """

    env: RecordedEnv
    policy: Policy
    about: Mapping[str, Any]
    targets: tuple[str, ...] = (ALL,)
    licence: str = ""


@dataclass(frozen=True)
class WorkerSpec:
    """Picklable description of a worker.

    build: makes the stage. seed: of the episodes. keep: filter, "" keeps all episodes. states, images: see `Recorder`.
    rest: folder for the episodes that do not pass the filter; None drops them.
    """

    build: Callable[[], Stage]
    seed: int
    keep: str = ""
    states: bool = True
    images: ImageFormat | None = None
    rest: Path | None = None

    @property
    def more_folders(self) -> tuple[Path, ...]:
        """See `WorkSpec`."""
        return () if self.rest is None else (self.rest,)

    def moved(self, more_folders: tuple[Path, ...]) -> WorkerSpec:
        """See `WorkSpec`."""
        return dataclasses.replace(self, rest=next(iter(more_folders), None))

    def start(self, folder: Path) -> Worker:
        """Make a worker that writes episode files to ``folder``."""
        return Worker(self, folder)


class Stopped(Exception):
    """A worker was asked to stop during a request."""


class Work(Protocol):
    """What a worker does: it is made in its process, by a `WorkSpec`."""

    @property
    def ready(self) -> WorkerReady:
        """The message of a started worker."""
        ...

    def run(
        self,
        request: Request,
        tell: Callable[[Message], object],
        stopped: Callable[[], bool],
    ) -> None:
        """Execute a request; the last message is a RequestDone.

        Raises:
            Stopped: ``stopped`` returned True.
        """
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class WorkSpec(Protocol):
    """Picklable description of the work of a worker."""

    @property
    def more_folders(self) -> tuple[Path, ...]:
        """Folders that its files go to besides that of `start`."""
        ...

    def moved(self, more_folders: tuple[Path, ...], /) -> WorkSpec:
        """The same work with other `more_folders`."""
        ...

    def start(self, folder: Path) -> Work:
        """Make it; its files go to ``folder``."""
        ...


# An exception from a sink is the one way out of a rollout within an episode.
class StopSink(Sink[RolloutEnv]):
    """Checks after every control step whether the worker should stop."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped = stopped

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Leave the rollout if the worker should stop."""
        if self._stopped():
            raise Stopped


class Worker:
    """Rolls out episodes into files. Episodes that are not yet decided on are held back in memory."""

    def __init__(self, spec: WorkerSpec, folder: Path) -> None:
        self._spec = spec
        self._stage = spec.build()
        self._filter = Filter(spec.keep) if spec.keep else None
        self._files = EpisodeFiles(folder)
        self._rest = (
            None if spec.rest is None else EpisodeFiles(spec.rest / EPISODE_FOLDER)
        )
        self._held: dict[int, EpisodeData] = {}
        self._request = Request(())
        self._tell = _nobody
        self._recorder = Recorder(
            self,
            self._stage.env,
            self._stage.about,
            keep=self._is_stored,
            states=spec.states,
            images=spec.images,
            licence=self._stage.licence,
        )

    @property
    def ready(self) -> WorkerReady:
        """The message of a started worker."""
        return WorkerReady(self._recorder.run, self._stage.targets)

    def run(
        self,
        request: Request,
        tell: Callable[[Message], object],
        stopped: Callable[[], bool],
    ) -> None:
        """Execute a request.

        Raises:
            StorageError: the disk is full.
            Stopped: ``stopped`` returned True.
        """
        self._request = request
        self._tell = tell
        for index, keep in request.decided.items():
            # A worker that was started again does not hold what its predecessor held.
            data = self._held.pop(index, None)
            if keep and data is not None:
                self._write(data, self._files)
                tell(EpisodeStored(index))
        if request.indices:
            sinks = [self._recorder, StopSink(stopped)]
            rollout(
                self._stage.env,
                self._stage.policy,
                request.indices,
                self._spec.seed,
                sinks,
            )
        tell(RequestDone())

    def append(self, data: EpisodeData) -> int:
        """Store or hold back an episode from the recorder; returns its size in the file [bytes]."""
        if not self._passes(data.record, data.run):
            assert self._rest is not None, "the recorder was not told to drop it"
            size = self._write(data, self._rest)
            # Kept aside for whoever wants the failures too; quotas do not count it.
            self._tell(EpisodeDone(outcome_of(data.record, False), False))
            return size
        outcome = outcome_of(data.record, True)
        if outcome.index in self._request.keep or self._request.guaranteed(
            outcome.target
        ):
            size = self._write(data, self._files)
            self._tell(EpisodeDone(outcome, True))
            return size
        self._held[outcome.index] = data
        self._tell(EpisodeDone(outcome, False))
        return 0

    def _write(self, data: EpisodeData, files: EpisodeFiles) -> int:
        try:
            return files.append(data)
        except OSError as error:
            raise not_written(files.path_of(data.name), error) from error

    def _passes(self, record: EpisodeRecord, run: RunInfo) -> bool:
        return self._filter is None or self._filter(record, run)

    def _is_stored(self, record: EpisodeRecord, run: RunInfo) -> bool:
        """Whether the recorder is to hand on an episode; one that it is not to is finished."""
        # With a folder for the rest, the others are stored as well.
        stored = self._rest is not None or self._passes(record, run)
        # An episode that the policy gave up has no label that could be trusted.
        if record.error or not stored:
            self._tell(EpisodeDone(outcome_of(record, False), False, record.error))
        return stored and not record.error

    def close(self) -> None:
        """Close the environment."""
        self._stage.env.close()


def _has_target(subtask: str | None) -> bool:
    """Whether the subtask has a target object or link; whole tasks and Navigate have none."""
    return bool(subtask) and not SUBTASKS[subtask].navigates


def outcome_of(record: EpisodeRecord, passes: bool) -> Outcome:
    """The part of an episode that quotas count. Each object or link has its own quota; chains and Navigate have one."""
    target = target_of(record) if _has_target(record.subtask) else ALL
    return Outcome(record.index, target, last_label(record), passes, record.skipped_homes)


def _nobody(message: Message) -> None:
    """Ignore a message."""
