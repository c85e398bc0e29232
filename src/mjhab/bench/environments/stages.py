"""Where the time of a control step goes: a stopwatch on the methods of an environment, and memory in use."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjhab.core.arithmetic.sums import ordered_sum

if TYPE_CHECKING:
    from mjhab.envs.loop import TaskLoop

STEP_STAGES = (
    "physics",
    "measure",
    "reward",
    "labels",
    "render",
    "observe",
    "reset",
    "other",
)


def watch_env(watch: Stopwatch, env: TaskLoop) -> None:
    """Count the stages of a control step of an environment."""
    for stage, methods in env.timed_methods().items():
        for owner, method in methods:
            watch.time(owner, method, stage)


def stage_seconds(
    watch: Stopwatch, total: float, num_envs: int
) -> tuple[dict[str, float], float]:
    """Stop a watch: seconds of each of STEP_STAGES, of ``total`` [s], and the time of a world's one reset [ms]."""
    seconds = watch.stop()
    # What no stage counts, such as the bookkeeping of the loop itself.
    seconds["other"] = total - ordered_sum(seconds.values())
    reset_ms = 1000 * seconds.get("reset", 0.0) / num_envs
    return {stage: round(seconds.get(stage, 0.0), 5) for stage in STEP_STAGES}, round(
        reset_ms, 3
    )


class Stopwatch:
    """Counts the time spent in methods of given objects; time inside another counted method belongs to that one.

    Args:
        wait: called at the end of each, for a device that works on while the caller goes on.
    """

    def __init__(self, wait: Callable[[], None] = lambda: None) -> None:
        self._wait = wait
        self._seconds: dict[str, float] = {}
        self._inner: list[float] = []
        self._wrapped: list[tuple[Any, str]] = []

    def time(self, owner: Any, method: str, stage: str) -> None:
        """Count ``owner.method`` under ``stage`` from now on."""
        original: Callable[..., Any] = getattr(owner, method)

        def counted(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            begun = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                self._wait()
                # After the wait, so that the work of a device counts for the method that asked for it.
                spent = time.perf_counter() - begun
                own = spent - self._inner.pop()
                self._seconds[stage] = self._seconds.get(stage, 0.0) + own
                if self._inner:
                    self._inner[-1] += spent

        setattr(owner, method, counted)
        self._wrapped.append((owner, method))

    def stop(self) -> dict[str, float]:
        """Give the methods back; returns seconds per stage."""
        for owner, method in self._wrapped:
            # The counted method is an attribute of the instance; below it lies that of the class.
            delattr(owner, method)
        return dict(self._seconds)
