"""``--policy learned``: the checkpoints that come with the package."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjhab.cli.main import parse
from mjhab.evaluation.evaluate import EvalSpec, resolved_config
from mjhab.evaluation.parts import describe_policy
from mjhab.evaluation.resolve import (
    PolicyOptions,
    Wanted,
    full_spec,
    inspect_policy,
    open_policy,
    resolve_policy,
)
from mjhab.learning import shipped_kind
from mjhab.learning.assigned.entries import trained_for
from mjhab.learning.assigned.files import read_entries
from mjhab.learning.checkpoint import load_checkpoint, load_student, save_student
from mjhab.learning.policy import StudentEnsemble
from mjhab.learning.policy_kind import members
from mjhab.learning.students.heads import make_student
from mjhab.scenes.pack_source import pack_request
from tests.learning.small import INPUTS, config, fake_env, layout
from tests.refusals import refused

LARGEST_BYTES = 10_000_000
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
    spec = EvalSpec.of("learned", **CLOSE)
    assert isinstance(spec.policy, str)
    facts = describe_policy(spec.policy)
    assert facts.name == "learned" and len(facts.identity["policy_sha256"]) == 64
    assert resolve_policy(spec.policy, fake_env(1)).name == "student"
    assert full_spec("expert", "set_table", None, None) == "expert"


@pytest.mark.usefixtures("shelf")
def test_another_robot_than_that_of_the_training_is_refused_first() -> None:
    spec = EvalSpec.of("learned", **CLOSE, env={"robot": "panda_omron"})
    with refused("robot", "panda_omron", expected="fetch", advice="Leave out --robot"):
        resolved_config(spec, describe_policy(spec.policy))


@pytest.mark.usefixtures("shelf")
@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"subtask": "close", "target": "kitchen_counter/drawer"},
            "Did you mean 'set_table.close.kitchen_counter-dr",
        ),
        (
            {"subtask": "close"},
            ("give --target, ", "for: set_table.close.kitchen_counter-drawer3"),
        ),
        (
            {"task": "tidy_house"},
            "no student for the task 'tidy_house', but for: set_table.close",
        ),
    ],
)
def test_where_there_is_none_those_are_named_that_there_are(
    given: dict[str, Any], said: str | tuple[str, ...]
) -> None:
    with refused(said=said):
        inspect_policy(str(EvalSpec.of("learned", **given).policy))


def test_one_student_may_serve_all_targets(shelf: Path) -> None:
    for_all = shelf / "set_table.pick.safetensors"
    save_student(for_all, make_student(config(), layout()), {})
    assert shipped_kind.shipped_path("set_table", "pick", "024_bowl") == str(for_all)
    assert shipped_kind.shipped_path("set_table", "pick", "") == str(for_all)
    own = shelf / "set_table.pick.024_bowl.safetensors"
    save_student(own, make_student(config(), layout()), {})
    assert shipped_kind.shipped_path("set_table", "pick", "024_bowl") == str(own)


def test_one_student_may_act_for_several_names_and_together_with_others(
    shelf: Path,
) -> None:
    name = "set_table.close.kitchen_counter-drawer3"
    scene = {"task": "set_table", "subtask": "pick", "target": ""}
    told = {"scene": scene, "also": [{**CLOSE, "split": "train"}]}
    save_student(
        shelf / "all.safetensors", make_student(config(), layout(), seed=1), told
    )
    index = {name: [name, "all"], "set_table.pick": ["all"]}
    (shelf / "index.json").write_text(json.dumps(index))
    spec = shipped_kind.shipped_path(**CLOSE)
    assert [path.stem for path in members(spec)] == [name, "all"]
    pick = shipped_kind.shipped_path("set_table", "pick", "024_bowl")
    assert [path.stem for path in members(pick)] == ["all"]
    assert list(shipped_kind.shipped()) == [name, "set_table.pick"]
    (shelf / f"{name}.safetensors").unlink()
    (shelf / "index.json").write_text(
        json.dumps({name: ["all"], "set_table.pick": ["all"]})
    )
    entries = shipped_kind.ShippedTask("learned", "set_table").entries
    assert [(entry.subtask, entry.target) for entry in entries] == [
        ("close", CLOSE["target"]),
        ("pick", ""),
    ]


@pytest.mark.usefixtures("shelf")
def test_students_act_together(shelf: Path) -> None:
    name = "set_table.close.kitchen_counter-drawer3"
    save_student(shelf / "all.safetensors", make_student(config(), layout(), seed=1), {})
    (shelf / "index.json").write_text(json.dumps({name: [name, "all"]}))
    policy = resolve_policy(str(EvalSpec.of("learned", **CLOSE).policy), fake_env(1))
    assert isinstance(policy, StudentEnsemble) and len(policy.members) == 2


def test_the_students_of_a_task_act_in_turn(shelf: Path) -> None:
    path = shelf / "set_table.close.kitchen_counter-drawer3.safetensors"
    scene = {"task": "set_table", "subtask": "close", "target": CLOSE["target"]}
    save_student(path, make_student(config(), layout()), {"scene": scene})
    (entry,) = shipped_kind.ShippedTask("learned", "set_table").entries
    assert (entry.subtask, entry.target, entry.checkpoint) == (
        "close",
        CLOSE["target"],
        str(path),
    )
    assert (
        describe_policy(str(EvalSpec.of("learned", task="set_table").policy)).name
        == "learned"
    )


def test_a_file_of_policies_has_a_name_of_its_own(shelf: Path) -> None:
    path = next(shelf.glob("*.safetensors"))
    entries = [
        {"subtask": "close", "target": CLOSE["target"], "checkpoint": path.name},
        {"subtask": "pick", "target": "", "checkpoint": "expert", "task": "tidy_house"},
    ]
    (shelf / "elsewhere.json").write_text(json.dumps({"policies": entries}))
    (shelf / "index.json").write_text("{}")
    assert list(shipped_kind.policy_files()) == ["elsewhere"]
    spec = EvalSpec.of("learned:elsewhere", **CLOSE)
    assert isinstance(spec.policy, str)
    assert inspect_policy(spec.policy).name == "learned:elsewhere"
    env = fake_env(1)
    vars(env.config).update(CLOSE, navigate="teleport")
    assert resolve_policy(spec.policy, env).name == "policies"
    env.config.subtask = "open"
    with refused(said="has no policy for set_table open"):
        resolve_policy(spec.policy, env)


def test_a_file_names_students_of_the_package_beside_others_that_see_larger_images(
    shelf: Path,
) -> None:
    half = dataclasses.replace(INPUTS, image_size=INPUTS.image_size // 2)
    student = make_student(config(inputs=half), layout(half))
    save_student(
        shelf / "set_table.close.kitchen_counter-drawer3.safetensors", student, {}
    )
    name = "learned:set_table/close/kitchen_counter/drawer3"
    entries = [{"subtask": "close", "target": "", "checkpoint": name}]
    path = shelf / "mine.json"
    path.write_text(json.dumps({"policies": entries}))
    env = fake_env(1)
    vars(env.config).update(CLOSE, navigate="teleport")
    assert resolve_policy(str(path), env).name == "policies"
    with refused(said="does not fit this environment"):
        resolve_policy(name, env)


def test_the_old_name_finds_the_same_and_stays_the_name_of_its_runs(
    shelf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = (EvalSpec.of(name, **CLOSE) for name in ("student", "learned"))
    described = [describe_policy(spec.policy) for spec in (old, new)]
    assert [facts.name for facts in described] == ["student", "learned"]
    assert described[0].identity == described[1].identity
    words = ["--policy", "student", "--subtask", "close"]
    assert parse(["eval", *words]).spec.policy == "student:set_table/close/"
    assert "--policy student is now --policy learned" in capsys.readouterr().err
    parse(["serve", "learned", *words[2:]])
    assert capsys.readouterr().err == ""
    parse(["serve", "student:set_table/close/fridge/top_door"])
    assert "student: is now --policy learned:" in capsys.readouterr().err


def test_a_misspelt_student_is_suggested() -> None:
    with refused("policy", "leraned", expected="learned"):
        inspect_policy("leraned")


def test_what_is_shipped_is_small_acts_and_says_where_it_learned() -> None:
    there = shipped_kind.shipped()
    assert shipped_kind.file_name(**CLOSE) in there
    for name, spec in there.items():
        for path in members(spec):
            assert path.stat().st_size <= LARGEST_BYTES
            student = load_student(path)
            about = load_checkpoint(path).about
            scene = about["scene"]
            learned = trained_for(path, about)
            rows = [shipped_kind.file_name(**vars(one)) for one in learned]
            # One with a name of its own knows by the sentence what is to be done.
            assert name in rows or student.layout.inputs.sentence
            assert (scene["profile"], student.layout.profile) == ("ms_hab", "ms_hab")
            pack = scene["assets"]
            assert "/" not in (pack if isinstance(pack, str) else pack["place"])


@pytest.mark.parametrize("name", list(shipped_kind.policy_files()))
def test_files_of_policies_name_what_is_there_and_was_trained_for_it(name: str) -> None:
    for entry in read_entries(shipped_kind.policy_files()[name]):
        if entry.checkpoint == "expert":
            continue
        kind, _, what = entry.checkpoint.partition(":")
        own = kind == "learned" and shipped_kind.shipped_path(**vars(Wanted.parse(what)))
        for path in members(own or entry.checkpoint):
            assert path.stat().st_size <= LARGEST_BYTES
            about = load_checkpoint(path).about
            trained = [one for one in trained_for(path, about) if one.task == entry.task]
            assert (entry.subtask, entry.target) in {
                (one.subtask, target) for one in trained for target in (one.target, "")
            }
            assert about["scene"]["profile"] == "ms_hab"
            assert pack_request(about["scene"].get("assets", "builtin")).place == name


@pytest.mark.usefixtures("shelf")
def test_one_that_reads_the_sentence_has_a_name_of_its_own(shelf: Path) -> None:
    inputs = dataclasses.replace(INPUTS, sentence=True, condition=False)
    told = layout(inputs)
    save_student(shelf / "one.safetensors", make_student(config(inputs=inputs), told), {})
    spec = EvalSpec.of("learned:one", **CLOSE)
    assert isinstance(spec.policy, str)
    facts = describe_policy(spec.policy)
    assert (facts.name, facts.reads_instruction) == ("learned:one", True)
    assert resolve_policy(spec.policy, fake_env(1, told)).name == "student"


def test_the_expert_drives_where_no_student_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shipped_kind, "FOLDER", tmp_path)
    monkeypatch.setattr(
        shipped_kind.ShippedTask, "together", lambda self, entries, *_: entries
    )
    driving: Any = SimpleNamespace(config=SimpleNamespace(navigate="drive"))

    def drivers() -> list[str]:
        entries: Any = resolve_policy("learned:set_table", driving)
        return [entry.checkpoint for entry in entries if entry.subtask == "navigate"]

    def ship(subtask: str) -> str:
        path = tmp_path / f"set_table.{subtask}.safetensors"
        scene = {"task": "set_table", "subtask": subtask, "target": ""}
        save_student(path, make_student(config(), layout()), {"scene": scene})
        return str(path)

    ship("pick")
    assert drivers() == ["expert"]
    assert open_policy("learned:set_table").takes_style
    shipped = ship("navigate")
    assert drivers() == [shipped]
    assert not open_policy("learned:set_table").takes_style


def test_a_style_needs_an_expert_that_acts() -> None:
    teleported: Any = SimpleNamespace(
        config=SimpleNamespace(
            task="set_table", subtask=None, target="", navigate="teleport"
        )
    )
    options = PolicyOptions(style=("hand=open",))
    with refused("style", ("hand=open",), advice="--navigate drive"):
        resolve_policy("learned:builtin", teleported, options)
