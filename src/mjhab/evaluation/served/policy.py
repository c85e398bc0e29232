"""A policy that is asked over websockets, in all worlds of an environment."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.data.record.provenance import describe_run
from mjhab.data.record.worlds import RecordedEnv
from mjhab.envs.observations import STATE_KEY, camera_key
from mjhab.evaluation.served.action_spaces import ActionReader
from mjhab.evaluation.served.metadata import own_part, space_of
from mjhab.robots.kinematics import rotation_vector
from mjhab.serving.address import Address
from mjhab.serving.client import Connection, PolicyFault
from mjhab.serving.dialects.dialect import Ask

MAX_FAULT_CHARACTERS = 300
TCP_POSE = "extra/tcp_pose_wrt_base"


@dataclass
class _Running:
    """What is remembered of the episode in one world. ``fault``: why it cannot go on, "" if it can."""

    session: str
    chunk: np.ndarray | None = None
    place: int = 0
    step: int = 0
    begun: bool = False
    fault: str = ""


class ServedPolicy:
    """A policy that is asked over websockets.

    Every world has a connection of its own, so that a server keeps their episodes apart; with ``address.batch`` one
    connection asks for all worlds at once. A world whose server does not answer, or answers something that is no
    action, stands still from there on and has a `fault`; the others go on.

    Args:
        address: which server, and how it is asked.
        env: the environment to act in.

    Raises:
        UsageError: there is no such server, or the environment has other actions than the policy sends.
    """

    name = "served"

    def __init__(self, address: Address, env: RecordedEnv) -> None:
        self._address = address
        self._env = env
        count = 1 if address.batch else env.num_envs
        self._connections = [Connection(address) for _ in range(count)]
        metadata = self._connections[0].greet()
        self._reader = ActionReader(space_of(address, metadata), self._env.action_table)
        needs = own_part(metadata).get("needs", ())
        self._needs = set(needs) if isinstance(needs, list) else set()
        self._config = describe_run(env, {}).config if self._needs else {}
        self._worlds = [_new_episode() for _ in range(env.num_envs)]
        self._pool = ThreadPoolExecutor(count)

    @property
    def latency_ms(self) -> list[float]:
        """How long every request took so far [ms]."""
        return [value for connection in self._connections for value in connection.latency_ms]

    def fault(self, world: int) -> str:
        """Why the episode in a world cannot go on, "" if it can."""
        return self._worlds[world].fault

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,)."""
        for w in np.flatnonzero(mask).tolist():
            self._worlds[w] = _new_episode()

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A): the next ones of the chunks, after asking for new chunks where they are used up."""
        over = self._env.progress.done
        running = [w for w, world in enumerate(self._worlds) if not (over[w] or world.fault)]
        due = [w for w in running if self._is_used_up(self._worlds[w])]
        groups = [due] if self._address.batch else [[w] for w in due]
        groups = [group for group in groups if group]
        asks = [[self._ask(w, obs, info) for w in group] for group in groups]
        if len(groups) == 1:
            self._ask_server(groups[0], asks[0])
        else:
            list(self._pool.map(self._ask_server, groups, asks))
        actions = np.zeros((len(self._worlds), len(self._env.action_table)), np.float32)
        for w in running:
            world = self._worlds[w]
            if not world.fault:
                assert world.chunk is not None
                actions[w] = world.chunk[world.place]
                world.place += 1
                world.step += 1
        return actions

    def close(self) -> None:
        """Close the connections."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        for connection in self._connections:
            connection.close()

    def _is_used_up(self, world: _Running) -> bool:
        if world.chunk is None:
            return True
        return world.place >= min(len(world.chunk), self._address.execute)

    def _ask_server(self, worlds: Sequence[int], asks: Sequence[Ask]) -> None:
        """Get new chunks for some worlds over one connection."""
        running = [self._worlds[w] for w in worlds]
        connection = self._connections[0 if self._address.batch else worlds[0]]
        begins = not any(world.begun for world in running)
        for world in running:
            world.begun = True
        try:
            chunks = connection.ask(asks, begins)
        except PolicyFault as error:
            for world in running:
                world.fault = _fault_text(str(error))
            return
        for world, chunk in zip(running, chunks, strict=True):
            problem = self._reader.problem(chunk)
            if problem:
                world.fault = _fault_text(problem)
            else:
                world.chunk = self._reader.read(chunk)
                world.place = 0

    def _ask(self, w: int, obs: Any, info: Mapping[str, Any]) -> Ask:
        spec = info["episode_spec"][w]
        prompt = spec["instruction"] if self._address.prompt == "task" else info["instruction"][w]
        robot = self._env.layout.robot
        head, hand = (obs.get(camera_key(camera, "rgb")) for camera in robot.camera_names)
        q = self._env.state.robot_q[w]
        opened = float(np.mean(q[robot.columns.fingers])) / robot.limits.gripper[1]
        return Ask(
            external=None if head is None else head[w],
            wrist=None if hand is None else hand[w],
            state=np.asarray(obs[STATE_KEY][w], np.float32),
            arm=np.asarray(q[list(robot.arm_columns)], np.float32),
            gripper=float(np.clip(1.0 - opened, 0.0, 1.0)),
            tcp=_position_and_turn(obs[TCP_POSE][w]),
            prompt=prompt,
            session=self._worlds[w].session,
            chunk=self._address.execute,
            own=self._own_part(w, obs) if self._needs else None,
        )

    def _own_part(self, w: int, obs: Any) -> dict[str, Any]:
        """What a server of mjhab wants to know of a world."""
        part: dict[str, Any] = {"config": self._config, "step": self._worlds[w].step}
        if "world" in self._needs:
            part["world"] = self._env.get_state(w)
        if "observation" in self._needs:
            part["observation"] = {key: values[w] for key, values in obs.items()}
        return part


def _new_episode() -> _Running:
    return _Running(uuid.uuid4().hex)


def _position_and_turn(pose: np.ndarray) -> np.ndarray:
    """Position [m] and rotation vector [rad] (6,) of a pose (7,)."""
    pose = np.asarray(pose, np.float64)
    turn = cast(np.ndarray, rotation_vector(mat_from_quat(pose[None, 3:])))[0]
    return np.concatenate([pose[:3], turn]).astype(np.float32)


def _fault_text(text: str) -> str:
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable[:MAX_FAULT_CHARACTERS]
