"""An evaluation is a function of (seed, index): not of the number of worlds, nor of threads."""

from __future__ import annotations

import json
from pathlib import Path

from mjhab.cli.main import main


def evaluate(out: Path, worlds: int, threads: int) -> dict[int, dict]:
    args = [
        "eval",
        "--task",
        "set_table",
        "--subtask",
        "close",
        "--target",
        "kitchen_counter/drawer3",
    ]
    args += [
        *"--episodes 3 --films 0 --worlds".split(),
        str(worlds),
        "--threads",
        str(threads),
        "--out",
        str(out),
    ]
    assert main(args) == 0
    records = [
        json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()
    ]
    return {r["index"]: {k: v for k, v in r.items() if k != "seconds"} for r in records}


def test_worlds_and_threads_do_not_change_a_bit(tmp_path: Path):
    reference = evaluate(tmp_path / "one", 1, 1)
    assert sorted(reference) == [0, 1, 2]
    assert len({r["final_state"] for r in reference.values()}) == 3
    # Of three episodes in two worlds, the last begins in a world that has had one.
    assert evaluate(tmp_path / "two", 2, 2) == reference
