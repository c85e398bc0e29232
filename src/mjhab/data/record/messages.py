"""The messages between the coordinator of a generation and its workers."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field

from mjhab.core.errors import UsageError
from mjhab.data.record.quotas import GuaranteedTargets, Outcome
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.storage import StorageError
from mjhab.rollout.records import EpisodeRecord


@dataclass(frozen=True)
class Request:
    """Work for a worker.

    indices: episodes to roll out. keep: those to keep in any case. guaranteed: targets whose episodes are certainly
    kept. decided: whether to keep episodes that the worker holds back in memory, by index.
    """

    indices: tuple[int, ...]
    keep: frozenset[int] = frozenset()
    guaranteed: GuaranteedTargets = field(default_factory=lambda: GuaranteedTargets(True))
    decided: Mapping[int, bool] = field(default_factory=dict)


@dataclass(frozen=True)
class WorkerReady:
    """A worker has started. run: description of its episodes' source, if it records. targets: see `Stage`."""

    run: RunInfo | None = None
    targets: tuple[str, ...] = ()


@dataclass(frozen=True)
class EpisodeDone:
    """An episode is finished. stored: it is on the disk; otherwise the worker holds it back or has dropped it.

    error: why the policy could not finish it, so that it was dropped; "" if it could.
    """

    outcome: Outcome
    stored: bool
    error: str = ""


@dataclass(frozen=True)
class EpisodeStored:
    """An episode that was held back is on the disk."""

    index: int


@dataclass(frozen=True)
class EpisodeEvaluated:
    """An episode is finished, and nothing but its record is kept. film_problem: why films are missing, or None."""

    record: EpisodeRecord
    film_problem: str | None


@dataclass(frozen=True)
class RequestDone:
    """A request is finished."""


@dataclass(frozen=True)
class WorkerFailed:
    """A worker failed with an error. kind: "usage", "storage" or "error"."""

    kind: str
    text: str


@dataclass(frozen=True)
class WorkerExited:
    """A worker has ended: it was killed, crashed, or stopped on request."""


Message = (
    WorkerReady
    | EpisodeDone
    | EpisodeStored
    | EpisodeEvaluated
    | RequestDone
    | WorkerFailed
    | WorkerExited
)


def failure(error: Exception) -> WorkerFailed:
    """Convert an exception to a message."""
    if isinstance(error, StorageError):
        return WorkerFailed("storage", str(error))
    if isinstance(error, UsageError):
        return WorkerFailed("usage", str(error))
    return WorkerFailed("error", traceback.format_exc())
