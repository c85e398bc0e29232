"""Whether the files of a data set are those that it lists."""

from __future__ import annotations

from pathlib import Path

from mjhab.core.errors import fault
from mjhab.core.files.checksums import differences, listed_in
from mjhab.evaluation.publishing.about import ABOUT, MAKING

EXPORTED = "meta/files.json"
"""List of the files of an export."""
POLICY = "policy.json"
"""Record and list of a published policy."""
LISTS = (ABOUT, EXPORTED, POLICY)


def list_of(folder: Path) -> Path:
    """The file that lists those of a data set or an export.

    Raises:
        UsageError: the folder is neither, or not finished.
    """
    for name in LISTS:
        if (folder / name).is_file():
            return folder / name
    if (folder / MAKING).is_file():
        raise fault(
            folder, "is not finished: the same `mjhab dataset make` goes on with it."
        )
    raise fault(
        folder,
        f"holds neither {ABOUT} nor {EXPORTED}: make a data set by `mjhab dataset make` or `mjhab export lerobot`.",
    )


def check_set(folder: Path) -> list[str]:
    """What differs between the files of a data set or an export and its list, one line each.

    Raises:
        UsageError: the folder has no list, or a damaged one.
    """
    return differences(folder, listed_in(list_of(folder)))
