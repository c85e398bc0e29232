"""Hashes of what must be the same under every version of Python, as JSON: models, starts, and states under actions.

    python tests/bits/bits_of.py

Its folder of cached files should be empty, so that this interpreter computes everything itself.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

import numpy as np

import mjhab
from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.layout.compile import compile_home, home_hash

SUBTASKS = (("set_table", "close"), ("prepare_groceries", "place"))
STEPS = 5
MODEL_ARRAYS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_invweight0",
    "dof_invweight0",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "jnt_range",
    "qpos0",
)


def main() -> None:
    print(json.dumps({name: hashed(array) for name, array in results()}))


def hashed(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def results() -> Iterator[tuple[str, np.ndarray]]:
    """Name and array of every result."""
    yield "arithmetic", np.frombuffer(arithmetic_digest(), np.uint8)
    for task, subtask in SUBTASKS:
        env = mjhab.make(task=task, subtask=subtask, num_envs=2, autoreset="disabled")
        inner = env.unwrapped
        env.reset(seed=0)
        home = inner.layout.pack.homes[0]
        model = compile_home(inner.layout, home)
        yield (
            f"{task} hash",
            np.frombuffer(home_hash(inner.layout, home).encode(), np.uint8),
        )
        for name in MODEL_ARRAYS:
            yield f"{task} {home.name} {name}", getattr(model, name)
        yield f"{task} start", inner.sim.qpos.copy()
        random = np.random.default_rng(0)
        for _ in range(STEPS):
            env.step(random.uniform(-1, 1, (2, *inner.single_action_space.shape)))
        yield f"{task} after {STEPS} steps", inner.sim.qpos.copy()
        env.close()


if __name__ == "__main__":
    main()
