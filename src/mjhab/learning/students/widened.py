"""Give a trained student more views of its cameras: it acts as before until it is trained on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import cast

import torch

from mjhab.learning.configs import VIEWS, InputConfig
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.parts import image_keys
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.routed import RoutedTrunk


def widened(student: BehaviourCloning, views: Mapping[int, str]) -> BehaviourCloning:
    """A joined student of which some experts see more views.

    The weights with which an expert reads the new images are zero, so that it acts as before. The encoder of a new
    image is that of another expert that sees it, if there is one.

    Args:
        student: made by `learning.assigned.join`.
        views: number of an expert: what it is to see, one of VIEWS.
    """
    old = student.config
    named = list(old.network.experts)
    for number, name in views.items():
        named[number] = name
    seen = [VIEWS[name] for name in named]
    inputs = dataclasses.replace(
        old.inputs,
        whole_views=any(whole for whole, _ in seen),
        target_views=any(target for _, target in seen),
    )
    network = dataclasses.replace(old.network, experts=tuple(named))
    made = make_student(
        dataclasses.replace(old, inputs=inputs, network=network),
        dataclasses.replace(student.layout, inputs=inputs),
    )
    assert isinstance(made, BehaviourCloning)
    apart = "trunk.experts."
    rest = {k: v for k, v in student.state_dict().items() if not k.startswith(apart)}
    made.load_state_dict(rest, strict=False)
    before = cast("RoutedTrunk", student.trunk).experts
    after = cast("RoutedTrunk", made.trunk).experts
    donors: dict[str, torch.nn.Module] = {}
    keys = [_keys(inputs, name) for name in old.network.experts]
    for expert, its in zip(before, keys, strict=True):
        for key, encoder in zip(its, cast("Trunk", expert).encoder.encoders, strict=True):
            donors.setdefault(key, encoder)
    for number, (source, target) in enumerate(zip(before, after, strict=True)):
        _widen(
            cast("Trunk", source),
            cast("Trunk", target),
            keys[number],
            _keys(inputs, named[number]),
            donors,
        )
    return made


def _keys(inputs: InputConfig, views: str) -> tuple[str, ...]:
    whole, target = VIEWS[views]
    return image_keys(
        dataclasses.replace(inputs, whole_views=whole, target_views=target)
    )


def _widen(
    source: Trunk,
    target: Trunk,
    had: tuple[str, ...],
    has: tuple[str, ...],
    donors: Mapping[str, torch.nn.Module],
) -> None:
    """Copy a trunk to one that sees the images ``has`` in place of ``had``."""
    width = (source.encoder.width - source.encoder.vector_width) // max(1, len(had))
    first = cast("torch.nn.Linear", target.layers[0])
    was = cast("torch.nn.Linear", source.layers[0])
    with torch.no_grad():
        first.weight.zero_()
        for at, key in enumerate(has):
            if key in had:
                k = had.index(key)
                first.weight[:, at * width : (at + 1) * width] = was.weight[
                    :, k * width : (k + 1) * width
                ]
                donor = source.encoder.encoders[k]
            else:
                donor = donors.get(key)
            if donor is not None:
                target.encoder.encoders[at].load_state_dict(donor.state_dict())
        first.weight[:, len(has) * width :] = was.weight[:, len(had) * width :]
        if was.bias is not None:
            first.bias.copy_(was.bias)
    target.encoder.normalizer.load_state_dict(source.encoder.normalizer.state_dict())
    rest = {k: v for k, v in source.layers.state_dict().items() if not k.startswith("0.")}
    target.layers.load_state_dict(rest, strict=False)
