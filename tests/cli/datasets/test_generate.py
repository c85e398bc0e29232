"""``mjhab generate`` and ``mjhab replay``: data sets from the command line, on the real environment."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.core.files.interrupts import stop_signals
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import open_shard
from mjhab.evaluation.generate import build_stage, make_job
from mjhab.evaluation.specs import GenerateSpec
from mjhab.tasks.style import Styles
from tests.data.record.test_replay import changed
from tests.data.record.worker_pools import InlinePool
from tests.refusals import command, refused


def machine(
    capsys: pytest.CaptureFixture[str], *args: str, code: int = 0
) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*args, "--json"]) == code
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 1
    return json.loads(lines[0])


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers of `mjhab generate` are in this process."""
    monkeypatch.setattr(
        "mjhab.evaluation.generate.make_pool", lambda workers, ray: InlinePool()
    )


COMMAND = (
    "generate",
    "--subtask",
    "pick",
    "--policy",
    "zero",
    "--worlds",
    "2",
    "--episodes",
    "2",
    "--threads",
    "2",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes by a worker process."""
    out = tmp_path_factory.mktemp("generate") / "set"
    assert main([*COMMAND, "--out", str(out)]) == 0
    return out


def test_generate_tells_machines_what_it_made(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = machine(capsys, *COMMAND, "--out", str(made), "--resume")
    assert {"written", "kept", "labels", "episodes_per_hour", "bytes_per_episode"} <= set(
        again
    )
    assert (again["written"], again["kept"], sum(again["labels"].values())) == (0, 2, 2)
    sizes = [path.stat().st_size for path in (made / "episodes").glob("*.h5")]
    assert again["bytes_per_episode"] == round(sum(sizes) / 2) and len(sizes) == 2
    found = list(episodes(made))
    assert [(episode.record.index, episode.steps) for episode in found] == [
        (0, 200),
        (1, 200),
    ]
    assert found[0].run.config["policy"] == {"name": "zero"}


def test_what_is_packed_is_the_same_and_goes_on(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(made, tmp_path / "packed"))
    query = ("data", "query", "--list", "2", "--where", "steps > 1")
    before = machine(capsys, *query, str(out))
    told = machine(capsys, "data", "pack", str(out))
    (shard,) = out.glob("*.h5")
    assert told == {"episodes": 2, "shards": 1, "bytes": shard.stat().st_size}
    assert not (out / "episodes").exists()
    after = machine(capsys, *query, str(out))
    for row in (*before["episodes"], *after["episodes"]):
        del row["shard"]
    assert before == after
    more = machine(capsys, *COMMAND, "--episodes", "3", "--out", str(out), "--resume")
    assert (more["written"], more["kept"]) == (1, 3)
    assert machine(capsys, "data", "check", str(out))["ok"] == 3
    with refused(where=tmp_path, said="nothing to pack"):
        command("data", "pack", tmp_path)


def test_episodes_that_the_policy_cannot_finish_end_with_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n"
        "class Mine:\n"
        "    name = 'mine'\n"
        "    def __init__(self, env): self.shape = (env.num_envs, 13)\n"
        "    def reset(self, mask): pass\n"
        "    def act(self, obs, info): return np.zeros(self.shape, np.float32)\n"
        "    def fault(self, world): return 'no answer within 30 s'\n"
    )
    policy = ("--policy", f"{tmp_path}/mine.py:Mine")
    out = tmp_path / "set"
    words = (*COMMAND, *policy, "--out", str(out))
    assert main([*words, "--json"]) == 1
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert (found["kept"], found["tried"], found["errors"]) == (0, 2, 2)
    assert "could not finish 2 episodes" in told.err and "no answer within" in told.err
    assert not (out / "tried.jsonl").exists()


def test_the_library_function_goes_on_with_what_the_command_began(
    made: Path, tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(made, out)
    more = mjhab.generate(
        "zero", subtask="pick", episodes=3, worlds=2, threads=2, out=out, resume=True
    )
    assert (more.summary["written"], more.summary["kept"]) == (1, 3)


def test_replay_verifies(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = machine(capsys, "replay", str(made), "--verify", "--worlds", "2")
    assert found == {"episodes": 2, "exact": 2, "max_error": 0.0, "unlike": 0, "moved": 0}

    def shift(arrays: dict[str, Any]) -> None:
        arrays["states/qpos"][5] += 1e-9

    wrong = changed(made, tmp_path / "wrong.h5", shift)
    found = machine(
        capsys,
        "replay",
        str(wrong),
        "--verify",
        "--where",
        "index == 1",
        "--worlds",
        "1",
        code=1,
    )
    assert (found["episodes"], found["exact"]) == (1, 0) and 0.9e-9 < found[
        "max_error"
    ] < 1.1e-9


def test_replay_renders(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "depth.h5"
    command = (
        "replay",
        str(made),
        *"--render depth --cameras fetch_hand --camera-size 12 16 --where".split(),
        "index == 1",
        "--out",
        str(out),
    )
    found = machine(capsys, *command)
    assert (found["episodes"], found["frames"]) == (1, 201) and found["bytes"] > 0
    with open_shard(out) as shard:
        assert next(iter(shard)).frame("fetch_hand", "depth", 200).shape == (12, 16, 1)


def test_the_profile_is_recorded_and_reaches_the_environment(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "out": tmp_path,
        "task": "tidy_house",
        "subtask": "pick",
        "episodes": 1,
        "worlds": 1,
        "profile": "ms_hab",
    }
    config = make_job(GenerateSpec.of(**options)).config
    assert (config["profile"], config["stillness"], config["spawn_rule"]) == (
        "ms_hab",
        "published",
        "published",
    )
    assert "starts" not in config
    stage = build_stage(GenerateSpec.of(**options))
    assert stage.env.config.profile == "ms_hab" and stage.env.config.stationary == (
        "head",
    )
    for change, name in (
        ({"stillness": "absolute"}, "stillness"),
        ({"cameras": ("fetch_hand",)}, "cameras"),
    ):
        with refused(name, where="profile 'ms_hab'"):
            make_job(GenerateSpec.of(**{**options, **change}))
    shorter = build_stage(GenerateSpec.of(**{**options, "horizon": 50}))
    assert shorter.env.config.horizon == 50 and shorter.env.config.profile == "ms_hab"
    with refused("horizon", -1):
        GenerateSpec.of(**{**options, "horizon": -1})
    one_camera = make_job(
        GenerateSpec.of(**{**options, "profile": "mjhab", "cameras": ("fetch_hand",)})
    )
    assert one_camera.config["cameras"] == ["fetch_hand"]


def test_what_cannot_work_is_refused_before_anything_is_built(
    made: Path, tmp_path: Path
) -> None:
    out = ("--out", str(tmp_path / "new"))
    shard = ("--out", str(tmp_path / "new.h5"))
    one = ("generate", "--episodes", "1")
    replay = ("replay", str(made))
    own = str(min(made.rglob("*.h5")))
    for args, told in (
        (("generate", "--subtask", "pick", *out), dict(option="episodes")),
        ((*one, "--subtask", "pik", *out), dict(option="subtask", expected="pick")),
        ((*one, "--keep", "lable == 'x'", *out), dict(said="column 1")),
        ((*one, "--images", "dept", *out), dict(option="observation mode")),
        ((*one, "--out", str(made)), dict(option="out", advice="Give --resume")),
        (
            (*one, "--subtask", "place", "--resume", "--out", str(made)),
            dict(said="another"),
        ),
        ((*one, "--ray", "127.0.0.1:1", *out), dict(said="Ray")),
        (replay, dict(said="--verify, or --render")),
        ((*replay, "--verify", "--render", "rgb"), dict(said="one of the two")),
        ((*replay, "--render", "rgb"), dict(option="out", where="render")),
        ((*replay, "--render", "rgb", "--out", own), dict(option="out", given=own)),
        (("replay", "--verify"), dict(said="name shards")),
        ((*replay, "--render", "depth", *out), dict(given=out[1], expected=".h5")),
        ((*replay, "--render", "dept", *shard), dict(expected="depth")),
        (
            (*replay, "--render", "depth", "--cameras", "follow", *shard),
            dict(said="colour only"),
        ),
    ):
        with refused(**told):
            command(*args)
    assert not list(tmp_path.glob("new*"))


def test_a_quota_that_was_not_filled_fails(
    inline: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = machine(
        capsys,
        *COMMAND,
        *"--target 024_bowl --per-target 1 --keep success --out".split(),
        str(tmp_path),
        code=1,
    )
    assert (found["written"], found["kept"], found["tried"], found["yield"]) == (
        0,
        0,
        2,
        0.0,
    )
    assert found["labels"] == {} and found["bytes_per_episode"] == 0


def test_signals_are_noted_and_given_back() -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    with stop_signals() as stopped:
        assert not stopped()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


def test_ray_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from mjhab.data.record.ray_workers import RayPool

    monkeypatch.setitem(sys.modules, "ray", None)
    with refused("--ray", said=("pip install", "[scale]'")):
        RayPool("local")


def test_styles_are_drawn_per_episode_and_kept_with_it(
    inline: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "styled"
    words = ("--style", "release=drop", "speed=0.7..0.9", "hold=2")
    machine(
        capsys,
        *COMMAND,
        *"--subtask place --policy expert".split(),
        *words,
        "--out",
        str(out),
    )
    made = list(episodes(out))
    for episode in made:
        style = episode.record.style
        assert style == Styles.parse(words[1:]).draw(0, episode.record.index).__dict__
        assert json.loads(episode.attributes["style"]) == style
        assert episode.run.config["policy"]["style"] == [
            "speed=0.7..0.9",
            "release=drop",
            "hold=2",
        ]
    assert len({episode.record.style["speed"] for episode in made}) == 2
    found = machine(
        capsys,
        "data",
        "query",
        str(out),
        "--where",
        "style.speed < 0.95 and style.release == 'drop'",
    )
    assert (found["matched"], found["of"]) == (2, 2)
    with refused(said="style"):
        command(*COMMAND, *"--subtask place --policy expert --resume --out".split(), out)


OWN = """
import numpy as np

class Still:
    name = "still"
    env_options = {"obs_mode": "depth", "camera_size": 16, "horizon": 3}
    def reset(self, mask):
        self.worlds = len(mask)
    def act(self, obs, info):
        assert obs["sensor_data/fetch_hand/depth"].shape == (self.worlds, 16, 16, 1)
        return np.zeros((self.worlds, 13))
"""


def test_a_policy_of_ones_own(
    inline: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(OWN)
    words = (*COMMAND, "--policy", f"{file}:Still")
    seen = tmp_path / "seen"
    assert machine(capsys, *words, "--out", str(seen))["kept"] == 2
    found = list(episodes(seen))
    policy = found[0].run.config["policy"]
    assert [episode.steps for episode in found] == [3, 3]
    assert (
        policy["name"] == "mine.py:Still" and policy["env_options"]["obs_mode"] == "depth"
    )
    assert len(policy["policy_sha256"]) == 64
    with refused("camera_size", expected="16"):
        command(*words, "--images", "rgb", "--out", tmp_path / "other")
    stored = tmp_path / "stored"
    machine(
        capsys, *words, "--images", "rgb", "--camera-size", "16", "--out", str(stored)
    )
    episode = next(episodes(stored))
    assert episode.frame("fetch_hand", "rgb", 0).shape == (16, 16, 3)
    assert episode.frame("fetch_hand", "depth", 0).shape == (16, 16, 1)
    file.write_text(OWN + "# another version")
    with refused(said="policy_sha256"):
        command(*words, "--resume", "--out", seen)
    with refused("class", "Stil", expected="Still"):
        command(*COMMAND, "--policy", f"{file}:Stil", "--out", tmp_path / "new")
    assert not (tmp_path / "new").exists()
