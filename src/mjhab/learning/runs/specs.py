"""What `mjhab.train` and ``mjhab train`` are asked for: options of all algorithms, and of those that imitate.

Those of reinforcement learning are in `learning.reinforcement.specs`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from mjhab.config.env import SPLITS, EnvConfig
from mjhab.config.env_spec import EnvSpec
from mjhab.config.env_spec import env_options as env_mark
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.machine import cores
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag, OptionsOf
from mjhab.learning.changes import Sets, changes_of, with_changes
from mjhab.learning.configs import (
    ACT,
    BC,
    DAGGER,
    DIFFUSION,
    FLOW,
    ImitationConfig,
    preset_of,
)
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.style import Styles
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from mjhab.data.select.query import Filter

SECONDS_PER_MINUTE = 60.0
HELD_OUT = "val"
"""Split of the homes that nothing is trained in and policies are judged in."""


@dataclass(frozen=True)
class Scene:
    """The fields of `EnvConfig` that say what a policy learns, as they are recorded with it.

    profile, spawn_rule, stillness, joint_dynamics: as in `EnvConfig`; "" takes those of the given data, or else the
    defaults. robot: its name, "" for the default. spawns: file of start states, "" for drawn ones.
    randomise: what is perturbed where the policy learns; evaluations perturb nothing.
    """

    task: str = "set_table"
    subtask: str = "close"
    target: str = ""
    split: str = "train"
    assets: str | dict[str, Any] = "builtin"
    home: str = ""
    profile: str = ""
    spawn_rule: str = ""
    stillness: str = ""
    joint_dynamics: str = ""
    robot: str = ""
    spawns: str = ""
    randomise: str = ""

    @property
    def name(self) -> str:
        """``TASK/SUBTASK`` or ``TASK/SUBTASK/TARGET``."""
        return "/".join(filter(None, (self.task, self.subtask, self.target)))

    def env_options(self) -> dict[str, Any]:
        """Options of `mjhab.envs.make`; empty values are left out and take its defaults."""
        return {name: value for name, value in asdict(self).items() if value}

    def record(self) -> dict[str, Any]:
        """All options as plain data, ``randomise`` only where it is given: other runs are recorded as they were."""
        told = asdict(self)
        if not self.randomise:
            del told["randomise"]
        return told

    def apart_from_profile(self) -> dict[str, Any]:
        """The non-empty options that can be combined with a profile."""
        given = {
            "spawn_rule": self.spawn_rule,
            "stillness": self.stillness,
            "joint_dynamics": self.joint_dynamics,
            "robot": self.robot,
        }
        return {name: value for name, value in given.items() if value}


def scene_names(scenes: Sequence[Scene]) -> list[str]:
    """Distinct names of scenes; after an @ the file of their starts, or the asset pack if it is a further one."""
    names: list[str] = []
    for scene in scenes:
        pack = scene.assets
        place = str(pack["place"] if isinstance(pack, dict) else pack)
        taken = scene.name in names
        where = Path(scene.spawns).stem if scene.spawns else Path(place).name
        names.append(f"{scene.name}@{where}" if taken or scene.spawns else scene.name)
    return names


@dataclass(frozen=True)
class Resources:
    """Resources of collection and evaluation; they change the speed, not the results.

    worlds: per process. workers: number of processes. threads: per process, 0 uses all cores.
    """

    worlds: int = 16
    workers: int = 1
    threads: int = 0

    @property
    def at_once(self) -> int:
        """Number of episodes that run at the same time."""
        return self.worlds * self.workers


SCENE = frozenset(option.name for option in dataclasses.fields(Scene))
DOCS: Mapping[str, str] = {
    "subtask": "The subtask to learn: pick, place, navigate, open, close or one of a plugin.",
    "target": "The object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3; one policy for all of them if "
    "absent.",
    "seed": "Seed of everything: weights, batches, episodes.",
    "threads": "Threads of physics and network; 0 takes all cores. The last bits of the weights depend on it.",
    "num_envs": "Parallel episodes per process. Changes the speed, never the collected data.",
    "randomise": "Domain randomisation, such as camera:3,noise:3: what the policy learns from is perturbed, at a level "
    "that is drawn for every episode, from 0 to the one that is named (see docs/perturbations.md). Evaluations of the "
    "run perturb nothing.",
}
"""What fields of `EnvConfig` mean for a training."""
SHOWN: Mapping[str, str] = {"profile": "default: that of --data, else mjhab"}


def env_options(*more: str, worlds: int = 1) -> OptionsOf:
    """The mark of ``env`` of a training.

    Args:
        more: fields of `EnvConfig` that are options besides those of a `Scene`, seed and threads.
        worlds: default of ``num_envs``.
    """
    names = (*SCENE, "seed", "threads", *more)
    return env_mark(
        *names, docs=DOCS, shown=SHOWN, subtask=Scene.subtask, num_envs=worlds
    )


OF_IMITATION = env_options("num_envs", worlds=Resources.worlds)
Number = Annotated[int | None, Flag(metavar="N", shown="default: that of the preset")]


@dataclass(frozen=True, kw_only=True)
class TrainSpec(EnvSpec):
    """Options of all algorithms."""

    WHAT: ClassVar[str] = "a training run"
    APART: ClassVar[frozenset[str]] = frozenset({"preset"})
    ALGORITHM: ClassVar[str] = ""
    """Name of the algorithm; "" for that of ``preset``, which then is a configuration."""

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """Folder of the run: checkpoints, collected data, curves, report."""
    preset: Annotated[
        Any, Flag(metavar="NAME", kind=str, shown="default: the algorithm's first")
    ] = ""
    """Named configuration of network and training. In Python also a configuration, such as a `ImitationConfig`."""
    set: Annotated[
        tuple[str, ...], Flag(metavar="NAME=VALUE ...", shown="default: none")
    ] = ()
    """Change fields of the preset, e.g. inputs.image_size=64 network.hidden=512; a wrong name lists all."""
    env: Annotated[Mapping[str, Any], OF_IMITATION] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`."""
    budget_minutes: Annotated[float, Flag(metavar="MINUTES")] = 0.0
    """Time limit of the whole run, including the final evaluation [min]; 0 for no limit."""
    eval_episodes: int = 100
    """Episodes of the final evaluation; 0 for none."""
    round_episodes: int = 32
    """Episodes of the evaluations during training; 0 for none."""
    eval_split: Annotated[
        str | None,
        Flag(
            metavar="train|val|test",
            shown="default: val; with --home the split of the training",
        ),
    ] = None
    """Homes of the final evaluation."""
    films: Annotated[int, Bound(most=10_000)] = 2
    """Number of episodes to film in the first and in the last evaluation, for the report of the run; 0 for none."""
    resume: bool = False
    """Continue the run in the folder from its last checkpoint."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.eval_split is not None and self.eval_split not in SPLITS:
            raise unknown_name("split", self.eval_split, SPLITS)
        # Checks the options of the environment here, and not when the run has made its folder.
        _ = self.asked

    @classmethod
    def of(cls, *args: Any, **options: Any) -> Self:
        """See `EnvSpec.of`; one path stands for several in ``data``."""
        if isinstance(options.get("data"), str | Path):
            options["data"] = (options["data"],)
        return super().of(*args, **options)

    def _chosen(self, kind: type[Any], presets: Any) -> Any:
        """The preset with the changes of the options.

        Args:
            kind: class of its configuration.
            presets: makes the configuration of an algorithm and a name.

        Raises:
            UsageError: there is no such preset or field, or a value is out of range.
        """
        config = self.preset
        if not isinstance(config, kind):
            config = presets(self.ALGORITHM, config)
        elif self.ALGORITHM not in ("", config.algorithm):
            raise wrong_value(
                "preset", config.algorithm, f"one of algorithm {self.ALGORITHM}"
            )
        return with_changes(config, self.set, changes_of(self, config))

    @cached_property
    def scene(self) -> Scene:
        """What the policy learns."""
        given = {name: value for name, value in self.env.items() if name in SCENE}
        return Scene(**{**given, "randomise": self.asked.randomise})

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """All that the policy learns."""
        return (self.scene,)

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.asked.seed

    @property
    def budget_seconds(self) -> float:
        """Wall time of the whole run [s]; 0 for no limit."""
        return SECONDS_PER_MINUTE * self.budget_minutes

    @property
    def final_split(self) -> str:
        """Split of the homes of the final evaluation."""
        return self.eval_split or (self.scene.split if self.scene.home else HELD_OUT)


@dataclass(frozen=True, kw_only=True)
class ImitationSpec(TrainSpec):
    """Options of all algorithms that imitate the expert.

    Raises:
        UsageError: a name is unknown, a number out of range, or options exclude each other.
    """

    data: Annotated[
        tuple[Path, ...], Flag(metavar="PATH ...", shown="default: none")
    ] = ()
    """Learn from these demonstrations: shards or folders of them, with images of the preset's size. If absent, the
    expert generates demonstrations first."""
    where: Annotated[
        str | None, Flag(metavar="FILTER", shown="default: the successful ones")
    ] = None
    """With --data: which episodes, as in `mjhab data query`."""
    per_target: int = 0
    """With --data: only so many demonstrations of every target, those with the lowest indices; 0 for all."""
    demos: Annotated[Number, Sets("demos")] = None
    """Without --data: number of episodes that the expert tries."""
    style: Annotated[
        tuple[str, ...],
        Flag(metavar="NAME=VALUE ...", shown="default: that of the preset"),
        Sets("style"),
    ] = ()
    """Style of the demonstrating expert, as in `mjhab generate`; with noise=0..0.2 it executes noisy actions, and the
    student learns the intended ones."""
    updates: Annotated[Number, Sets("updates")] = None
    """Updates of the network (in dagger: of the first round)."""
    start: Annotated[Path | None, Flag(metavar="CHECKPOINT", shown="default: none")] = (
        None
    )
    """Begin with the weights of this student of the same algorithm and network, in place of random ones. A student of
    behaviour cloning may see fewer views and know other targets; what is new begins without influence. Of a joined
    student (see `mjhab policy join`) the network begins that its gate chooses for the sentences of this run."""
    also: Annotated[
        tuple[str, ...],
        Flag(metavar="TASK/SUBTASK[/TARGET] ...", shown="default: none"),
    ] = ()
    """Further subtasks that the same student learns, for instance tidy_house/pick set_table/open/fridge/top_door.
    Numbers of episodes are for each of them."""
    also_assets: Annotated[
        tuple[str, ...], Flag(metavar="builtin|FOLDER ...", shown="default: none")
    ] = ()
    """Further asset packs in which the same student learns all of these subtasks. Numbers of episodes are for each."""
    device: Annotated[str, Flag(metavar="DEVICE")] = "cpu"
    """Device that the network is trained on: cpu, auto, cuda:0, ...; episodes are simulated on the CPU. With auto it
    is the first GPU, if there is one. Only on the CPU do equal runs end with equal bits."""
    workers: Annotated[int, Bound(1, 256)] = 1
    """Processes that collect, or read --data; 1 uses this process. Changes the speed, never the data."""
    ray: Annotated[str | None, Flag(metavar="ADDRESS", shown="default: none")] = None
    """Collect with actors of this Ray cluster ("local" starts one here); all nodes must see the folder --out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # The class is frozen; the words in their full form are what is recorded and compared.
        object.__setattr__(self, "style", tuple(Styles.parse(self.style).words))
        check_data(self.data, self.where)
        if self.data and self.demos is not None:
            raise wrong_value(
                "demos",
                self.demos,
                "left out with data: the expert generates demos, data names recorded demonstrations",
            )
        if self.per_target and not self.data:
            raise wrong_value(
                "per_target",
                self.per_target,
                "left out without data",
                "It chooses among recorded demonstrations: give data, or demos.",
            )
        # Wrong presets and scenes are told before anything is written.
        _ = self.config, self.scenes

    @cached_property
    def config(self) -> ImitationConfig:
        """The preset with the changes of the options, with the cameras of the scene's robot."""
        # Here: the help of a command does not wait for layouts.
        from mjhab.learning.observation.spec import inputs_of_robot

        config: ImitationConfig = self._chosen(ImitationConfig, preset_of)
        inputs = inputs_of_robot(config.student.inputs, self.scene.robot)
        student = dataclasses.replace(config.student, inputs=inputs)
        return dataclasses.replace(config, student=student)

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """All scenes: that of ``env``, those of ``also``, which differ in task, subtask and target only, and all of
        them in the packs of ``also_assets``."""
        here = (self.scene, *(_also(self.scene, text) for text in self.also))
        elsewhere = (
            dataclasses.replace(scene, assets=EnvConfig(assets=pack).assets)
            for pack in self.also_assets
            for scene in here
        )
        return (*here, *elsewhere)

    @property
    def teachers(self) -> tuple[str, ...]:
        """The teaching policy of every scene, "" for the expert."""
        return ("",) * len(self.scenes)

    @property
    def resources(self) -> Resources:
        """Resources."""
        threads = self.asked.threads or max(1, cores() // self.workers)
        return Resources(self.asked.num_envs, self.workers, threads)

    @property
    def torch_threads(self) -> int:
        """Threads of the network, 0 for torch's default."""
        return self.asked.threads

    @property
    def filter(self) -> Filter | None:
        """Filter on the episodes of ``data``; None takes the default."""
        from mjhab.data.select.query import Filter

        return Filter(self.where) if self.where else None


def check_data(data: tuple[Path, ...], where: str | None) -> None:
    """Check a filter on recorded demonstrations before anything is read or written.

    Raises:
        UsageError: it cannot be read, or there are no recorded demonstrations.
    """
    from mjhab.data.select.query import Filter

    if where is None:
        return
    Filter(where)
    if not data:
        raise wrong_value(
            "where",
            where,
            "left out without data",
            "It filters recorded demonstrations: give data.",
        )


def _also(like: Scene, text: str) -> Scene:
    """The scene that ``TASK/SUBTASK`` or ``TASK/SUBTASK/TARGET`` names, with the other options of ``like``.

    Raises:
        UsageError: the text has another form, or a name is unknown.
    """
    task, _, rest = text.partition("/")
    subtask, _, target = rest.partition("/")
    if not task or not subtask:
        raise wrong_value(
            "also",
            text,
            "TASK/SUBTASK or TASK/SUBTASK/TARGET, for instance set_table/open/fridge/top_door",
        )
    TASKS.check(task)
    SUBTASKS.check(subtask)
    # A file of starts is of one subtask.
    return dataclasses.replace(like, task=task, subtask=subtask, target=target, spawns="")


@dataclass(frozen=True, kw_only=True)
class BcSpec(ImitationSpec):
    """Behaviour cloning: predict the demonstrated actions. Presets: small, quick, state (no images), paper.

    `mjhab train bc --subtask close --target kitchen_counter/drawer3 --out runs/bc`

    Preset paper is MS-HAB's student with depth images of 128 px; small predicts chunks of actions from images of 32 px,
    normalized states and the last action.
    """

    ALGORITHM: ClassVar[str] = BC


@dataclass(frozen=True, kw_only=True)
class FlowSpec(ImitationSpec):
    """Flow matching: samples chunks of actions, for multimodal demonstrations. Presets: flow, quick."""

    ALGORITHM: ClassVar[str] = FLOW


@dataclass(frozen=True, kw_only=True)
class ActSpec(ImitationSpec):
    """Action chunking with a small transformer and a latent variable (ACT). Presets: act, quick."""

    ALGORITHM: ClassVar[str] = ACT


@dataclass(frozen=True, kw_only=True)
class DiffusionSpec(ImitationSpec):
    """MS-HAB's diffusion policy, with demonstrations truncated at success and averaged weights. Preset: paper_dp."""

    ALGORITHM: ClassVar[str] = DIFFUSION


@dataclass(frozen=True, kw_only=True)
class DaggerSpec(ImitationSpec):
    """Take-over DAgger: in each round the student starts episodes, the expert finishes them, and the student learns.

    `mjhab train dagger --task set_table --subtask close --target kitchen_counter/drawer3 --preset quick
    --budget-minutes 20 --out runs/close`

    Presets: small, quick, state (no images), flow, act. Every round is kept in --out as an ordinary data set.
    """

    ALGORITHM: ClassVar[str] = DAGGER

    rounds: Annotated[Number, Sets("dagger.rounds")] = None
    """Rounds after the first."""
    round_updates: Annotated[Number, Sets("dagger.updates")] = None
    """Updates after every round except the first."""
    takeovers: Annotated[Number, Sets("dagger.episodes")] = None
    """Episodes of every round except the first."""
    final_updates: Annotated[Number, Sets("dagger.final_updates")] = None
    """Updates after the last round, on all rounds, with a learning rate that decreases to zero."""
    first_prefix: Annotated[Number, Sets("dagger.first_prefix")] = None
    """Largest number of control steps for which the student acts in the first round with take-overs."""
    prefix_growth: Annotated[Number, Sets("dagger.prefix_growth")] = None
    """Increase of this number per round. If the expert finishes nearly all episodes, a larger value trains faster."""
    teacher: Annotated[
        tuple[str, ...], Flag(metavar="POLICY ...", shown="default: the expert")
    ] = ()
    """Learn from this policy in place of the expert, named as in `mjhab eval --policy`: it demonstrates, and in later
    rounds the student acts in whole episodes, in which it names the action to imitate in every control step
    (distillation). One for all, or one for each: of --subtask, then of --also, then of all these in the packs of
    --also-assets. "expert" is the expert, who takes over."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.teacher) not in (0, 1, len(self.scenes)):
            raise wrong_value(
                "teacher",
                len(self.teacher),
                f"one policy, or one for each of the {len(self.scenes)} subtasks and packs",
            )
        of_expert = self.style or self.first_prefix or self.prefix_growth
        if of_expert and all(self.teachers):
            raise wrong_value(
                "teacher",
                self.teacher,
                "left out with style, first_prefix and prefix_growth",
                "These are of an expert who takes over; a teacher does not.",
            )

    @property
    def teachers(self) -> tuple[str, ...]:
        """The teaching policy of every scene, "" for the expert."""
        from mjhab.evaluation.resolve import EXPERT, full_spec

        given = self.teacher or (EXPERT,)
        every = given * len(self.scenes) if len(given) == 1 else given
        return tuple(
            ""
            if spec == EXPERT
            else full_spec(spec, scene.task, scene.subtask, scene.target)
            for spec, scene in zip(every, self.scenes, strict=True)
        )
