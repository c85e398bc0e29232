"""Several networks in one: the sentence chooses which of them acts. `learning.assigned.join` makes such students."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from mjhab.core.errors import wrong_value
from mjhab.learning.configs import VIEWS, StudentConfig
from mjhab.learning.networks import Normalizer, Trunk
from mjhab.learning.observation.parts import image_keys
from mjhab.learning.observation.sentences import SENTENCE_WIDTH
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.student import Student

COPIES = 64
"""Variants of a sentence that a gate learns from."""
MOST_NEW = 6
"""Most words that are added to a sentence: the codes of words share entries, so that an unknown one can look like some
known ones. Without such variants 89 % of 1,800 sentences of the axis "language", level 3, found their route; with them
all did. Leaving words out at random, too, was worse."""
PENALTY = 1e-3
"""Weight of the squared weights of a gate."""


class RoutedTrunk(nn.Module):
    """A mixture of experts whose gate reads the sentence alone, and lets one of them act (top-1).

    The gate is linear in the words (`observation.sentences`) and gives one of R routes; ``config.network.routes`` names
    the expert of each. An expert sees the state, its views, and which route it is in place of the sentence. The
    features are those of the one that acts, in its own columns, so that the linear layer behind is one for each.

    Raises:
        UsageError: the student reads no sentence, or has a one-hot condition beside it.
    """

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__()
        inputs = config.inputs
        routes = config.network.routes
        if inputs.condition or not inputs.sentence:
            raise wrong_value(
                "network.routes",
                routes,
                "left out unless the sentence alone tells the task (inputs.sentence=true, inputs.condition=false)",
            )
        self.history = inputs.history
        self.routes = routes
        names = tuple(f"route{number}" for number in range(len(routes)))
        every, widths = layout.image_keys, layout.image_channels
        self.gate = nn.Linear(SENTENCE_WIDTH, len(routes))
        self.experts = nn.ModuleList()
        self._channels: list[list[int]] = []
        for views in config.network.experts:
            whole, target = VIEWS[views]
            # An expert is told the number of the route where it was told a subtask.
            told = replace(
                inputs,
                sentence=False,
                condition=True,
                whole_views=whole,
                target_views=target,
            )
            plain = replace(config.network, experts=(), routes=())
            seen = replace(layout, inputs=told, kinds=(), targets=names)
            expert = Trunk(replace(config, inputs=told, network=plain), seen)
            self.experts.append(expert)
            self._channels.append(
                [
                    channel
                    for step in range(self.history)
                    for key in seen.image_keys
                    for channel in _span(widths, every.index(key), step)
                ]
            )
        self._seen_width = max(
            self._expert(number).encoder.width for number in range(len(self.experts))
        )
        self.layers = _ExpertLayers(self.experts)
        self.width = len(self.experts) * (1 + self._expert(0).width)

    def _expert(self, number: int) -> Trunk:
        return cast("Trunk", self.experts[number])

    @property
    def normalizer(self) -> Normalizer:
        """Normalizer of the vector input of the first expert: each has its own."""
        return self._expert(0).normalizer

    def route(self, vector: Tensor, among: Sequence[int] = ()) -> Tensor:
        """Index (B,) of the route that the newest sentence of observations (B, V) asks for.

        Args:
            vector: its last columns are the sentence. among: the routes to choose from; all if not given.
        """
        asked = self.gate(vector[:, -SENTENCE_WIDTH:])
        if not among:
            return asked.argmax(dim=1)
        return torch.tensor(among, device=asked.device)[
            asked[:, list(among)].argmax(dim=1)
        ]

    def encoded(self, vector: Tensor, images: Tensor) -> Tensor:
        """Which expert acts (one-hot), and the input of its layers: (B, E + F)."""
        route = self.route(vector)
        told = nn.functional.one_hot(route, len(self.routes)).to(vector.dtype)
        steps = vector.unflatten(1, (self.history, -1))[..., :-SENTENCE_WIDTH]
        seen = torch.cat([steps, told[:, None].expand(-1, self.history, -1)], dim=2)
        acting = torch.tensor(self.routes, device=vector.device)[route]
        chosen = nn.functional.one_hot(acting, len(self.experts)).to(vector.dtype)

        def of(number: int) -> Tensor:
            mine = images[:, self._channels[number]]
            found = self._expert(number).encoded(seen.flatten(1), mine)
            # An expert of fewer images than another has zeros behind what it sees.
            return nn.functional.pad(found, (0, self._seen_width - found.shape[1]))

        return _by_expert(chosen, self._seen_width, of)

    def forward(self, vector: Tensor, images: Tensor) -> Tensor:
        return self.layers(self.encoded(vector, images))


def secondary_weights(student: Student) -> frozenset[str]:
    """Names of the weights of the encoders of whole views in networks of a joined student that see the target as well.

    Such a network acts by the views of the target in the first place.
    """
    inputs = student.config.inputs
    whole = len(image_keys(replace(inputs, whole_views=True, target_views=False)))
    encoders = tuple(
        f"trunk.experts.{number}.encoder.encoders.{image}."
        for number, views in enumerate(student.config.network.experts)
        if all(VIEWS[views])
        # Whole views are the first images.
        for image in range(whole)
    )
    return frozenset(name for name in student.state_dict() if name.startswith(encoders))


def _span(widths: Sequence[int], number: int, step: int) -> range:
    """Channels of an image of a step of the history; ``widths``: of all images of a step."""
    first = step * sum(widths) + sum(widths[:number])
    return range(first, first + widths[number])


class _ExpertLayers(nn.Module):
    """The layers behind the encoders: from (B, E + F) to the features (B, E * (1 + H)) of the expert that acts."""

    def __init__(self, experts: nn.ModuleList) -> None:
        super().__init__()
        # In a tuple, which registers no parameters: the experts have them.
        self._experts = (experts,)

    def forward(self, encoded: Tensor) -> Tensor:
        experts = [cast("Trunk", expert) for expert in self._experts[0]]
        count = len(experts)
        chosen, seen = encoded[:, :count], encoded[:, count:]

        def of(number: int) -> Tensor:
            expert = experts[number]
            return expert.layers(seen[:, : expert.encoder.width])

        features = _by_expert(chosen, experts[0].width, of)
        # A constant 1 of the acting expert, by which the joined head switches its bias.
        own = torch.cat([torch.ones_like(seen[:, :1]), features[:, count:]], dim=1)
        return (chosen[:, :, None] * own[:, None]).flatten(1)


def _by_expert(chosen: Tensor, width: int, run: Callable[[int], Tensor]) -> Tensor:
    """``chosen`` (B, E) and, for each row, what its expert gives: (B, E + width).

    Every expert that is asked at all gets the whole batch: the last bits of a row depend on the size of the batch.
    """
    found = chosen.new_zeros(len(chosen), width)
    for number in range(chosen.shape[1]):
        mine = chosen[:, number] > 0
        # Experts that nobody asks cost nothing; on the device meta there are no values to ask.
        if mine.is_meta or mine.any():
            found = torch.where(mine[:, None], run(number), found)
    return torch.cat([chosen, found], dim=1)


def fit_gate(
    sentences: Sequence[Sequence[str]], encode: Callable[[str], np.ndarray], seed: int
) -> tuple[Tensor, Tensor]:
    """Fit a gate to the sentences of each route by logistic regression.

    Random words are added, so that a sentence of which some words are new is understood by the others.

    Args:
        sentences: of each route (R), distinct. encode: a sentence to (S,). seed: of what is added.

    Returns:
        Weights (R, S) and biases (R,).
    """
    random = np.random.default_rng(seed)
    rows, wanted = [], []
    for route, said in enumerate(sentences):
        for sentence in said:
            rows.append(encode(sentence))
            rows += [encode(_varied(sentence, random)) for _ in range(COPIES)]
            # Routes with few sentences count as much as those with many.
            share = 1.0 / ((1 + COPIES) * len(said))
            wanted += [(route, share)] * (1 + COPIES)
    # LBFGS in float32 stops early, where differences of the loss are rounded away.
    seen = torch.from_numpy(np.stack(rows)).double()
    labels = torch.tensor([route for route, _ in wanted])
    weight = torch.tensor([each for _, each in wanted]).double()
    weights = torch.zeros(len(sentences), seen.shape[1], dtype=torch.float64)
    bias = torch.zeros(len(sentences), dtype=torch.float64)
    for tensor in (weights, bias):
        tensor.requires_grad_(True)
    solver = torch.optim.LBFGS(
        [weights, bias], max_iter=300, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        solver.zero_grad()
        errors = nn.functional.cross_entropy(
            seen @ weights.T + bias, labels, reduction="none"
        )
        total = (weight * errors).sum() / len(sentences) + PENALTY * (weights**2).sum()
        total.backward()
        return total

    solver.step(loss)
    return weights.detach().float(), bias.detach().float()


def _varied(sentence: str, random: np.random.Generator) -> str:
    """The sentence with some words more that nobody has ever heard."""
    new = random.integers(10**9, size=random.integers(MOST_NEW + 1))
    # Numbers are no words of any language, so that none is known by chance.
    return " ".join([sentence, *(f"x{number}" for number in new.tolist())])
