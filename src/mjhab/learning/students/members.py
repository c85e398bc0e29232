"""Networks that are carried over to other students, whole or out of a joined one."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn

from mjhab.learning.configs import VIEWS, InputConfig, NetworkConfig
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.parts import image_keys
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.routed import RoutedTrunk

VIEW_NAMES = {views: name for name, views in VIEWS.items()}


@dataclass(frozen=True)
class Member:
    """The network of a policy, or the one that acts on some requests in a policy joined before.

    student: whose network it is. expert: its number in a joined policy; None of a plain one.
    """

    student: BehaviourCloning
    expert: int | None = None

    @property
    def trunk(self) -> Trunk:
        """Encoder and layers of the network."""
        trunk = self.student.trunk
        if self.expert is None:
            return cast("Trunk", trunk)
        return cast("Trunk", cast("RoutedTrunk", trunk).experts[self.expert])

    @property
    def sees(self) -> tuple[bool, bool]:
        """Whether it sees whole images and views of the target."""
        if self.expert is not None:
            return VIEWS[self.student.config.network.experts[self.expert]]
        return views_of(self.student.config.inputs)

    @property
    def views(self) -> str:
        """Which views of the cameras it sees, one of VIEWS."""
        return VIEW_NAMES[self.sees]

    @property
    def encoders(self) -> dict[str, nn.Module]:
        """The encoders of the images that it sees, by key of the observation."""
        keys = keys_of(self.student.config.inputs, self.sees)
        return dict(zip(keys, self.trunk.encoder.encoders, strict=True))

    @property
    def normalized_head(self) -> tuple[Tensor, Tensor]:
        """Weights (rows, H) and biases (rows,) of its last layer, which gives normalized actions."""
        weight, bias = self.student.head.weight, self.student.head.bias
        if self.expert is None:
            return weight, bias
        width = 1 + self.trunk.width
        mine = weight[:, self.expert * width : (self.expert + 1) * width]
        # Column 0 is the bias of the expert; training gives the shared one values as well.
        return mine[:, 1:], mine[:, 0] + bias

    @property
    def head(self) -> tuple[Tensor, Tensor]:
        """The same of actions that are not normalized."""
        student = self.student
        scale = student.action_normalizer.scale.repeat(student.config.chunk)
        mean = student.action_normalizer.mean.repeat(student.config.chunk)
        weight, bias = self.normalized_head
        return weight * scale[:, None], bias * scale + mean


def views_of(inputs: InputConfig) -> tuple[bool, bool]:
    """Whether a student sees whole images and views of the target."""
    return inputs.whole_views, inputs.target_views


def keys_of(inputs: InputConfig, sees: tuple[bool, bool]) -> tuple[str, ...]:
    """Keys of the images of a network that sees some views, as `views_of`."""
    whole, target = sees
    seen = dataclasses.replace(inputs, whole_views=whole, target_views=target)
    return image_keys(seen)


def loses_images(before: tuple[bool, bool], after: tuple[bool, bool]) -> bool:
    """Whether a network that has seen some views, as `views_of`, sees one of them no longer."""
    return any(its and not still for its, still in zip(before, after, strict=True))


def network_alone(network: NetworkConfig) -> NetworkConfig:
    """The configuration of one network of a joined policy."""
    return dataclasses.replace(network, experts=(), routes=())


def inputs_alone(inputs: InputConfig) -> InputConfig:
    """Inputs apart from those in which carried networks may differ: the views, and how they are told a task."""
    return dataclasses.replace(
        inputs, whole_views=True, target_views=True, condition=False, sentence=True
    )


def layout_alone(layout: ObservationSpec) -> ObservationSpec:
    """A layout apart from such inputs, and from the tasks that it knows."""
    inputs = inputs_alone(layout.inputs)
    return dataclasses.replace(layout, targets=(), kinds=(), inputs=inputs)


def take_over(
    trunk: Trunk,
    member: Member,
    table: Tensor,
    images: Mapping[str, nn.Module | None],
) -> None:
    """Copy a member's network to one that is told its tasks in another code, and may see more images.

    Args:
        trunk: the new network. member: what it is to do. table: (T, R) what the member is told, a code of T numbers,
            for each of the R numbers of the new code.
        images: keys of those that the new network sees, all of the member's among them, with the encoder of one that is
            new to the member; None if nobody has one. It has no influence before it is learned from.
    """
    old, mine = member.trunk.state_dict(), member.encoders
    measured = len(member.trunk.normalizer.mean) - len(table)
    new = {k: v for k, v in old.items() if not k.startswith("encoder.encoders.")}
    features = member.trunk.encoder.image_features
    weight = old["layers.0.weight"]
    own = {
        key: weight[:, number * features : (number + 1) * features]
        for number, key in enumerate(mine)
    }
    behind = weight[:, len(mine) * features :]
    # With a layer of its own for the state, the code enters there.
    stated = not isinstance(member.trunk.encoder.state, nn.Identity)
    if stated:
        key = "encoder.state.weight"
        key = key if key in old else "encoder.state.0.weight"
        new[key] = _recoded(old[key], measured, table)
    else:
        behind = _recoded(behind, measured, table)
    for number, (key, known) in enumerate(images.items()):
        if encoder := mine.get(key, known):
            new |= {
                f"encoder.encoders.{number}.{name}": value
                for name, value in encoder.state_dict().items()
            }
    unread = weight.new_zeros(len(weight), features)
    seen = [own.get(key, unread) for key in images]
    new["layers.0.weight"] = torch.cat([*seen, behind], dim=1)
    for name, filler in (("mean", 0.0), ("scale", 1.0)):
        key = f"encoder.normalizer.{name}"
        # Codes are not normalized: mean 0 and scale 1 leave them as they are.
        rest = torch.full((table.shape[1],), filler)
        new[key] = torch.cat([old[key][:measured], rest])
    # Encoders that nobody has keep their random weights.
    trunk.load_state_dict({**trunk.state_dict(), **new})


def _recoded(weight: Tensor, measured: int, table: Tensor) -> Tensor:
    """Weights of a vector with a code at the end of every step for one with another code: ``table`` (T, R)."""
    parts = []
    for step in weight.unflatten(1, (-1, measured + len(table))).unbind(1):
        parts += [step[:, :measured], step[:, measured:] @ table]
    return torch.cat(parts, dim=1)
