"""A data set to generate: the job, its folder, and how far it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjhab.core.errors import fault
from mjhab.core.files.cache import write_text
from mjhab.core.files.reading import parse_json, read_bytes, reason
from mjhab.core.files.run_folder import RunFolder
from mjhab.data.record.quotas import Outcome
from mjhab.data.record.workers import WorkerSpec
from mjhab.data.store.episode_files import GENERATION_CONFIG
from mjhab.data.store.places import entries, has_shards

TRIED = "tried.jsonl"


class DataFolder(RunFolder):
    """The folder of a data set that is generated."""

    CONFIG_FILE = GENERATION_CONFIG
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
    keep, 0 without a quota. labels: of the kept episodes. complete: the job is finished. bytes: size of their files.
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


def tried_in(folder: Path) -> int:
    """Number of episodes that earlier runs of a job have tried in its folder, kept or not."""
    stored = entries(folder) if has_shards(folder) else ()
    return len(read_tried(folder / TRIED)) + sum(1 for _ in stored)


def read_tried(path: Path) -> list[Outcome]:
    """Read the episodes that were tried and not kept. An incomplete last line is removed from the file."""
    if not path.exists():
        return []
    try:
        # Kept, because the missing end of the last line is what shows a kill.
        lines = read_bytes(path).decode("utf-8").splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise fault(path, f"damaged ({reason(error)}); choose another --out.") from error
    whole = [line for line in lines if line.endswith("\n")]
    # Else the next append would continue the torn line.
    if whole != lines:
        write_text(path, "".join(whole))
    try:
        return [Outcome.from_dict(parse_json(line)) for line in whole]
    except (ValueError, TypeError) as error:
        raise fault(path, f"damaged ({reason(error)}); choose another --out.") from error
