"""Training on imported data of MS-HAB: the paper's preset trains, and what needs states is refused in one line."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjhab.cli.main import main
from mjhab.data.imports.ms_hab import import_ms_hab
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import select
from mjhab.data.store.places import episodes
from mjhab.learning.checkpoint import load_checkpoint
from mjhab.learning.configs import InputConfig
from mjhab.learning.demos import entries_of, load_demonstrations, observation_spec_of_data
from mjhab.learning.reinforcement.demonstrations.recorded import check_episode
from mjhab.learning.students import bc
from tests.data.imports.test_ms_hab import original
from tests.refusals import refused

STAGE = ("--task", "set_table", "--subtask", "pick", "--target", "024_bowl")
TINY = (
    "network.channels=4,4,4,4,4",
    "network.hidden=16",
    "network.image_features=16",
    "optimizer.batch=4",
)
PAPER_SIDE_PX = 128


def imported(folder: Path, side: int) -> Path:
    """A data set of two episodes with images of ``side`` [px]."""
    return import_ms_hab(original(folder, 2, side=side), folder / "imp").shard.parent


def test_the_papers_preset_trains_on_data_of_the_original(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Most of the time would go into files of the paper's widths.
    monkeypatch.setattr(bc, "PAPER_HIDDEN", (32, 16, 8))
    data = imported(tmp_path, PAPER_SIDE_PX)
    assert len(select(data, Filter("profile == 'ms_hab'")).matched) == 2
    run = tmp_path / "run"
    options = ["--data", str(data), "--out", str(run), "--updates", "2"]
    options += ["--eval-episodes", "0", "--round-episodes", "0"]
    options += [part for each in TINY for part in ("--set", each)]
    assert main(["train", "bc", "--preset", "paper", *STAGE, *options]) == 0
    layout = load_checkpoint(run / "student.safetensors").layout
    assert layout.profile == "ms_hab" and layout.robot == "fetch"
    assert layout.control == ("pd_joint_delta_pos", "forward", "head")
    assert len(layout.actions) == 13 and sum(width for _, width in layout.state) == 42


def test_what_needs_states_is_refused_in_one_line(tmp_path: Path) -> None:
    data = imported(tmp_path, 8)
    with refused(said=("128x128 px. It was imported", "inputs.image_size=8")):
        observation_spec_of_data(data, InputConfig(image_size=128))
    with refused(said=("no depth images of cam", "fetch_hand, fetch_head")):
        observation_spec_of_data(data, InputConfig(cameras=("cam",), image_size=8))
    layout = observation_spec_of_data(data, InputConfig(image_size=8, base_velocity=True))
    with refused(where="024_bowl.h5", said=("data without states", "--preset paper")):
        load_demonstrations(data, layout, -1)
    session: Any = SimpleNamespace(request=SimpleNamespace(recompute_rewards=False))
    with refused(
        where="024_bowl.h5",
        said=("its actions cannot be simulated again", "train bc --data"),
    ):
        check_episode(session, next(episodes(data)))


def test_data_imported_before_it_told_its_actions(tmp_path: Path) -> None:
    data = imported(tmp_path, 8)
    episode = next(episodes(data))
    run = dataclasses.replace(episode.run, config={"env": {}}, layout={})
    older: Any = SimpleNamespace(run=run, name=episode.name, shard=episode.shard)
    with refused(
        where="024_bowl.h5",
        said="does not say control_mode, base, stationary, the names of the actions",
    ):
        entries_of(older)
