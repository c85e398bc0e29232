"""``python -m mjhab.reports.students FILE.json RUN EVALUATION ...``: table of training cost and success of students.

RUN is a folder of `mjhab train dagger`, EVALUATION a folder of `mjhab eval` of its checkpoint. Rows of the same student
(task, subtask, target, preset, seed) in the file are replaced, others stay.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.reading import read_json_object
from mjhab.core.machine import cores
from mjhab.data.store.reading import episodes
from mjhab.data.store.shard import last_label
from mjhab.reports.metrics import label_counts, mean, wilson
from mjhab.reports.paper import paper_success
from mjhab.rollout.store import read_records, write_text

SECONDS_PER_MINUTE = 60.0
IDENTITY = ("task", "subtask", "target", "preset", "seed")
"""Keys that identify a row."""


def student_row(run: Path, evaluation: Path) -> dict[str, Any]:
    """One row: training data, training cost and success of a student.

    Raises:
        UsageError: a folder is not such a run, or the evaluation is of another checkpoint.
    """
    config = read_json(run / "config.json")
    summary = read_json(run / "summary.json")
    judged = read_json(evaluation / "config.json")
    records = read_records(evaluation)
    scene = config["scene"]
    digest = hashlib.sha256((run / "student.safetensors").read_bytes()).hexdigest()
    if judged.get("policy_sha256") != digest:
        raise UsageError(f"{evaluation} is not an evaluation of {run / 'student.safetensors'}.")
    return {
        **{name: scene[name] for name in ("task", "subtask", "target", "assets")},
        "preset": config["config"]["student"]["preset"],
        "seed": config["seed"],
        "profile": judged["policy_profile"],
        "training": training(run, config, summary),
        "evaluation": {
            **{
                name: judged[name]
                for name in ("profile", "split", "seed", "horizon", "policy_sha256")
            },
            "episodes": len(records),
            "success_once": mean(record.success_once for record in records),
            "success_once_interval": wilson(
                sum(record.success_once for record in records), len(records)
            ),
            "success_at_end": mean(record.success_at_end for record in records),
            "success_at_end_interval": wilson(
                sum(record.success_at_end for record in records), len(records)
            ),
            "labels": label_counts(last_label(record) for record in records),
        },
        "paper_success_once": paper_success(
            scene["task"], scene["subtask"], judged["split"], scene["target"]
        ),
    }


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file of a run folder.

    Raises:
        UsageError: the file does not exist.
    """
    if not path.is_file():
        raise UsageError(
            f"{path} does not exist: give folders of `mjhab train` and `mjhab eval`, in turn."
        )
    return read_json_object(path)


def training(run: Path, config: dict[str, Any], summary: dict[str, Any]) -> dict[str, Any]:
    """Training data and training cost of a student."""
    data = []
    commits = set()
    for folder in sorted((run / "data").glob("round_*")):
        found = list(episodes(folder))
        commits |= {episode.run.commit for episode in found}
        data.append({"episodes": len(found), "frames": sum(episode.steps for episode in found)})
    metrics = [
        json.loads(line)
        for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    ]
    return {
        "split": config["scene"]["split"],
        "algorithm": config["algorithm"],
        "rounds": data,
        "episodes": sum(part["episodes"] for part in data),
        "frames": sum(part["frames"] for part in data),
        "updates": summary["steps"],
        "samples": summary["samples"],
        "cpu_minutes": round(summary["cpu_seconds"] / SECONDS_PER_MINUTE, 1),
        "minutes": round(summary["seconds"] / SECONDS_PER_MINUTE, 1),
        "cores": cores(),
        "success_once_on_the_way": [
            row["success_once"] for row in metrics if "success_once" in row
        ],
        "commits": sorted(commits),
    }


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows to the file; rows of the same students are replaced."""
    earlier = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.is_file() else []
    table = {tuple(row[name] for name in IDENTITY): row for row in [*earlier, *rows]}
    content = {
        "what": "students: policies that act from depth images and state",
        "rows": list(table.values()),
    }
    write_text(path, json.dumps(content, indent=1) + "\n")


def main(words: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    path = Path(words[0])
    places = [Path(word) for word in words[1:]]
    try:
        rows = [
            student_row(run, judged) for run, judged in zip(places[::2], places[1::2], strict=True)
        ]
    except MjhabError as error:
        print(f"mjhab: {error}", file=sys.stderr)
        return 1
    write_rows(path, rows)
    for row in rows:
        judged = row["evaluation"]
        low, high = judged["success_once_interval"]
        print(
            f"{row['task']} {row['subtask']} {row['target']}: {100 * judged['success_once']:.1f} % "
            f"({100 * low:.0f} to {100 * high:.0f} %) of {judged['episodes']}, at end "
            f"{100 * judged['success_at_end']:.1f} %; {row['training']['cpu_minutes']} CPU minutes"
        )
    return 0


if __name__ == "__main__":
    if len(sys.argv) < 4 or len(sys.argv) % 2:
        sys.exit(__doc__)
    sys.exit(main(sys.argv[1:]))
