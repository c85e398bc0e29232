"""Run the commands of the documentation, page by page: `make test-docs` calls this, not pytest, since it takes minutes.

The commands of a page run in a folder of their own, in the order in which they stand there, so that each finds what
those before it have made. Numbers that make a command take long are made small. Servers and the viewer run until their
page is done. Programs other than mjhab are not run: pytest checks that make targets and extras exist.

    python tests/docs/check_commands.py FOLDER [PAGE ...]
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjhab.cli.main import parse
from mjhab.config.env_spec import EnvSpec, env_names
from tests.docs.pages import (
    PAGES,
    README,
    ROOT,
    Command,
    blocks,
    commands,
    name_of,
    saved,
)

SMALL: dict[str, str] = {
    "episodes": "2",
    "generate": "2",
    "demos": "4",
    "per_target": "1",
    "chains": "0",
    "count": "2",
    "worlds": "2",
    "workers": "1",
    "steps": "40",
    "rounds": "1",
    "seeds": "1",
    "films": "0",
    "budget_minutes": "0.3",
    "eval_episodes": "2",
    "round_episodes": "2",
    "takeovers": "2",
    "samples": "200",
    "keep": "steps >= 0",
    "threads": "1",
}
"""Option to the value that makes it quick; only options that a command has, and that are not off, are set."""
ALWAYS = {"score": ("--episodes", "1"), "train": ("--budget-minutes", "0.3")}
"""What is added to a command whatever it says."""
IMITATION = ("bc", "flow", "act", "diffusion", "dagger")
FEW_DEMONSTRATIONS = ("--demos", "8")
"""What is added to imitation from demonstrations of its own, which else takes all of the budget."""
SMALL_BENCHMARKS: dict[str, tuple[str, ...]] = {
    "benchmarks.grasp": ("--seconds", "1"),
    "benchmarks.parity": ("--worlds", "2", "--steps", "40", "--grasp-seconds", "0"),
    "benchmarks.scaling": ("--rounds", "1", "--worlds", "2"),
    "benchmarks.sim": ("--rounds", "1", "--worlds", "2"),
    "benchmarks.soak": ("--steps", "40", "--worlds", "2"),
    "benchmarks.spawn": ("--count", "2"),
}
"""What is added to developers' benchmarks."""
LASTING = ("serve", "view")
"""Commands that go on until they are ended."""
END_SECONDS = 30.0
COMMAND_SECONDS = 600.0
Lasting = subprocess.Popen[str]


def small(words: list[str]) -> list[str]:
    """The words of a command with numbers that make it quick."""
    if words[:2] in (["score", "check"], ["score", "table"]):
        return words
    # It has one world if the page does not say more, and refuses the option for recorded episodes.
    if words[0] == "view":
        return words
    given: Any = parse(words).spec
    added = []
    for name, value in SMALL.items():
        now = value_of(given, name)
        numbers = now if isinstance(now, tuple) else (now,)
        if any(number for number in numbers):
            added += [f"--{name.replace('_', '-')}", value]
    if words[0] == "train" and words[1] in IMITATION and "--data" not in words:
        added += FEW_DEMONSTRATIONS
    return [*words, *added, *ALWAYS.get(words[0], ())]


def value_of(given: Any, name: str) -> Any:
    """The value of an option of a parsed command, None if it has no such option."""
    if isinstance(given, EnvSpec):
        names = {**env_names(type(given))}
        return getattr(given, name, getattr(given.asked, names.get(name, name), None))
    return getattr(given, name, None)


def main(out: Path, names: list[str]) -> int:
    """Run the pages of these names, all of them without any; returns how many commands failed."""
    failed = []
    for page in PAGES:
        if not names or name_of(page) in names:
            failed += run_page(page, out / name_of(page).replace("/", "_"))
    for line in failed:
        print(f"FAILED {line}", file=sys.stderr)
    print(f"{len(failed)} commands of the documentation failed")
    return min(len(failed), 1)


def run_page(page: Path, folder: Path) -> list[str]:
    """Run a page in a folder, which is made anew; returns the commands that failed."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    # Scripts write into the pages and results beside them.
    shutil.copytree(
        ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns("media")
    )
    for block in [*saved(README), *saved(page)]:
        (folder / block.file).write_text(block.code)
    failed = []
    lasting: list[Lasting] = []
    try:
        for block in blocks(page):
            if block.language != "bash" or block.reason:
                continue
            for command in commands(block):
                if command.program in ("mjhab", "python"):
                    begun = time.monotonic()
                    good = run(command, folder, lasting)
                    told = f"{name_of(page)}: {' '.join(command.words)}"
                    print(f"{time.monotonic() - begun:6.1f} s  {told}", flush=True)
                    failed += [] if good else [told]
    finally:
        ended = [(process, ends_well(process)) for process in lasting]
    failed += [f"the end of {one.args}" for one, good in ended if not good]
    return failed


def run(command: Command, folder: Path, lasting: list[Lasting]) -> bool:
    """Run one command of mjhab; whether it did what it should. One that lasts is added to ``lasting``."""
    given = with_files(command.words[1:], folder)
    words = [sys.executable, *given]
    if command.program == "mjhab":
        words = [sys.executable, "-m", "mjhab.cli.main", *small(given)]
    elif given[0] == "-m":
        words += SMALL_BENCHMARKS.get(given[1], ())
    paths = os.pathsep.join(map(str, (ROOT / "src", ROOT)))
    environment = {**os.environ, "PYTHONPATH": paths, **command.variables}
    if command.words[1] in LASTING and "--export" not in command.words:
        process = subprocess.Popen(
            words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        started = bool(process.stdout.readline())
        if started:
            lasting.append(process)
        return started
    try:
        done = subprocess.run(
            words,
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            timeout=COMMAND_SECONDS,
        )
    except subprocess.TimeoutExpired:
        print(f"not done after {COMMAND_SECONDS:.0f} s", file=sys.stderr)
        return False
    return done.returncode == 0


def with_files(words: Sequence[str], folder: Path) -> list[str]:
    """The words with the files of a folder in place of patterns such as ``scores/*/result.json``, as in a shell."""
    given: list[str] = []
    for word in words:
        found = sorted(map(str, folder.resolve().glob(word))) if "*" in word else []
        given += found or [word]
    return given


def ends_well(process: Lasting) -> bool:
    """End a command that lasts, as a user does; whether it exits with 0 in time."""
    process.terminate()
    try:
        return process.wait(END_SECONDS) == 0
    except subprocess.TimeoutExpired:
        process.kill()
        return False


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
