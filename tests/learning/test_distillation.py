"""Distillation: the student acts, the teacher labels, and everything is learned from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.data.select.interventions import taught_steps
from mjhab.data.store.places import episodes
from mjhab.learning.checkpoint import load_checkpoint
from mjhab.learning.runs.intervention import (
    OF_DISTILLATION,
    RELABELLED,
    TEACHER,
    Relabelling,
)
from mjhab.learning.runs.specs import DaggerSpec, scene_names
from mjhab.learning.train import train
from tests.learning.test_intervention import Steady
from tests.refusals import refused

WORLDS = 3
CLOSE = {"subtask": "close", "target": "kitchen_counter/drawer3"}


class Correcting(Steady):
    """A policy that remembers what was executed in its place."""

    executed: np.ndarray | None = None

    def replace_action(self, actions: np.ndarray, replan: bool = False) -> None:
        # The rest of a chunk led from an action that was not executed.
        assert replan
        self.executed = actions


def test_the_student_acts_and_the_teacher_names_the_actions() -> None:
    student = Steady("student", -0.5, WORLDS)
    teacher = Correcting("teacher", 0.5, WORLDS)
    policy = Relabelling(student, teacher)
    policy.reset(np.ones(WORLDS, bool))
    assert (policy.act({}, {}) == -0.5).all()
    assert (policy.notes().intended == 0.5).all()
    assert [policy.notes().actors[k] for k in policy.notes().actor] == [RELABELLED] * 3
    # It sees its previous action, so it must know that another one was executed.
    assert teacher.executed is not None and (teacher.executed == -0.5).all()
    assert len(student.resets) == len(teacher.resets) == 1


def test_without_a_student_the_teacher_demonstrates() -> None:
    policy = Relabelling(None, Correcting("teacher", 0.5, WORLDS))
    policy.reset(np.ones(WORLDS, bool))
    assert (policy.act({}, {}) == 0.5).all()
    assert {policy.notes().actors[k] for k in policy.notes().actor} == {TEACHER}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"teacher": ("a.json", "b.json")}, "one for each of the 1"),
        ({"teacher": ("a.json",), "style": ("noise=0.1",)}, "left out with style"),
        ({"teacher": ("a.json",), "first_prefix": 5}, "left out with style"),
    ],
)
def test_options_that_exclude_each_other(options: dict[str, Any], expected: str) -> None:
    with refused("teacher", expected=expected):
        DaggerSpec.of(out="x", **CLOSE, **options)


def test_the_expert_may_take_over_in_one_scene_and_a_policy_teach_in_another() -> None:
    spec = DaggerSpec.of(
        out="x",
        **CLOSE,
        also=("set_table/open/fridge/top_door",),
        teacher=("expert", "a.json"),
        style=("noise=0.1",),
        first_prefix=5,
    )
    assert spec.teachers == ("", "a.json:set_table/open/fridge/top_door")
    alone = DaggerSpec.of(out="x", **CLOSE, teacher=("expert",), first_prefix=5)
    assert alone.teachers == ("",)


def test_a_teacher_for_each_subtask_in_each_pack() -> None:
    spec = DaggerSpec.of(
        out="x",
        **CLOSE,
        also=("set_table/open/fridge/top_door",),
        also_assets=("rooms",),
        teacher=("a.json", "student", "c.json", "student"),
    )
    close = "set_table/close/kitchen_counter/drawer3"
    fridge = "set_table/open/fridge/top_door"
    assert scene_names(spec.scenes) == [
        close,
        fridge,
        f"{close}@rooms",
        f"{fridge}@rooms",
    ]
    assert spec.teachers == (
        f"a.json:{close}",
        f"student:{fridge}",
        f"c.json:{close}",
        f"student:{fridge}",
    )


def test_a_teacher_that_sees_larger_images_is_refused(tmp_path: Path) -> None:
    with refused(said="inputs.image_size=32"):
        train(
            "dagger",
            out=tmp_path / "run",
            preset="quick",
            set=["inputs.image_size=16"],
            profile="ms_hab",
            teacher=["student"],
            eval_episodes=0,
            home="builtin_m0_00",
            **CLOSE,
        )
    assert not (tmp_path / "run" / "data").exists()


def test_a_run_learns_from_all_episodes_of_the_student(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "preset": "quick",
        "teacher": ["student"],
        "profile": "ms_hab",
        "home": "builtin_m0_00",
        "rounds": 1,
        "demos": 1,
        "takeovers": 1,
        "updates": 2,
        "round_updates": 2,
        "final_updates": 0,
        "set": ["optimizer.batch=8", "network.hidden=16"],
        "worlds": 1,
        "threads": 1,
        "eval_episodes": 0,
        "round_episodes": 0,
        **CLOSE,
    }
    run = tmp_path / "run"
    train("dagger", out=run, **options)
    shown = list(episodes(run / "data" / "round_000"))
    acted = list(episodes(run / "data" / "round_001"))
    assert all(episode.record.success_once for episode in shown)
    # Two updates teach nothing: the student fails, and what the teacher would have done is learned.
    assert len(acted) == 1 and not any(e.record.success_once for e in acted)
    for episode in acted:
        assert tuple(episode.actors) == OF_DISTILLATION
        assert taught_steps(episode).all()
        wanted = episode.array("actions_intended")
        assert np.abs(wanted - episode.array("actions")).max() > 0.1
    about = load_checkpoint(run / "student.safetensors").about
    assert about["trained"]
    # What was collected belongs to this teacher.
    with refused(said="teachers"):
        train("dagger", out=run, **{**options, "teacher": []}, resume=True)
