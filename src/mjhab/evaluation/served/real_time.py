"""Chunks of actions of a served policy: when they are there, and what acts while the policy thinks.

Without `Pace` the world waits for every answer. With it the world goes on: an answer that takes d control steps is
there d steps after its observation. The steps are counted, not slept through, so that neither the speed of the
simulation nor its number of worlds changes what happens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mjhab.core.timing import STEP_SECONDS
from mjhab.serving.address import CHUNK, LAST, Address

_SLACK = 1e-9
"""Rounding of a latency that is a whole number of control steps."""


@dataclass(frozen=True)
class Pace:
    """How the world goes on while a policy thinks.

    meanwhile: what acts, see `Address.meanwhile`. hz: control steps per second. latency_ms: of every answer; None for
    what each request took.
    """

    meanwhile: str
    hz: float
    latency_ms: float | None = None

    @classmethod
    def of(cls, address: Address) -> Pace | None:
        """That of an address; None where the world waits."""
        if not address.real_time:
            return None
        hz = 1.0 / STEP_SECONDS if address.hz is None else address.hz
        return cls(address.meanwhile, hz, address.latency_ms)

    def in_force_ms(self, measured_ms: float) -> float:
        """How late an answer is [ms] whose request took ``measured_ms``."""
        return measured_ms if self.latency_ms is None else self.latency_ms

    def delay(self, measured_ms: float) -> int:
        """Control steps from an observation to the answer, whose request took ``measured_ms``."""
        # An answer that comes within a step acts from the next one.
        return math.ceil(1e-3 * self.in_force_ms(measured_ms) * self.hz - _SLACK)


@dataclass(frozen=True, eq=False)
class Answer:
    """Actions (H, A) of an environment. first: control step that the first is for. arrives: when they are there."""

    chunk: np.ndarray
    first: int
    arrives: int


@dataclass
class Playback:
    """The chunks of the running episode of one world.

    chunk: in execution. place: index of its next action. taken: number of its actions that were executed. pending: an
    answer that is on its way. last: action executed last.
    """

    chunk: np.ndarray | None = None
    place: int = 0
    taken: int = 0
    pending: Answer | None = None
    last: np.ndarray | None = None

    @property
    def _left(self) -> int:
        return 0 if self.chunk is None else len(self.chunk) - self.place

    def is_due(self, execute: int) -> bool:
        """Whether the policy must be asked: ``execute`` actions were executed, or none is left."""
        # One request at a time: a server that is behind must not get a queue.
        return self.pending is None and (not self._left or self.taken >= execute)

    def receive(self, step: int, pace: Pace | None) -> None:
        """Take the answer that is there in control step ``step``, if there is one.

        What was executed meanwhile came from the chunk before, so its actions for the steps that have passed are left
        out, and those for later wait for their step; where the robot only waited, all of them are still to be done.
        """
        answer = self.pending
        if answer is None:
            return
        overlaps = pace is not None and pace.meanwhile == CHUNK
        if step < (max(answer.arrives, answer.first) if overlaps else answer.arrives):
            return
        self.chunk = answer.chunk
        self.place = max(0, step - answer.first) if overlaps else 0
        self.taken = 0
        self.pending = None

    def act(self, still: np.ndarray, pace: Pace | None) -> tuple[np.ndarray, bool]:
        """The next action (A,), and whether the policy had none ready: then it is its last one, or ``still`` (A,)."""
        meanwhile = CHUNK if pace is None else pace.meanwhile
        waits = self.pending is not None and meanwhile != CHUNK
        late = self.chunk is None or not self._left or waits
        if self.chunk is not None and not late:
            action = self.chunk[self.place]
            self.place += 1
            self.taken += 1
        elif meanwhile == LAST and self.last is not None:
            action = self.last
        else:
            action = still
        self.last = action
        return action, late
