"""docs/serving.md has every key that is sent, and the joints of the state in their order."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from mjhab.robots.registry import robot_named
from mjhab.serving.dialects.names import DIALECTS
from tests.serving.constant import an_ask

DOCS = Path(__file__).parents[2] / "docs" / "serving.md"
UNTOLD = {"endpoint", "__action_chunk_size__"}
"""Told beside the table of what is sent."""


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_every_key_is_told(dialect: str) -> None:
    rows = DOCS.read_text(encoding="utf-8").partition("## Every key")[2].splitlines()
    begin = next(k for k, row in enumerate(rows) if row.startswith(f"| {dialect} |"))
    own = [rows[begin]]
    for row in rows[begin + 1 :]:
        if not row.startswith("| |"):
            break
        own.append(row)
    told = {word for row in own for word in row.split("|")[2].split("`")[1::2]}
    ask = dataclasses.replace(
        an_ask(), robot="fetch", cameras=("fetch_head", "fetch_hand")
    )
    sent = set(DIALECTS[dialect].request([ask], {}, batch=False))
    assert sent - UNTOLD == told


def test_the_joints_of_the_state_are_told_in_order() -> None:
    robot = robot_named("fetch")
    names = [name.removesuffix("_joint") for name in robot.joints[robot.columns.upper]]
    assert f"joint positions: {', '.join(names)} |" in DOCS.read_text(encoding="utf-8")
