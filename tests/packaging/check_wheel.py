"""mjhab as it is installed from a wheel, away from its checkout: run by `release_check.py`.

    python check_wheel.py files|demo|examples SOURCE OUT VERSION

SOURCE: the folder src/mjhab that the wheel was made of. OUT: a folder for what the commands write.
"""

from __future__ import annotations

import json
import os
import py_compile
import subprocess
import sys
from importlib import metadata
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


def check_files(source: Path, out: Path, version: str) -> None:
    """Every file of the package but caches is in the wheel, and its lists and registries are whole."""
    assert mjhab.__version__ == metadata.version("mjhab") == version
    installed = Path(mjhab.__file__).parent
    assert installed != source, f"the checkout was imported: {installed}"
    names = [
        path.relative_to(source)
        for path in source.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    missing = [str(name) for name in names if not (installed / name).is_file()]
    assert not missing, f"the wheel lacks {', '.join(missing)}"
    homes = run("homes", "list")["homes"]
    assert len(homes) == 105, len(homes)
    assert run("envs", "list")
    run("doctor")


def check_demo(source: Path, out: Path, version: str) -> None:
    """The demo runs, and its report stands alone."""
    summary = run("demo", "--out", str(out / "demo"))
    assert summary["episodes"] == 4, summary
    page = (out / "demo" / "report.html").read_text(encoding="utf-8")
    assert "<style" in page and "<script" in page, "the report has no style or no script"
    assert len(list((out / "demo" / "films").iterdir())) == 4


def check_examples(source: Path, out: Path, version: str) -> None:
    """The examples come with the wheel, and each command that is printed beside them works.

    Those that need more than the wheel are compiled.
    """
    from mjhab.cli.machine.examples import EXAMPLES

    folder = out / "examples"
    told = run("examples", "--out", str(folder))
    names = {path.name for path in folder.iterdir()}
    assert told["written"] > 10 and set(told["commands"]) == names, told
    for name, line in told["commands"].items():
        if EXAMPLES[name].needs:
            py_compile.compile(str(folder / name), doraise=True)
            continue
        done = subprocess.run(line, shell=True, cwd=out, check=False)
        assert done.returncode == 0, f"example {name}: {line}"


CHECKS = {"files": check_files, "demo": check_demo, "examples": check_examples}


if __name__ == "__main__":
    CHECKS[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4])
