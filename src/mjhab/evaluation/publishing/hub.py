"""Data sets and policies to and from the hub; what is pushed or pulled has the files that it lists, or is refused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.assets.hub import download, list_files
from mjhab.assets.uploads import upload
from mjhab.core.errors import UsageError, fault
from mjhab.core.files.checksums import README, differences, listed_in, published
from mjhab.core.files.reading import read_json_object
from mjhab.evaluation.publishing.about import ABOUT
from mjhab.evaluation.publishing.card import card
from mjhab.evaluation.publishing.check import LISTS, list_of
from mjhab.evaluation.publishing.spec import DatasetPushSpec, PullSpec

_MOST_SHOWN = 3


@dataclass(frozen=True)
class Pushed:
    """What was pushed. address: of the commit. files: their number. bytes: their size."""

    address: str
    files: int
    bytes: int


@dataclass(frozen=True)
class Pulled:
    """What was pulled. commit: of the repository."""

    path: Path
    commit: str
    files: int


def push_dataset(spec: DatasetPushSpec) -> Pushed:
    """Upload a data set or an export with its card, in one commit.

    Raises:
        UsageError: there is no token, the folder is no data set, or its files are not those that it lists.
        TransferError: see `upload`.
    """
    return push_folder(spec.folder, spec.repo, "dataset", private=spec.private)


def push_folder(folder: Path, repo: str, kind: str, private: bool = False) -> Pushed:
    """Upload the files that a folder lists, their list and the card.

    Raises:
        UsageError: see `push_dataset`.
        TransferError: see `upload`.
    """
    describing = list_of(folder)
    listed = listed_in(describing)
    # Before anything is sent: a commit cannot be taken back from those who pulled it.
    _refuse_differences(folder, differences(folder, listed))
    if describing.name == ABOUT and not (folder / README).is_file():
        text = card(read_json_object(describing))
        (folder / README).write_text(text, encoding="utf-8")
    names = [*listed, describing.relative_to(folder).as_posix(), README]
    files = {name: folder / name for name in names if (folder / name).is_file()}
    about = f"mjhab: {folder.resolve().name}"
    address = upload(repo, kind, files, about, private)
    size = int(np.sum([path.stat().st_size for path in files.values()]))
    return Pushed(address, len(files), size)


def pull(spec: PullSpec, kind: str) -> Pulled:
    """Download a data set, an export or a policy, and compare its files with those that it lists.

    Raises:
        UsageError: the folder holds something else, or what came is not what is listed.
        TransferError: see `hub.download`; the same call continues.
    """
    found = list_files(spec.repo, spec.revision, kind)
    describing = next((name for name in LISTS if name in found.files), None)
    if describing is None:
        raise fault(
            found.address,
            f"holds none of {', '.join(LISTS)}: it was not pushed by mjhab.",
        )
    # Files of another set in the folder would become part of this one.
    there = [name for name, _ in published(spec.out)] if spec.out.is_dir() else []
    foreign = [name for name in there if name not in found.files]
    if foreign:
        raise fault(
            spec.out,
            f"holds {foreign[0]}, which {spec.repo} has not; name a new folder as --out.",
        )
    download(found, [*found.files], spec.out)
    listed = listed_in(spec.out / describing)
    _refuse_differences(spec.out, differences(spec.out, listed))
    return Pulled(spec.out, found.commit, len(found.files))


def _refuse_differences(folder: Path, wrong: list[str]) -> None:
    """Refuse files that are not as listed.

    Raises:
        UsageError: names some of them.
    """
    if wrong:
        more = f" and {len(wrong) - _MOST_SHOWN} more" if len(wrong) > _MOST_SHOWN else ""
        raise UsageError(
            f"{folder} is not what its card tells: {'; '.join(wrong[:_MOST_SHOWN])}{more}. `mjhab dataset check "
            f"{folder}` lists all; make the set again, or pull it anew."
        )
