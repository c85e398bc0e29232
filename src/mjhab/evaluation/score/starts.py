"""Writing the start digests of a track; needed once after every change of the episodes' start states."""

from __future__ import annotations

import json

import numpy as np

from mjhab.core.files.cache import write_atomic
from mjhab.evaluation.evaluate import EvalSpec, make_env
from mjhab.evaluation.score.manifest import STARTS_FILE, ScoreRow, manifest, start_digest


def write_starts(track: str, split: str, worlds: int, threads: int) -> int:
    """Write the missing start digests of a track on a split into the package; returns how many are new.

    Rows that the file already has stay unchanged: delete them from the file after a change of the start states.

    Raises:
        UsageError: the track or split is unknown.
    """
    asked = manifest(track, split)
    content = (
        json.loads(STARTS_FILE.read_text(encoding="utf-8"))
        if STARTS_FILE.exists()
        else {}
    )
    known = content.setdefault(f"{track}/{split}", {})
    count = 0
    for row in asked.rows:
        if row.name in known:
            continue
        known[row.name] = starts_of(row, split, asked.seed, worlds, threads)
        count += row.episodes
        _write(json.dumps(content, indent=0, sort_keys=True) + "\n")
    return count


def _write(text: str) -> None:
    write_atomic(
        STARTS_FILE, lambda temporary: temporary.write_text(text, encoding="utf-8")
    )


def starts_of(
    row: ScoreRow, split: str, seed: int, worlds: int, threads: int
) -> list[str]:
    """Start digests of a row's episodes, by index."""
    spec = EvalSpec.of(
        policy="zero",
        task=row.task,
        subtask=row.subtask or None,
        target=row.target or None,
        episodes=row.episodes,
        worlds=worlds,
        seed=seed,
        split=split,
        threads=threads,
    )
    env = make_env(spec, {})
    digests = []
    try:
        for first in range(0, row.episodes, env.num_envs):
            indices = np.arange(first, min(first + env.num_envs, row.episodes))
            mask = np.arange(env.num_envs) < len(indices)
            env.reset(seed=seed, options={"episode": indices, "reset_mask": mask})
            digests += [start_digest(env, w) for w in range(len(indices))]
    finally:
        env.close()
    return digests
