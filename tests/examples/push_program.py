"""What test_push runs in a process of its own: the example from its environment to its report."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np

import mjhab
from mjhab.cli.main import main
from mjhab.data.store.places import episodes
from mjhab.tasks.subtasks.registry import SUBTASKS

ENV_ID = "mjhab/PushSubtaskTrain-v1"
EPISODES = 2
HORIZON = 150


def captured(*args: str) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert main(args) == 0, text.getvalue()
    return text.getvalue()


def trains() -> None:
    """The environment of the id steps, with a dense reward between 0 and 1 that sums the terms of Push."""
    env: Any = gymnasium.make_vec(ENV_ID, num_envs=2, threads=1, episode_pool=2).unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        _, reward, *_, info = env.step(action)
        terms = info["reward_terms"]
        assert set(terms) == {"reach", "push", "in_zone", "rest", "force", "success"}
        assert ((reward > 0) & (reward <= 1)).all()
        total = (
            sum(terms.values()) / env.rewarder.dense.tables[info["kind"][0]].attainable
        )
        np.testing.assert_allclose(reward, total)
    assert [spec["plan"][0]["kind"] for spec in info["episode_spec"]] == ["push", "push"]
    env.close()


def records(out: Path) -> None:
    """A worker process records episodes, which are labelled by the rules of Push."""
    made = mjhab.generate(
        "expert",
        task="push_objects",
        subtask="push",
        episodes=EPISODES,
        horizon=HORIZON,
        workers=1,
        worlds=EPISODES,
        threads=1,
        out=out,
    )
    assert made.summary["kept"] == EPISODES
    assert set(made.summary["labels"]) <= set(SUBTASKS["push"].labels)
    assert made.summary["labels"]["push_success"] >= 1, made.summary
    for episode in episodes(out):
        (subtask,) = episode.record.subtasks
        assert subtask.kind == "push" and subtask.legacy_label is None


def uses(out: Path) -> None:
    """Recorded episodes are filtered, labelled anew, exported and reported."""
    exported = out.with_name("exported")
    mine = captured("data", "query", str(out), "--where", "subtask == 'push'")
    labels = ", ".join(repr(label) for label in SUBTASKS["push"].labels)
    assert captured("data", "query", str(out), "--where", f"label in [{labels}]") == mine
    assert (
        captured("data", "query", str(out), "--where", "touched or not touched") == mine
    )
    assert main(["data", "query", str(out), "--where", "label == 'pushed'"]) == 2
    assert main(["label", str(out)]) == 0
    assert main(["export", "maniskill", str(out), "--out", str(exported)]) == 0
    found = list(exported.rglob("*.h5"))
    assert found
    for path in found:
        with h5py.File(path) as file:
            assert len(file) > 0
    page = exported / "report.html"
    assert main(["data", "report", str(out), "--out", str(page)]) == 0
    assert "push" in page.read_text(encoding="utf-8")


def learns(out: Path) -> None:
    """A student learns from the recorded episodes."""
    run = out.with_name("student")
    args = ("train", "bc", "--task", "push_objects", "--subtask", "push")
    data = ("--data", str(out), "--where", "subtask == 'push'", "--preset", "state")
    few = ("--updates", "2", "--round-episodes", "0", "--eval-episodes", "0")
    told = captured(*args, *data, *few, "--out", str(run), "--json").splitlines()[-1]
    assert json.loads(told)["demonstrations"] == EPISODES
    assert (run / "student.safetensors").is_file()


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    listed = json.loads(captured("envs", "list", "--json").splitlines()[-1])["envs"]
    mine = next(env for env in listed if env["id"] == ENV_ID)
    assert mine["subtask"] == "push" and mine["task"] == "push_objects"
    assert mine["plugin"].endswith("examples/push")
    trains()
    records(folder / "push")
    uses(folder / "push")
    learns(folder / "push")
    print("all of Push works")
