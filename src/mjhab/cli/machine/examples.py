"""``mjhab examples``: copies of the example plugins and homes, to try and to change."""

from __future__ import annotations

import filecmp
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mjhab.cli.output import Listing, report
from mjhab.core.errors import fault, wrong_value
from mjhab.core.files.cache import write_atomic
from mjhab.core.typed.bounds import Output
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options

# By path and not as a package: importing an example would register what it adds.
SOURCE = Path(__file__).parents[2] / "examples"
"""The examples in the package; their files are data, nothing imports them."""


@dataclass(frozen=True)
class Example:
    """What an example adds to mjhab, and a command that uses it; "{}" in it is the folder of the examples."""

    about: str
    command: str
    needs: str = ""
    """What must be installed beside mjhab, as pip is told it; "" for nothing."""


EXAMPLES = {
    "push": Example(
        "a subtask with success, labels, reward and an expert",
        "MJHAB_PLUGINS={}/push mjhab eval --task push_objects --subtask push --episodes 4 --out runs/push",
    ),
    "clear_table.py": Example(
        "a household task of the subtasks that there are",
        "MJHAB_PLUGINS={}/clear_table.py mjhab eval --task clear_table --episodes 4 --out runs/clear",
    ),
    "reward.py": Example(
        "a reward: Pick, paid for a soft grip",
        "MJHAB_PLUGINS={}/reward.py mjhab envs describe mjhab/GentlePickSubtaskTrain-v1",
    ),
    "robot": Example(
        "a robot in one file",
        "MJHAB_PLUGINS={}/robot/boxy.py mjhab eval --robot boxy --subtask pick --episodes 4 --out runs/boxy",
    ),
    "control_mode.py": Example(
        "a control mode",
        "MJHAB_PLUGINS={}/control_mode.py mjhab eval --subtask pick --policy zero --control pd_joint_pos_smooth "
        "--episodes 2 --out runs/smooth",
    ),
    "policy_server.py": Example(
        "a policy server without mjhab, for `mjhab eval --policy ws://localhost:8000`",
        "python {}/policy_server.py 8000",
        needs="websockets msgpack",
    ),
    "grpo.py": Example(
        "group-relative policy optimization of a small transformer",
        "python {}/grpo.py --updates 100",
        needs="torch",
    ),
    "mug": Example(
        "an object from a GLB file",
        "MJHAB_PLUGINS={}/mug/mug.py mjhab eval --task tidy_house --subtask pick --target mug --episodes 4 "
        "--out runs/mug",
    ),
    "home": Example(
        "homes as files, and a pack of them",
        "mjhab homes render cottage --assets {}/home/cottage.json --view inside --out cottage.png",
    ),
}
"""File or folder in SOURCE to what it is."""


@dataclass(frozen=True)
class ExamplesSpec:
    """Copy the examples of plugins and homes into a folder, and show how to try them.

    `mjhab examples`

    Files that are there already are kept; files with other content are refused.
    """

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()] = Path("examples")
    """Folder to copy them into."""

    def __post_init__(self) -> None:
        take_options(self)


def run_examples(spec: ExamplesSpec, json: bool) -> int:
    """Copy the examples, and print what they are and how to try them; returns 0.

    Raises:
        UsageError: the folder has files of the same names with other content.
    """
    written = copy_examples(spec.out)
    folder = shlex.quote(str(spec.out))
    found = {name: entry.command.format(folder) for name, entry in EXAMPLES.items()}
    rows = [(name, entry.about) for name, entry in EXAMPLES.items()]
    report(
        json,
        {"folder": str(spec.out), "written": written, "commands": found},
        Listing(f"examples in {spec.out}", ("example", "what it adds"), rows),
        "To try them:",
        *found.values(),
    )
    return 0


def copy_examples(folder: Path) -> int:
    """Copy the examples into a folder; returns the number of files that were not there yet.

    Raises:
        UsageError: the folder has files of the same names with other content; nothing is written then.
    """
    places = {path: folder / path.relative_to(SOURCE) for path in _files()}
    if folder.exists() and not folder.is_dir():
        raise wrong_value("out", str(folder), "a folder, not a file")
    changed = [
        str(p) for f, p in places.items() if p.exists() and not filecmp.cmp(f, p, False)
    ]
    # Before anything is written: a half-copied folder would mix two versions.
    if changed:
        raise fault(
            folder,
            f"has files that differ from the examples: {', '.join(changed)}. They are not overwritten; "
            "choose another --out.",
        )
    new = {file: place for file, place in places.items() if not place.exists()}
    for file, place in new.items():
        _copy(file, place)
    return len(new)


def _copy(file: Path, place: Path) -> None:
    """Copy a file whole or not at all.

    Raises:
        OSError: it cannot be written; the error names ``place``, where that of the system names the source or nothing.
    """
    try:
        content = file.read_bytes()
        write_atomic(place, lambda temporary: temporary.write_bytes(content))
    except OSError as error:
        # The error names the temporary file, which a user has never seen.
        raise OSError(error.errno, error.strerror, str(place)) from error


def _files() -> list[Path]:
    paths = sorted(SOURCE.rglob("*"))
    # A run of an example leaves compiled files beside it.
    return [path for path in paths if path.is_file() and "__pycache__" not in path.parts]
