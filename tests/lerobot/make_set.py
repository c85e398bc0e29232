"""Record a small set with images for `make test-lerobot`: random actions in real homes.

python make_set.py FOLDER EPISODES
"""

from __future__ import annotations

import sys
from pathlib import Path

from mjhab.data.record.recorder import Recorder
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.shard import ShardWriter
from mjhab.envs import make
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy

STEPS = 30
SIZE = 128
WORLDS = 4


def main(folder: Path, episodes: int) -> None:
    """Pick and Place in equal numbers, so that there are several tasks and shards."""
    for subtask, count in (("pick", episodes - episodes // 2), ("place", episodes // 2)):
        env = make(
            task="set_table",
            subtask=subtask,
            num_envs=WORLDS,
            autoreset="disabled",
            obs_mode="rgbd+seg",
            camera_size=SIZE,
            seed=0,
        )
        path = folder / f"{subtask}.h5"
        path.unlink(missing_ok=True)
        with ShardWriter(path) as writer:
            recorder = Recorder(writer, env, {"name": "random"}, images=ImageFormat())
            rollout(
                env, RandomPolicy(0), list(range(count)), 0, [recorder], max_steps=STEPS
            )
        print(f"{path}: {recorder.kept} episodes")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
