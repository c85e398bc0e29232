"""Names of the package that nothing uses: ``python tests/guard/dead_names.py`` (vulture); ``make check`` runs it.

Functions, classes, methods, properties and constants count; attributes and other variables do not, because those of
MuJoCo's, Warp's and viser's objects are set all over. Tests do not count as users. What only a string names is used:
the tables of commands, policies, packs and public names.
"""

from __future__ import annotations

import ast
import fnmatch
import sys
from collections.abc import Iterator
from pathlib import Path

from vulture import Vulture

ROOT = Path(__file__).parents[2]
PATHS = ("src/mjhab", "benchmarks", "examples", "docs/scripts", "plugins")
KINDS = ("function", "class", "method", "property")
EXCEPTIONS: dict[str, tuple[str, ...]] = {
    "Python, numba, io, gymnasium, OMPL, torch and Warp call them": (
        *("__getattr__", "__dir__", "on_start", "on_end", "checkMotion", "set_epoch"),
        *("readable", "writable", "seekable", "readinto", "allocate", "deallocate"),
        *("_flatdim", "_flatten", "_flatten_space", "_unflatten", "_LanesModel"),
    ),
    "adapters: vla-eval, LeRobot, stable-baselines3, rsl_rl and torchrl call them": (
        *("MjhabBenchmark", "MjhabEnvConfig", "create_envs", "configure_render"),
        *("get_tasks", "get_step_result", "get_metric_keys", "get_metadata"),
        *("get_action_spec", "get_observation_spec", "get_hold_action", "make_obs"),
        *("get_observations", "step_async", "step_wait", "get_attr", "set_attr"),
        *("env_method", "env_is_wrapped", "_reset", "_set_seed", "to_*"),
    ),
    "for users and plugins, documented": (
        *("register_policy_kind", "save_pack", "write_hab", "from_json", "check_taint"),
        *("get_frames", "set_frames", "target_words", "ms_hab_policy"),
    ),
    "another process runs it": ("serve_still",),
    "registries take whatever of their type a module holds": (
        *("PD_*", "CAMERA", "LAYOUT", "LIGHT", "*_GROCERIES", "*_HOUSE", "SET_TABLE"),
    ),
    "tell what docstrings refer to": ("AGENT_RADIUS_M", "PRIVILEGED", "ATTRIBUTES"),
    "tests look at them": ("pids", "parked", "check_above", "check_kind"),
}
"""Why nothing here calls them: patterns of names."""
OF_SCRIPTS = "src/mjhab/compat/"
"""What lies here is called by scripts that were written for other simulators, by their names."""


def named_in_strings() -> Iterator[str]:
    """The last part of every "module:name" in the sources, and the public names of `mjhab`."""
    for path in (ROOT / "src" / "mjhab").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value.rpartition(":")[2]


def dead_names() -> list[str]:
    """A line for each name without a user that no exception excuses."""
    reader = Vulture()
    reader.scavenge([str(ROOT / path) for path in PATHS])
    used = set(named_in_strings())
    excused = [pattern for patterns in EXCEPTIONS.values() for pattern in patterns]
    lines = []
    for item in reader.get_unused_code(min_confidence=60):
        path = Path(item.filename).relative_to(ROOT)
        name = str(item.name)
        outside = "examples" in path.parts or path.as_posix().startswith(OF_SCRIPTS)
        counts = item.typ in KINDS or (item.typ == "variable" and name.isupper())
        if not counts or name in used or outside:
            continue
        if not any(fnmatch.fnmatchcase(name, pattern) for pattern in excused):
            lines.append(f"{path}:{item.first_lineno}: {item.typ} {name}")
    return lines


if __name__ == "__main__":
    found = dead_names()
    print("\n".join(found))
    sys.exit(1 if found else 0)
