"""The example of a policy server: it knows nothing of mjhab, and mjhab acts by it."""

from __future__ import annotations

import ast
import subprocess
import sys

import numpy as np

from mjhab.evaluation.parts import close_policy, requests_of
from mjhab.evaluation.resolve import resolve_policy
from mjhab.rollout.loop import rollout
from tests.evaluation.served.test_policy import world
from tests.examples.plugins import EXAMPLES

FILE = EXAMPLES / "policy_server.py"


def test_it_is_30_lines_that_do_not_know_mjhab() -> None:
    tree = ast.parse(FILE.read_text(encoding="utf-8"))
    imported = {
        name
        for node in ast.walk(tree)
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [str(node.module)]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert imported == {"argparse", "msgpack", "numpy", "websockets.sync.server"}
    written = [line for line in ast.unparse(tree).splitlines() if line.strip()]
    assert len(written) <= 35


def test_mjhab_acts_by_it() -> None:
    server = subprocess.Popen(
        [sys.executable, str(FILE), "0"], stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    try:
        port = int(server.stdout.readline())
        env = world(num_envs=2, obs_mode="rgb", camera_size=16)
        for options in ("", "?real_time=yes&latency_ms=100&execute=4"):
            policy = resolve_policy(f"ws://localhost:{port}{options}", env)
            obs, info = env.reset(seed=0)
            policy.reset(np.ones(2, bool))
            actions = [policy.act(obs, info) for _ in range(4)]
            brightness = obs["sensor_data/fetch_head/rgb"].mean((1, 2, 3)) / 255.0
            np.testing.assert_allclose(actions[-1][:, 11], brightness, rtol=1e-5)
            assert not np.delete(actions[-1], 11, axis=1).any()
            close_policy(policy)
        assert requests_of(policy)["late_steps"] == 4
        policy = resolve_policy(f"ws://localhost:{port}", env)
        records = rollout(env, policy, [0, 1], seed=0, max_steps=3)
        assert not any(record.error for record in records)
        close_policy(policy)
        env.close()
    finally:
        server.kill()
        server.wait()
        server.stdout.close()
