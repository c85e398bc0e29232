"""mjhab as it is installed from a wheel, away from its checkout: run by `make test-wheel`.

    python check_wheel.py SOURCE OUT

SOURCE: the folder src/mjhab that the wheel was made of. OUT: folder for the demo's results.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import mjhab

COMMAND = Path(sys.executable).with_name("mjhab")


def run(*args: str, **variables: str) -> dict:
    """The last line of the JSON that a command prints, with variables of the environment."""
    done = subprocess.run(
        [COMMAND, *args, "--json"],
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
        env={**os.environ, **variables},
    )
    assert done.returncode == 0, f"mjhab {' '.join(args)}: {done.stderr}"
    return json.loads(done.stdout.strip().splitlines()[-1])


def check_files(source: Path) -> int:
    """Every file of the package but caches is in the wheel; returns how many are no Python."""
    installed = Path(mjhab.__file__).parent
    assert installed != source, f"the checkout was imported: {installed}"
    names = [
        path.relative_to(source)
        for path in source.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    missing = [str(name) for name in names if not (installed / name).is_file()]
    assert not missing, f"the wheel lacks {', '.join(missing)}"
    return sum(name.suffix != ".py" for name in names)


def check_examples(folder: Path) -> None:
    """The examples come with the wheel, and one of them runs as a plugin."""
    shutil.rmtree(folder, ignore_errors=True)
    told = run("examples", "--out", str(folder))
    assert told["written"] > 10 and set(told["commands"]) == {
        p.name for p in folder.iterdir()
    }
    plugin = {"MJHAB_PLUGINS": str(folder / "push")}
    words = (
        "--task",
        "push_objects",
        "--subtask",
        "push",
        "--episodes",
        "1",
        "--films",
        "0",
    )
    out = str(folder.with_name("push"))
    assert run("eval", *words, "--out", out, "--overwrite", **plugin)["episodes"] == 1


def main(source: Path, out: Path) -> None:
    """Check the files, then run what a new user runs."""
    data = check_files(source)
    check_examples(out.with_name("examples"))
    homes = run("homes", "list")["homes"]
    assert len(homes) == 105, len(homes)
    assert run("envs", "list")
    run("doctor")
    summary = run("demo", "--out", str(out))
    assert summary["episodes"] == 4, summary
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<style" in page and "<script" in page, "the report has no style or no script"
    assert len(list((out / "films").iterdir())) == 4
    print(
        f"the wheel works: {data} files of data, {len(homes)} homes, demo with {summary['success_once']:.0%} success"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
