"""An evaluation of a VLA that others published for MS-HAB, unchanged, over their fork of it that shows colours.

Its policy server is ``examples/policy_server.py``, which knows nothing of mjhab. What differs from their use is given
from outside: plans, spawns, steps and homes in a configuration file, the number of episodes and the port as arguments.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Protocol

EXAMPLES = Path(__file__).parents[2] / "examples"
EPISODES = 2
CONFIG = """
env_id: CloseSubtaskTrain-v0
num_envs: 1
max_episode_steps: 12
obs_mode: rgbd
continuous_task: True
cat_state: False
cat_pixels: False
frame_stack: null
task_plan_fp: {plans}
spawn_data_fp: {spawns}
record_video: True
env_kwargs: {{require_build_configs_repeated_equally_across_envs: False}}
"""


class Runner(Protocol):
    """`originals.Runs`, as far as it is needed here."""

    out: Path
    rearrange: Path

    def run(self, name: str, *command: str | Path, **env: str) -> bool:
        """Run a command of this interpreter."""
        ...


def evaluate_vla(runs: Runner, checkout: Path) -> bool:
    """Run ``examples/mshab/main.py`` of a checkout; whether all of its episodes came to their end.

    It goes on after errors and exits with 0, so its log tells.
    """
    checkout = checkout.resolve()
    kind = "set_table/close/train"
    config = runs.out / "vla.yml"
    plans = runs.rearrange / "task_plans" / kind / "kitchen_counter.json"
    spawns = runs.rearrange / "spawn_data" / kind / "spawn_data.pt"
    config.write_text(CONFIG.format(plans=plans, spawns=spawns))
    paths = (checkout / "third_party/mshab", checkout / "packages/openpi-client/src")
    found = [*map(str, paths), *filter(None, [os.environ.get("PYTHONPATH")])]
    script = checkout / "examples/mshab/main.py"
    command = [sys.executable, str(EXAMPLES / "policy_server.py"), "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            options = {
                "mshab-env-config-path": config,
                "num-eval-episodes": EPISODES,
                "host": "localhost",
                "port": server.stdout.readline().strip(),
                "video-out-path": runs.out / "vla_films",
            }
            given = [
                str(x) for key, value in options.items() for x in (f"--args.{key}", value)
            ]
            began = runs.run(
                "vla",
                "-m",
                "mjhab.compat.mshab",
                script,
                *given,
                PYTHONPATH=os.pathsep.join(found),
            )
        finally:
            server.terminate()
    log = (runs.out / "vla.log").read_text()
    return began and f"{EPISODES}/{EPISODES}" in log and "ERROR" not in log
