"""Provenance of recorded data: configuration, versions, commit, machine, models."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.joints import BASE
from mjhab.core.version import __version__
from mjhab.data.record.worlds import RecordedEnv, Views
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.run_entries import ACTION_TABLE, SCAN_YAWS

# Those whose version may change a bit of a state or of a file.
_LIBRARIES = ("mujoco", "mujoco-warp", "numpy", "h5py")
_FREE = frozenset(
    {
        "num_envs",
        "threads",
        "seed",
        "autoreset",
        "obs_keys",
        "render_mode",
        "backend",
        "device",
        "starts",
        "buffers",
    }
)
"""Environment options that do not change an episode. The seed is stored with each episode; options of the GPU backend
have no effect, because recording uses the CPU backend."""
_VIEW = frozenset(
    {
        "obs_mode",
        "cameras",
        "camera_size",
        "shader",
        "shading",
        "frame_stack",
        "handle_points",
        "object_axes",
        "reward_mode",
        "reward_scales",
        "reward_formula",
        "reward_normaliser",
    }
)
"""Environment options that change the observations and rewards of an episode, but not its physics or outcome."""
_LATER = frozenset({"perturb", "randomise"})
"""Environment options that are left out where they are empty: recordings without them stay as they were."""
TRAIN_MAKER = "make_train"
"""``config["maker"]`` of runs in SubtaskTrain environments; runs in environments of `mjhab.envs.make` have none."""
BUILTIN_LICENCE = "Apache-2.0: homes, furniture and objects made by the code of mjhab"


def describe_run(
    env: RecordedEnv, policy: Mapping[str, Any], licence: str = ""
) -> RunInfo:
    """Describe the run of a policy in an environment.

    Args:
        env: a SequentialTask or SubtaskTrain environment on the CPU.
        policy: its name and every option that changes its actions, as JSON data: {"name": "expert", ...}.
        licence: of the assets; needed for assets other than the built-in ones.
    """
    options = {
        name: _plain(value) for name, value in dataclasses.asdict(env.config).items()
    }
    config: dict[str, Any] = {
        "env": {
            k: v
            for k, v in options.items()
            if k not in _FREE | _VIEW and (v or k not in _LATER)
        },
        "policy": dict(policy),
    }
    # Other environments leave the seed out of the identity, because each episode has its own.
    if getattr(env.config, "trains", False):
        # The start states come from a pool that depends on the environment's seed.
        config["env"]["seed"] = options["seed"]
        config["maker"] = TRAIN_MAKER
    return RunInfo(
        config=config,
        options={k: v for k, v in options.items() if k in _VIEW},
        versions=versions(),
        commit=source_commit(),
        machine=f"{platform.machine()} {platform.system()}",
        layout=_layout_of(env),
        assets=_text(env.config.assets),
        licence=licence
        or (
            BUILTIN_LICENCE
            if env.config.assets == "builtin"
            else "unknown: see the asset pack"
        ),
    )


def _layout_of(env: RecordedEnv) -> dict[str, Any]:
    """What the columns of the recorded states, actions and images are, as JSON data."""
    layout = env.layout
    # All homes of a run have the same sizes, so that any world tells them.
    first = env.sim.get_world(0)
    return {
        "objects": list(layout.object_names),
        "links": list(layout.link_ids),
        "sizes": {
            "qpos": len(first["qpos"]),
            "qvel": len(first["qvel"]),
            "ctrl": len(first["ctrl"]),
        },
        "columns": _columns(env.sim.addresses),
        "robot": layout.robot.name,
        "joints": [
            # Observed positions of joints leave out the base.
            joint.removesuffix("_joint")
            for joint in layout.robot.joints[BASE.stop :]
        ],
        "actions": [entry.name for entry in env.action_table],
        ACTION_TABLE: [dict(vars(entry)) for entry in env.action_table],
        "taints": list(env.taint_names),
        SCAN_YAWS: {kind.name: kind.scan_yaw for kind in layout.objects if kind.scan_yaw},
        **describe_views(env.observer),
        **({"stage": layout.stage} if layout.stage else {}),
    }


def describe_views(views: Views) -> dict[str, Any]:
    """Entries of a run's layout that describe camera images; empty without images.

    "cameras" holds the calibration of each camera. With segmentation, "segments" holds the names of its ids.
    """
    outputs = getattr(views, "outputs", ())
    if not outputs:
        return {}
    found: dict[str, Any] = {"cameras": views.calibration()}
    if "seg" in outputs or "pointcloud" in outputs:
        found["segments"] = list(views.segmentation_names)
    return found


def versions() -> dict[str, str]:
    """Versions of Python, mjhab and the libraries that affect bit-exact results."""
    found = {"python": platform.python_version(), "mjhab": __version__}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        # The GPU backend is an extra.
        except PackageNotFoundError:
            continue
    return found


@lru_cache(maxsize=1)
def source_commit() -> str:
    """Commit of mjhab's own checkout, with "+changes" if files differ from it.

    Where mjhab runs from a package or a copy without git, the environment variable MJHAB_COMMIT gives it, else "".
    """
    folder = Path(__file__).parents[2]

    def git(*words: str) -> str:
        words = ("git", "-C", str(folder), *words)
        done = subprocess.run(
            # A git that waits for a lock or a network folder must not hold up a recording.
            words,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        return done.stdout.strip()

    try:
        # A virtual environment may lie inside another repository, so git must track this file.
        git("ls-files", "--error-unmatch", "__init__.py")
        return git("rev-parse", "HEAD") + (
            "+changes" if git("status", "--porcelain", "--", ".") else ""
        )
    except (OSError, subprocess.SubprocessError):
        return os.environ.get("MJHAB_COMMIT", "")


_SEARCH_TREES = "bvh_"


def model_hash(model: Any) -> str:
    """Hash of every array of a compiled model: sizes, poses, masses, servos, names.

    Those of the search trees are left out: they change how fast contacts are found, and not which.
    """
    digest = hashlib.sha256()
    for name in sorted(dir(model)):
        if name.startswith(_SEARCH_TREES):
            continue
        value = None if name.startswith("_") else getattr(model, name)
        if isinstance(value, np.ndarray):
            digest.update(
                # The shape tells apart arrays whose bytes are equal.
                f"{name}{value.shape}".encode() + np.ascontiguousarray(value).tobytes()
            )
        elif isinstance(value, bytes | int | float):
            digest.update(f"{name}{value!r}".encode())
    return digest.hexdigest()[:16]


def _columns(addresses: Any) -> dict[str, list[int]]:
    """Columns of qpos and qvel: robot joints, then the first column of each object and of each link."""
    names = ("robot_q", "robot_v", "object_q", "object_v", "link_q")
    return {
        name: np.asarray(getattr(addresses, name)).astype(int).tolist() for name in names
    }


def _text(assets: Any) -> str:
    """An asset pack as text: its place, or its place and options as JSON."""
    return assets if isinstance(assets, str) else json.dumps(assets, sort_keys=True)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return (
        [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
    )
