"""Policies by subtask: each world is acted in by the policy of its active subtask."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.core.errors import UsageError
from mjhab.evaluation.parts import close_policy
from mjhab.evaluation.resolve import (
    NoPolicyError,
    full_spec,
    inspect_policy,
    open_policy,
    resolve_policy,
)
from mjhab.evaluation.score.manifest import manifest
from mjhab.evaluation.score.run import facts_for
from mjhab.learning.assigned.entries import Entry
from mjhab.learning.assigned.files import entries_text, read_entries
from mjhab.learning.by_subtask import PoliciesBySubtask, PoliciesFile
from mjhab.learning.checkpoint import save_student
from mjhab.learning.policy import StudentPolicy
from mjhab.learning.policy_kind import joined
from mjhab.learning.students.heads import make_student
from tests.learning.small import config, fake_env, layout
from tests.refusals import refused

PLAN = [
    {"kind": "navigate", "target": "024_bowl_:0000"},
    {"kind": "pick", "target": "024_bowl_:0000"},
    {"kind": "pick", "target": "013_apple_:0000"},
]


class Constant:
    """Acts by one number, and notes the worlds that it is told to forget and to know."""

    name = "constant"

    def __init__(self, value: float) -> None:
        self.value = value
        self.forgotten: list[list[bool]] = []
        self.known: list[bool] = []

    def reset(self, mask: np.ndarray) -> None:
        self.forgotten.append(mask.tolist())

    def act(self, obs: Any, info: Any) -> np.ndarray:
        self.known = [episode is not None for episode in info["episode_spec"]]
        return np.full((2, 3), self.value, np.float32)


def test_each_world_has_the_policy_of_its_subtask() -> None:
    entries = (Entry("pick", "013_apple", ""), Entry("pick", "", ""))
    apple, others = Constant(1.0), Constant(2.0)
    policy = PoliciesBySubtask(entries, [apple, others], worlds=2, width=3)
    info: dict[str, Any] = {"episode_spec": [{"plan": PLAN}] * 2}
    acted = [
        policy.act({}, {**info, "pointer": np.array(pointer)})[:, 0].tolist()
        for pointer in ([0, 1], [1, 1], [2, 1], [3, 2])
    ]
    assert acted == [[0.0, 2.0], [2.0, 2.0], [1.0, 2.0], [0.0, 1.0]]
    assert others.forgotten == [[False, True], [True, False]]
    assert apple.forgotten == [[True, False], [False, True]]
    assert apple.known == [False, True]


class Chooser(Constant):
    """Is told the worlds in which its actions count."""

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self.chosen: list[list[bool]] = []

    def act_in(self, obs: Any, info: Any, mask: np.ndarray) -> np.ndarray:
        self.chosen.append(mask.tolist())
        return self.act(obs, info)


def test_a_policy_that_works_long_is_asked_only_for_its_worlds() -> None:
    entries = (Entry("navigate", "", "expert"), Entry("pick", "", ""))
    driver, picker = Chooser(1.0), Constant(2.0)
    policy = PoliciesBySubtask(entries, [driver, picker], worlds=2, width=3)
    info: dict[str, Any] = {
        "episode_spec": [{"plan": PLAN}] * 2,
        "pointer": np.array([0, 1]),
    }
    assert policy.act({}, info)[:, 0].tolist() == [1.0, 2.0]
    assert driver.chosen == [[True, False]]


class Failing(Constant):
    """Fails in every world, and notes that it was closed."""

    closed = False

    def fault(self, world: int) -> str:
        return f"no answer in world {world}"

    def close(self) -> None:
        self.closed = True


def test_a_fault_is_that_of_the_acting_policy_and_all_are_closed() -> None:
    entries = (Entry("navigate", "", "ws://a"), Entry("pick", "", ""))
    driver, picker = Failing(1.0), Constant(2.0)
    policy = PoliciesBySubtask(entries, [driver, picker], worlds=2, width=3)
    info: dict[str, Any] = {"episode_spec": [{"plan": PLAN}] * 2}
    policy.act({}, {**info, "pointer": np.array([0, 1])})
    assert [policy.fault(world) for world in range(2)] == ["no answer in world 0", ""]
    policy.act({}, {**info, "pointer": np.array([1, 3])})
    assert [policy.fault(world) for world in range(2)] == ["", ""]
    close_policy(policy)
    assert driver.closed


def test_images_need_not_be_square() -> None:
    wide = {"camera_size": (64, 48)}
    assert joined("both", [("a", wide), ("b", wide)]) == wide
    assert joined("both", [("a", {"camera_size": 32}), ("b", {"camera_size": 64})]) == {
        "camera_size": 64
    }
    with refused(said="for one and 32"):
        joined("both", [("a", wide), ("b", {"camera_size": 32})])


def test_two_policies_for_the_same_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "policies.json"
    entries = [
        {"subtask": "pick", "target": "024_bowl", "checkpoint": name}
        for name in ("expert", "zero")
    ]
    path.write_text(json.dumps({"policies": entries}), encoding="utf-8")
    with refused(where="policies.json", said="two policies for pick 024_bowl"):
        read_entries(path)


def test_an_entry_names_any_policy(tmp_path: Path) -> None:
    path = tmp_path / "policies.json"
    rows = [
        ("navigate", "expert", "expert"),
        ("pick", "ms_hab:a.pt", f"ms_hab:{tmp_path / 'a.pt'}"),
        ("place", "mine.py:Mine", str(tmp_path / "mine.py:Mine")),
        ("open", "student:set_table/open/fridge/top_door", "student:set_table/open/fridge/top_door"),
        ("close", "a.safetensors+b.safetensors", f"{tmp_path}/a.safetensors+{tmp_path}/b.safetensors"),
    ]  # fmt: skip
    listed = [
        {"subtask": name, "target": "", "checkpoint": spec} for name, spec, _ in rows
    ]
    path.write_text(json.dumps({"policies": listed}), encoding="utf-8")
    assert [entry.checkpoint for entry in read_entries(path)] == [
        read for *_, read in rows
    ]
    for spec, told in (
        ("other.json", "not another policies file"),
        ("student", "say which"),
    ):
        path.write_text(
            json.dumps({"policies": [{**listed[0], "checkpoint": spec}]}), "utf-8"
        )
        with pytest.raises(UsageError, match=told):
            read_entries(path)


def test_the_expert_does_what_a_file_leaves_to_it(tmp_path: Path) -> None:
    path = tmp_path / "policies.json"
    names = ("navigate", "open", "pick", "place", "close")
    listed = [
        {
            "subtask": name,
            "target": "",
            "checkpoint": "zero" if name == "open" else "expert",
        }
        for name in names
    ]
    path.write_text(json.dumps({"policies": listed}), encoding="utf-8")
    run = mjhab.evaluate(
        str(path),
        task="set_table",
        episodes=1,
        worlds=1,
        films=0,
        navigate="drive",
        style=("hand=open",),
        out=tmp_path / "run",
    )
    (record,) = run.records
    assert record.style["hand"] == "open"
    # The expert drives to the drawer; nobody opens it.
    assert record.completed == 1 and [s.kind for s in record.subtasks] == [
        "navigate",
        "open",
    ]
    style = ("hand=open",)
    alone = tmp_path / "alone"
    opening = {"task": "set_table", "subtask": "open", "target": "fridge/top_door"}
    with refused("style", style, expected="only the expert has a style"):
        mjhab.evaluate(str(path), **opening, episodes=1, style=style, out=alone)
    assert not alone.exists()


def test_files_of_policies_are_read_and_refused(tmp_path: Path) -> None:
    path = tmp_path / "policies.json"
    entries = (Entry("pick", "", str(tmp_path / "sub" / "a.safetensors")),)
    path.write_text(entries_text(path, entries), encoding="utf-8")
    assert read_entries(path) == entries
    for wrong, said in (
        ("[]", "expected a JSON object"),
        ("{", "not valid JSON"),
        ('{"policies": {}}', "must hold"),
        (json.dumps({"policies": [{"subtask": "pick"}]}), "must hold"),
        (
            json.dumps(
                {"policies": [{"subtask": "pik", "target": "", "checkpoint": "a"}]}
            ),
            "Did you mean 'pick'",
        ),
    ):
        path.write_text(wrong, encoding="utf-8")
        with pytest.raises(UsageError, match=said):
            read_entries(path)
    with refused(where="other.json", said="does not exist"):
        read_entries(tmp_path / "other.json")


def policies_file(path: Path, *rows: tuple[str, str, str, str]) -> str:
    """A file of policies from (task, subtask, target, policy)."""
    names = ("task", "subtask", "target", "checkpoint")
    listed = [dict(zip(names, row, strict=True)) for row in rows]
    path.write_text(json.dumps({"policies": listed}), encoding="utf-8")
    return str(path)


def entries_for(spec: str, task: str, subtask: str, target: str) -> list[tuple[str, str]]:
    """Target and policy of the entries that act."""
    opened = open_policy(full_spec(spec, task, subtask, target))
    assert isinstance(opened, PoliciesFile)
    return [(entry.target, entry.checkpoint) for entry in opened.entries]


def test_each_row_has_its_own_policy(tmp_path: Path) -> None:
    spec = policies_file(
        tmp_path / "mine.json",
        ("", "pick", "", "zero"),
        ("set_table", "pick", "", "random"),
        ("set_table", "pick", "024_bowl", "expert"),
        ("set_table", "open", "fridge/top_door", "expert"),
    )
    assert entries_for(spec, "tidy_house", "pick", "") == [("", "zero")]
    assert entries_for(spec, "set_table", "pick", "013_apple") == [("", "random")]
    assert entries_for(spec, "set_table", "pick", "024_bowl") == [("024_bowl", "expert")]
    both = [("", "random"), ("024_bowl", "expert")]
    assert entries_for(spec, "set_table", "pick", "") == both
    assert sorted(entries_for(spec, "set_table", "", "")) == sorted(
        [*both, ("fridge/top_door", "expert")]
    )
    # Another row's policy is no part of what a run is.
    one = inspect_policy(full_spec(spec, "set_table", "pick", "024_bowl"))
    other = inspect_policy(full_spec(spec, "set_table", "pick", "013_apple"))
    assert one.name == other.name == "mine" and one.identity != other.identity
    with pytest.raises(
        NoPolicyError, match=r"no policy for set_table close .*for: pick, set_table pick"
    ):
        entries_for(spec, "set_table", "close", "fridge/top_door")
    asked = manifest("ms_hab_7")
    having = [row for row in asked.rows if facts_for(spec, row, asked.profile)]
    assert [row.name for row in having] == [
        "set_table.pick.013_apple",
        "set_table.pick.024_bowl",
        "set_table.open.fridge-top_door",
    ]


def test_a_folder_of_training_runs_is_a_file_of_policies(tmp_path: Path) -> None:
    def write(path: Path, *scenes: tuple[str, str, str]) -> None:
        path.parent.mkdir(exist_ok=True)
        names = ("task", "subtask", "target")
        told = [
            {**dict(zip(names, scene, strict=True)), "split": "train"} for scene in scenes
        ]
        about = {"scene": told[0], "also": told[1:]} if told else {}
        save_student(path, make_student(config(), layout()), about)

    close = ("set_table", "close", "kitchen_counter/drawer3")
    run = tmp_path / "run" / "student.safetensors"
    write(run, ("set_table", "pick", ""), ("tidy_house", "pick", ""))
    write(run.with_name("training.safetensors"), close)
    write(tmp_path / "drawer.safetensors", close)
    spec = str(tmp_path)
    drawer = str(tmp_path / "drawer.safetensors")
    assert entries_for(spec, "tidy_house", "pick", "") == [("", str(run))]
    assert entries_for(spec, *close) == [(close[2], drawer)]
    assert entries_for(str(run.parent), "set_table", "pick", "024_bowl") == [
        ("", str(run))
    ]
    env = fake_env(1)
    task, subtask, target = close
    env.config = SimpleNamespace(
        **vars(env.config),
        task=task,
        subtask=subtask,
        target=target,
        navigate="teleport",
    )
    # A script may name the folder alone.
    policy = resolve_policy(spec, env)
    assert isinstance(policy, PoliciesBySubtask)
    assert isinstance(policy.acting_policies[0], StudentPolicy)
    write(tmp_path / "again" / "student.safetensors", close)
    with refused(said=("two policies for set_table close", "leave one")):
        entries_for(spec, *close)
    write(tmp_path / "again" / "student.safetensors")
    with refused(
        where="student.safetensors", said="does not say what it was trained for"
    ):
        entries_for(spec, *close)
    (tmp_path / "empty").mkdir()
    with refused("policy", str(tmp_path / "empty")):
        entries_for(str(tmp_path / "empty"), *close)
