"""An env without physics that speaks what the recorder reads: random signals, labels by the real tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from gymnasium.vector import AutoresetMode

from mjhab.core.seeding import stream
from mjhab.data.store.schema import STORED_CHECKS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.tasks.labelling.tracker import SubtaskTracker
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import name_of, number_of

CHAIN = (
    ("open", "kitchen_counter/drawer3"),
    ("pick", "024_bowl_:0000"),
    ("place", "024_bowl_:0000"),
    ("navigate", "fridge"),
    ("close", "kitchen_counter/drawer3"),
)
NQ = 30
NV = 28
SIZE = 16


@dataclass(frozen=True)
class FakeConfig:
    """The options the provenance looks at."""

    task: str = "set_table"
    subtask: str = ""
    num_envs: int = 1
    assets: str = "builtin"
    obs_mode: str = "state"
    runs_to_horizon: bool = False
    has_flat_keys: ClassVar[bool] = True
    handle_points: str = "ours"
    control_mode: str = "pd_joint_delta_pos"
    base: str = "forward"
    stationary: tuple[str, ...] = ()


class _Sim:
    def __init__(self, env: FakeEnv) -> None:
        self._env = env
        starts = {
            "robot_q": [0, 1, 2],
            "robot_v": [0, 1, 2],
            "object_q": [2],
            "object_v": [2],
            "link_q": [9],
        }
        self.addresses = SimpleNamespace(**starts)

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        one = self._env.worlds[world]
        return {
            "qpos": one.qpos.copy(),
            "qvel": one.qpos[:NV] * 0.5,
            "ctrl": np.zeros(13),
        }

    def model(self, home: str) -> Any:
        return SimpleNamespace(
            nq=NQ, qpos0=np.full(NQ, float(len(home))), names=home.encode()
        )


class FakeEnv:
    """W worlds; an episode is a function of (seed, index). Episodes whose index ends in 4 are tainted."""

    taint_names = ("contact_overflow", "nan", "penetration")

    def __init__(
        self,
        num_envs: int = 2,
        subtask: str = "",
        images: bool = False,
        horizon: int = 20,
        segments: Sequence[str] = (),
    ) -> None:
        self.num_envs = num_envs
        self.images = images
        self.segments = segments
        self.horizon = horizon
        self.metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}
        self.config = FakeConfig(
            subtask=subtask, num_envs=num_envs, runs_to_horizon=bool(subtask)
        )
        self.plan = tuple(e for e in CHAIN if e[0] == subtask) if subtask else CHAIN
        self.layout = SimpleNamespace(
            robot=ROBOT,
            objects=[],
            object_names=["024_bowl_:0000"],
            link_ids=["kitchen_counter/drawer3"],
            stage="",
        )
        self.action_table = [SimpleNamespace(name=f"a{i}") for i in range(13)]
        self.worlds = [_World(self, 0, w) for w in range(num_envs)]
        self.sim, self.observer, self.homes = (
            _Sim(self),
            _observer(self),
            [""] * num_envs,
        )
        self.state = None
        self.focus = None
        self.tracker: SubtaskTracker | None = None
        self._settle(np.zeros(num_envs, bool))

    def render_worlds(
        self, worlds: Sequence[int], width: int = 480, height: int = 360
    ) -> np.ndarray:
        return np.zeros((len(worlds), height, width, 3), np.uint8)

    def reset(self, seed: int, options: dict[str, Any]) -> tuple[dict, dict]:
        mask = options["reset_mask"]
        for w, index in zip(np.flatnonzero(mask), options["episode"], strict=True):
            self.worlds[w] = _World(self, seed, int(index))
        self._settle(mask)
        return self._observe(None, None, None, None), self._info(
            [[]] * self.num_envs, [None] * self.num_envs
        )

    def _settle(self, mask: np.ndarray) -> None:
        self.signals = self.outcome_signals = self._signals()
        self.homes = [w.home for w in self.worlds]
        if self.tracker is None:
            self.tracker = SubtaskTracker(self.signals)
        self.tracker.restart(mask, self.signals)
        self._outcome()

    def _outcome(self) -> None:
        self.progress = SimpleNamespace(done=np.array([w.done for w in self.worlds]))
        self.success = np.array([w.success for w in self.worlds])
        self.fail = np.array([w.done and not w.success for w in self.worlds])

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        live = np.array([not w.done for w in self.worlds])
        kind = np.array([number_of(self.plan[w.pointer][0]) for w in self.worlds])
        for w, world in enumerate(self.worlds):
            if live[w]:
                world.step(actions[w])
        self.outcome_signals = self._signals()
        assert self.tracker is not None
        events = self.tracker.step(
            kind, self.outcome_signals, np.array([w.t for w in self.worlds]), live
        )
        labels = self.tracker.labels(kind)
        ended: list[dict[str, Any] | None] = [None] * self.num_envs
        moved = np.zeros(self.num_envs, bool)
        for w, world in enumerate(self.worlds):
            if live[w] and world.ends():
                ended[w] = self._ended(w, int(kind[w]), labels[w])
                moved[w] = world.move()
        for w in np.flatnonzero(moved):
            self.worlds[w].bits = self.worlds[w].fresh()
        self.signals = self._signals()
        self.tracker.restart(moved, self.signals)
        self._outcome()
        over = self.progress.done
        obs = self._observe(None, None, None, None)
        reward = np.array([0.5 * w.t for w in self.worlds])
        return (
            obs,
            reward,
            over & self.success,
            over & ~self.success,
            self._info(events, ended),
        )

    def _ended(self, w: int, kind: int, label: str) -> dict[str, Any]:
        assert self.tracker is not None
        world = self.worlds[w]
        return {
            "index": world.pointer,
            "kind": name_of(kind),
            "target": self.plan[world.pointer][1],
            "label": label,
            "legacy_label": self.tracker.legacy_label(w, kind),
            "success_once": world.good,
            "success_at_end": world.good,
            "start_step": world.start,
            "end_step": world.t,
            "peak_force": 3.0,
            "cumulative_force": 4.0,
            "events": self.tracker.events(w),
        }

    def _signals(self) -> Signals:
        bits = np.array([w.bits for w in self.worlds])
        force = np.array([w.force for w in self.worlds])
        checks = {name: bits[:, k] for k, name in enumerate(STORED_CHECKS)}
        kind = np.zeros(self.num_envs, np.int64)
        return Signals(
            **checks,
            robot_force=force,
            target_force=force * 2,
            cumulative_force=force * 3,
            kind=kind,
        )

    def _info(self, events: list[list[str]], ended: list[Any]) -> dict[str, Any]:
        worlds = self.worlds
        return {
            "pointer": np.array([w.pointer for w in worlds]),
            "robot_force": np.array([w.force for w in worlds]),
            "success": self.success.copy(),
            "fail": self.fail.copy(),
            "spawn_fallback": np.zeros(len(worlds), bool),
            "taint": np.array(
                [2 if w.index % 10 == 4 and w.t > 2 else 0 for w in worlds], np.uint8
            ),
            "reward_terms": {
                "reach": np.array([float(w.t) for w in worlds]),
                "hold": np.ones(len(worlds)),
            },
            "events": events,
            "ended": ended,
            "episode_spec": [w.spec for w in worlds],
        }

    def _observe(self, *_: Any) -> dict[str, np.ndarray]:
        qpos = np.array([w.qpos for w in self.worlds], np.float32)
        grasped = np.array([[w.bits[0]] for w in self.worlds], np.float32)
        obs: dict[str, Any] = {"agent/qpos": qpos[:, :4], "extra/is_grasped": grasped}
        obs["state"] = np.concatenate(list(obs.values()), axis=1)
        if self.images:
            shape = (self.num_envs, SIZE, SIZE)
            level = (np.abs(qpos[:, :1]) * 1000).astype(np.int16)[:, None, None]
            ramp = np.arange(SIZE * SIZE, dtype=np.int16).reshape(SIZE, SIZE, 1)
            obs["sensor_data/fetch_head/depth"] = level + np.broadcast_to(
                ramp, (*shape, 1)
            )
            obs["sensor_data/fetch_head/rgb"] = np.repeat(
                obs["sensor_data/fetch_head/depth"] % 256, 3, 3
            ).astype("u1")
            obs["sensor_param/fetch_head/intrinsic_cv"] = np.tile(
                np.eye(3, dtype=np.float32), (self.num_envs, 1, 1)
            )
            if self.segments:
                obs["sensor_data/fetch_head/seg"] = obs[
                    "sensor_data/fetch_head/depth"
                ].astype(np.int32) % len(self.segments)
                pose = np.tile(np.eye(4, dtype=np.float32), (self.num_envs, 1, 1))
                pose[:, :3, 3] = qpos[:, :3]
                obs["sensor_param/fetch_head/cam2world_gl"] = pose
        return obs

    def wordings(self, world: int) -> tuple[tuple[str, ...], ...]:
        return tuple((f"{kind} {target}", f"please {kind}") for kind, target in self.plan)

    def get_state(self, world: int) -> dict[str, Any]:
        return {
            "sim": self.sim.get_world(world),
            "flags": {"fallback": False},
            "t": self.worlds[world].t,
        }

    def close(self) -> None:
        self.worlds.clear()

    def state_digest(self, world: int) -> str:
        return f"{self.worlds[world].qpos.sum():.6f}"


def _observer(env: FakeEnv) -> SimpleNamespace:
    """What the recorder asks; with segments also the names of their ids and a calibration."""
    if not env.segments:
        return SimpleNamespace(observe=env._observe)
    return SimpleNamespace(
        observe=env._observe,
        outputs=("depth", "rgb", "seg"),
        segmentation_names=env.segments,
        calibration=lambda: {"fetch_head": {"size": [SIZE, SIZE]}},
    )


class _World:
    """One episode: bits flip at random, subtasks end after a drawn number of steps."""

    def __init__(self, env: FakeEnv, seed: int, index: int) -> None:
        self.plan = env.plan
        self.horizon = env.horizon
        self.index = index
        self.rng = stream(seed, "fake", index)
        self.home = f"builtin_m{index % 3}_00"
        self.lengths = self.rng.integers(1, 12, len(env.plan))
        self.outcomes = self.rng.random(len(env.plan)) < 0.85
        self.bits = self.fresh()
        self.qpos = self.rng.normal(size=NQ)
        self.t = self.pointer = self.start = 0
        self.force = 0.0
        self.good = False
        self.done = False
        self.success = False
        entries = [
            {"kind": kind, "target": target, "goal": np.zeros(3)}
            for kind, target in env.plan
        ]
        self.spec = {
            "seed": seed,
            "index": index,
            "home": self.home,
            "task": "set_table",
            "split": "val",
            "subtask": env.config.subtask or None,
            "plan": entries,
        }

    def fresh(self) -> np.ndarray:
        """(K,) checks at the start of a subtask: nothing achieved, no force spent."""
        bits = self.rng.random(len(STORED_CHECKS)) < 0.3
        bits[STORED_CHECKS.index("success")] = False
        bits[STORED_CHECKS.index("force_ok")] = True
        return bits

    def step(self, action: np.ndarray) -> None:
        self.t += 1
        chance = np.full(len(STORED_CHECKS), 0.12)
        chance[STORED_CHECKS.index("success")] = 0.04
        chance[STORED_CHECKS.index("force_ok")] = 0.01
        self.bits = self.bits ^ (self.rng.random(len(STORED_CHECKS)) < chance)
        self.qpos[:5] += self.rng.normal(size=5) + 0.1 * float(action.sum())
        self.force = float(self.rng.exponential(100.0 * (1 + self.index)))

    def ends(self) -> bool:
        """One subtask alone runs to its horizon."""
        return (
            self.t >= self.horizon
            if len(self.plan) == 1
            else self.t - self.start >= self.lengths[self.pointer]
        )

    def move(self) -> bool:
        """End the subtask; returns whether another one begins."""
        self.good = bool(self.outcomes[self.pointer])
        self.start = self.t
        last = self.pointer + 1 == len(self.plan)
        self.success = self.good and last
        self.done = last or not self.good
        self.pointer += self.good and not last
        return not self.done
