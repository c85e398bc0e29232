"""The example of a reward of one's own: Pick's terms and one more, which a hard grip loses."""

from __future__ import annotations

import numpy as np
import pytest

import mjhab
from mjhab.tasks.subtasks.registry import SUBTASKS
from tests.examples.plugins import loaded
from tests.tasks.build import CONFIG, squeeze
from tests.tasks.rewards.states import PICK, view_of


def test_one_term_is_added_to_those_of_pick_and_a_hard_grip_loses_it() -> None:
    with loaded("reward.py"):
        mine = SUBTASKS["gentle_pick"].reward
        theirs = SUBTASKS["pick"].reward
        assert mine is not None and theirs is not None
        assert mine.terms[:-1] == theirs.terms and mine.terms[-1].name == "soft"
        assert mine.attainable == theirs.attainable + 3.0
        forces = np.array([0.0, 60.0, 2410.0])
        view = view_of([PICK] * 3, fingers_force=forces, finger_force=squeeze())
        when, raw = mine.raw(view, CONFIG)
        assert when["grasped"].all()
        assert raw["soft"] == pytest.approx([1.0, 0.5, 60 / 2470])


def test_it_is_paid_in_an_environment() -> None:
    with loaded("reward.py"):
        env = mjhab.make_train(
            task="clear_counter", subtask="gentle_pick", num_envs=1, threads=1
        )
        env.reset(seed=0)
        _, _, _, _, info = env.step(np.zeros((1, 13), np.float32))
        assert "soft" in info["reward_terms"]
        env.close()
