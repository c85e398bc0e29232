"""Jobs for the tests of generation, and a pool whose workers live in this process and die when they are told to."""

from __future__ import annotations

import functools
import random
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from mjhab.data.record.job import Job
from mjhab.data.record.messages import (
    EpisodeDone,
    EpisodeEvaluated,
    Message,
    Request,
    WorkerExited,
    failure,
)
from mjhab.data.record.workers import Stage, Work, WorkerSpec, WorkSpec
from mjhab.data.store.places import episodes
from mjhab.rollout.policy import RandomPolicy
from tests.data.fake_world import FakeEnv

KEEP = "label != 'cant_close_failure' and steps > 6"


def build(worlds: int = 2, subtask: str = "") -> Stage:
    """A stage without physics."""
    return Stage(
        cast("Any", FakeEnv(worlds, subtask)), RandomPolicy(0), {"name": "random"}
    )


def job(out: Path, keep: str = "", worlds: int = 2, **options: Any) -> Job:
    """A job on that stage; the filter lets tainted episodes in, so that enough of them pass."""
    where = f"({keep}) and (tainted or not tainted)" if keep else ""
    spec = WorkerSpec(functools.partial(build, worlds), 0, where)
    given: dict[str, Any] = {"episodes": 400, "chunk": 3, **options}
    return Job(spec, {"keep": keep}, out, **given)


def kept(place: Path) -> dict[int, str]:
    """Index and digest of the episodes in a folder, each of which is there once."""
    found = [
        (episode.record.index, str(episode.attributes["digest"]))
        for episode in episodes(place)
    ]
    assert len(dict(found)) == len(found)
    return dict(sorted(found))


class Killed(BaseException):
    """The end of a worker."""


class InlinePool:
    """Carries out requests at once and delivers what was said in a random order among workers.

    ``deaths``: chance that a worker dies before it tells of an episode, after the episode was written if it was.
    """

    def __init__(self, seed: int = 0, deaths: float = 0.0) -> None:
        self.random = random.Random(seed)
        self.deaths = deaths
        self.died = 0
        self.workers: dict[int, Work] = {}
        self.said: dict[int, deque[Message]] = {}
        self.stopped = False

    def start(self, number: int, spec: WorkSpec, folder: Path) -> None:
        try:
            self.workers[number] = spec.start(folder)
            self.said[number] = deque([self.workers[number].ready])
        except Exception as error:
            self.said[number] = deque([failure(error)])

    def send(self, number: int, request: Request) -> None:
        said = self.said[number]

        def tell(message: Message) -> None:
            if (
                isinstance(message, EpisodeDone | EpisodeEvaluated)
                and self.random.random() < self.deaths
            ):
                raise Killed
            said.append(message)

        try:
            self.workers[number].run(request, tell, bool)
        except Killed:
            self.died += 1
            self.workers.pop(number).close()
            said.append(WorkerExited())
        except Exception as error:
            said.append(failure(error))

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        waiting = [number for number, said in self.said.items() if said]
        number = self.random.choice(waiting)
        return [(number, self.said[number].popleft())]

    def stop(self) -> None:
        self.stopped = True
        for worker in self.workers.values():
            worker.close()
        self.workers.clear()


def after(calls: int) -> Callable[[], bool]:
    """Says True from the call of that number on."""
    count = iter(range(calls + 1))
    return lambda: next(count, calls) >= calls
