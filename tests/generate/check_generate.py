"""Generate episodes with two workers, kill -9 twice at random moments, go on, and check and replay what is there.

    make test-generate EPISODES=1000
    python check_generate.py FOLDER EPISODES [SEED OF THE KILLS]

First one of the workers is killed: the run goes on without it. Then everything is killed at once, and the same command
with --resume goes on.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from mjhab.data.store.episode_files import EPISODE_FOLDER, EpisodeFiles

MJHAB = [sys.executable, "-m", "mjhab.cli.main"]
MAKE = "generate --task set_table --subtask pick --workers 2 --seed 0 --json".split()
EARLY = (0.1, 0.4)
LATE = (0.5, 0.9)
"""Shares of the episodes that are written when the two kills come."""
_LONGEST_WAIT = 3.0
"""A kill comes up to so many seconds after its share is reached: anywhere in an episode."""


def start(out: Path, episodes: int, *more: str) -> subprocess.Popen[str]:
    """The command, at the head of a process group of its own."""
    command = [*MJHAB, *MAKE, "--episodes", str(episodes), "--out", str(out), *more]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    )


def written(out: Path) -> int:
    """Episodes in the folder at this moment."""
    return len(EpisodeFiles(out / EPISODE_FOLDER).names)


def wait_until(
    out: Path, process: subprocess.Popen[str], count: float, dice: random.Random
) -> None:
    """Return at a random moment after so many episodes were written."""
    while written(out) < count:
        assert process.poll() is None, (
            f"it ended before {count:.0f} episodes were written; give a larger number"
        )
        time.sleep(0.2)
    time.sleep(dice.uniform(0.0, _LONGEST_WAIT))
    assert process.poll() is None, (
        "it ended before it could be killed; give a larger number of episodes"
    )


def workers(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the workers of a running command."""
    children = (
        Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    )
    return [
        int(pid)
        for pid in children
        if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]


def ask(*command: str) -> dict[str, Any]:
    """What a command tells machines."""
    done = subprocess.run(
        [*MJHAB, *command, "--json"], stdout=subprocess.PIPE, text=True, check=False
    )
    print(f"mjhab {' '.join(command)}: exit code {done.returncode}", flush=True)
    return json.loads(done.stdout)


def make(out: Path, episodes: int, dice: random.Random) -> dict[str, Any]:
    """Generate with two kills; returns what the command says at last."""
    process = start(out, episodes)
    wait_until(out, process, dice.uniform(*EARLY) * episodes, dice)
    victim = dice.choice(workers(process))
    os.kill(victim, signal.SIGKILL)
    print(f"killed worker {victim}, {written(out)} episodes were written", flush=True)
    wait_until(out, process, dice.uniform(*LATE) * episodes, dice)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    print(f"killed everything, {written(out)} episodes were written", flush=True)
    process = start(out, episodes, "--resume")
    said, _ = process.communicate()
    assert process.returncode == 0, f"exit code {process.returncode}"
    return json.loads(said)


def main(out: Path, episodes: int, seed: int | None = None) -> None:
    """Make the set, and ask of it all that a set must hold."""
    if out.exists():
        assert (out / "generation.json").is_file(), f"{out} holds something else"
        shutil.rmtree(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    seed = random.SystemRandom().randrange(1 << 16) if seed is None else seed
    begun = time.perf_counter()
    said = make(out, episodes, random.Random(seed))
    seconds = time.perf_counter() - begun
    assert said["kept"] == said["tried"] == episodes, said
    found = ask("data", "check", str(out))
    assert (found["episodes"], found["ok"], found["damaged"], found["doubled"]) == (
        episodes,
        episodes,
        0,
        0,
    ), found
    assert not found["unreadable"] and not found["unfinished"], found
    where = ("--where", "tainted or not tainted")
    rows = ask("data", "query", str(out), *where, "--list", str(episodes))["episodes"]
    assert {(row["seed"], row["index"]) for row in rows} == {
        (0, index) for index in range(episodes)
    }
    replayed = ask("replay", str(out), "--verify", *where)
    assert (replayed["episodes"], replayed["exact"]) == (episodes, episodes), replayed
    assert (replayed["max_error"], replayed["moved"]) == (0.0, 0), replayed
    rate = {
        "episodes_per_hour": round(episodes / seconds * 3600),
        "bytes_per_episode": said["bytes_per_episode"],
    }
    print(
        json.dumps(
            {
                "episodes": episodes,
                "exact": replayed["exact"],
                "kills_seed": seed,
                **rate,
                **said["labels"],
            }
        )
    )


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        int(sys.argv[2]),
        int(sys.argv[3]) if len(sys.argv) > 3 else None,
    )
