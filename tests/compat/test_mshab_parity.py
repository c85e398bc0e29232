"""The table of docs/ms_hab.md judges everything that an environment of MS-HAB's ids shows."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import mjhab.compat.mshab.ids  # noqa: F401 - makes the ids known

SCRIPTS = Path(__file__).parents[2] / "docs" / "scripts"
NAMES = {
    "handle_active_joint_qmin": "handle_active_joint_qpos, qmin, qmax",
    "handle_active_joint_qmax": "handle_active_joint_qpos, qmin, qmax",
}
APART = {"reconfigure"}
"""Of a reset, for wrappers."""


@pytest.fixture
def parity(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    yield importlib.import_module("parity_tables")
    for name in ("parity_tables", "result_files"):
        sys.modules.pop(name, None)


def leaves(space: Any, path: str = "") -> Iterator[str]:
    for key, part in space.spaces.items():
        if isinstance(part, gymnasium.spaces.Dict):
            yield from leaves(part, f"{path}{key}/")
        else:
            yield f"{path}{key}"


@pytest.mark.parametrize("kind", ["pick", "close", "navigate"])
def test_every_entry_of_an_environment_is_judged(parity: Any, kind: str) -> None:
    env = gymnasium.make(
        f"{kind.capitalize()}SubtaskTrain-v0",
        num_envs=1,
        obs_mode="rgb+depth+segmentation",
        sensor_configs={"width": 16, "height": 16},
        add_event_tracker_info=True,
    )
    worlds: Any = env.unwrapped
    _, info = env.reset(seed=0)
    shown = leaves(worlds.single_observation_space)
    plain = {name.replace("fetch_head", "*").replace("fetch_hand", "*") for name in shown}
    assert plain == set(parity.OBSERVATIONS)
    judged = {name for names in parity.INFO for name in names.split(", ")}
    told = {NAMES.get(name, name).split(", ")[0] for name in info} - APART
    assert told <= judged
    assert worlds.single_action_space.shape == (13,)
    env.close()


def test_the_table_is_of_the_code(parity: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = list(parity.rows())
    assert {row[2] for row in rows} == {"same", "converted", "different"}
    assert len({(kind, name) for kind, name, *_ in rows}) == len(rows) > 200
    monkeypatch.setitem(parity.REWARD, "pick/dance", ("same", ""))
    with pytest.raises(ValueError, match="pick/dance"):
        list(parity.rows())
    monkeypatch.delitem(parity.INFO, "is_static")
    with pytest.raises(ValueError, match="is_static"):
        list(parity.rows())
