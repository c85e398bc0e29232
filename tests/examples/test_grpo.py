"""The example of GRPO: advantages within groups, and updates that move the policy towards what was better."""

from __future__ import annotations

import runpy

import pytest
import torch

from tests.examples.plugins import EXAMPLES


@pytest.fixture(scope="module")
def grpo() -> dict:
    return runpy.run_path(str(EXAMPLES / "grpo.py"))


def test_advantages_compare_within_a_group(grpo: dict) -> None:
    gain = grpo["advantages"](torch.tensor([1.0, 3.0, 10.0, 10.0]), 2)
    assert gain[0] == -gain[1] < 0 and gain[2:].tolist() == [0.0, 0.0]


def test_an_update_makes_the_better_action_likelier(grpo: dict) -> None:
    torch.manual_seed(0)
    policy = grpo["ChunkTransformer"](5, 3, False)
    optimizer = torch.optim.Adam(policy.parameters(), 1e-2)
    seen = {"states": torch.randn(2, 5), "task_descriptions": ["close it", "shut it"]}
    acted = policy(seen).sample()
    before = policy(seen).log_prob(acted).mean((1, 2)).detach()
    step = grpo["Step"](seen, acted, before, torch.ones(2, dtype=torch.bool))
    grpo["update"](policy, optimizer, [step], torch.tensor([1.0, -1.0]))
    change = policy(seen).log_prob(acted).mean((1, 2)).detach() - before
    assert change[0] > 0 > change[1]


def test_it_trains_on_images_and_sentences(grpo: dict) -> None:
    words = "--updates 1 --groups 1 --tries 2 --chunks 1 --images".split()
    (mean,) = grpo["main"](words)
    assert mean > 0
