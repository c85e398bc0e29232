"""Episodes for pictures: what was where in every control step, from recorded data or by running them again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjhab.core.errors import about, fault, wrong_value
from mjhab.core.files.reading import read_json_object
from mjhab.core.files.run_folder import CONFIG
from mjhab.core.joints import BASE, BASE_YAW
from mjhab.core.typed.options import with_tuples
from mjhab.data.record.targets import active_entries, targets_in_base
from mjhab.data.store.places import entries
from mjhab.data.store.reading import open_shard
from mjhab.evaluation.filming import scene_of
from mjhab.evaluation.global_random import SeededGlobals
from mjhab.evaluation.parts import (
    RECORDED,
    close_policy,
    env_options,
    make_env,
    open_any,
    policy_options,
)
from mjhab.evaluation.recorded import recorded_env
from mjhab.evaluation.shots.spec import ShotSpec, check_step, no_episode
from mjhab.evaluation.specs import EvalSpec
from mjhab.rollout.loop import rollout
from mjhab.rollout.sinks import Sink, StepView
from mjhab.rollout.store import EPISODES_FILE, read_records

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


class Take(NamedTuple):
    """An episode.

    env: a world of the layout. home: its name. qpos: (N+1, nq) states. targets: (N+1, 3) what is worked on, in the
    world [m]; nan where nothing is known. sentences: (N+1,) of the active subtasks. title: a few words.
    """

    env: SequentialTaskEnv
    home: str
    qpos: np.ndarray
    targets: np.ndarray
    sentences: tuple[str, ...]
    title: str

    @property
    def steps(self) -> int:
        """Number N of control steps."""
        return len(self.qpos) - 1


def open_take(spec: ShotSpec) -> Take:
    """The episode of a specification, up to the step that is asked for if it has to run again.

    Raises:
        UsageError: there is no such episode or step, or it cannot be drawn here.
    """
    place = Path(spec.place)
    sight = {"shader": spec.asked.shader, "threads": spec.asked.threads}
    if spec.shading is not None:
        sight["shading"] = dict(vars(spec.shading))
    if (place / EPISODES_FILE).is_file():
        return _run_again(spec, place, sight)
    return _recorded(spec, place, sight)


def _recorded(spec: ShotSpec, place: Path, sight: Mapping[str, Any]) -> Take:
    known = list(entries(place))
    found = [entry for entry in known if entry.record.index == spec.episode]
    if not found:
        raise no_episode(
            spec.episode, place, sorted(entry.record.index for entry in known)
        )
    # Seeds and configurations of one folder may have the same index.
    if len(found) > 1:
        files = ", ".join(str(entry.path) for entry in found[:4])
        raise wrong_value(
            "episode",
            spec.episode,
            "one episode",
            f"Name the file of one of those with this index: {files}.",
            place,
        )
    entry = found[0]
    if "states/initial" in entry.run.absent:
        raise fault(entry.path, "was imported without states, so it cannot be drawn.")
    with open_shard(entry.path) as shard:
        episode = shard.episode(entry.name)
        if "states/qpos" not in episode.paths:
            raise fault(
                entry.path,
                "was recorded without states (--no-states), so it cannot be drawn.",
            )
        qpos = episode.array("states/qpos")
        record = episode.record
        active = active_entries(episode)
        in_base = targets_in_base(episode)
    check_step(spec.step or 0, len(qpos) - 1, f"episode {entry.name}")
    env = recorded_env(entry.run, obs_mode="state", num_envs=1, **sight)
    words = record.instructions or (record.instruction,)
    sentences = tuple(words[min(k, len(words) - 1)] for k in active.tolist())
    base = qpos[:, env.sim.addresses.robot_q[BASE]]
    height = env.layout.robot.base_height
    targets = _in_world(base, height, in_base)
    return Take(
        env, record.home, qpos, targets, sentences, _title(record.home, entry.name)
    )


def _in_world(base: np.ndarray, height: float, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the frames of base links at (n, 3) x, y [m], yaw [rad] in the world; nan for all zeros."""
    cos, sin = np.cos(base[:, BASE_YAW]), np.sin(base[:, BASE_YAW])
    x = base[:, 0] + cos * points[:, 0] - sin * points[:, 1]
    y = base[:, 1] + sin * points[:, 0] + cos * points[:, 1]
    placed = np.stack([x, y, points[:, 2] + height], axis=1)
    # Zeros are what is observed where there is no target.
    return np.where(np.any(points, axis=1)[:, None], placed, np.nan)


def _title(home: str, name: str) -> str:
    return f"{name} in {home}"


class _Enough(Exception):
    """The step that is asked for was reached."""


class _StateKeeper(Sink["SequentialTaskEnv"]):
    """Keeps states, targets and sentences of the one episode that runs, up to a step."""

    def __init__(self, until: int | None) -> None:
        self.qpos: list[np.ndarray] = []
        self.targets: list[np.ndarray] = []
        self.sentences: list[str] = []
        self.home = ""
        self._until = until

    def on_reset(
        self, env: SequentialTaskEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        self._keep(env, info)

    def on_step(self, env: SequentialTaskEnv, step: StepView) -> None:
        self._keep(env, step.info)
        # Later steps are not shown, and a chain takes minutes.
        if self._until is not None and len(self.qpos) > self._until:
            raise _Enough

    def _keep(self, env: SequentialTaskEnv, info: Mapping[str, Any]) -> None:
        self.home = env.homes[0]
        self.qpos.append(env.sim.get_world(0)["qpos"].copy())
        self.targets.append(scene_of(env, 0).target)
        self.sentences.append(str(info["instruction"][0]))


def _run_again(spec: ShotSpec, place: Path, sight: Mapping[str, Any]) -> Take:
    known = {record.index: record for record in read_records(place)}
    record = known.get(spec.episode)
    if record is None:
        raise no_episode(spec.episode, place, sorted(known))
    name = f"episode {spec.episode}"
    check_step(spec.step or 0, record.steps, name)
    with about(place / CONFIG):
        evaluation = spec_of_run(read_json_object(place / CONFIG))
    opened = open_any(evaluation.policy)
    env = make_env(
        evaluation, {**env_options(evaluation, opened.facts), **sight, "num_envs": 1}
    )
    policy = None
    # A contact sheet needs all of it.
    middle = record.steps // 2 if spec.step is None else spec.step
    keeper = _StateKeeper(None if spec.sheet else middle)
    try:
        with SeededGlobals(evaluation.asked.seed):
            policy = opened.build(env, policy_options(evaluation))
            rollout(env, policy, [spec.episode], evaluation.asked.seed, [keeper])
    except _Enough:
        pass
    finally:
        close_policy(policy)
    return Take(
        env,
        keeper.home,
        np.stack(keeper.qpos),
        np.stack(keeper.targets),
        tuple(keeper.sentences),
        _title(keeper.home, name),
    )


def spec_of_run(config: Mapping[str, Any]) -> EvalSpec:
    """The specification that made the configuration of an evaluation, for one world.

    Raises:
        UsageError: the configuration names no policy, or one that cannot be opened here.
    """
    if config.get("spawns") is not None:
        raise wrong_value(
            "spawns",
            "a file",
            "none",
            "Such a run cannot run again from its folder: record episodes with `mjhab generate`.",
        )
    options = {
        field: config[key]
        for key, field in RECORDED.items()
        if config.get(key) is not None and key not in ("worlds", "threads", "spawns")
    }
    if "profile" in config:
        options["profile"] = config["profile"]
    return EvalSpec.of(
        policy=config["policy"],
        **options,
        worlds=1,
        episodes=1,
        films=0,
        style=tuple(config.get("style", ())),
        instruction=config.get("instruction"),
        env=with_tuples(config.get("env", {})),
    )
