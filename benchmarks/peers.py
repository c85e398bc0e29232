"""Control steps per second beside other simulators, in the same minutes: ``python -m benchmarks.peers``."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import run_command
from benchmarks.peers_worker import PEERS, SIDE
from mjhab.cli.output import Listing, report
from mjhab.core.files.reading import reason
from mjhab.core.version import __version__

WORKER = Path(__file__).with_name("peers_worker.py")
LONGEST_START_S = 300.0
"""Longest time that a peer may take to start [s]."""


@dataclass(frozen=True)
class PeersSpec:
    """Measure control steps and images per second of mjhab and of the peers that are installed, one after the other.

    `python -m benchmarks.peers --python ~/peers/bin/python --rounds 3`

    Peers need another version of MuJoCo, so they have a virtual environment of their own:
    `python -m venv ~/peers; ~/peers/bin/pip install robosuite gymnasium-robotics 'mujoco==3.3.5'`. One that is not
    installed there, or does not run, is left out with the reason.
    """

    python: Path = Path(sys.executable)
    """Interpreter in whose environment the peers are."""
    seconds: float = 10.0
    """Length of each measurement [s]."""
    rounds: int = 3
    """Rounds over all; the rows have the best one."""
    worlds: tuple[int, ...] = (1, 16)
    """Numbers of worlds of mjhab. Peers have one process each, which is how they are used."""
    threads: int = 0
    """Threads of mjhab, 0 for all cores."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure(spec: PeersSpec) -> dict[str, Any]:
    """The rows, best of all rounds, and why peers are missing."""
    rows: dict[str, dict[str, Any]] = {}
    missing: dict[str, str] = {}
    for _ in range(max(1, spec.rounds)):
        for worlds in spec.worlds:
            for obs in ("state", "rgbd"):
                _keep(rows, _ours(spec, worlds, obs))
        for name in PEERS:
            found = _theirs(spec, name)
            if isinstance(found, str):
                missing[name] = found
            else:
                _keep(rows, found)
    return {"rows": list(rows.values()), "missing": missing}


def _keep(rows: dict[str, dict[str, Any]], row: dict[str, Any]) -> None:
    before = rows.get(row["name"])
    # The best round: others on the machine can only make it slower.
    if before is None or row["steps_per_s"] > before["steps_per_s"]:
        rows[row["name"]] = row


def _ours(spec: PeersSpec, worlds: int, obs: str) -> dict[str, Any]:
    """SetTable Pick in a furnished home of about 30 objects, 20 Hz, random actions."""
    from mjhab.envs import make

    env = make(
        task="set_table",
        subtask="pick",
        num_envs=worlds,
        threads=spec.threads,
        obs_mode=obs,
        camera_size=SIDE,
        autoreset="disabled",
    )
    env.reset(seed=0)
    # The same actions in every round.
    env.action_space.seed(0)
    # The first step compiles kernels.
    env.step(env.action_space.sample())
    count = 0
    begun = time.perf_counter()
    while (spent := time.perf_counter() - begun) < spec.seconds:
        env.step(env.action_space.sample())
        count += worlds
    env.close()
    images = 2 if obs == "rgbd" else 0
    rate = count / spent
    said = "RGB-D" if images else "states"
    return {
        "name": f"mjhab SetTable Pick, {said}, {worlds} world{'s' * (worlds > 1)}",
        "version": __version__,
        "steps_per_s": round(rate, 1),
        "images_per_s": round(images * rate, 1) if images else None,
    }


def _theirs(spec: PeersSpec, name: str) -> dict[str, Any] | str:
    """The row of a peer, or why there is none."""
    words = [str(spec.python), str(WORKER), name, str(spec.seconds)]
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            timeout=LONGEST_START_S + spec.seconds,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return reason(error)
    said = done.stdout.strip().splitlines()
    if done.returncode or not said:
        # The last line of a traceback says what was wrong.
        last = done.stderr.strip().splitlines() or ["it said nothing"]
        return last[-1]
    # Peers greet on stdout, so only the last line is ours.
    return {"name": name, **json.loads(said[-1])}


def run(spec: PeersSpec) -> int:
    """Run the benchmark."""
    found = measure(spec)
    columns = ("environment", "version", "control steps/s", "images/s")
    cells = [
        (row["name"], row["version"], row["steps_per_s"], row["images_per_s"] or "-")
        for row in found["rows"]
    ]
    title = "Random actions, one machine, the same minutes"
    left_out = (f"{name}: not measured ({why})" for name, why in found["missing"].items())
    report(spec.json, found, Listing(title, columns, cells), *left_out)
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """The command."""
    return run_command("peers", PeersSpec, run, words, {"rounds": 1, "worlds": 1})


if __name__ == "__main__":
    raise SystemExit(main())
