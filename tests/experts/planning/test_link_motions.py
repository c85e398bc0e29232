"""Motions of doors and drawers: searched for once for every link, robot and height."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mjhab.envs.parts.world_view import JointedLink, home_shapes
from mjhab.experts.planning import link_motions
from mjhab.experts.planning.link_motions import LinkMotions
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.robot import Robot
from mjhab.scenes.packs import open_pack


def height(robot: Robot, link: JointedLink) -> LinkMotions:
    """A search that finds nothing but how high the link is."""
    return LinkMotions(np.full((1, 1, 1), link.origin[2]), np.zeros(1), np.zeros(1))


def base_height(robot: Robot, link: JointedLink) -> LinkMotions:
    """A search that finds nothing but how high the base is."""
    return LinkMotions(np.full((1, 1, 1), robot.base_height), np.zeros(1), np.zeros(1))


@pytest.fixture
def link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JointedLink:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    monkeypatch.setattr(link_motions, "_FOUND", {})
    pack = open_pack("builtin")
    return home_shapes(Layout(pack, ()), pack.homes[0].name).links["fridge/top_door"]


def test_the_same_door_at_another_height_has_stances_of_its_own(link: JointedLink):
    """The order in which homes are seen decides nothing."""
    lifted = replace(link, origin=link.origin + np.array([0.0, 0.0, 0.2]))
    for each in (link, lifted, link):
        found = link_motions.cached(ROBOT, each, "height", height)
        assert found.q.item() == each.origin[2]
    aside = replace(link, origin=link.origin + np.array([3.0, 1.0, 0.0]))
    assert link_motions.cached(ROBOT, aside, "height", height) is link_motions.cached(
        ROBOT, link, "height", height
    )


def test_a_changed_robot_of_the_same_name_has_stances_of_its_own(link: JointedLink):
    high = replace(ROBOT, base_height=ROBOT.base_height + 0.1)
    for robot in (ROBOT, high):
        found = link_motions.cached(robot, link, "base", base_height)
        assert found.q.item() == robot.base_height


def test_stances_are_searched_anew_for_other_code_of_the_shapes_of_links(
    link: JointedLink, monkeypatch: pytest.MonkeyPatch
):
    named: list[str] = []

    def note(*names: str) -> bytes:
        named.extend(names)
        return b""

    monkeypatch.setattr(link_motions, "code_digest", note)
    link_motions.cached(ROBOT, link, "height", height)
    for user in (JointedLink, Robot, LinkMotions):
        module = user.__module__.removeprefix("mjhab.")
        assert any(f"{module}.".startswith(f"{name}.") for name in named)
