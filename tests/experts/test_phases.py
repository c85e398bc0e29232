"""Names of what a script is doing: read off the suspended generators, and off the traceback of an error."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
import pytest

from mjhab.envs import make
from mjhab.experts import make_expert
from mjhab.experts.phases import (
    PHASES,
    doing,
    phase,
    phases_in,
    phases_of,
)
from tests.refusals import refused


@phase("wave")
def wave(times: int) -> Generator[int, None, None]:
    yield from range(times)
    raise ValueError("tired")


def unnamed() -> Generator[int, None, None]:
    yield from wave(1)


@phase("greet")
def greet() -> Generator[int, None, None]:
    yield -1
    yield from unnamed()


def test_phases_are_those_of_the_suspended_generators() -> None:
    script = greet()
    assert next(script) == -1 and phases_of(script) == ("greet",)
    assert next(script) == 0 and phases_of(script) == ("greet", "wave")


def test_an_error_names_the_phases_it_was_raised_in() -> None:
    script = greet()
    with pytest.raises(ValueError, match="tired") as caught:
        list(script)
    assert phases_in(caught.value) == ("greet", "wave")
    assert phases_of(script) == ()


def test_a_phase_has_a_name_of_its_own() -> None:
    assert len(set(PHASES.values())) == len(PHASES)


def test_the_expert_says_what_it_is_doing() -> None:
    env = make(
        task="set_table",
        subtask="open",
        target="kitchen_counter/drawer3",
        num_envs=1,
        autoreset="disabled",
    )
    policy = make_expert(env)
    obs, info = env.reset(seed=0)
    policy.reset(np.ones(1, bool))
    assert policy.phases(0) == ()
    seen = set()
    told: list[str] = []
    while info["ended"][0] is None:
        obs, _, _, _, info = env.step(policy.act(obs, info))
        seen.add(policy.phases(0))
        now = policy.notes().doing[0]
        assert now.phases == policy.phases(0)
        told += [now.skill] if now.skill not in told else []
    assert ("open the drawer", "take the handle", "grasp the handle") in {
        names[:3] for names in seen
    }
    assert any(names[:2] == ("open the drawer", "let go of the handle") for names in seen)
    assert told == ["approach", "grasp", "pull", "release", "retract", "hold"]


def test_an_inner_phase_without_a_skill_does_that_of_the_outer_one() -> None:
    @phase("tidy", "carry")
    def tidy() -> Generator[int, None, None]:
        yield from greet()

    script = tidy()
    next(script)
    assert doing(script) == ("carry", ("tidy", "greet"))


def test_a_skill_is_one_of_the_list() -> None:
    with refused(given="jump", expected="lift"):
        phase("leap", "jump")
