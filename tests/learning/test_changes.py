"""Fields of a preset that are set by name, and devices of training."""

from __future__ import annotations

import pytest
import torch

from mjhab.core.errors import UsageError
from mjhab.learning.changes import settable, with_changes
from mjhab.learning.configs import BC, DAGGER, preset_of
from mjhab.learning.devices import AUTO, CPU, training_device


def test_fields_are_set_by_name() -> None:
    changed = with_changes(
        preset_of(DAGGER, "quick"),
        ["chunk=4", "inputs.image_size=64", "network.channels=32,64,64", "optimizer.ema=0",
         "inputs.previous_action=false", "dagger.rounds=2"],
    )  # fmt: skip
    student = changed.student
    assert (student.chunk, student.inputs.image_size, student.optimizer.ema) == (4, 64, 0.0)
    assert student.network.channels == (32, 64, 64)
    assert not student.inputs.previous_action
    assert changed.dagger is not None and changed.dagger.rounds == 2


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("chunk", "NAME=VALUE"),
        ("inputs.imag_size=64", "Did you mean 'inputs.image_size'"),
        ("dagger.rounds=2", "unknown field"),
        ("chunk=four", "'four' is no int"),
        ("network.channels=32,x", "'x' is no int"),
        ("inputs.condition=yes", "neither true nor false"),
        ("chunk=1", "execute must be from 1 to chunk"),
        ("chunk=0", "must be at least 1"),
        ("algorithm=act", "unknown field"),
        ("inputs.image_size=0", "must be at least 1"),
        ("optimizer.batch=0", "must be at least 1"),
        ("hold_steps=-2", "must be at least -1"),
        ("optimizer.learning_rate=nan", "must be at least 0, and finite"),
        ("optimizer.learning_rate=inf", "must be at least 0, and finite"),
        ("network.channels=", "at least one value"),
        ("network.channels=32,0", "must be at least 1"),
        ("network.encoder=smal", "Did you mean 'small'"),
        ("optimizer.schedule=cosin", "Did you mean 'cosine'"),
    ],
)
def test_wrong_words_are_refused(word: str, told: str) -> None:
    with pytest.raises(UsageError, match=told):
        with_changes(preset_of(BC), [word])


def test_every_settable_field_takes_its_own_value() -> None:
    preset = preset_of(DAGGER)
    words = [
        f"{name}={','.join(map(str, value)) if isinstance(value, tuple) else str(value).lower()}"
        for name, value in settable(preset).items()
    ]
    assert with_changes(preset, words) == preset


def test_devices_have_names() -> None:
    assert training_device(CPU) == torch.device("cpu")
    assert training_device(AUTO).type == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(UsageError, match="valid names here: cpu, auto"):
        training_device("cuda:77")
