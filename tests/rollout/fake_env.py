"""A small in-memory env that speaks the env protocol of the rollout loop, without physics.

Every episode is a function of (seed, index) and of the actions it gets: subtasks take a drawn number of steps and end
by success, by force or by their horizon; forces rise with the size of the actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from mjhab.core.seeding import stream
from mjhab.rollout.policy import ACTION_SIZE

KINDS = ("pick", "place", "navigate", "open", "close")
SET_TABLE = tuple(
    (kind, target)
    for link, thing in (
        ("kitchen_counter/drawer3", "024_bowl_:0000"),
        ("fridge/top_door", "013_apple_:0000"),
    )
    for kind, target in (
        ("navigate", link),
        ("open", link),
        ("navigate", thing),
        ("pick", thing),
        ("navigate", thing),
        ("place", thing),
        ("navigate", link),
        ("close", link),
    )
)
GOOD = {
    "pick": "straightforward_success",
    "place": "placed_in_goal_success",
    "navigate": "navigation_success",
    "open": "open_success",
    "close": "closed_success",
}
BAD = {
    "pick": "cant_grasp_failure",
    "place": "didnt_reach_goal_failure",
    "navigate": "navigation_failure",
    "open": "cant_open_failure",
    "close": "cant_close_failure",
}


class FakeEnv:
    """W worlds of scripted episodes; ``quality`` is the chance that a subtask succeeds."""

    taint_names = ("contact_overflow", "nan", "deep_penetration", "engine_warning")
    action_table = (None,) * ACTION_SIZE

    def __init__(
        self,
        num_envs: int,
        plan: tuple[tuple[str, str], ...] = SET_TABLE,
        subtask: str | None = None,
        quality: float = 0.85,
        taint_chance: float = 0.1,
        broken_camera: bool = False,
    ) -> None:
        self.metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}
        self.num_envs = num_envs
        self.plan = plan
        self.subtask = subtask
        self.quality = quality
        self.taint_chance = taint_chance
        self.broken_camera = broken_camera
        self.worlds: list[_World | None] = [None] * num_envs
        self.steps_taken = 0
        self.resets: list[list[int]] = []
        self.interrupt_at: int | None = None
        self.interrupt: Callable[[], object] = _ctrl_c
        self.closed = False

    def reset(
        self, seed: int, options: dict[str, Any]
    ) -> tuple[np.ndarray, dict[str, Any]]:
        mask = options["reset_mask"]
        indices = options["episode"]
        assert (
            mask.shape == (self.num_envs,)
            and mask.dtype == bool
            and len(indices) == mask.sum()
        )
        for w, index in zip(np.flatnonzero(mask), indices, strict=True):
            self.worlds[w] = _World(self, seed, int(index))
        self.resets.append([int(index) for index in indices])
        return self._obs(), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        assert actions.shape == (self.num_envs, 13) and actions.dtype == np.float32
        self.steps_taken += 1
        if self.interrupt_at == self.steps_taken:
            self.interrupt()
        for w, world in enumerate(self.worlds):
            if world is None or world.over:
                assert not actions[w].any(), "an idle world must get zero actions"
            else:
                world.step(actions[w])
        info = self._info()
        over = np.array([world is not None and world.over for world in self.worlds])
        truncated = over & ~(info["success"] | info["fail"])
        return self._obs(), np.zeros(self.num_envs), over & ~truncated, truncated, info

    def render_worlds(
        self, worlds: Sequence[int], width: int = 480, height: int = 360
    ) -> np.ndarray:
        return np.stack([self._picture(w, width, height) for w in worlds])

    def _picture(self, w: int, width: int, height: int) -> np.ndarray:
        if self.broken_camera:
            raise RuntimeError("no renderer works here")
        world = self.worlds[w]
        assert world is not None
        image = np.full((height, width, 3), (235, 232, 226), np.uint8)
        x = int((world.t * 3) % max(width - 40, 1))
        image[height // 3 : height // 3 + 40, x : x + 40] = (
            40 + 12 * world.pointer,
            90,
            160,
        )
        return image

    def state_digest(self, world: int) -> str:
        state = self.worlds[world]
        assert state is not None
        return f"{state.t:016d}"

    def close(self) -> None:
        self.closed = True

    def _obs(self) -> np.ndarray:
        return np.array([0.0 if world is None else world.t for world in self.worlds])

    def _info(self) -> dict[str, Any]:
        blank = _World(self, 0, 0)
        worlds = [world or blank for world in self.worlds]
        return {
            "pointer": np.array([world.pointer for world in worlds]),
            "robot_force": np.array([world.force for world in worlds]),
            "finger_force": np.array([2.0 * world.force for world in worlds]),
            "cumulative_force": np.array([world.cumulative for world in worlds]),
            "success": np.array([world.success for world in worlds]),
            "fail": np.array([world.fail for world in worlds]),
            "spawn_fallback": np.zeros(self.num_envs, bool),
            "taint": np.array([world.taint for world in worlds], np.uint8),
            "events": [list(world.events) for world in worlds],
            "ended": [world.ended for world in worlds],
            "episode_spec": [
                None if world is None else world.episode for world in self.worlds
            ],
        }


def _ctrl_c() -> None:
    raise KeyboardInterrupt


class _World:
    """One episode."""

    def __init__(self, env: FakeEnv, seed: int, index: int) -> None:
        self.plan = env.plan
        self.rng = stream(seed, "fake", index)
        self.outcomes = self.rng.random(len(self.plan)) < env.quality
        self.lengths = self.rng.integers(6, 20, len(self.plan))
        self.tainted = self.rng.random() < env.taint_chance
        self.t = self.pointer = self.start = self.taint = 0
        self.force = self.cumulative = self.peak = 0.0
        self.success = self.fail = self.over = False
        self.events: list[str] = []
        self.seen: list[list[Any]] = []
        self.ended: dict[str, Any] | None = None
        entries = [
            {"kind": kind, "target": target, "goal": np.zeros(3)}
            for kind, target in self.plan
        ]
        self.episode = {
            "seed": seed,
            "index": index,
            "home": f"builtin_m{index % 2}_{index % 4:02d}",
            "task": "set_table",
            "split": "val",
            "subtask": env.subtask,
            "plan": entries,
        }

    def step(self, action: np.ndarray) -> None:
        self.t += 1
        self.events = []
        self.ended = None
        self.force = (
            float(self.rng.exponential(8.0) + 5.0 * np.abs(action).sum())
            if self.t % 3 == 0
            else 0.0
        )
        self.cumulative += self.force
        self.peak = max(self.peak, self.force)
        age = self.t - self.start
        if age == 3:
            self._event("contact")
        if age == 5 and self.outcomes[self.pointer]:
            self._event("grasped")
        if self.tainted and self.t == 4:
            self.taint = 0b101
        if age >= self.lengths[self.pointer]:
            self._end_subtask()

    def _event(self, name: str) -> None:
        self.events.append(name)
        self.seen.append([self.t, name])

    def _end_subtask(self) -> None:
        kind, target = self.plan[self.pointer]
        good = bool(self.outcomes[self.pointer])
        if good:
            self._event("success")
        self.ended = {
            "index": np.int64(self.pointer),
            "kind": kind,
            "target": target,
            "label": GOOD[kind] if good else BAD[kind],
            "legacy_label": None,
            "success_once": np.bool_(good),
            "success_at_end": good,
            "start_step": self.start,
            "end_step": self.t,
            "peak_force": np.float64(self.peak),
            "peak_finger_force": np.float64(2.0 * self.peak),
            "cumulative_force": self.cumulative,
            "events": self.seen,
        }
        self.start = self.t
        self.cumulative = 0.0
        self.peak = 0.0
        self.seen = []
        if good:
            self.pointer += 1
            self.success = self.pointer == len(self.plan)
        else:
            self.fail = True
        self.over = self.success or self.fail
