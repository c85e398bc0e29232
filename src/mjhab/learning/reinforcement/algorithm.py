"""A training run without its algorithm: checkpoints, evaluations, replay buffers, demonstrations."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from mjhab.core.files.cache import write_text
from mjhab.learning.reinforcement.demonstrations.expert import collect_demonstrations
from mjhab.learning.reinforcement.demonstrations.recorded import replay_recorded
from mjhab.learning.reinforcement.replay import ReplayBuffer, ReplayShape
from mjhab.learning.reinforcement.session import DEMONSTRATIONS, ReinforcementSession
from mjhab.learning.runs import distributed
from mjhab.learning.students.student import Student
from mjhab.tasks.subtasks.registry import SUBTASKS, horizons

COMPLETE = "complete.json"
"""File that marks a complete buffer; it holds the buffer's shape and ring positions."""


class AlgorithmRun(ABC):
    """The part of a training run that all algorithms share."""

    def __init__(self, session: ReinforcementSession) -> None:
        self.session = session
        self.config = session.config

    actor: Student

    @abstractmethod
    def prepare(self) -> None:
        """Make or read the demonstrations and imitate them, if the config asks for it.

        Raises:
            OutOfTime: the budget is spent.
            UsageError: recorded demonstrations do not fit.
        """

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """State that the next update depends on, as named tensors for a checkpoint."""

    @abstractmethod
    def learn(self) -> None:
        """Train until the run's number of samples is reached.

        Raises:
            OutOfTime: the budget is spent.
        """

    def save(self) -> None:
        """Write a checkpoint; all worlds start new episodes."""
        self.session.save(self.actor, self.tensors())

    def expect_steps(self, steps: int) -> None:
        """The first update waits for so many control steps, see `Session.expect`."""
        worlds = self.session.worlds.count
        self.session.expect_work(
            steps,
            f"{steps} control steps of {worlds} worlds",
            "--worlds and --eval-episodes",
            of_expert=False,
        )

    def between(self, before: int) -> None:
        """Evaluate and write a checkpoint if either became due since ``before`` samples."""
        session = self.session
        every = self.config.eval_samples
        if session.spec.round_episodes and session.due(every, before):
            session.evaluate(session.spec.round_episodes)
        # After the evaluation, so that a resumed run knows the best success.
        if session.due(self.config.checkpoint_samples, before):
            self.save()
        # Last, so that a run whose time is up has its checkpoint.
        session.check_time()

    def buffer(self, name: str, worlds: int, capacity: int) -> ReplayBuffer:
        """Make an empty replay buffer for ``capacity`` control steps of ``worlds`` worlds; on a processor it is kept
        in the folder ``name`` of the run.
        """
        seen = self.session.worlds.seen
        images = seen.images.shape[1:]
        # A transition needs the entry behind it.
        steps = max(capacity // worlds, 2)
        # Between two checkpoints every step may end an episode, whose last observation takes an entry, too.
        apart = -(-self.config.checkpoint_samples // worlds)
        reserve = min(2 * apart + 1, steps // 4)
        if name == DEMONSTRATIONS:
            # Demonstrations are never overwritten, so that no entries must be kept free.
            reserve = 0
        shape = ReplayShape(
            worlds=worlds,
            steps=steps,
            vector=seen.vector.shape[1],
            images=(int(images[0]), int(images[1]), int(images[2])),
            privileged=seen.privileged.shape[1],
            actions=len(self.session.layout.actions),
        )
        self.session.log.say(f"memory of the buffer {name}: {shape.words}")
        device = self.session.worlds.device
        # In files, so that a resumed run has its experience; memory of a GPU cannot be mapped.
        folder = self.session.folder.path / name if device.type == "cpu" else None
        return ReplayBuffer(shape, device, folder, reserve)

    def demonstrations(self, episodes: int, style: tuple[str, ...] = ()) -> ReplayBuffer:
        """A buffer of recorded episodes or, without any, of ``episodes`` new episodes of the expert.

        ``style``: of the expert, see `collect_demonstrations`.
        """
        folder = self.session.folder.path / DEMONSTRATIONS

        def fill() -> ReplayBuffer:
            return (
                self._replay_recorded()
                if self.session.spec.data
                else self._ask_expert(episodes, style)
            )

        shown = kept_demonstrations(folder, fill)
        self.session.demonstrations = shown.episodes
        return shown

    def _replay_recorded(self) -> ReplayBuffer:
        session = self.session

        def make(worlds: int, steps: int) -> ReplayBuffer:
            return self.buffer(DEMONSTRATIONS, worlds, worlds * steps)

        def tell(done: int, total: int) -> None:
            session.log.show({"phase": f"demonstrations: {done}/{total}"})
            # Several processes have different numbers of batches, and could not decide together.
            if distributed.processes() == 1:
                session.check_time()

        return replay_recorded(session, make, tell)

    def _ask_expert(self, episodes: int, style: tuple[str, ...]) -> ReplayBuffer:
        session = self.session
        subtask = SUBTASKS[session.spec.scene.subtask]
        # Two more: the last observation of an episode, and the entry that the ring keeps apart.
        horizon = int(max(*horizons(session.env.task_config), subtask.limits.horizon)) + 2

        def make(worlds: int) -> ReplayBuffer:
            # Large enough for the longest episodes, because what is overwritten would be lost silently.
            per_world = -(-episodes // worlds) * horizon
            return self.buffer(DEMONSTRATIONS, worlds, worlds * per_world)

        def tell(done: int) -> None:
            session.log.show({"phase": f"demonstrations: {done}/{episodes}"})

        return collect_demonstrations(session, episodes, make, tell, style)


def kept_demonstrations(folder: Path, fill: Callable[[], ReplayBuffer]) -> ReplayBuffer:
    """The buffer in ``folder`` if an earlier start of the run has completed it, else the result of ``fill``.

    On a GPU buffers are not files and the folder does not exist, so every start fills the buffer anew.
    """
    done = folder / COMPLETE
    if done.is_file():
        kept = json.loads(done.read_text(encoding="ascii"))
        buffer = ReplayBuffer(
            ReplayShape.from_plain(kept["shape"]), torch.device("cpu"), folder
        )
        # An array that was deleted was made anew, empty: then all is filled again.
        if not buffer.is_new:
            buffer.position.copy_(torch.tensor(kept["position"]))
            return buffer
    buffer = fill()
    if folder.is_dir():
        kept = {"shape": asdict(buffer.shape), "position": buffer.position.tolist()}
        # Last: the mark says that the arrays are complete.
        write_text(done, json.dumps(kept) + "\n")
    return buffer
