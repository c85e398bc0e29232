"""Table of training cost and success of students: ``python -m mjhab.reports.students FILE.json RUN EVALUATION ...``.

RUN is a folder of `mjhab train`, or several joined by "+" whose students act together; EVALUATION is a folder of
`mjhab eval` of their checkpoints, or of the compact ones next to them. With - for RUN the row of the file for the same
task, subtask, target, image size and asset pack, of seed 0, keeps its training and gets the evaluation. Rows of the
same student (`IDENTITY`) are replaced, others stay.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import MjhabError, UsageError, fault
from mjhab.core.files.cache import write_json
from mjhab.core.files.reading import read_json_object
from mjhab.core.machine import cores
from mjhab.core.progress import say
from mjhab.core.version import __version__
from mjhab.data.store.episode_data import last_label
from mjhab.data.store.places import episodes
from mjhab.reports.compared.trainings import FINAL, SECONDS_PER_MINUTE, read_metrics
from mjhab.reports.metrics import label_counts, mean, wilson
from mjhab.reports.paper import paper_success
from mjhab.rollout.store import read_records

IDENTITY = tuple("task subtask target assets preset image_size views seed".split())
"""Keys that identify a row; a row without ``views`` sees whole images."""
WHOLE = "whole"
"""Images as the cameras take them."""
AND = "+"
"""Between the runs of students that act together."""
KEEP = Path("-")
"""In place of a run: the training of the row stays as it is."""


def student_row(run: Path, evaluation: Path) -> dict[str, Any]:
    """One row: training data, training cost and success of a student.

    Raises:
        UsageError: a folder is not such a run, or the evaluation is of another checkpoint.
    """
    runs = [Path(part) for part in str(run).split(AND)]
    config = read_json(runs[0] / "config.json")
    judged = read_json(evaluation / "config.json")
    if judged.get("policy_sha256") not in _digests(runs):
        raise fault(evaluation, f"not an evaluation of a checkpoint in {run}.")
    trained = [training(one) for one in runs]
    # The config of a reinforcement run is that of its student.
    student = config["config"].get("student", config["config"])
    return {
        **{name: judged[name] or "" for name in ("task", "subtask", "target")},
        "assets": pack_name(judged["assets"]) + _walls_of(config["scene"]),
        "preset": student["preset"],
        "image_size": student["inputs"]["image_size"],
        "views": views(student["inputs"]),
        "seed": config["seed"],
        "profile": judged["policy_profile"],
        "training": trained[0] | {"members": len(runs)} | _sums(trained),
        **evaluated(judged, evaluation),
    }


def views(inputs: Mapping[str, Any]) -> str:
    """What the images of a student show: whole images, views of the target, or both; see `configs.InputConfig`."""
    target = bool(inputs.get("target_views", False))
    whole = bool(inputs.get("whole_views", True))
    return " + ".join(
        name for name, shown in ((WHOLE, whole), ("target", target)) if shown
    )


def judged_row(rows: Sequence[dict[str, Any]], evaluation: Path) -> dict[str, Any]:
    """The row of the student that an evaluation judged, with its numbers.

    Raises:
        UsageError: the folder is not such a run, or not one row of ``rows`` is of this student.
    """
    judged = read_json(evaluation / "config.json")
    # Students without images have size 0 in the table.
    size = judged["env"]["camera_size"] if judged["env"]["obs_mode"] != "state" else 0
    wanted = {name: judged[name] or "" for name in ("task", "subtask", "target")}
    wanted |= {"image_size": size, "assets": pack_name(judged["assets"]), "seed": 0}
    found = [row for row in rows if wanted.items() <= row.items()]
    if len(found) != 1:
        raise UsageError(
            f"{len(found)} rows are of {'/'.join(map(str, wanted.values()))}, not one."
        )
    return {**found[0], **evaluated(judged, evaluation)}


def pack_name(assets: str | Mapping[str, Any]) -> str:
    """Name of a pack in a row: its folder, and the stage if it is not the scenes' own (none where that is missing)."""
    given = {"place": assets} if isinstance(assets, str) else assets
    stage = given.get("stage", "own")
    return Path(given["place"]).name + ("" if stage == "own" else f"?stage={stage}")


def _walls_of(scene: Mapping[str, Any]) -> str:
    """What a row adds to the name of the pack if homes had walls beside doors in training."""
    assets = scene.get("assets", "builtin")
    walls = 0 if isinstance(assets, str) else assets.get("door_walls", 0)
    return f"?door_walls={walls}" if walls else ""


def evaluated(judged: dict[str, Any], evaluation: Path) -> dict[str, Any]:
    """The part of a row that an evaluation with the config ``judged`` gives."""
    records = read_records(evaluation)
    return {
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
            judged["task"], judged["subtask"], judged["split"], judged["target"] or ""
        ),
    }


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file of a run folder.

    Raises:
        UsageError: the file does not exist.
    """
    if not path.is_file():
        raise fault(
            path,
            "does not exist: give folders of `mjhab train` and `mjhab eval`, in turn.",
        )
    return read_json_object(path)


def _digests(runs: Sequence[Path]) -> set[str]:
    """Hashes of the policies that the checkpoints of runs can be, one of each together."""
    files = [
        [
            hashlib.sha256(file.read_bytes()).hexdigest()
            for file in run.glob("*.safetensors")
        ]
        for run in runs
    ]
    if len(runs) == 1:
        return set(files[0])
    # The evaluation hashed the hashes of its members, of which each run has several checkpoints.
    together = ("".join(chosen) for chosen in itertools.product(*files))
    return {hashlib.sha256(text.encode()).hexdigest() for text in together}


def _sums(trained: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the trainings of students that act together cost in all."""
    counts = ("episodes", "frames", "updates", "samples")
    found: dict[str, Any] = {}
    for name in (*counts, "cpu_minutes", "minutes"):
        values = [one[name] for one in trained]
        # A sum without one of its parts would be wrong.
        if None in values:
            found[name] = None
        else:
            whole = ordered_sum(values)
            found[name] = int(whole) if name in counts else whole
    return found


def training(run: Path) -> dict[str, Any]:
    """Training data and training cost of a student."""
    config = read_json(run / "config.json")
    summary = read_json(run / "summary.json")
    data = []
    commits = set()
    for folder in sorted((run / "data").glob("round_*")):
        found = list(episodes(folder))
        commits |= {episode.run.commit for episode in found}
        data.append(
            {"episodes": len(found), "frames": sum(episode.steps for episode in found)}
        )
    metrics = read_metrics(run)
    return {
        "split": config["scene"]["split"],
        "algorithm": config["algorithm"],
        "rounds": data,
        "episodes": summary["demonstrations"],
        # Older runs tell none; the folders lack what --data gave.
        "frames": summary.get("frames") or sum(part["frames"] for part in data) or None,
        "device": summary.get("device", "cpu"),
        "updates": summary["steps"],
        "samples": summary["samples"],
        "cpu_minutes": round(summary["cpu_seconds"] / SECONDS_PER_MINUTE, 1),
        "minutes": round(summary["seconds"] / SECONDS_PER_MINUTE, 1),
        "cores": cores(),
        "success_once_on_the_way": [
            row["success_once"]
            for row in metrics
            # The final evaluation is that of the finished policy, often in other homes.
            if "success_once" in row and row.get("evaluation") != FINAL
        ],
        "commits": sorted(commits) or [summary.get("commit", "")],
    }


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows to the file; rows of the same students are replaced."""
    table = {
        # Later entries of a dict win: new rows replace those of the file.
        tuple(({"views": WHOLE} | row)[name] for name in IDENTITY): row
        for row in [*read_rows(path), *rows]
    }
    content = {
        "what": "students: policies that act from depth images and state",
        "date": datetime.date.today().isoformat(),
        "version": __version__,
        "command": "python -m mjhab.reports.students docs/results/students.json RUN EVALUATION",
        "rows": list(table.values()),
    }
    write_json(path, content)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of the file; none if it does not exist."""
    return json.loads(path.read_text(encoding="utf-8"))["rows"] if path.is_file() else []


def main(words: Sequence[str] | None = None) -> int:
    """Run the command (words of ``sys.argv`` if None); returns the exit code.

    Raises:
        SystemExit: the words are no such command.
    """
    parser = argparse.ArgumentParser(
        "python -m mjhab.reports.students", description=__doc__
    )
    parser.add_argument(
        "file", type=Path, metavar="FILE.json", help="the table; made or added to"
    )
    parser.add_argument(
        "places", type=Path, nargs="+", metavar="RUN EVALUATION", help="see above"
    )
    options = parser.parse_args(words)
    path, places = options.file, options.places
    if len(places) % 2:
        parser.error(f"every RUN needs its EVALUATION; got {len(places)} folders.")
    try:
        rows = [
            student_row(run, judged)
            if run != KEEP
            else judged_row(read_rows(path), judged)
            for run, judged in zip(places[::2], places[1::2], strict=True)
        ]
    except MjhabError as error:
        say(f"mjhab: {error}")
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
    sys.exit(main())
