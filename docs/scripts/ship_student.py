"""Put a trained student into the package: ``python docs/scripts/ship_student.py FILE ROW...``.

FILE is student.safetensors of a run, ROW what it was trained for: TASK/SUBTASK or TASK/SUBTASK/TARGET. The weights are
stored in about half of their size, in a file named after the row. A student for several rows is stored as all_rows;
src/mjhab/learning/shipped/index.json names the rows that it acts for, alone or together with another. With --name it
is stored under a name of its own, for ``--policy learned:NAME``, or, with a name such as replica_cad/tidy_house.pick,
for a file of policies such as src/mjhab/learning/shipped/replica_cad.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from mjhab.learning.checkpoint import load_checkpoint, save_compact
from mjhab.learning.policy_kind import CHECKPOINT_SUFFIX
from mjhab.learning.shipped_kind import FOLDER, file_name

ALL_ROWS = "all_rows"


def ship(source: Path, rows: Sequence[str], name: str = "") -> None:
    """Write the file of a student for the given rows."""
    scenes = []
    for row in rows:
        task, subtask, *target = row.split("/", 2)
        scenes.append({"task": task, "subtask": subtask, "target": "".join(target)})
    name = name or (file_name(**scenes[0]) if len(scenes) == 1 else ALL_ROWS)
    about = {**load_checkpoint(source).about}
    # Where files lay on the machine of the training is nobody's business.
    about.pop("members", None)
    pack = about["scene"]["assets"]
    if isinstance(pack, dict):
        pack = {**pack, "place": Path(pack["place"]).name}
    known = {**about["scene"], "assets": pack, "spawns": ""}
    told = [{**known, **scene} for scene in scenes]
    place = FOLDER / f"{name}{CHECKPOINT_SUFFIX}"
    place.parent.mkdir(exist_ok=True)
    save_compact(source, place, {**about, "scene": told[0], "also": told[1:]})
    place.chmod(0o644)
    print(f"{place}: {place.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, metavar="CHECKPOINT.safetensors")
    parser.add_argument("rows", nargs="+", metavar="TASK/SUBTASK[/TARGET]")
    parser.add_argument("--name", default="", help="name of its own")
    options = parser.parse_args()
    ship(options.source, options.rows, options.name)
