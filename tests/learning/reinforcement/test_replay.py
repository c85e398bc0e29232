"""The replay buffer: transitions never cross the end of an episode, and images are stored once."""

from __future__ import annotations

from pathlib import Path

import torch

from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.algorithm import kept_demonstrations
from mjhab.learning.reinforcement.replay import ReplayBuffer, ReplayShape
from tests.refusals import refused

CPU = torch.device("cpu")
SHAPE = ReplayShape(
    worlds=3, steps=40, vector=2, images=(1, 4, 4), privileged=1, actions=1
)


def seen(episode: torch.Tensor, step: torch.Tensor) -> AgentObs:
    """Observations that tell episode and step of every world."""
    images = step[:, None, None, None].expand(-1, 1, 4, 4).to(torch.uint8)
    return AgentObs(
        torch.stack([episode, step], dim=1).float(), images, step[:, None].float()
    )


def filled(steps: int, folder: Path | None = None, reserve: int = 0) -> ReplayBuffer:
    """World w has episodes of 3 + w steps, one after another; the last step of each is a failure in world 0."""
    buffer = ReplayBuffer(SHAPE, CPU, folder, reserve)
    length = torch.tensor([3, 4, 5])
    episode = torch.zeros(3, dtype=torch.int64)
    step = torch.zeros(3, dtype=torch.int64)
    for _ in range(steps):
        ends = step + 1 == length
        failed = ends & (torch.arange(3) == 0)
        buffer.add(seen(episode, step), step[:, None].float(), step.float(), failed)
        worlds = torch.nonzero(ends).flatten()
        if len(worlds):
            buffer.close(worlds, seen(episode, step + 1).rows(worlds))
        step = torch.where(ends, 0, step + 1)
        episode = episode + ends
    return buffer


def test_what_follows_is_the_next_step_of_the_same_episode() -> None:
    drawn = filled(200).draw(2000, torch.Generator().manual_seed(0))
    assert torch.equal(drawn.seen.vector[:, 0], drawn.next_seen.vector[:, 0])
    assert torch.equal(drawn.seen.vector[:, 1] + 1, drawn.next_seen.vector[:, 1])
    assert torch.equal(
        drawn.next_seen.images[:, 0, 0, 0].float(), drawn.next_seen.vector[:, 1]
    )
    assert torch.equal(drawn.reward, drawn.seen.vector[:, 1])
    assert set(drawn.seen.vector[:, 1].tolist()) == {0.0, 1.0, 2.0, 3.0, 4.0}


def test_only_failures_are_followed_by_nothing() -> None:
    drawn = filled(200).draw(2000, torch.Generator().manual_seed(0))
    ends = drawn.terminated
    assert ends.any() and set(drawn.seen.vector[ends, 1].tolist()) == {2.0}


def test_all_transitions_are_equally_likely() -> None:
    buffer = filled(30)
    drawn = buffer.draw(30_000, torch.Generator().manual_seed(0))
    keys = drawn.seen.vector[:, 0] * 10 + drawn.seen.vector[:, 1]
    # In the last world every episode has five steps, the first world's have three; each step is as likely.
    _, counts = torch.unique(keys, return_counts=True)
    assert counts.max() < 4 * counts.min()


def test_reserved_entries_are_not_drawn() -> None:
    buffer = filled(200, reserve=20)
    oldest = float(
        buffer.draw(3000, torch.Generator().manual_seed(0)).seen.vector[:, 0].min()
    )
    assert oldest > float(
        filled(200).draw(3000, torch.Generator().manual_seed(0)).seen.vector[:, 0].min()
    )


def test_a_buffer_in_files_is_there_after_its_process(tmp_path: Path) -> None:
    first = filled(30, tmp_path)
    wanted = first.draw(50, torch.Generator().manual_seed(1))
    again = ReplayBuffer(SHAPE, CPU, tmp_path)
    again.position.copy_(first.position)
    found = again.draw(50, torch.Generator().manual_seed(1))
    assert torch.equal(wanted.seen.vector, found.seen.vector)
    assert torch.equal(wanted.next_seen.images, found.next_seen.images)


def test_demonstrations_are_made_again_if_a_file_of_theirs_is_gone(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "demonstrations"
    made: list[int] = []

    def fill() -> ReplayBuffer:
        made.append(len(made))
        return filled(30, folder)

    wanted = kept_demonstrations(folder, fill)
    assert kept_demonstrations(folder, fill).episodes == wanted.episodes
    assert made == [0]
    (folder / "begins.npy").unlink()
    assert kept_demonstrations(folder, fill).episodes == wanted.episodes
    assert made == [0, 1]


def test_a_buffer_larger_than_the_memory_is_refused_with_what_fits() -> None:
    huge = ReplayShape(64, 10**9, 50, (2, 128, 128), 40, 13)
    with refused(said=("does not fit:", "GiB are free. A capacity of")):
        ReplayBuffer(huge, CPU)


def test_images_are_kept_once() -> None:
    depth = ReplayShape(1, 2, 0, (2, 32, 32), 0, 0)
    assert depth.row_bytes < 2 * 32 * 32 + 10
