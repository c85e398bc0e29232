"""Trained policies for the hub: the checkpoints, a list of them with hashes, and a card made of their records."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjhab.core.errors import fault
from mjhab.core.files.checksums import KEY, README, list_files
from mjhab.core.version import __version__
from mjhab.evaluation.publishing.check import POLICY
from mjhab.learning.checkpoint import SUFFIX, load_checkpoint, student_of
from mjhab.learning.configs import to_plain
from mjhab.learning.observation.backbone import COPY
from mjhab.learning.runs.run import STUDENT

ASSIGNED_FILE = "policies.json"
"""Which policy of a folder acts in which subtask, if the folder tells."""
_MOST_TOLD = 300
"""Longest value of a record that a card shows [characters]."""


def gather(policy: Path, folder: Path, licence: str = "") -> None:
    """Fill a folder with a policy as it is published: checkpoints, `POLICY` with their list, and README.md.

    Args:
        policy: a checkpoint, or a folder of training runs.
        folder: an empty folder.
        licence: as the hub names it; "" if none is told.

    Raises:
        UsageError: there is no checkpoint, or one is damaged or no student.
    """
    told = {}
    for name, path in _checkpoints(policy).items():
        saved = load_checkpoint(path)
        # Builds the network once: what cannot act should not be published.
        student_of(path, saved)
        told[name] = {
            "about": dict(saved.about),
            "student": to_plain(saved.config),
        }
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / name)
        if saved.layout.backbone:
            copy = (folder / name).with_name(COPY)
            # Under the one name by which a checkpoint finds it.
            shutil.copyfile(saved.config.inputs.backbone, copy)
    if policy.is_dir() and (policy / ASSIGNED_FILE).is_file():
        shutil.copyfile(policy / ASSIGNED_FILE, folder / ASSIGNED_FILE)
    # Before `POLICY` and the card are written, which cannot hold their own hash.
    files = list_files(folder, frozenset())
    record = {
        "format": "mjhab-policy",
        "mjhab": __version__,
        "policies": told,
        KEY: files,
    }
    (folder / POLICY).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    (folder / README).write_text(policy_card(record, licence), encoding="utf-8")


def _checkpoints(policy: Path) -> dict[str, Path]:
    """The students to publish, by their path in the repository."""
    if not policy.is_dir():
        return {STUDENT: policy}
    found = {
        path.relative_to(policy).as_posix(): path
        for path in sorted(policy.rglob(STUDENT))
    }
    if not found:
        raise fault(policy, f"holds no {STUDENT} of `mjhab train`.")
    return found


def policy_card(record: Mapping[str, Any], licence: str) -> str:
    """Text of README.md; ``record``: content of `POLICY`."""
    policies = record["policies"]
    first = next(iter(policies))
    head = [f"license: {licence}"] if licence else []
    head += [
        "library_name: mjhab",
        "pipeline_tag: robotics",
        "tags: [robotics, mobile-manipulation, mjhab]",
    ]
    use = first if len(policies) == 1 else ""
    parts = [
        "\n".join(["---", *head, "---"]),
        f"# {len(policies)} {'policy' if len(policies) == 1 else 'policies'} of mjhab {record['mjhab']}",
        "```bash\n"
        "mjhab policy pull USER/NAME --out policies/this\n"
        f"mjhab eval --policy policies/this{'/' if use else ''}{use} --episodes 20 --out runs/this\n"
        "```",
        *(f"## {name}\n\n{_about(each)}" for name, each in policies.items()),
        f"Weights are safetensors (`*{SUFFIX}`); `{POLICY}` holds the whole record and the SHA-256 of every file.",
    ]
    return "\n\n".join(parts) + "\n"


def _about(told: Mapping[str, Any]) -> str:
    rows = [
        f"| {name} | {_cell(value)} |"
        for part in ("about", "student")
        for name, value in sorted(told[part].items())
    ]
    return "\n".join(["| | |", "|---|---|", *rows])


def _cell(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    # A bar or a line break would end the cell.
    text = " ".join(text.replace("|", r"\|").split())
    return text if len(text) <= _MOST_TOLD else f"{text[:_MOST_TOLD]} ..."
