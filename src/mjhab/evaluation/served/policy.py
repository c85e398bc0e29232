"""A remote policy that is queried over websockets for all worlds of an environment."""

from __future__ import annotations

import threading
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from mjhab.core.conventions.changes import within_half_a_turn
from mjhab.core.conventions.names import WRAPPED, Conventions
from mjhab.core.errors import fault
from mjhab.core.progress import say
from mjhab.core.rotations import wrap
from mjhab.data.record.provenance import describe_run
from mjhab.data.record.worlds import RecordedEnv
from mjhab.envs.observations.modes import STATE_KEY, camera_key
from mjhab.evaluation.served.action_spaces import ActionReader
from mjhab.evaluation.served.metadata import check_rate, own_part, space_of
from mjhab.evaluation.served.own_state import OWN_STATE, STATE_PARTS, split_state
from mjhab.evaluation.served.real_time import Answer, Pace, Playback
from mjhab.serving.address import CHUNK, Address
from mjhab.serving.client import Connection, PolicyFault
from mjhab.serving.dialects.dialect import STEP, Ask
from mjhab.serving.patience import Patience

MAX_FAULT_CHARACTERS = 300
"""Largest length of the error message stored for an episode."""
TCP_POSE = "extra/tcp_pose_wrt_base"
"""Observation key of the tcp pose in the base frame, (7,) position [m] and quaternion."""


@dataclass
class _Running:
    """State of the running episode of one world.

    session: unique id of the episode. playback: its chunks. step: control steps so far. begun: a request was sent.
    fault: error that ended the episode, or "".
    """

    session: str
    playback: Playback = field(default_factory=Playback)
    step: int = 0
    begun: bool = False
    fault: str = ""


class ServedPolicy:
    """A remote policy that is queried over websockets.

    Every world has its own connection, so that the server can separate the episodes; with ``address.batch`` a single
    connection queries all worlds at once. If the server does not answer, or answers with an invalid action, the world
    gets a `fault` and zero actions from then on; the other worlds continue.

    Args:
        address: of the server, with the protocol's options.
        env: the environment to act in.
        instruction: the prompt in place of the episodes' sentences; "" for these.

    Raises:
        UsageError: there is no such server, the environment's actions do not match the policy's, or there is an
            instruction and the server says that its policy reads none.
    """

    name = "served"

    def __init__(self, address: Address, env: RecordedEnv, instruction: str = "") -> None:
        self._address = address
        self._instruction = instruction
        self._env = env
        count = 1 if address.batch else env.num_envs
        patience = Patience(address)
        self._connections = [Connection(address, patience) for _ in range(count)]
        # Threads: they wait for the network, and servers answer several requests at a time.
        self._pool = ThreadPoolExecutor(count)
        metadata = self._connections[0].greet()
        check_rate(address, metadata)
        own = own_part(metadata)
        if instruction and own.get("reads_instruction") is False:
            self.close()
            raise fault(
                f"policy {own.get('policy', '')} that {address.shown} serves",
                "reads no instruction. Leave "
                "--instruction out, or serve a student that was trained with sentences.",
            )
        self._reader = ActionReader(space_of(address, metadata), self._env.action_table)
        self._splits = metadata.get(STATE_PARTS) == OWN_STATE
        self._pace = Pace.of(address)
        self._late = 0
        self._told_late = False
        needs = own.get("needs", ())
        self._needs = set(needs) if isinstance(needs, list) else set()
        # Only servers of mjhab ask for it, and it is sent with every request.
        self._config = describe_run(env, {}).config if self._needs else {}
        self._worlds = [_new_episode() for _ in range(env.num_envs)]
        self._counting = threading.Lock()
        self._outside: Counter[str] = Counter()

    @property
    def latency_ms(self) -> list[float]:
        """How long after its observation every answer so far was there [ms]."""
        return [
            value if self._pace is None else self._pace.in_force_ms(value)
            for connection in self._connections
            for value in connection.latency_ms
        ]

    @property
    def late_steps(self) -> int | None:
        """Control steps so far in which the policy had no action ready; None where the world waits for it."""
        return None if self._pace is None else self._late

    @property
    def out_of_range(self) -> dict[str, int]:
        """How many values of executed actions were out of range so far, by entry of the action."""
        return dict(self._outside)

    def fault(self, world: int) -> str:
        """Error that ended the episode of a world, or ""."""
        return self._worlds[world].fault

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,)."""
        for w in np.flatnonzero(mask).tolist():
            self._worlds[w] = _new_episode()

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A): the next ones of the chunks. Used-up chunks are requested anew first."""
        return self.act_in(obs, info, np.ones(len(self._worlds), bool))

    def act_in(self, obs: Any, info: Mapping[str, Any], mask: np.ndarray) -> np.ndarray:
        """Actions (W, A) as of `act`; zero outside of the worlds in ``mask`` (W,), for which nothing is requested."""
        asked = mask & ~np.asarray(self._env.progress.done)
        running = [
            w for w, world in enumerate(self._worlds) if asked[w] and not world.fault
        ]
        for w in running:
            # Before the worlds that are due are chosen: an answer that is there now is not asked for again.
            self._worlds[w].playback.receive(self._worlds[w].step, self._pace)
        execute = self._address.execute
        due = [w for w in running if self._worlds[w].playback.is_due(execute)]
        groups = [due] if self._address.batch else [[w] for w in due]
        groups = [group for group in groups if group]
        # Made before the threads run, since the environment is not made for several.
        asks = [[self._ask(w, obs, info) for w in group] for group in groups]
        # A thread costs more than it saves for a single request.
        if len(groups) == 1:
            self._ask_server(groups[0], asks[0])
        else:
            # The list waits for all, and raises what a thread raised.
            list(self._pool.map(self._ask_server, groups, asks))
        actions = np.zeros((len(self._worlds), len(self._env.action_table)), np.float32)
        still = self._still() if self._pace is not None else actions
        for w in running:
            world = self._worlds[w]
            if not world.fault:
                world.playback.receive(world.step, self._pace)
                actions[w], late = world.playback.act(still[w], self._pace)
                self._late += late
                world.step += 1
        return actions

    def _still(self) -> np.ndarray:
        """Actions (W, A) with which the robots stand still; what a hand was last told holds on."""
        still = np.asarray(self._env.controller.still(self._env.state)).copy()
        for w, world in enumerate(self._worlds):
            last = world.playback.last
            still[w, self._reader.gripper] = (
                2.0 * self._opening(w) - 1.0
                if last is None
                else last[self._reader.gripper]
            )
        return still

    def _opening(self, w: int) -> float:
        """Opening of the gripper of a world, 0 closed to 1 open."""
        robot = self._env.layout.robot
        q = self._env.state.robot_q[w]
        opened = float(np.mean(q[robot.columns.fingers])) / robot.limits.gripper[1]
        return float(np.clip(opened, 0.0, 1.0))

    def close(self) -> None:
        """Close the connections."""
        # A server that hangs must not hold up the end.
        self._pool.shutdown(wait=False, cancel_futures=True)
        for connection in self._connections:
            connection.close()

    def _ask_server(self, worlds: Sequence[int], asks: Sequence[Ask]) -> None:
        """Request new chunks for some worlds over one connection."""
        running = [self._worlds[w] for w in worlds]
        connection = self._connections[0 if self._address.batch else worlds[0]]
        begins = not any(world.begun for world in running)
        for world in running:
            world.begun = True
        try:
            chunks = connection.ask(asks, begins)
        # It ends these episodes and not the evaluation.
        except PolicyFault as error:
            for world in running:
                world.fault = _fault_text(str(error))
            return
        for world, chunk in zip(running, chunks, strict=True):
            problem = self._reader.problem(chunk)
            if problem:
                world.fault = _fault_text(problem)
            else:
                self._count_outside(chunk[: self._address.execute])
                actions = self._reader.read(chunk)
                first, delay = world.step, 0
                if self._pace is not None:
                    delay = self._pace.delay(connection.latency_ms[-1])
                    if connection.first_step is not None:
                        first = connection.first_step
                    self._tell_late(delay, len(actions))
                world.playback.pending = Answer(actions, first, world.step + delay)

    def _tell_late(self, delay: int, length: int) -> None:
        """Tell once that no action of an answer is left when it is there."""
        if delay < length or self._told_late or self._address.meanwhile != CHUNK:
            return
        self._told_late = True
        say(
            f"mjhab: {self._address.shown} answers {delay} control steps after the observation with {length} actions: "
            "none is left to execute. Serve longer chunks, or give --meanwhile still."
        )

    def _count_outside(self, chunk: np.ndarray) -> None:
        """Count the values of a chunk (H, A) that the environment clips, and tell the first of them."""
        outside = self._reader.outside(chunk)
        if not outside.any():
            return
        found = {
            name: int(number)
            for name, number in zip(self._reader.names, outside.sum(0), strict=True)
            if number
        }
        # Several threads count at a time.
        with self._counting:
            is_first = not self._outside
            self._outside.update(found)
        if is_first:
            say(
                f"mjhab: {self._address.shown} sends {self._reader.excess(chunk)}. Values out of range are clipped; "
                "how many there were is counted."
            )

    def _ask(self, w: int, obs: Any, info: Mapping[str, Any]) -> Ask:
        spec = info["episode_spec"][w]
        sentence = (
            spec["instruction"]
            if self._address.prompt == "task"
            else info["instruction"][w]
        )
        robot = self._env.layout.robot
        external, wrist = (*robot.camera_names, "", "")[:2]
        # Policies of states alone have no images.
        head, hand = (obs.get(camera_key(camera, "rgb")) for camera in (external, wrist))
        # Environments that are recorded are those of the CPU.
        parts = split_state(cast("Any", self._env)) if self._splits else None
        q = self._env.state.robot_q[w]
        if Conventions.of(vars(self._env.config)).joint_angles == WRAPPED:
            q = within_half_a_turn(q, robot.endless)
        return Ask(
            robot=robot.name,
            cameras=(external, wrist),
            external=None if head is None else head[w],
            wrist=None if hand is None else hand[w],
            state=np.asarray(obs[STATE_KEY][w], np.float32),
            arm=self._arm_positions(q),
            gripper=1.0 - self._opening(w),
            tcp=np.asarray(obs[TCP_POSE][w], np.float64),
            prompt=self._instruction or sentence,
            session=self._worlds[w].session,
            chunk=self._address.execute,
            own=self._own_part(w, obs) if self._needs else None,
            timing=self._timing(w),
            sensed=None if parts is None else parts[0][w],
            unsensed=None if parts is None else parts[1][w],
        )

    def _arm_positions(self, q: np.ndarray) -> np.ndarray:
        """Positions of the arm's joints [rad] float32; those of joints that turn without end in [-pi, pi)."""
        robot = self._env.layout.robot
        columns = list(robot.arm_columns)
        limits = np.array([robot.joint_limits[column] for column in columns])
        arm = q[columns]
        return np.where(np.isfinite(limits[:, 0]), arm, wrap(arm)).astype(np.float32)

    def _timing(self, w: int) -> dict[str, Any] | None:
        """See `Ask.timing`."""
        if self._pace is None:
            return None
        measured = [connection.latency_ms[-1:] for connection in self._connections]
        last = max((value for values in measured for value in values), default=0.0)
        return {
            STEP: self._worlds[w].step,
            "hz": self._pace.hz,
            "delay": self._pace.delay(last),
        }

    def _own_part(self, w: int, obs: Any) -> dict[str, Any]:
        """The part of a request that only mjhab servers need: configuration, step, and state of the world."""
        world = self._worlds[w]
        part: dict[str, Any] = {"config": self._config, "step": world.step}
        if self._pace is not None:
            part["chunk"] = True
            if world.playback.last is not None:
                part["executed"] = world.playback.last
        if self._instruction:
            part["instruction"] = self._instruction
        if "world" in self._needs:
            part["world"] = self._env.get_state(w)
        if "observation" in self._needs:
            part["observation"] = {key: values[w] for key, values in obs.items()}
        return part


def _new_episode() -> _Running:
    return _Running(uuid.uuid4().hex)


def _fault_text(text: str) -> str:
    # The text comes from the server and goes into records and terminals.
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable[:MAX_FAULT_CHARACTERS]
