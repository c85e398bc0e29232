"""What is wrong with the episodes of a shard: missing or inconsistent parts, changed bytes, broken pictures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from mjhab.core.files.reading import reason
from mjhab.data.store.episode_data import (
    ending_problems,
    episode_digest,
    last_label,
    run_id,
    style_text,
    unnamed_actors,
)
from mjhab.data.store.images import check_frame
from mjhab.data.store.reading import RecordedEpisode, Shard
from mjhab.data.store.schema import DamagedError, column_widths, problems


def problems_in(shard: Shard, name: str) -> list[str]:
    """Describe what is wrong with an episode of a shard, even if it cannot be opened; empty if nothing is."""
    try:
        return episode_problems(shard.episode(name))
    except DamagedError as error:
        # h5py's own error names the part that is damaged.
        cause = error.__cause__ or error
        return [f"cannot be read ({type(cause).__name__}: {reason(cause)})"]


def episode_problems(episode: RecordedEpisode) -> list[str]:
    """Describe missing or inconsistent parts and changed bytes; empty if the episode is undamaged.

    Raises:
        DamagedError: it cannot be read.
    """
    with episode.reading():
        arrays, columns = episode.contents()
        wrong = problems(
            arrays,
            episode.steps,
            others=True,
            schema=episode.schema,
            widths=column_widths(episode.run.layout, columns),
            absent=episode.run.absent,
        )
        # Only of arrays whose types are right: others would raise here.
        wrong = wrong or unnamed_actors(arrays, episode.actors)
        if not wrong and episode_digest(arrays) != episode.attributes["digest"]:
            wrong.append("its bytes are not those that were written (digest)")
        # Pictures last, since checking them takes the longest.
        return wrong or _contradictions(episode) or _picture_problems(arrays)


def refuse_damage(episode: RecordedEpisode) -> None:
    """Check a whole episode before other files are made from it.

    Raises:
        DamagedError: the episode is damaged; the message says how.
    """
    wrong = episode_problems(episode)
    if wrong:
        raise DamagedError(
            f"episode {episode.name} of {episode.shard.path} is damaged: {'; '.join(wrong)}. Remove it with: "
            f"mjhab data repair {episode.shard.path}"
        )


def _contradictions(episode: RecordedEpisode) -> list[str]:
    """Describe where record, attributes and run of an episode contradict each other."""
    record = episode.record
    attributes = episode.attributes
    expected = {
        "seed": record.seed,
        "index": record.index,
        "home": record.home,
        "label": last_label(record),
        "success": record.success_once,
        "steps": record.steps,
        "style": style_text(record),
    }
    wrong = [
        f"its record has {name} {value!r}, its group {attributes[name]!r}"
        for name, value in expected.items()
        if name in attributes and attributes[name] != value
    ]
    wrong += ending_problems(attributes["ending"])
    if run_id(episode.run_data) != attributes["run"]:
        wrong.append("what made it (its run) is not what was written")
    if episode.run.episode_name(record.seed, record.index) != episode.name:
        wrong.append(
            f"its record is that of episode {record.index} of seed {record.seed}"
        )
    return wrong


def _picture_problems(arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Describe the first frame of each camera that is no picture, or has another size than the frames before it."""
    found = []
    for path, ends in arrays.items():
        folder, _, name = path.rpartition("/")
        if name != "ends" or not path.startswith("images/"):
            continue
        data = arrays[f"{folder}/bytes"]
        sizes = set()
        for t, (start, end) in enumerate(itertools.pairwise([0, *ends.tolist()])):
            try:
                sizes.add(
                    check_frame(data[start:end].tobytes(), folder.rpartition("/")[2])
                )
            except ValueError as error:
                found.append(f"frame {t} of {folder}: {error}")
                # After a broken frame the ends of the others cannot be trusted.
                break
        if len(sizes) > 1:
            found.append(f"the frames of {folder} have {len(sizes)} different sizes")
    return found
