"""Progress through a plan: active subtask, elapsed steps and accumulated force; pure functions.

One control step: ``accumulate`` the force and the clocks, ``measure``, then ``advance`` the pointer
(mshab/envs/sequential_task.py, without its quirk of counting resets as steps).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mjhab.core.arrays import (
    Array,
    cast,
    constant,
    may_hold,
    namespace,
    pick_column,
    where_rows,
    zeros,
)
from mjhab.tasks.plan import PlanArrays
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import horizons
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True)
class Progress:
    """Progress of every world through its plan. All arrays are (W,)."""

    pointer: Array
    """int64, index of the active subtask; equals the plan's length once all are done."""
    steps_left: Array
    """int64, control steps left for the active subtask."""
    subtask_step: Array
    """int64, control steps spent in the active subtask."""
    episode_step: Array
    """int64, control steps since the reset."""
    cumulative_force: Array
    """float [N x control steps] over the active subtask."""
    peak_force: Array
    """float [N], largest force of one control step in the active subtask."""
    peak_finger_force: Array
    """float [N], likewise of the two fingers together, which no limit counts."""
    success_once: Array
    """bool: the active subtask has succeeded in some step (used in continuous evaluation)."""
    done: Array
    """bool: the episode has ended; the row does not change until it is reset."""


@dataclass(frozen=True)
class StepOutcome:
    """Result of a control step. All arrays are (W,) bool, False for worlds that were done before the step."""

    advanced: Array
    """The active subtask was completed and the pointer moved on."""
    success: Array
    """The whole plan is completed; in continuous evaluation: the subtask succeeds in this step."""
    fail: Array
    """The episode failed: force over the limit, a finished Place undone, or the horizon reached without success. With
    `TaskConfig.goes_on` of a chain: in this step."""
    timeout: Array
    """The horizon of the active subtask is reached and it was not completed in this step."""
    force_exceeded: Array
    """The accumulated force is over its limit."""
    place_broken: Array
    """The object of a finished Place is no longer at its goal."""
    done: Array
    """The episode ended in this step."""
    ended: Array
    """The subtask that was active in this step ended: completed, failed or out of time."""
    success_once: Array
    """The subtask that was active has been achieved in some step so far."""
    success_at_end: Array
    """The subtask that was active is achieved in this step."""


def _horizon(plan: PlanArrays, pointer: Array, config: TaskConfig) -> Array:
    """(W,) horizon of the subtask at ``pointer``; past the end, that of the last subtask."""
    # Past the end a horizon is still read, though nothing depends on it.
    kind = pick_column(plan.kind, namespace(pointer).minimum(pointer, plan.length - 1))
    return constant(horizons(config), pointer)[kind]


def start(plan: PlanArrays, config: TaskConfig, like: Array | None = None) -> Progress:
    """Progress of W worlds at the start of their plans.

    Args:
        plan: the plans.
        config: thresholds; gives the horizons.
        like: a float array with the dtype of the forces; ``plan.goal_pos`` if not given.
    """
    xp = namespace(plan.length)
    zero = xp.zeros_like(plan.length)
    force = (
        xp.zeros_like(plan.goal_pos[:, 0, 0])
        if like is None
        else zeros((zero.shape[0],), like)
    )
    # False of the right library and device.
    no = plan.length < 0
    left = _horizon(plan, zero, config)
    return Progress(zero, left, zero, zero, force, force, force, no, no)


def reset_rows(
    progress: Progress, mask: Array, plan: PlanArrays, config: TaskConfig
) -> Progress:
    """Restart the worlds in ``mask`` (W,) on their (new) plans; every other row keeps its exact values."""
    return where_rows(mask, start(plan, config, progress.cumulative_force), progress)


def accumulate(progress: Progress, robot_force: Array, fingers_force: Array) -> Progress:
    """Count one control step: its forces (W,) [N] and its time. Worlds that are done do not change."""
    xp = namespace(robot_force)
    step = cast(~progress.done, progress.pointer.dtype)
    # Chosen and not multiplied: a broken world may give NaN, which times 0 stays NaN.
    force = xp.where(progress.done, 0.0, robot_force)
    fingers = xp.where(progress.done, 0.0, fingers_force)
    return Progress(
        progress.pointer,
        progress.steps_left - step,
        progress.subtask_step + step,
        progress.episode_step + step,
        progress.cumulative_force + force,
        xp.maximum(progress.peak_force, force),
        xp.maximum(progress.peak_finger_force, fingers),
        progress.success_once,
        progress.done,
    )


def give_up(
    broken: Array, progress: Progress, signals: Signals
) -> tuple[Progress, Signals]:
    """Set the remaining steps of the worlds in ``broken`` (W,) bool to 0 and their success to False."""
    left = namespace(broken).where(broken, 0, progress.steps_left)
    success = signals.success & ~broken
    return replace(progress, steps_left=left), replace(signals, success=success)


def advance(
    progress: Progress, signals: Signals, plan: PlanArrays, config: TaskConfig
) -> tuple[Progress, StepOutcome]:
    """Advance the pointer where the active subtask is completed; end episodes that failed or are completed.

    A subtask is completed when it succeeds, with its force within the limit, while every finished Place still holds.
    The next one then starts with its own horizon and zero force. A finished plan has no force limit.
    With ``config.continuous`` the pointer stays and the episode runs to the horizon: success may be lost again, and
    too much force only marks the episode as failed. With ``config.hold_steps`` it ends that many steps after the
    first success or excess of force. With ``config.goes_on`` only success and time end a chain. The values of the
    subtask that ended are in the ``progress`` passed in.

    Returns:
        The new progress and the outcome of this step.
    """
    if config.continuous:
        return _advance_continuous(progress, signals, config.hold_steps)
    alive = ~progress.done
    # A success in the step in which the force goes over its limit is a failure.
    advanced = alive & signals.success & signals.placed_ok & signals.force_ok
    force_exceeded = alive & ~signals.force_ok
    place_broken = alive & ~signals.placed_ok
    # Success in the last step still counts.
    timeout = alive & ~advanced & (progress.steps_left <= 0)
    pointer = progress.pointer + advanced
    success = advanced & (pointer >= plan.length)
    fail = force_exceeded | place_broken | timeout
    done = success | (timeout if config.goes_on else fail)
    moved = advanced & ~success
    outcome = StepOutcome(
        advanced,
        success,
        fail,
        timeout,
        force_exceeded,
        place_broken,
        done,
        advanced | done,
        advanced,
        advanced,
    )
    new = Progress(
        pointer,
        progress.steps_left,
        progress.subtask_step,
        progress.episode_step,
        progress.cumulative_force,
        progress.peak_force,
        progress.peak_finger_force,
        progress.success_once | advanced,
        progress.done | done,
    )
    return (_begin_next(new, moved, plan, config) if may_hold(moved) else new), outcome


def _begin_next(
    progress: Progress, moved: Array, plan: PlanArrays, config: TaskConfig
) -> Progress:
    """Set horizon, time and force to those at the start of the subtask at the pointer in the worlds ``moved`` (W,)."""
    xp = namespace(moved)
    return Progress(
        progress.pointer,
        xp.where(moved, _horizon(plan, progress.pointer, config), progress.steps_left),
        xp.where(moved, 0, progress.subtask_step),
        progress.episode_step,
        xp.where(moved, 0.0, progress.cumulative_force),
        xp.where(moved, 0.0, progress.peak_force),
        xp.where(moved, 0.0, progress.peak_finger_force),
        # It is about the active subtask, and another one begins.
        progress.success_once & ~moved,
        progress.done,
    )


def _advance_continuous(
    progress: Progress, signals: Signals, hold_steps: int
) -> tuple[Progress, StepOutcome]:
    """The single-subtask rule of ``advance``: the horizon ends the episode, or ``hold_steps`` after its outcome."""
    alive = ~progress.done
    now = alive & signals.success & signals.force_ok
    once = alive & (progress.success_once | now)
    timeout = alive & (progress.steps_left <= 0)
    force_exceeded = alive & ~signals.force_ok
    no = alive & ~alive
    # Running out of time after a success is no failure: continuous evaluation goes on until then.
    fail = force_exceeded | (timeout & ~once)
    outcome = StepOutcome(
        no, now, fail, timeout & ~now, force_exceeded, no, timeout, timeout, once, now
    )
    steps_left = progress.steps_left
    if hold_steps >= 0:
        xp = namespace(steps_left)
        # At the first success alone: a later one must not prolong the episode.
        decided = (now & ~progress.success_once) | force_exceeded
        steps_left = xp.where(
            decided,
            # Never longer than the horizon.
            xp.minimum(steps_left, xp.full_like(steps_left, hold_steps)),
            steps_left,
        )
    new = replace(
        progress,
        steps_left=steps_left,
        success_once=progress.success_once | now,
        done=progress.done | timeout,
    )
    return new, outcome
