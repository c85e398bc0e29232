"""Generation as a library function: what `mjhab generate` does, from Python."""

from __future__ import annotations

import doctest
import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.assets.sources import licence_of
from mjhab.data.record.job import Standing
from mjhab.data.record.workers import ALL
from mjhab.evaluation import generate as library
from mjhab.evaluation.generate import (
    GenerateSpec,
    build_stage,
    make_job,
    resolved_config,
    run_generation,
)
from mjhab.evaluation.resolve import PolicyFacts
from mjhab.rollout.policy import ZeroPolicy
from tests.data.fake_world import FakeEnv
from tests.refusals import refused


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Environments without physics in the place of real ones; the options that were asked for."""
    asked: list[dict[str, Any]] = []

    def make_env(evaluation: Any, options: dict[str, Any]) -> FakeEnv:
        asked.append(options)
        return FakeEnv(min(evaluation.asked.num_envs, evaluation.episodes))

    monkeypatch.setattr(library, "make_env", make_env)
    return asked


class Own(ZeroPolicy):
    """A policy of a user."""

    name = "own"
    env_options = {"obs_mode": "depth", "camera_size": 32}  # noqa: RUF012


def test_the_example_of_the_docstring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(
        mjhab.generate, "mjhab.generate", globs={}
    )
    assert len(example.examples) > 3
    assert doctest.DocTestRunner().run(example).failed == 0
    folder = tmp_path / "runs" / "close" / "episodes"
    (file,) = folder.glob("*.h5")
    assert file.stem.endswith("-0-0000000") and (folder / "index.jsonl").is_file()


def test_the_example_of_the_docstring_of_evaluate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(
        mjhab.evaluate, "mjhab.evaluate", globs={}
    )
    assert len(example.examples) > 3
    assert doctest.DocTestRunner().run(example).failed == 0
    assert (tmp_path / "runs" / "zero" / "report.html").exists()


def test_policies_of_ones_own(built: list[dict[str, Any]], tmp_path: Path) -> None:
    sets = [
        mjhab.generate(policy, episodes=6, worlds=4, out=tmp_path / str(number))
        for number, policy in enumerate(
            ["zero", ZeroPolicy(), ZeroPolicy, lambda env: ZeroPolicy()]
        )
    ]
    first = [episode.array("actions") for episode in sets[0].episodes()]
    assert len(first) == 6
    for made in sets:
        assert (
            made.summary["kept"] == made.summary["written"] == 6
            and made.standing.complete
            and not made.is_short
        )
        np.testing.assert_equal(
            [episode.array("actions") for episode in made.episodes()], first
        )
    mjhab.generate(Own, episodes=1, stillness="published", out=str(tmp_path / "own"))
    asked = {"obs_mode": "depth", "camera_size": 32, "stillness": "published"}
    assert asked.items() <= built[-1].items()


def test_a_stopped_generation_goes_on(
    built: list[dict[str, Any]], tmp_path: Path
) -> None:
    told: list[Standing] = []
    spec = GenerateSpec.of(tmp_path / "set", "random", episodes=12, worlds=2)
    first = run_generation(spec, told.append, lambda: any(now.kept for now in told))
    assert (
        0 < first.standing.kept < 12
        and not first.standing.complete
        and told[-1].kept == first.standing.kept
    )
    with refused("out", expected="empty"):
        run_generation(spec)
    second = run_generation(replace(spec, resume=True))
    assert (
        second.standing.complete and second.summary["written"] == 12 - first.standing.kept
    )
    assert [episode.record.index for episode in second.episodes()] == list(range(12))


def test_ctrl_c_keeps_what_is_finished(
    built: list[dict[str, Any]], tmp_path: Path
) -> None:
    class Impatient(ZeroPolicy):
        left = 30

        def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt
            return super().act(obs, info)

    with pytest.raises(KeyboardInterrupt):
        mjhab.generate(Impatient(), episodes=20, worlds=2, out=tmp_path)
    made = mjhab.generate(ZeroPolicy(), episodes=20, worlds=2, out=tmp_path, resume=True)
    assert 0 < made.summary["written"] < made.summary["kept"] == 20


def test_there_are_never_more_workers_than_episodes(tmp_path: Path) -> None:
    spec = GenerateSpec.of(
        out=tmp_path, policy="zero", subtask="close", episodes=3, workers=200
    )
    assert make_job(spec).workers == 3
    spec = GenerateSpec.of(out=tmp_path, policy="zero", subtask="close", per_target=10**9)
    assert make_job(spec).episodes == 100_000_000


def test_a_quota_that_is_not_filled_is_told(
    built: list[dict[str, Any]], tmp_path: Path
) -> None:
    made = mjhab.generate(
        "random", episodes=4, per_target=3, keep="steps < 0", out=tmp_path / "set"
    )
    assert made.is_short and made.standing.complete and made.summary["tried"] == 4
    assert (made.summary["kept"], made.summary["yield"], made.summary["labels"]) == (
        0,
        0.0,
        {},
    )


def test_what_cannot_work_is_refused_before_anything_is_built(
    built: list[dict[str, Any]], tmp_path: Path
) -> None:
    unknown = "option of a data set"
    told: dict[str, Any]
    for options, told in (
        ({"per_target": 0}, dict(option="episodes", advice="Give per_target")),
        ({"per_target": -1}, dict(option="per_target", given=-1)),
        ({"episodes": 0}, dict(option="episodes", given=0)),
        ({"episodes": 10**18}, dict(option="episodes", given=10**18)),
        ({"per_target": 10**18}, dict(option="per_target", given=10**18)),
        ({"workers": 10**6}, dict(option="workers", expected="at most 256")),
        ({"workers": -1}, dict(option="workers", given=-1)),
        ({"worlds": 0}, dict(option="worlds", given=0)),
        ({"subtask": "pik"}, dict(option="subtask", expected="pick")),
        ({"style": ("speed=2",)}, dict(said="speed")),
        ({"keep": "lable == 'x'"}, dict(said="column 1")),
        ({"preset": "pick_papr"}, dict(expected="pick_paper")),
        ({"images": "dept"}, dict(option="observation mode", given="dept")),
        ({"images": "rgb", "rgb": "gif"}, dict(option="image format", given="gif")),
        ({"images": "rgb", "cameras": ("head",)}, dict(option="camera", given="head")),
        ({"episode": 3}, dict(option=unknown, given="episode", expected="episodes")),
        ({"spawns": "x.npz"}, dict(option=unknown, given="spawns")),
        ({"env": {"cameras": ("fetch_hand",)}}, dict(option=unknown, given="cameras")),
        ({"policy": "exprt"}, dict(option="policy", expected="expert")),
        ({"stillness": "relative"}, dict(said="stillness")),
        ({"policy": Own, "images": "rgb"}, dict(option="camera_size", expected="32")),
        (
            {"policy": functools.partial(Own), "workers": 1, "style": ("hold=2",)},
            dict(option="style", given=("hold=2",)),
        ),
        (
            {"policy": lambda env: Own(), "workers": 1},
            dict(said="cannot be sent to worker processes"),
        ),
        ({"ray": "127.0.0.1:1"}, dict(said="Ray")),
    ):
        with refused(**told):
            mjhab.generate(
                **{
                    "episodes": None if "per_target" in options else 1,
                    "out": tmp_path / "set",
                    **options,
                }
            )
    assert not built and not (tmp_path / "set").exists()
    with pytest.raises(TypeError, match="out"):
        mjhab.generate("zero", episodes=1)  # type: ignore[call-arg]


def test_targets_that_quotas_count(tmp_path: Path) -> None:
    stage = build_stage(
        GenerateSpec.of(tmp_path, "random", subtask="open", episodes=1, threads=1)
    )
    assert stage.targets == ("kitchen_counter/drawer3", "fridge/top_door")
    assert stage.about == {"name": "random", "seed": 0} and stage.licence == ""
    stage.env.close()
    job = make_job(GenerateSpec.of(tmp_path, per_target=5, images="depth", rgb="jpeg"))
    assert job.episodes >= 500 and job.spec.images is not None and job.spec.states


def test_whole_tasks_and_navigate_have_one_quota(
    built: list[dict[str, Any]], tmp_path: Path
) -> None:
    cases: list[dict[str, Any]] = [
        {},
        {"subtask": "navigate"},
        {"subtask": "navigate", "target": "024_bowl"},
    ]
    for options in cases:
        assert build_stage(
            GenerateSpec.of(tmp_path, episodes=1, policy="zero", **options)
        ).targets == (ALL,)
    one = build_stage(
        GenerateSpec.of(
            tmp_path, episodes=1, policy="zero", subtask="pick", target="024_bowl"
        )
    )
    assert one.targets == ("024_bowl",)


def test_the_configuration_holds_what_decides_and_nothing_else(tmp_path: Path) -> None:
    spec = GenerateSpec.of(tmp_path, episodes=1)
    config = resolved_config(spec, PolicyFacts("expert"))
    assert "style" not in config and "env" not in config
    free: dict[str, Any] = {
        "episodes": 9,
        "per_target": 2,
        "worlds": 9,
        "workers": 3,
        "threads": 2,
        "ray": "local",
    }
    assert (
        resolved_config(
            GenerateSpec.of(tmp_path / "b", resume=True, **free), PolicyFacts("expert")
        )
        == config
    )
    for change in (
        {"seed": 1},
        {"states": False},
        {"reward_mode": "dense"},
        {"keep": "success"},
        {"style": ("hold=2", "speed=0.5..1")},
        {"env": {"open_start": 0.5}},
        {"env": {"horizon": 7}},
    ):
        assert (
            resolved_config(
                GenerateSpec.of(**{"out": tmp_path, "episodes": 1, **change}),
                PolicyFacts("expert"),
            )
            != config
        ), change
    asked = resolved_config(
        replace(spec, style=("hold=2", "speed=0.5..1")), PolicyFacts("expert")
    )
    assert asked["style"] == ["speed=0.5..1.0", "hold=2"]


def test_licence_of_public_assets(tmp_path: Path) -> None:
    assert licence_of("builtin") == "" == licence_of(str(tmp_path))
    for name in (
        "configs/scenes/a.scene_instance.json",
        "configs/objects/a.object_config.json",
        "urdf/a/a.urdf",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert "CC BY" in licence_of(str(tmp_path)) and "YCB" in licence_of(
        str(tmp_path / "apt_0")
    )
