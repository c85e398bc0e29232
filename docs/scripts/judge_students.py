"""Judge the students that come with mjhab in homes of val and test, alone and in whole tasks.

`python docs/scripts/judge_students.py --out runs/judged` evaluates one row after the other, each in a process of its
own (`mjhab eval`), skips what is done, and takes every finished row into docs/results/students-judged.json.
`python docs/scripts/result_tables.py` makes the tables of docs/policies.md from that.
"""

from __future__ import annotations

import argparse
import datetime
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjhab.core.version import __version__
from mjhab.evaluation.resolve import LEARNED
from mjhab.reports.metrics import wilson
from mjhab.reports.students import pack_name
from mjhab.scenes.pack_source import pack_request

FILE = Path(__file__).parents[1] / "results" / "students-judged.json"
ROWS = (
    ("tidy_house", "pick", ""),
    ("tidy_house", "place", ""),
    ("prepare_groceries", "pick", ""),
    ("prepare_groceries", "place", ""),
    ("set_table", "pick", ""),
    ("set_table", "place", ""),
    ("set_table", "open", "fridge/top_door"),
    ("set_table", "open", "kitchen_counter/drawer3"),
    ("set_table", "close", "fridge/top_door"),
    ("set_table", "close", "kitchen_counter/drawer3"),
)
CHAINS = ("tidy_house", "prepare_groceries", "set_table")
KEYS = ("task", "subtask", "target", "split", "seed", "pack", "navigate")
"""What identifies a row of the file; whole tasks have no subtask, and they alone a way between subtasks. The pack of a
folder has the folder's name, and after "?stage=" its walls, if it has any."""


def command(
    row: dict[str, Any], episodes: int, told: Sequence[str], folder: Path
) -> list[str]:
    """`mjhab eval` of a row; ``told``: the policy, and the pack."""
    words = [sys.executable, "-m", "mjhab", "eval"]
    words += ["--task", row["task"], "--split", row["split"], "--seed", str(row["seed"])]
    for name in ("subtask", "target"):
        words += [f"--{name}", row[name]] if row[name] else []
    if row["navigate"]:
        way, *style = row["navigate"].split()
        words += ["--navigate", way, *(["--style", *style] if style else [])]
    words += [
        *told,
        "--profile",
        "ms_hab",
        "--episodes",
        str(episodes),
        "--worlds",
        "16",
    ]
    words += ["--films", "0", "--threads", "1", "--out", str(folder), "--json"]
    return words + (["--resume"] if (folder / "config.json").is_file() else [])


def judged(row: dict[str, Any], folder: Path, commit: str) -> dict[str, Any]:
    """A row of the file, from the folder of its evaluation."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    count = summary["episodes"]
    once = round(summary["success_once"] * count)
    return {
        **row,
        "episodes": count,
        "success_once": summary["success_once"],
        "interval": wilson(once, count),
        "success_at_end": summary["success_at_end"],
        "progressive": summary["progressive"],
        "labels": summary["labels"],
        "tainted": summary["tainted"],
        "horizon": config["horizon"],
        "policy_sha256": config["policy_sha256"],
        "subtasks": [
            {name: part[name] for name in ("kind", "target", "reached", "successes")}
            for part in summary.get("subtasks", ())
        ],
        "commit": commit,
    }


def take(row: dict[str, Any]) -> None:
    """Write a row to the file; one of the same KEYS is replaced."""
    found: dict[str, Any] = {"rows": []}
    if FILE.is_file():
        found = json.loads(FILE.read_text(encoding="utf-8"))
    rows = found["rows"]
    # Other rows are as old as they were.
    today = datetime.date.today().isoformat()
    since = found.get("date", today).partition("/")[0]
    versions = {*found.get("version", __version__).split(" and "), __version__}
    table = {tuple(each[key] for key in KEYS): each for each in [*rows, row]}
    content = {
        "what": "policies that come with mjhab, profile ms_hab",
        "date": today if since == today else f"{since}/{today}",
        "version": " and ".join(sorted(versions)),
        "command": "python docs/scripts/judge_students.py --out runs/judged",
        "rows": [table[key] for key in sorted(table)],
    }
    FILE.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def wanted(options: argparse.Namespace) -> list[tuple[dict[str, Any], int]]:
    """Rows to judge, each with its number of episodes."""
    names = [(*row, options.episodes) for row in ROWS]
    names += [(task, "", "", options.chains) for task in CHAINS]
    found = []
    for split in options.split:
        for seed in options.seed:
            for task, subtask, target, count in names:
                pack = pack_of(options)
                navigate = "" if subtask else options.navigate
                values = (task, subtask, target, split, seed, pack, navigate)
                row = dict(zip(KEYS, values, strict=True))
                shown = "/".join(filter(None, (task, subtask or "chain", target)))
                if count and any(shown.startswith(only) for only in options.only):
                    found.append((row, count))
    return found


def pack_of(options: argparse.Namespace) -> str:
    """Name of the pack in a row, with the walls that it has here."""
    stage = {"stage": options.stage} if options.stage else {}
    request = pack_request({"place": options.assets, **stage})
    return pack_name(request.as_json()).removesuffix("?stage=none")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--policy", default=LEARNED, help="learned, or learned:NAME")
    parser.add_argument(
        "--assets", default="builtin", help="builtin, or FOLDER of a pack"
    )
    parser.add_argument("--stage", default="", help="walls, as of mjhab eval")
    parser.add_argument("--split", nargs="+", default=["val", "test"])
    parser.add_argument("--seed", nargs="+", type=int, default=[0])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--chains", type=int, default=50)
    parser.add_argument(
        "--navigate",
        default="teleport",
        help="of whole tasks; or drive, 'drive hand=open'",
    )
    parser.add_argument("--only", nargs="+", default=[""], help="such as set_table/open")
    options = parser.parse_args()
    told = ["--policy", options.policy, "--assets", options.assets]
    told += ["--stage", options.stage] if options.stage else []
    head = ["git", "rev-parse", "HEAD"]
    commit = subprocess.run(head, capture_output=True, text=True).stdout.strip()
    for row, count in wanted(options):
        name = ".".join(str(row[key]).replace("/", "-") or "all" for key in KEYS)
        folder = options.out / name
        print(name, flush=True)
        done = subprocess.run(
            command(row, count, told, folder), stdout=subprocess.DEVNULL
        )
        if done.returncode:
            sys.exit(done.returncode)
        take(judged(row, folder, commit))


if __name__ == "__main__":
    main()
