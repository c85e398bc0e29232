"""Demonstrations driven by the hand's pose, and their replay: ``python -m benchmarks.teleop``."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mjhab
from benchmarks.command import run_command
from mjhab.cli.output import listing_of, report
from mjhab.core.files.cache import write_text
from mjhab.core.rotations import wrap
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.shard import ShardWriter
from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts import make_expert
from mjhab.rollout.loop import rollout
from mjhab.rollout.sinks import Sink, StepView
from mjhab.viewer.sources.hand import SHARES, HandControl, tcp_in_arm_frame
from mjhab.viewer.sources.hand_input import HandInput
from mjhab.viewer.sources.switch import PolicySwitch
from mjhab.viewer.sources.takes import TakeRecorder

RESULT = "teleop.json"
NEAR_M = 0.03
NEAR_RAD = 0.1
"""How near hand and base come to a waypoint before the next one."""
GRIP_M = 0.01
"""How near the hand comes before the fingers open or close."""
REST_RAD = 0.05
"""How near the expert's arm is to its posture at rest where the person takes the key for it."""
PATIENCE = 15
"""Control steps after which the next waypoint is taken all the same."""
ANSWER_S = 0.15
"""Time in which an error of the base is driven away [s]."""
TURN_PER_M = 2.0
"""Turn for an error to the side while driving [rad/s per m]."""


@dataclass(frozen=True)
class TeleopSpec:
    """Let a scripted person drive demonstrations by the pose of the hand, along the expert's ways, and replay them.

    `python -m benchmarks.teleop --assets replica_cad --out runs/teleop`
    """

    subtasks: tuple[str, ...] = ("pick", "open")
    """The subtasks."""
    task: str = "set_table"
    """The task."""
    assets: str = "builtin"
    """Asset pack."""
    demonstrations: int = 10
    """Successful demonstrations of each subtask."""
    tries: int = 20
    """Most episodes of each subtask."""
    horizon: int = 500
    """Control steps of an episode; a person is slower than the expert."""
    seed: int = 0
    """Seed of the episodes."""
    out: Path = Path("runs/teleop")
    """Folder with a shard for each subtask, and teleop.json."""
    json: bool = False
    """Print one line of JSON instead of a table."""


class Waypoint(NamedTuple):
    """Where the expert was: joints (J,) [m, rad], pose (7,) of the tcp in the world; whether it opened the gripper."""

    q: np.ndarray
    tcp: np.ndarray
    opens: bool


class Guide(Sink[SequentialTaskEnv]):
    """Note the way of a policy in the only world, as ``way``."""

    def __init__(self) -> None:
        self.way: list[Waypoint] = []

    def on_reset(
        self, env: SequentialTaskEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """Begin a new way."""
        self.way = []

    def on_step(self, env: SequentialTaskEnv, step: StepView) -> None:
        """Note where an action led to."""
        view = env.view(0)
        opens = step.actions[0, env.controller.gripper] >= 0.0
        self.way.append(Waypoint(view.q, view.tcp_pose, bool(opens)))


class ScriptedHuman(HandControl):
    """A person who drags the handle of the hand along a way, with one finger on the keys of base, torso and gripper.

    Args:
        way: waypoints; at the last one it stays.
    """

    def __init__(self, way: Sequence[Waypoint]) -> None:
        super().__init__()
        self._way = way
        self._at = 0
        self._waited = 0
        self._presses = False

    def begin(self, env: SequentialTaskEnv, world: int) -> None:
        """Start the way."""
        super().begin(env, world)
        self._at = self._waited = 0
        self._presses = False

    def action(self, env: SequentialTaskEnv, world: int) -> np.ndarray:
        """The action (A,) towards the next waypoint."""
        view = env.view(world)
        goal = self._next(view)
        # The key must be let go in between: what counts is that it goes down.
        self._presses = not self._presses and goal.opens != (self.gripper > 0.0)
        arm = list(view.robot.arm_columns)
        rests = bool(np.abs(wrap(goal.q[arm] - view.robot.rest[arm])).max() < REST_RAD)
        self.take(HandInput(self._keys(view, goal.q), self._presses, rest=rests))
        self.aim(tcp_in_arm_frame(view.robot, view.q, goal.tcp))
        return super().action(env, world)

    def _next(self, view: WorldView) -> Waypoint:
        goal = self._way[self._at]
        grips = self._way[min(self._at + 1, len(self._way) - 1)].opens != goal.opens
        hand = np.linalg.norm(view.tcp_pose[:3] - goal.tcp[:3])
        # A base on wheels that stands does not move sideways: the hand makes up for that.
        base, _ = _in_base_frame(view, goal.q)
        turn = abs(float(wrap(view.q[2] - goal.q[2])))
        self._waited += 1
        is_near = hand < (GRIP_M if grips else NEAR_M)
        is_near = is_near and abs(base) < NEAR_M and turn < NEAR_RAD
        if is_near or self._waited > PATIENCE:
            self._waited = 0
            self._at = min(self._at + 1, len(self._way) - 1)
        return self._way[self._at]

    def _keys(self, view: WorldView, goal: np.ndarray) -> dict[str, float]:
        """Deflections that drive base and torso to those of the joints ``goal`` (J,)."""
        limits = view.robot.limits
        q = view.q
        ahead, aside = _in_base_frame(view, goal)
        # Only while it drives: one that stands would turn to and fro, and never come to rest.
        steered = TURN_PER_M * aside * np.clip(ahead / NEAR_M, -1.0, 1.0)
        turn = float(wrap(goal[2] - q[2])) / ANSWER_S + steered
        (torso,) = view.robot.torso_columns
        wishes = {
            "forward": ahead / ANSWER_S / limits.forward,
            "turn": turn / limits.yaw_rate,
            "torso": (goal[torso] - q[torso]) / limits.joint_delta,
        }
        return {
            name: float(np.clip(wish / SHARES[name], -1.0, 1.0))
            for name, wish in wishes.items()
        }


def _in_base_frame(view: WorldView, goal: np.ndarray) -> tuple[float, float]:
    """How far ahead of the base, and to its left, the base of the joints ``goal`` (J,) stands [m]."""
    cos, sin = np.cos(view.q[2]), np.sin(view.q[2])
    dx, dy = goal[:2] - view.q[:2]
    return float(cos * dx + sin * dy), float(cos * dy - sin * dx)


def drive(
    env: SequentialTaskEnv, index: int, seed: int, writer: ShardWriter
) -> tuple[bool, bool]:
    """Record an episode that a scripted person drives along the expert's way; whether expert and person succeed."""
    guide = Guide()
    (shown,) = rollout(env, make_expert(env), [index], seed, [guide])
    switch = PolicySwitch(env, seed)
    # What the person does not move shall stand still.
    switch.choose("zero")
    switch.hand, switch.hand_world = ScriptedHuman(guide.way), 0
    recorder = TakeRecorder(writer, env, {"name": "zero"}, writer.has)
    (driven,) = rollout(env, switch, [index], seed, [recorder])
    return shown.success_once, driven.success_once


def replayed(env: SequentialTaskEnv, episode: RecordedEpisode) -> bool:
    """Whether the stored actions of an episode, from its stored first state, succeed."""
    record = episode.record
    env.reset(seed=record.seed, options={"episode": np.array([record.index])})
    env.set_state(0, episode.initial())
    succeeded = False
    for action in episode.array("actions"):
        *_, info = env.step(action[None])
        # Success counts once, as in evaluations.
        succeeded |= bool(info["success"][0])
    return succeeded


def measure(spec: TeleopSpec) -> list[dict[str, Any]]:
    """Counts by subtask, written to ``teleop.json``."""
    spec.out.mkdir(parents=True, exist_ok=True)
    rows = [_measured(spec, subtask) for subtask in spec.subtasks]
    write_text(spec.out / RESULT, json.dumps(rows, indent=2))
    return rows


def _measured(spec: TeleopSpec, subtask: str) -> dict[str, Any]:
    env = mjhab.make(
        task=spec.task,
        subtask=subtask,
        assets=spec.assets,
        horizon=spec.horizon,
        autoreset="disabled",
        threads=1,
    )
    shard = spec.out / f"{subtask}.h5"
    tried = shown = driven = 0
    with ShardWriter(shard) as writer:
        while driven < spec.demonstrations and tried < spec.tries:
            by_expert, by_person = drive(env, tried, spec.seed, writer)
            tried += 1
            shown += by_expert
            driven += by_person
    made = [episode for episode in episodes(shard) if episode.record.success_once]
    again = sum(replayed(env, episode) for episode in made)
    arm = env.controller.gripper
    env.close()
    verified = mjhab.replay(shard)
    return {
        "subtask": subtask,
        "tried": tried,
        "expert": shown,
        "driven": driven,
        "replayed": again,
        "exact": f"{verified.exact} of {verified.episodes}",
        "steps": float(np.median([e.record.steps_to_success or 0 for e in made] or [0])),
        "largest": max(
            (float(np.abs(e.array("actions")[:, :arm]).max()) for e in made), default=0.0
        ),
    }


def run(spec: TeleopSpec) -> int:
    """Measure and print; returns 0."""
    rows = measure(spec)
    report(spec.json, {"rows": rows}, listing_of("teleoperation", rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_command(
        "teleop", TeleopSpec, run, words, {"demonstrations": 1, "tries": 1, "horizon": 1}
    )


if __name__ == "__main__":
    sys.exit(main())
