"""Fingerprints of what mjhab computes, to show that a change of structure changes no result.

    python tests/guard/fingerprint.py record before.json
    ... move, cut, rename ...
    python tests/guard/fingerprint.py record after.json
    python tests/guard/fingerprint.py compare before.json after.json

``record`` runs experts on every task and subtask, steps every environment id under random actions, exports a data set
and compiles a model, all through the public commands, and writes one SHA-256 per result. Numbers differ between
processors, so that both files must come from one machine. ``--data FOLDER`` adds a ReplicaCAD pack; ``--small`` is the
version that the test suite runs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import mujoco
import numpy as np

import mjhab

CHAINS = ("set_table", "tidy_house", "prepare_groceries")
SUBTASKS: dict[str, tuple[str, ...]] = {
    "set_table": ("pick", "place", "navigate", "open", "close"),
    "tidy_house": ("pick", "place", "navigate"),
    "prepare_groceries": ("pick", "place", "navigate"),
}
ENV_STEPS = 200
SMALL_ENV = "mjhab/PickSubtaskTrain-v1"
RUN_ID = re.compile(r"episodes/[0-9a-f]{8}-")
RUNS = "runs/"
"""Group of a shard that tells which code made its episodes."""
VOLATILE = (
    "seconds",
    "time",
    "version",
    "commit",
    "code",
    "host",
    "hash",
    "digest",
    "id",
    "software",
)
"""Parts of the names of record entries that say when and with what they were made, not what happened."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    record = commands.add_parser("record")
    record.add_argument("file", type=Path)
    record.add_argument("--small", action="store_true")
    record.add_argument("--data", default="", help="folder of a ReplicaCAD pack")
    compare = commands.add_parser("compare")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.command == "compare":
        return report_differences(
            json.loads(options.before.read_text()), json.loads(options.after.read_text())
        )
    found = fingerprints(small=options.small, data=options.data)
    options.file.write_text(json.dumps(found, indent=1, sort_keys=True))
    print(f"{len(found)} fingerprints in {options.file}")
    return 0


def report_differences(before: dict[str, str], after: dict[str, str]) -> int:
    """Print the names whose fingerprints differ; 1 if there are any.

    Groups of episodes are named by a run id that depends on the code: it is left out of the names.
    """
    before = {RUN_ID.sub("episodes/", name): value for name, value in before.items()}
    after = {RUN_ID.sub("episodes/", name): value for name, value in after.items()}
    names = sorted(before.keys() | after.keys())
    different = [name for name in names if before.get(name) != after.get(name)]
    for name in different:
        print("differs:", name)
    print(f"{len(names) - len(different)} of {len(names)} are the same")
    return 1 if different else 0


def fingerprints(
    small: bool, data: str = "", run: Callable[..., object] | None = None
) -> dict[str, str]:
    """SHA-256 by name of everything the guard looks at.

    Args:
        small: look at little.
        data: folder of a ReplicaCAD pack; "" for none.
        run: runs a command; `run_command` if None.
    """
    run = run or run_command
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, options in episode_sets(small, data):
            out = Path(folder) / name.replace("/", "-")
            run("generate", *options, "--out", str(out))
            found.update(
                (f"{name}/{key}", value) for key, value in shard_fingerprints(out)
            )
        first = Path(folder) / "set_table-pick"
        exported = Path(folder) / "maniskill"
        run("export", "maniskill", str(first), "--out", str(exported))
        found.update(
            (f"export/{key}", value) for key, value in shard_fingerprints(exported)
        )
    for env_id in sorted(
        name for name in gymnasium.registry if name.startswith("mjhab/")
    ):
        if not small or env_id == SMALL_ENV:
            found[f"env/{env_id}"] = env_fingerprint(
                env_id, steps=20 if small else ENV_STEPS
            )
    found["model/builtin"] = model_fingerprint("builtin")
    if data:
        found["model/data"] = model_fingerprint(data)
    return found


def episode_sets(small: bool, data: str) -> Iterator[tuple[str, list[str]]]:
    """Name and ``mjhab generate`` options of every set of recorded episodes."""
    if small:
        words: list[str] = [
            *"--task set_table --subtask pick --episodes 1 --worlds 1".split()
        ]
        yield "set_table-pick", words
        return
    for task in CHAINS:
        yield task, ["--task", task, "--episodes", "2", "--worlds", "2"]
        for subtask in SUBTASKS[task]:
            yield (
                f"{task}-{subtask}",
                ["--task", task, "--subtask", subtask, "--episodes", "4"],
            )
    for mode in ("forward", "drive"):
        options = ["--navigate", "drive"] if mode == "drive" else []
        yield (
            f"random-{mode}",
            ["--task", "tidy_house", "--policy", "random", "--episodes", "1", *options],
        )
    if data:
        for task in CHAINS:
            for subtask in SUBTASKS[task]:
                yield (
                    f"data-{task}-{subtask}",
                    [
                        "--assets",
                        data,
                        "--task",
                        task,
                        "--subtask",
                        subtask,
                        "--episodes",
                        "1",
                    ],
                )


def run_command(*arguments: str) -> None:
    """Run an mjhab command in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "mjhab.cli.main", *arguments, "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(
            f"mjhab {' '.join(arguments)} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        )


def shard_fingerprints(folder: Path) -> Iterator[tuple[str, str]]:
    """Name and SHA-256 of every dataset of the HDF5 files below a folder, the volatile ones left out."""
    for path in sorted(folder.rglob("*.h5")):
        with h5py.File(path, "r") as file:
            datasets: dict[str, h5py.Dataset] = {}
            file.visititems(
                lambda name, item, into=datasets: (
                    into.update({name: item}) if is_dataset(item) else None
                )
            )
            for name, item in sorted(datasets.items()):
                if not name.startswith(RUNS) and not any(
                    part in name.lower() for part in VOLATILE
                ):
                    value = item[()]
                    content = (
                        stable_record(value)
                        if name.endswith("record")
                        else np.asarray(value).tobytes()
                    )
                    yield name, hashlib.sha256(content).hexdigest()


def is_dataset(item: Any) -> bool:
    return isinstance(item, h5py.Dataset)


def stable_record(value: Any) -> bytes:
    """The bytes of a JSON record without its volatile entries; other bytes as they are."""
    raw = np.asarray(value).tobytes().rstrip(b"\0")
    try:
        record = json.loads(raw)
    except ValueError:
        return raw
    kept = {
        key: entry
        for key, entry in record.items()
        if not any(part in key for part in VOLATILE)
    }
    return json.dumps(kept, sort_keys=True).encode()


def env_fingerprint(env_id: str, steps: int) -> str:
    """SHA-256 of the actions, observations and rewards of random play."""
    env = gymnasium.make_vec(env_id, num_envs=2, obs_mode="depth", camera_size=32, seed=7)
    digest = hashlib.sha256()
    rng = np.random.default_rng(7)
    obs, _ = env.reset(seed=7)
    for _ in range(steps):
        add_arrays(digest, obs)
        action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        obs, reward, terminated, truncated, _ = env.step(action)
        for array in (action, reward, terminated, truncated):
            digest.update(np.ascontiguousarray(array).tobytes())
    env.close()
    return digest.hexdigest()


def add_arrays(digest: Any, tree: Any) -> None:
    """Feed the arrays of nested dicts to a digest, in the order of their keys."""
    if isinstance(tree, dict):
        for key in sorted(tree):
            digest.update(key.encode())
            add_arrays(digest, tree[key])
    else:
        digest.update(np.ascontiguousarray(tree).tobytes())


def model_fingerprint(assets: str) -> str:
    """SHA-256 of the compiled model of the first home of a pack."""
    env = mjhab.make(task="set_table", assets=assets, num_envs=1)
    model = env.sim.model(env.layout.pack.homes[0].name)
    size = mujoco.mj_sizeModel(model)
    buffer = np.zeros(size, np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
