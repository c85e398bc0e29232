"""What a release needs, from a source tree to a user's first report: `make release-check` calls this, not pytest.

    python tests/packaging/release_check.py [--keep FOLDER]

Copies the tracked files into a temporary folder, builds sdist and wheel there (the wheel from the sdist,
as registries have it), installs the wheel and nothing else into an empty environment with the versions of
constraints.txt, and runs `check_wheel.py` in it: package data, demo, every example. Ends with 1 at the first failure.
Standard library only: nothing has to be installed before.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
VERSION_FILE = Path("src/mjhab/core/version.py")
MOST_SHOWN = 8000
"""Characters of what a failed step printed; a build lists every file of the package."""


def version_of(tree: Path) -> str:
    """The version that a source tree says it has."""
    text = (tree / VERSION_FILE).read_text(encoding="utf-8")
    (version,) = re.findall(r'^__version__ = "(.+)"$', text, re.MULTILINE)
    return version


def faults(tree: Path, version: str) -> list[str]:
    """What keeps a source tree from being tagged as ``version``."""
    log = (tree / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## \[(.+?)\](?: - (\d{4}-\d\d-\d\d))?$", log, re.MULTILINE)
    dates = dict(sections)
    found = []
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        found.append(f"{version} is no release: MAJOR.MINOR.PATCH")
    if version not in dates:
        found.append(f"CHANGELOG.md has no section [{version}]")
    elif not dates[version]:
        found.append(f"CHANGELOG.md: section [{version}] has no date")
    unreleased = re.search(
        r"^## \[Unreleased\]\n(.*?)^## ", log, re.DOTALL | re.MULTILINE
    )
    if unreleased and "\n- " in unreleased[1]:
        found.append(f"CHANGELOG.md: lines under [Unreleased] belong to [{version}]")
    return found


def copy_tracked(tree: Path) -> None:
    """Copy what git tracks, as it is in the working tree, so that nothing else gets into the sdist."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    for name in filter(None, listed.stdout.split("\0")):
        place = tree / name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, place, follow_symlinks=False)


def environment(folder: Path) -> Path:
    """Make a virtual environment; returns its Python."""
    venv.create(folder, with_pip=True, clear=True)
    return folder / "bin" / "python"


def run(step: str, *words: str | Path, cwd: Path, **variables: str) -> None:
    """Run one step and tell how long it took; what it printed is shown if it failed.

    Raises:
        SystemExit: it failed.
    """
    begun = time.monotonic()
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=clean | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        print(done.stdout[-MOST_SHOWN:], file=sys.stderr)
        sys.exit(f"release-check: {step} failed with exit code {done.returncode}")
    print(f"release-check: {step}: {time.monotonic() - begun:.0f} s", flush=True)


def check(folder: Path) -> None:
    """Build, install and try a release in an empty folder.

    Raises:
        SystemExit: a step failed.
    """
    tree, dist = folder / "tree", folder / "dist"
    copy_tracked(tree)
    version = version_of(tree)
    if wrong := faults(tree, version):
        sys.exit("release-check: " + "; ".join(wrong))
    pip = ("-m", "pip", "--disable-pip-version-check", "install", "-q")
    tools = environment(folder / "tools")
    run("build tools", tools, *pip, "build==1.3.0", cwd=folder)
    run("sdist and wheel", tools, "-m", "build", "--outdir", dist, tree, cwd=folder)
    sdist, wheel = dist / f"mjhab-{version}.tar.gz", next(dist.glob("*.whl"))
    for file in (sdist, wheel):
        print(f"release-check: {file.name}: {file.stat().st_size / 1e6:.1f} MB")
    python = environment(folder / "clean")
    constraints = tree / "constraints.txt"
    run("installation", python, *pip, "-c", constraints, wheel, cwd=folder)
    run("pip check", python, "-m", "pip", "check", cwd=folder)
    work = folder / "work"
    work.mkdir()
    source = tree / "src" / "mjhab"
    path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    cache = {"MJHAB_CACHE": str(folder / "cache"), "PATH": path}
    for part in ("files", "demo", "examples"):
        words = (python, "-I", HERE / "check_wheel.py", part, source, work, version)
        run(part, *words, cwd=work, **cache)
    print(f"release-check: mjhab {version} is ready to be tagged v{version}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Build, install and try a release.")
    parser.add_argument("--keep", type=Path, help="empty folder in which all is left")
    given = parser.parse_args()
    if given.keep:
        given.keep.mkdir(parents=True)
        check(given.keep.resolve())
        return
    with tempfile.TemporaryDirectory(prefix="mjhab-release-") as folder:
        check(Path(folder))


if __name__ == "__main__":
    main()
