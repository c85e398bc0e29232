"""Students and profiles: where demonstrations are made, what a checkpoint brings, and what is compared."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjhab.config.env import EnvConfig
from mjhab.config.profiles import MS_HAB
from mjhab.core.errors import UsageError
from mjhab.evaluation.evaluate import EvalSpec, resolved_config
from mjhab.evaluation.parts import describe_policy, env_options
from mjhab.learning.checkpoint import save_student
from mjhab.learning.demos import load_demonstrations, observation_spec_of_data
from mjhab.learning.observation.spec import ObservationSpec, profile_of
from mjhab.learning.policy import StudentPolicy
from mjhab.learning.runs.collection import longer, make_env
from mjhab.learning.runs.request import layout_for
from mjhab.learning.runs.specs import ImitationSpec, Resources, Scene
from mjhab.learning.students.heads import make_student
from tests.data.make import record_pictures
from tests.learning.small import INPUTS, config, fake_env, layout, train_config

CAMERAS = ("fetch_head", "fetch_hand")
BOTH = dataclasses.replace(INPUTS, cameras=CAMERAS)
CLOSE: dict[str, Any] = {"task": "set_table", "subtask": "close", "profile": "ms_hab"}


def of_ms_hab() -> ObservationSpec:
    told = layout(BOTH)
    return dataclasses.replace(told, control=(*told.control, "head"), profile="ms_hab")


@pytest.mark.parametrize("horizon", [0, 320])
def test_demonstrations_are_of_the_profile_and_last_as_long_as_asked(
    horizon: int,
) -> None:
    made = EnvConfig(**longer(CLOSE, horizon))
    assert made.horizon == (horizon or MS_HAB.horizon)
    wanted = MS_HAB.options("close", trains=False)
    assert all(
        getattr(made, name) == value
        for name, value in wanted.items()
        if name != "horizon"
    )
    assert profile_of(vars(made)) == "ms_hab"
    assert (
        profile_of({**vars(made), "profile": "mjhab", "stillness": "absolute"}) == "mjhab"
    )


def test_no_demonstration_is_cut_to_the_horizon_of_training() -> None:
    scene = Scene(**CLOSE, home="builtin_m0_00", randomise="start:2")
    env = make_env(scene, {}, Resources(1, 1, 1))
    assert env.config.horizon == 200
    assert env.config.perturbations.random == {"start": 2}
    assert env.config.stationary == ("head",)


def test_a_checkpoint_brings_its_profile_and_another_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_student(path, make_student(config(inputs=BOTH), of_ms_hab()), {})
    facts = describe_policy(str(path))

    def recorded(**env: Any) -> dict[str, Any]:
        spec = EvalSpec.of(str(path), subtask="pick", env=env)
        EnvConfig(**env_options(spec, facts))
        return resolved_config(spec, facts)

    own = recorded()
    other = recorded(profile="mjhab")
    assert (own["profile"], own["policy_profile"], own["stationary"]) == (
        "ms_hab",
        "ms_hab",
        ["head"],
    )
    assert (other["profile"], other["policy_profile"], other["stationary"]) == (
        "mjhab",
        "ms_hab",
        [],
    )


def test_a_stationary_head_is_no_other_layout_but_another_control_mode_is() -> None:
    student = make_student(config(inputs=BOTH), of_ms_hab())
    env = fake_env(told=layout(BOTH))
    StudentPolicy(student, env)
    env.config = SimpleNamespace(
        control_mode="pd_ee_delta_pose", base="forward", stationary=("head",)
    )
    with pytest.raises(UsageError, match="control pd_ee_delta_pose"):
        StudentPolicy(student, env)


def test_demonstrations_of_another_profile_are_refused(tmp_path: Path) -> None:
    record_pictures(tmp_path / "a.h5", range(2))
    every = "success or not success"
    request = ImitationSpec.of(
        out=tmp_path / "run",
        preset=train_config(),
        profile="ms_hab",
        data=tmp_path,
        where=every,
    )
    with pytest.raises(
        UsageError,
        match=r"demonstrations are of profile mjhab, not ms_hab.*generate --profile ms_hab",
    ):
        layout_for(request)
    told = observation_spec_of_data(tmp_path, INPUTS, request.filter)
    with pytest.raises(UsageError, match="profile mjhab instead of ms_hab"):
        load_demonstrations(
            tmp_path, dataclasses.replace(told, profile="ms_hab"), 3, request.filter
        )


def test_layouts_come_back_from_json_and_old_ones_are_of_the_default_profile() -> None:
    told = of_ms_hab()
    plain = told.to_plain()
    assert ObservationSpec.from_plain(told.inputs, plain) == told
    del plain["profile"]
    assert ObservationSpec.from_plain(told.inputs, plain).profile == "mjhab"
