"""Writing the start digests of a track; needed once after every change of the episodes' start states."""

from __future__ import annotations

import json

import numpy as np

from mjhab.core.files.cache import write_text
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.evaluation.parts import make_env
from mjhab.evaluation.score.manifest import (
    STARTS_FILE,
    Manifest,
    ScoreHomes,
    ScoreRow,
    manifest,
    start_digest,
    starts_key,
)
from mjhab.evaluation.score.run import row_options
from mjhab.scenes.pack_source import Assets


def write_starts(
    track: str, split: str, worlds: int, threads: int, assets: Assets = "builtin"
) -> int:
    """Write the missing start digests of a track on a split into the package; returns how many are new.

    Rows that the file already has stay unchanged: delete them from the file after a change of the start states.

    Raises:
        UsageError: the track or split is unknown, or there is no such pack.
    """
    homes = ScoreHomes.of(assets)
    asked = manifest(track, split, homes=homes)
    content = (
        json.loads(STARTS_FILE.read_text(encoding="utf-8"))
        if STARTS_FILE.exists()
        else {}
    )
    known = content.setdefault(starts_key(track, split, homes), {})
    count = 0
    for row in asked.rows:
        if row.name in known:
            continue
        known[row.name] = starts_of(asked, row, worlds, threads, assets)
        count += asked.count(row)
        # After every row, since a kill should cost one at most.
        _write(json.dumps(content, indent=0, sort_keys=True) + "\n")
    return count


def _write(text: str) -> None:
    write_text(STARTS_FILE, text)


def starts_of(
    asked: Manifest,
    row: ScoreRow,
    worlds: int,
    threads: int,
    assets: Assets = "builtin",
) -> list[str]:
    """Start digests of a row's episodes, seed by seed, by index."""
    return [
        digest
        for seed in asked.seeds
        for digest in _starts_of(asked, row, seed, worlds, threads, assets)
    ]


def _starts_of(
    asked: Manifest, row: ScoreRow, seed: int, worlds: int, threads: int, assets: Assets
) -> list[str]:
    spec = EvalSpec.of(
        policy="zero",
        **row_options(asked, row, seed, assets),
        worlds=worlds,
        threads=threads,
    )
    env = make_env(spec, {"profile": asked.profile})
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
