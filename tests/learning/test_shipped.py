"""``--policy student``: the checkpoints that come with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mjhab.core.errors import UsageError
from mjhab.evaluation.evaluate import EvalSpec, describe_policy
from mjhab.evaluation.resolve import full_spec, inspect_policy, resolve_policy
from mjhab.learning import shipped_kind
from mjhab.learning.checkpoint import load_checkpoint, load_student, save_student
from mjhab.learning.students.heads import make_student
from tests.learning.small import config, fake_env, layout

LARGEST_BYTES = 5_000_000
CLOSE: dict[str, Any] = {
    "task": "set_table",
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
}


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one student."""
    save_student(
        tmp_path / "set_table.close.kitchen_counter-drawer3.safetensors",
        make_student(config(), layout()),
        {},
    )
    monkeypatch.setattr(shipped_kind, "FOLDER", tmp_path)
    return tmp_path


@pytest.mark.usefixtures("shelf")
def test_a_student_is_chosen_by_what_is_to_be_done() -> None:
    spec = EvalSpec("student", **CLOSE)
    assert isinstance(spec.policy, str)
    facts = describe_policy(spec.policy)
    assert facts.name == "student" and len(facts.identity["policy_sha256"]) == 64
    assert resolve_policy(spec.policy, fake_env(1)).name == "student"
    assert full_spec("expert", "set_table", None, None) == "expert"


@pytest.mark.usefixtures("shelf")
@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"subtask": "close", "target": "kitchen_counter/drawer"},
            r"Did you mean 'set_table.close.kitchen_counter-dr",
        ),
        (
            {"subtask": "close"},
            r"give --target, .*for: set_table.close.kitchen_counter-drawer3",
        ),
        ({"task": "tidy_house"}, "no student for the task 'tidy_house', but for: set_table.close"),
    ],
)
def test_where_there_is_none_those_are_named_that_there_are(
    given: dict[str, Any], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        inspect_policy(str(EvalSpec("student", **given).policy))


def test_one_student_may_serve_all_targets(shelf: Path) -> None:
    for_all = shelf / "set_table.pick.safetensors"
    save_student(for_all, make_student(config(), layout()), {})
    assert shipped_kind.shipped_path("set_table", "pick", "024_bowl") == for_all
    assert shipped_kind.shipped_path("set_table", "pick", "") == for_all
    own = shelf / "set_table.pick.024_bowl.safetensors"
    save_student(own, make_student(config(), layout()), {})
    assert shipped_kind.shipped_path("set_table", "pick", "024_bowl") == own


def test_the_students_of_a_task_act_in_turn(shelf: Path) -> None:
    path = shelf / "set_table.close.kitchen_counter-drawer3.safetensors"
    scene = {"task": "set_table", "subtask": "close", "target": CLOSE["target"]}
    save_student(path, make_student(config(), layout()), {"scene": scene})
    (entry,) = shipped_kind.shipped_entries("set_table")
    assert (entry.subtask, entry.target, entry.checkpoint) == ("close", CLOSE["target"], path)
    assert describe_policy(str(EvalSpec("student", task="set_table").policy)).name == "student"


def test_a_misspelt_student_is_suggested() -> None:
    with pytest.raises(UsageError, match="Did you mean 'student'"):
        inspect_policy("studnet")


def test_what_is_shipped_is_small_acts_and_says_where_it_learned() -> None:
    there = shipped_kind.shipped()
    assert shipped_kind.file_name(**CLOSE) in there
    for name, path in there.items():
        assert path.stat().st_size <= LARGEST_BYTES
        student = load_student(path)
        scene = load_checkpoint(path).about["scene"]
        assert name == shipped_kind.file_name(scene["task"], scene["subtask"], scene["target"])
        assert (scene["profile"], student.layout.profile) == ("ms_hab", "ms_hab")
        assert scene["assets"] == "builtin"
