"""Take-over DAgger from nothing, in the real environment: one episode of everything."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.core.names import kind_of
from mjhab.core.registration.plugins import load_plugin
from mjhab.data.store.places import episodes
from mjhab.evaluation.evaluate import evaluate
from mjhab.learning.checkpoint import load_checkpoint, load_student
from mjhab.learning.configs import (
    DaggerConfig,
    ImitationConfig,
    InputConfig,
    NetworkConfig,
)
from mjhab.learning.demos import recorded_profile
from mjhab.learning.reinforcement.configs import RLPD, ReinforcementConfig, SacConfig
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs.collection import make_env
from mjhab.learning.runs.request import layout_for
from mjhab.learning.runs.specs import ImitationSpec, Resources, Scene
from mjhab.reports import students as students_report
from mjhab.robots.registry import ROBOTS, robot_named
from mjhab.tasks.plan import GOAL_OF
from tests.learning.small import config, train_in
from tests.onnx_file import HAS_ONNX, tiny_backbone
from tests.refusals import refused

BOXY = Path(__file__).parents[2] / "examples" / "robot" / "boxy.py"
HOLD_STEPS = 5
INPUTS = InputConfig(image_size=16, base_velocity=True, target_views=True)
SCENE = Scene(
    "set_table",
    "close",
    "kitchen_counter/drawer3",
    home="builtin_m0_00",
    profile="ms_hab",
)


def env_of(scene: Scene, worlds: int = 1) -> dict[str, Any]:
    """Options of a specification; 0 worlds leaves their number to the preset."""
    return {**scene.env_options(), "threads": 1, "worlds": worlds or None}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ImitationSpec]:
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("run")
    given = tiny_backbone(tmp_path_factory.mktemp("frozen") / "tiny.onnx")
    inputs = dataclasses.replace(INPUTS, backbone=str(given) if HAS_ONNX else "")
    student = config(inputs=inputs, demos=1, updates=2, hold_steps=HOLD_STEPS)
    dagger = DaggerConfig(
        rounds=1, episodes=1, updates=2, first_prefix=4, horizon=220, final_updates=1
    )
    request = ImitationSpec.of(
        out=out,
        preset=ImitationConfig(student, dagger),
        **env_of(SCENE),
        eval_episodes=1,
        round_episodes=0,
    )
    train_in(request, out)
    return out, request


def test_a_run_leaves_a_student_data_and_an_evaluation(
    run: tuple[Path, ImitationSpec],
) -> None:
    out, _ = run
    student = load_student(out / "student.safetensors")
    assert student.layout.state_width == 42 and student.layout.targets == (
        "kitchen_counter/drawer3",
    )
    assert ("base/turning_rate", 1) in student.layout.entries
    assert load_checkpoint(out / "training.safetensors").about["step"] == 5
    assert student.layout.profile == "ms_hab" and student.layout.control[2:] == ("head",)
    judged = json.loads(
        (out / "evaluations" / "latest" / "config.json").read_text(encoding="utf-8")
    )
    assert (judged["profile"], judged["horizon"], judged["policy_profile"]) == (
        "ms_hab",
        200,
        "ms_hab",
    )
    assert (out / "evaluations" / "latest" / "report.html").is_file()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'id="loss-plot"' in page and 'src="http' not in page
    assert "latest, episode_00000" in page and page.count("<video") == 1
    first, second = (
        list(episodes(out / "data" / f"round_00{number}")) for number in range(2)
    )
    assert len(first) == len(second) == 1


def test_rlpd_learns_from_recorded_episodes_with_rewards_of_its_own(
    run: tuple[Path, ImitationSpec], tmp_path: Path
) -> None:
    out, _ = run
    told = ReinforcementSpec.of(
        out=tmp_path,
        preset=ReinforcementConfig(
            RLPD,
            "tiny",
            InputConfig(cameras=(), image_size=0, previous_action=False, link_state=True),
            NetworkConfig(hidden=16, layers=1),
            sac=SacConfig(batch=8, warm_up=4, capacity=64, demonstrations=1),
            samples=8,
            worlds=2,
        ),
        **env_of(SCENE, worlds=0),
        eval_episodes=0,
        round_episodes=0,
        data=(out / "data",),
    )
    with refused(said="reward_mode sparse instead of normalized_dense"):
        train_in(told, tmp_path / "refused")
    told = dataclasses.replace(told, recompute_rewards=True)
    result = train_in(told, tmp_path / "run")
    assert result.summary["demonstrations"] == 2
    kept = tmp_path / "run" / "demonstrations"
    position = json.loads((kept / "complete.json").read_text(encoding="utf-8"))[
        "position"
    ]
    recorded = [
        episode
        for part in (0, 1)
        for episode in episodes(out / "data" / f"round_00{part}")
    ]
    # The first control step only leads into the recorded episode; an entry with what was seen last ends it.
    assert sum(position) == sum(episode.steps for episode in recorded)
    begins, reward = (np.load(kept / f"{name}.npy") for name in ("begins", "reward"))
    assert begins.sum() == sum(episode.steps - 1 for episode in recorded)
    paid = reward[begins]
    assert 0.0 < paid.min() < 0.5 < paid.max() <= 1.0
    vector = np.load(kept / "vector.npy")
    state = vector[0, 0, :42]
    assert any(
        np.allclose(state, episode.array("obs/state")[1], atol=1e-5)
        for episode in recorded
    )
    # The drawer is open at first and shut in the end; its heading is a direction.
    link = vector[0, : np.argmin(begins[0]) + 1, 42:46]
    assert link[0, 0] > 0.8 and link[-1, 0] < 0.01 and link[:, 1].min() < -0.05
    np.testing.assert_allclose(np.linalg.norm(link[:, 2:], axis=1), 1.0, atol=1e-5)


def test_what_was_collected_says_who_acted(run: tuple[Path, ImitationSpec]) -> None:
    out, _ = run
    for number in range(2):
        for episode in episodes(out / "data" / f"round_00{number}"):
            assert episode.actors == ("student", "expert") and episode.record.success_once
            assert recorded_profile(episode) == "ms_hab"
            assert (
                episode.steps
                == np.flatnonzero(episode.array("reward/success"))[0] + 1 + HOLD_STEPS
            )
            taken = episode.array("actor")
            assert taken[-1] == 1 and sorted(taken) == taken.tolist()
            assert number or taken.all()


def test_the_table_of_students_says_what_lies_in_the_folders(
    run: tuple[Path, ImitationSpec], tmp_path: Path
) -> None:
    out, _ = run
    table = tmp_path / "students.json"
    judged = out / "evaluations" / "latest"
    for _ in range(2):
        assert students_report.main([str(table), str(out), str(judged)]) == 0
    (row,) = json.loads(table.read_text(encoding="utf-8"))["rows"]
    learned = row["training"]
    assert (row["subtask"], row["profile"], row["evaluation"]["horizon"]) == (
        "close",
        "ms_hab",
        200,
    )
    assert (learned["episodes"], learned["updates"]) == (2, 5)
    assert learned["frames"] == sum(episode.steps for episode in episodes(out / "data"))
    assert row["evaluation"]["episodes"] == sum(row["evaluation"]["labels"].values()) == 1
    assert row["paper_success_once"]["bc"] == 88.39
    other = tmp_path / "other"
    shutil.copytree(out, other)
    (other / "student.safetensors").write_bytes(b"")
    assert students_report.main([str(table), str(other), str(judged)]) == 1


def test_a_run_that_is_over_resumes_to_the_same_student(
    run: tuple[Path, ImitationSpec],
) -> None:
    out, request = run
    before = load_checkpoint(out / "student.safetensors").tensors
    again = train_in(dataclasses.replace(request, eval_episodes=0), out, resume=True)
    assert (
        again.summary["steps"] == 5
        and again.summary["rounds"] == 1
        and again.summary["demonstrations"] == 2
    )
    after = load_checkpoint(out / "student.safetensors").tensors
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_one_student_learns_several_subtasks(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    student = config(inputs=INPUTS, demos=1, updates=2, hold_steps=HOLD_STEPS)
    dagger = DaggerConfig(rounds=0)
    opening = dataclasses.replace(SCENE, subtask="open")
    request = ImitationSpec.of(
        out=tmp_path / "run",
        preset=ImitationConfig(student, dagger),
        **env_of(SCENE),
        eval_episodes=1,
        round_episodes=0,
        films=0,
        also=(opening.name,),
    )
    result = train_in(request, tmp_path / "run")
    folders = {path.name for path in (tmp_path / "run" / "data" / "round_000").iterdir()}
    names = [scene.name for scene in request.scenes]
    assert names[1] == "set_table/open/kitchen_counter/drawer3"
    assert folders == {name.replace("/", ".") for name in names}
    assert [row["row"] for row in result.summary["rows"]] == names
    assert result.summary["episodes"] == 2
    about = load_checkpoint(tmp_path / "run" / "student.safetensors").about
    assert [scene["subtask"] for scene in (about["scene"], *about["also"])] == [
        "close",
        "open",
    ]
    kinds = {
        episode.record.plan[0].kind
        for name in folders
        for episode in episodes(tmp_path / "run" / "data" / "round_000" / name)
    }
    assert kinds == {"close", "open"}
    again = train_in(request, tmp_path / "run", resume=True)
    assert again.summary["steps"] == result.summary["steps"]


@pytest.mark.parametrize(
    ("task", "target"),
    [("set_table", ""), ("set_table", "024_bowl"), ("tidy_house", "")],
)
def test_a_student_of_navigate_knows_where_its_ways_lead(task: str, target: str) -> None:
    """To objects, to their goals and to links; with a target it carries this object to its goal."""
    scene = Scene(task, "navigate", target, home="builtin_m0_00", profile="ms_hab")
    request = ImitationSpec.of(
        out="unused",
        preset=ImitationConfig(config(inputs=InputConfig(cameras=(), image_size=0))),
        **env_of(scene),
    )
    layout = layout_for(request)
    env = make_env(scene, {}, Resources(worlds=4, threads=1))
    found: set[str] = set()
    for seed in range(3):
        env.reset(seed=seed)
        specs = [env.episode_spec(world) for world in range(4)]
        found |= {
            kind_of(entry["target"]) for spec in specs if spec for entry in spec["plan"]
        }
    assert found <= set(layout.targets)
    assert f"{GOAL_OF}{target}" in found if target else len(found) > 2


def test_other_robots_are_trained_with_their_own_cameras(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    assert load_plugin(BOXY).error == ""
    robot = robot_named("boxy")
    inputs = dataclasses.replace(INPUTS, cameras=robot.camera_names)
    student = config(inputs=inputs, demos=2, updates=1, hold_steps=HOLD_STEPS)
    scene = dataclasses.replace(SCENE, robot=robot.name, profile="")
    request = ImitationSpec.of(
        out=tmp_path / "run",
        preset=ImitationConfig(student),
        **env_of(scene),
        eval_episodes=1,
        round_episodes=0,
        films=0,
    )
    try:
        train_in(request, tmp_path / "run")
        layout = load_student(tmp_path / "run" / "student.safetensors").layout
        assert layout.robot == layout.env_options()["robot"] == robot.name
        judged = tmp_path / "run" / "evaluations" / "latest" / "config.json"
        assert (
            json.loads(judged.read_text(encoding="utf-8"))["env"]["robot"] == robot.name
        )
        standing = evaluate(
            "zero",
            subtask="close",
            episodes=1,
            robot=robot.name,
            films=0,
            out=tmp_path / "zero",
        )
        assert standing.records[0].steps
    finally:
        ROBOTS.remove(robot.name)
