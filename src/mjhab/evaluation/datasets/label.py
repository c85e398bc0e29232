"""Labels of recorded episodes by the present rules. `label` is `mjhab.label`; ``mjhab label`` calls `run_label`."""

from __future__ import annotations

from typing import Any

from mjhab.data.select.relabel import Relabelled, relabel_shards
from mjhab.evaluation.datasets.specs import LabelSpec, PlacesLike


def label(path: PlacesLike, **options: Any) -> Relabelled:
    """Recompute labels and events of recorded episodes from their signals, as ``mjhab label`` does.

    >>> import mjhab
    >>> made = mjhab.generate("zero", subtask="close", episodes=1, horizon=5, out="runs/close")
    >>> found = mjhab.label("runs/close")
    >>> found.episodes, found.subtasks, found.changes
    (1, 1, ())

    Args:
        path: a shard, a folder of shards, or several of them.
        **options: fields of `LabelSpec`: ``write=True`` writes the new labels into the shards.

    Returns:
        Numbers of episodes and subtasks, and the changes by name of the episode.

    Raises:
        UsageError: an option is unknown or invalid, or there are no shards.
        StorageError: the disk is full.
        DamagedError: signals of an episode are not those of its record.
    """
    return run_label(LabelSpec.of(path, **options))


def run_label(spec: LabelSpec) -> Relabelled:
    """Recompute labels and events of the episodes of a specification.

    Raises:
        UsageError, StorageError, DamagedError: see `label`.
    """
    return relabel_shards(spec.places, spec.write)
