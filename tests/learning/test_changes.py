"""Fields of a preset that are set by name, and devices of training."""

from __future__ import annotations

import pytest
import torch

from mjhab.learning.changes import settable, with_changes
from mjhab.learning.configs import BC, DAGGER, DIFFUSION, FLOW, preset_of
from mjhab.learning.devices import AUTO, CPU, training_device
from mjhab.learning.reinforcement.configs import PPO, RLPD, SAC, reinforcement_preset
from tests.refusals import refused


def test_fields_are_set_by_name() -> None:
    changed = with_changes(
        preset_of(DAGGER, "quick"),
        ["chunk=4", "inputs.image_size=64", "network.channels=32,64,64", "optimizer.ema=0",
         "inputs.previous_action=false", "dagger.rounds=2"],
    )  # fmt: skip
    student = changed.student
    assert (student.chunk, student.inputs.image_size, student.optimizer.ema) == (
        4,
        64,
        0.0,
    )
    assert student.network.channels == (32, 64, 64)
    assert not student.inputs.previous_action
    assert changed.dagger is not None and changed.dagger.rounds == 2


def test_fields_that_depend_on_each_other_are_set_in_any_order() -> None:
    preset = preset_of(BC, "small")
    for words in (["chunk=1", "execute=1"], ["execute=1", "chunk=1"]):
        student = with_changes(preset, words).student
        assert (student.chunk, student.execute) == (1, 1)
    polish = reinforcement_preset(PPO, "polish")
    low = ["ppo.learning_rate=1e-6", "ppo.least_learning_rate=1e-7"]
    for words in (low, low[::-1]):
        changed = with_changes(polish, words).ppo
        assert changed is not None
        assert (changed.learning_rate, changed.least_learning_rate) == (1e-6, 1e-7)


@pytest.mark.parametrize(
    ("word", "option", "expected"),
    [
        ("chunk", "set", "NAME=VALUE"),
        ("inputs.imag_size=64", "field of the preset", "inputs.image_size"),
        ("dagger.rounds=2", "field of the preset", ""),
        ("chunk=four", "--set chunk", "of type int"),
        ("network.channels=32,x", "--set network.channels", "of type int"),
        ("inputs.condition=yes", "--set inputs.condition", "false"),
        ("chunk=1", "execute", "from 1 to chunk"),
        ("chunk=0", "--set chunk", "at least 1"),
        ("algorithm=act", "field of the preset", ""),
        ("inputs.image_size=0", "--set inputs.image_size", "at least 1"),
        ("optimizer.batch=0", "--set optimizer.batch", "at least 1"),
        ("hold_steps=-2", "--set hold_steps", "at least -1"),
        ("optimizer.learning_rate=nan", "--set optimizer.learning_rate", "finite"),
        ("optimizer.learning_rate=inf", "--set optimizer.learning_rate", "finite"),
        ("network.channels=", "--set network.channels", "at least one value"),
        ("network.channels=32,0", "--set network.channels", "at least 1"),
        ("network.encoder=smal", "network.encoder", "small"),
        ("optimizer.schedule=cosin", "optimizer.schedule", "cosine"),
        ("optimizer.betas=0.9", "optimizer.betas", "two numbers from 0 to below 1"),
        ("optimizer.betas=0.9,1", "optimizer.betas", "two numbers from 0 to below 1"),
        ("optimizer.ema=1", "optimizer.ema", "at least 0 and below 1"),
        ("network.log_std=1,-5", "network.log_std", "two rising numbers"),
    ],
)
def test_wrong_words_are_refused(word: str, option: str, expected: str) -> None:
    with refused(option, expected=expected):
        with_changes(preset_of(BC), [word])


@pytest.mark.parametrize(
    ("algorithm", "option", "given"),
    [
        (FLOW, "sampling_steps", 0),
        (DIFFUSION, "sampling_steps", 0),
        (DAGGER, "dagger.new_share", 1.5),
    ],
)
def test_wrong_words_of_an_algorithm_are_refused(
    algorithm: str, option: str, given: float
) -> None:
    word = f"{option}={given}"
    with refused(option, given):
        with_changes(preset_of(algorithm), [word])


@pytest.mark.parametrize(
    ("algorithm", "name", "word", "expected"),
    [
        (PPO, "fast", "initial_std=0", "above 0"),
        (PPO, "scratch", "initial_std=1", "between 0.02 and 1.0"),
        (SAC, "fast", "initial_alpha=0", "above 0"),
        (SAC, "fast", "adam_beta=1", "at least 0 and below 1"),
        (SAC, "fast", "atoms=1", "at least 2"),
        (SAC, "fast", "value_low=20", "over rising values"),
        (RLPD, "demos", "demonstration_share=1", "at least 0 and below 1"),
    ],
)
def test_wrong_words_of_reinforcement_are_refused(
    algorithm: str, name: str, word: str, expected: str
) -> None:
    part = "ppo" if algorithm == PPO else "sac"
    field = word.partition("=")[0]
    with refused("atoms" if field == "value_low" else field, expected=expected):
        with_changes(reinforcement_preset(algorithm, name), [f"{part}.{word}"])


def as_words(fields: dict) -> list[str]:
    """NAME=VALUE of every field."""
    return [
        f"{name}={','.join(map(str, value)) if isinstance(value, tuple) else str(value).lower()}"
        for name, value in fields.items()
    ]


def test_every_settable_field_takes_its_own_value() -> None:
    preset = preset_of(DAGGER)
    assert with_changes(preset, as_words(settable(preset))) == preset


@pytest.mark.parametrize(
    ("algorithm", "name"), [(PPO, "depth"), (SAC, "fast"), (RLPD, "demos")]
)
def test_every_field_of_a_reinforcement_preset_takes_its_own_value(
    algorithm: str, name: str
) -> None:
    preset = reinforcement_preset(algorithm, name)
    assert with_changes(preset, as_words(settable(preset))) == preset


def test_fields_of_reinforcement_are_set_by_name() -> None:
    preset = reinforcement_preset(PPO, "fast")
    changed = with_changes(
        preset, ["ppo.demonstrations=800", "network.hidden=512", "horizon=0"]
    )
    assert changed.ppo is not None
    assert (changed.ppo.demonstrations, changed.network.hidden) == (800, 512)
    with refused(
        "field of the preset", "ppo.demonstration", expected="ppo.demonstrations"
    ):
        with_changes(preset, ["ppo.demonstration=800"])
    with refused("minibatches", 7):
        with_changes(preset, ["ppo.minibatches=7"])


def test_fields_of_reinforcement_that_depend_on_each_other_are_set_together() -> None:
    preset = reinforcement_preset(PPO, "fast")
    changed = with_changes(preset, ["ppo.minibatches=6", "worlds=48"])
    assert changed.ppo is not None and (changed.ppo.minibatches, changed.worlds) == (
        6,
        48,
    )


def test_devices_have_names() -> None:
    assert training_device(CPU) == torch.device("cpu")
    assert training_device(AUTO).type == ("cuda" if torch.cuda.is_available() else "cpu")
    with refused("device", "cuda:77", expected="auto"):
        training_device("cuda:77")
