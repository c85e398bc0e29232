"""Studies of reinforcement learning: SAC beside PPO, one policy per object beside one for all, learning curves."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjhab.core.files.cache import write_text
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.paper.reproduce.make import reproduce
from mjhab.paper.reproduce.results import curves_figure, outcomes, result_of
from mjhab.paper.reproduce.rows import table_rows
from mjhab.paper.reproduce.spec import TableSpec, chosen_rows
from mjhab.reports.compared.trainings import METRICS, ON_THE_WAY
from mjhab.reports.paper import paper_row
from tests.refusals import command, refused

DRAWER = "set_table/close/drawer"


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[ReinforcementSpec]:
    """Stands for trainings and evaluations, which take long; what was to be trained."""
    asked: list[ReinforcementSpec] = []

    def train(spec: ReinforcementSpec) -> SimpleNamespace:
        asked.append(spec)
        spec.out.mkdir(parents=True)
        rows = [
            {"samples": 100, "success_once": 0.25, "evaluation": ON_THE_WAY},
            {"samples": 150, "loss": 1.0},
            {"samples": 200, "success_once": 0.75, "evaluation": ON_THE_WAY},
        ]
        lines = "\n".join(map(json.dumps, rows))
        (spec.out / METRICS).write_text(lines, encoding="utf-8")
        summary = {"samples": 200, "cpu_seconds": 60.0, "demonstrations": 0}
        write_text(spec.out / "summary.json", json.dumps(summary))
        return SimpleNamespace(interrupted=False)

    monkeypatch.setattr("mjhab.learning.train.train_spec", train)
    monkeypatch.setattr(
        "mjhab.paper.reproduce.make.judge", lambda spec, judging, sinks: judging.out
    )
    record = SimpleNamespace(
        success_once=True, success_at_end=False, completed=1, plan=(1,), subtasks=()
    )
    monkeypatch.setattr(
        "mjhab.paper.reproduce.results.read_records", lambda folder: [record]
    )
    return asked


def test_a_row_is_trained_by_sac_and_by_ppo(
    tmp_path: Path, trained: list[ReinforcementSpec]
) -> None:
    asked = TableSpec(what="sac_ppo", out=tmp_path / "run", rows=(DRAWER,))
    results, interrupted = reproduce(asked)
    assert not interrupted
    assert [spec.config.algorithm for spec in trained] == ["sac", "ppo"]
    assert all(spec.round_episodes for spec in trained)
    assert [found["rules"] for found in results] == ["sac", "ppo"]
    assert results[0]["curves"] == [[[100, 0.25], [200, 0.75]]]
    lines = curves_figure(results)["data"]
    assert [line["y"] for line in lines] == [[0.25, 0.75]] * 2
    page = (tmp_path / "run" / "report.html").read_text("utf-8")
    assert "While they learn" in page and "Outcomes" in page
    # What is done is not trained again.
    reproduce(dataclasses.replace(asked, resume=True))
    assert len(trained) == 2


def test_curves_are_of_several_seeds(
    tmp_path: Path, trained: list[ReinforcementSpec]
) -> None:
    asked = TableSpec(
        what="curves", out=tmp_path / "run", rows=(DRAWER,), env={"seed": 5}
    )
    reproduce(asked)
    assert [spec.seed for spec in trained] == [5, 6, 7]
    assert {spec.config.algorithm for spec in trained} == {"ppo"}


def test_per_all_has_a_policy_per_object_and_one_for_all(
    tmp_path: Path, trained: list[ReinforcementSpec]
) -> None:
    reproduce(
        TableSpec(what="per_all", out=tmp_path / "run", rows=("prepare_groceries/pick",))
    )
    targets = [spec.scene.target for spec in trained]
    assert targets[-1] == "" and len(set(targets)) == len(targets) == 10
    assert {spec.config.algorithm for spec in trained} == {"sac"}


def test_one_policy_per_object_stands_beside_the_papers_labels() -> None:
    row = table_rows()["tidy_house/pick"]
    published = paper_row("tidy_house", "pick", "val", "all", "RL-All")
    assert published is not None
    label = max(published.labels, key=lambda name: published.labels[name])
    found = {"labels": {label: 1}, "episodes": 2, "success_once": 0.5}
    config = {"what": "per_all", "split": "val"}
    result = result_of(row, "rl_all", found, config)
    assert result["paper"] == {"rl_all": published.success_once}
    shares = {shown[2]: shown[3:] for shown in outcomes([result], "val")}
    assert shares[label] == (50.0, published.labels[label])
    assert set(shares) == set(published.labels)


def test_rows_of_one_policy_per_object_are_pick_and_place(tmp_path: Path) -> None:
    asked = TableSpec(what="per_all", out=tmp_path / "run")
    assert {row.subtask for row in chosen_rows(asked)} == {"pick", "place"}
    assert len(chosen_rows(asked)) == 6


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"column": "rl_per"}, dict(option="column", given="rl_per")),
        ({"policies": Path("there")}, dict(said="--policies")),
        ({"updates": 3}, dict(option="updates", given=3)),
        ({"preset": "small"}, dict(said="small")),
    ],
)
def test_what_does_not_go_together_is_refused(
    options: dict[str, Any], told: dict[str, Any], tmp_path: Path
) -> None:
    asked = TableSpec(what="sac_ppo", out=tmp_path / "run", **options)
    with refused(**told):
        chosen_rows(asked)


def test_the_command_refuses_an_algorithm_as_a_variant_of_others(tmp_path: Path) -> None:
    words = ["reproduce", "table1", "--variants", "sac", "--out", str(tmp_path / "run")]
    with refused("variant of table1", "sac"):
        command(*words)
