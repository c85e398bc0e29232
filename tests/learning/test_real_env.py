"""Take-over DAgger from nothing, in the real environment: one episode of everything."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from mjhab.data.store.reading import episodes
from mjhab.learning.checkpoint import load_checkpoint, load_student
from mjhab.learning.configs import DaggerConfig, InputConfig, TrainConfig
from mjhab.learning.runs.collection import Means, Scene
from mjhab.learning.runs.session import Request
from mjhab.learning.runs.train import train
from tests.learning.small import config

INPUTS = InputConfig(image_size=16, base_velocity=True)
SCENE = Scene("set_table", "close", "kitchen_counter/drawer3", home="builtin_m0_00")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Request]:
    torch.set_num_threads(1)
    student = config(inputs=INPUTS, demos=1, updates=2)
    dagger = DaggerConfig(rounds=1, episodes=1, updates=2, first_prefix=4, horizon=220)
    request = Request(TrainConfig(student, dagger), SCENE, Means(1, 1, 1), eval_episodes=1, round_episodes=0)
    out = tmp_path_factory.mktemp("run")
    train(request, out)
    return out, request


def test_a_run_leaves_a_student_data_and_an_evaluation(run: tuple[Path, Request]) -> None:
    out, _ = run
    student = load_student(out / "student.safetensors")
    assert student.layout.state_width == 42 and student.layout.targets == ("kitchen_counter/drawer3",)
    assert ("base/turning_rate", 1) in student.layout.entries
    assert load_checkpoint(out / "training.safetensors").about["step"] == 4
    assert (out / "evaluations" / "latest" / "report.html").is_file()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'id="loss-plot"' in page and 'src="http' not in page
    first, second = (list(episodes(out / "data" / f"round_00{number}")) for number in range(2))
    assert len(first) == len(second) == 1


def test_what_was_collected_says_who_acted(run: tuple[Path, Request]) -> None:
    out, _ = run
    for number in range(2):
        for episode in episodes(out / "data" / f"round_00{number}"):
            assert episode.actors == ("student", "expert") and episode.record.success_once
            taken = episode.array("actor")
            assert taken[-1] == 1 and sorted(taken) == taken.tolist()
            assert number or taken.all()


def test_a_run_that_is_over_resumes_to_the_same_student(run: tuple[Path, Request]) -> None:
    out, request = run
    before = load_checkpoint(out / "student.safetensors").tensors
    again = train(dataclasses.replace(request, eval_episodes=0), out, resume=True)
    assert again.summary["steps"] == 4 and again.summary["demonstrations"] == 2
    after = load_checkpoint(out / "student.safetensors").tensors
    assert all(torch.equal(before[name], after[name]) for name in before)
