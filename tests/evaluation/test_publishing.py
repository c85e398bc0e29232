"""Data sets by one command: what is in them, that nothing changes it, and files that do not match their list."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.core.files.reading import read_json_object
from mjhab.data.select.own_state import base_velocity
from mjhab.data.store.places import entries, episodes
from mjhab.evaluation import generate as library
from mjhab.evaluation.publishing.about import ABOUT, command_of
from mjhab.evaluation.publishing.check import check_set
from mjhab.evaluation.publishing.make import MadeDataset, run_making
from mjhab.evaluation.publishing.spec import DatasetSpec
from tests.data.fake_world import FakeEnv
from tests.refusals import command, refused

ROWS = ("set_table.pick.024_bowl", "set_table.close.kitchen_counter-drawer3")
KEEP = "success and home != 'builtin_m1_00'"
COUNT = 9


@pytest.fixture(scope="module", autouse=True)
def no_physics() -> Iterator[None]:
    """Environments without physics in the place of real ones."""

    def make_env(evaluation: Any, options: dict[str, Any]) -> FakeEnv:
        asked = evaluation.asked
        return FakeEnv(asked.num_envs, asked.subtask, images=True, horizon=6)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "make_env", make_env)
        yield


def spec_of(out: Path, per_target: int = COUNT, **options: Any) -> DatasetSpec:
    given: dict[str, Any] = {"rows": ROWS, "keep": KEEP, "policy": "random", **options}
    return DatasetSpec.of("ms_hab_7", out=out, per_target=per_target, **given)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeDataset:
    return run_making(spec_of(tmp_path_factory.mktemp("set") / "all"))


def contents(folder: Path) -> dict[str, list[tuple[int, str]]]:
    """Indices and digests by subset and row."""
    return {
        f"{subset}/{row}": sorted((e.record.index, e.digest) for e in entries(place))
        for subset in ("demonstrations", "failures", "recoveries")
        for row in ROWS
        if (place := _place(folder, subset, row)).exists()
    }


def _place(folder: Path, subset: str, row: str) -> Path:
    return folder / subset / (row if subset == "demonstrations" else f"{row}.h5")


def test_every_episode_up_to_the_last_is_in_one_subset(made: MadeDataset) -> None:
    assert not made.short and made.about["episodes"] == COUNT * len(ROWS)
    found = contents(made.path)
    for row in ROWS:
        kept = {index for index, _ in found[f"demonstrations/{row}"]}
        failed = {index for index, _ in found.get(f"failures/{row}", [])}
        again = {index for index, _ in found.get(f"recoveries/{row}", [])}
        told = made.about["per_target"][row]
        assert (told["episodes"], told["failures"], told["recoveries"]) == (
            len(kept),
            len(failed),
            len(again),
        )
        assert len(kept) == COUNT and not kept & failed and not again & (kept | failed)
        # Tainted episodes, whose index ends in 4, are in none.
        usable = {index for index in range(max(kept) + 1) if index % 10 != 4}
        assert usable <= kept | failed | again
    places = [made.path / "failures", made.path / "recoveries"]
    assert {e.record.success_once for e in entries(places[0])} == {False}
    assert {e.record.success_once for e in entries(places[1])} == {True}


def test_mishaps_on_purpose_are_no_demonstrations(tmp_path: Path) -> None:
    spec = spec_of(tmp_path, policy="expert", recoveries=0.25)
    for row in spec.chosen().values():
        asked = spec.generation(row)
        assert asked.style == ("mishap=0.25",) and asked.preset is None
        assert asked.keep == f"({KEEP}) and style.mishap == 0"
    paper = spec_of(tmp_path, policy="expert", recoveries=0.25, keep=None)
    keeps = [str(paper.generation(row).keep) for row in paper.chosen().values()]
    assert "straightforward_success" in keeps[0] and "closed_success" in keeps[1]
    assert all(keep.endswith("and style.mishap == 0") for keep in keeps)
    with refused("--recoveries", 0.25, advice="It keeps demonstrations alone."):
        spec_of(tmp_path, recoveries=0.25, failures=False)


def test_no_home_is_in_two_splits(made: MadeDataset) -> None:
    splits = read_json_object(made.path / "splits.json")
    val, train = set(splits["val"]["homes"]), set(splits["train"]["homes"])
    homes = {entry.record.home for entry in entries(made.path / "demonstrations")}
    assert val and train and not val & train and val | train == homes
    assert splits["val"]["episodes"] + splits["train"]["episodes"] == COUNT * len(ROWS)


def test_the_record_tells_what_the_episodes_have(made: MadeDataset) -> None:
    about = made.about
    recorded = list(episodes(made.path / "demonstrations"))
    assert about["frames"] == sum(episode.steps for episode in recorded)
    actions = np.concatenate([episode.array("actions") for episode in recorded])
    told = np.array([each["mean"] for each in about["actions"]])
    np.testing.assert_allclose(told, actions.mean(axis=0), atol=2e-6)
    spread = np.array([each["std"] for each in about["actions"]])
    np.testing.assert_allclose(spread, actions.std(axis=0), atol=1e-4)
    base = np.concatenate([base_velocity(episode) for episode in recorded])
    told = about["base_velocity"]
    assert [(each["name"], each["unit"]) for each in told] == [
        ("base_vel.forward", "m/s"),
        ("base_vel.left", "m/s"),
        ("base_vel.yaw", "rad/s"),
    ]
    np.testing.assert_allclose(
        [each["mean"] for each in told], base.mean(axis=0), atol=2e-6
    )
    assert about["sentences"]["wordings"] == 4
    assert about == read_json_object(made.path / ABOUT)


def test_the_card_says_what_a_user_must_know(made: MadeDataset) -> None:
    text = (made.path / "README.md").read_text()
    head = text.split("---")[1]
    assert "license: apache-2.0" in head and "task_categories: [robotics]" in head
    for word in (
        "mjhab dataset make ms_hab_7",
        "| set_table.pick.024_bowl |",
        "| val |",
        "| base_vel.left | m/s | base of the robot |",
        *ROWS,
    ):
        assert word in text
    assert made.about["command"] == command_of(spec_of(made.path))
    assert str(made.path.parent) not in text


def test_stops_and_a_raised_number_change_nothing(
    made: MadeDataset, tmp_path: Path
) -> None:
    out = tmp_path / "all"
    stopped = run_making(spec_of(out, 2), stopped=_after(3))
    assert not stopped.about and not (out / ABOUT).exists()
    with refused(where=out, said="is not finished: the same"):
        check_set(out)
    with refused(said="started with"):
        run_making(spec_of(out, 2, rgb="jpeg"))
    assert run_making(spec_of(out, 2)).about["episodes"] == 2 * len(ROWS)
    more = run_making(spec_of(out, COUNT))
    assert contents(out) == contents(made.path)
    assert more.about["per_target"] == made.about["per_target"] and not check_set(out)
    again = run_making(spec_of(out, COUNT))
    assert again.about["files"] == more.about["files"]


def _after(calls: int) -> Callable[[], bool]:
    left = iter(range(calls))
    return lambda: next(left, None) is None


def test_files_that_do_not_match_the_list(made: MadeDataset, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "copy"
    shutil.copytree(made.path, folder)
    assert check_set(folder) == [] and command("dataset", "check", folder) == 0
    shard = next((folder / "demonstrations").rglob("*.h5"))
    name = shard.relative_to(folder).as_posix()
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    assert check_set(folder) == [f"{name} has other content"]
    shard.write_bytes(data[:-1])
    (folder / "splits.json").unlink()
    shutil.copy(made.path / name, folder / "more.h5")
    assert check_set(folder) == [
        f"{name} has {len(data) - 1} bytes, not {len(data)}",
        "splits.json is missing",
        "more.h5 is not listed",
    ]
    assert command("dataset", "check", folder) == 1


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({}, "lists no files"),
        ({"../a": {"bytes": 1, "sha256": "0"}}, "../a"),
        ({"a": {"bytes": "1", "sha256": "0"}}, "no bytes and sha256"),
        ([1], "lists no files"),
    ],
)
def test_a_list_that_is_none(tmp_path: Path, files: object, said: str) -> None:
    (tmp_path / ABOUT).write_text(json.dumps({"files": files}))
    with refused(said=said):
        check_set(tmp_path)


def test_what_cannot_be_made_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with refused("track", given="libero", expected="ms_hab_7"):
        DatasetSpec.of("libero", out=tmp_path / "a")
    with refused("row", given="set_table.pick.spoon", expected=ROWS[0]):
        spec_of(tmp_path / "a", rows=("set_table.pick.spoon",))
    with refused(said="nonsense"):
        spec_of(tmp_path / "a", keep="nonsense > 3")
    with refused("per_target", given=0):
        spec_of(tmp_path / "a", 0)
    with refused(said="neither dataset.json"):
        check_set(tmp_path)
    (tmp_path / "of_others").write_text("mine")
    with refused("out", advice="another --out") as told:
        command("dataset", "make", "ms_hab_7", "--out", tmp_path)
    # The command has no --resume, and shows no bars of what does not begin.
    assert "--resume" not in str(told.value) and not capsys.readouterr().err
    assert (tmp_path / "of_others").read_text() == "mine"
    out = tmp_path / "b"
    with refused("rest"):
        library.GenerateSpec.of(policy="zero", out=out, episodes=1, rest=out / "rest")
