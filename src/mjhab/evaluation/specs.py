"""What `mjhab.evaluate` and ``mjhab eval``, `mjhab.generate` and ``mjhab generate`` are asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from mjhab.config.env import EnvConfig
from mjhab.config.env_spec import EnvSpec
from mjhab.core.errors import missing_field, unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.checks import check
from mjhab.core.typed.flags import Flag, OptionsOf
from mjhab.core.typed.options import fitting, take_options, taken
from mjhab.evaluation.resolve import full_spec
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot
from mjhab.rollout.policy import Policy
from mjhab.scenes.shading import PATH, RASTER
from mjhab.serving.address import SCHEMES, Address, with_options
from mjhab.tasks.instructions import telling_words
from mjhab.tasks.style import Styles

if TYPE_CHECKING:
    from mjhab.data.select.query import Filter

PolicyLike = str | Policy | Callable[..., Policy]
"""A specification for `resolve_policy`, a policy object, or a class or function that makes one."""
RUN_BY_EVALUATION = frozenset({"autoreset", "backend", "device", "starts", "buffers"})
"""Environment options that an evaluation sets itself."""
PolicyName = Annotated[
    PolicyLike, Flag(metavar="NAME|FILE.py:CLASS|ws://HOST:PORT", kind=str)
]


MAX_EPISODES = 100_000_000
FILM_SIZES = {RASTER: (1280, 720), PATH: (320, 180)}
"""Default width and height of films by shader [px]."""
SMALL_FILM = (480, 270)
"""Width and height of films that must not take long: of the demonstration and of training [px]."""
OfEnv = Annotated[
    Mapping[str, Any],
    OptionsOf(EnvConfig, apart=RUN_BY_EVALUATION, defaults={"num_envs": 8}),
]
OfServer = Annotated[Mapping[str, Any], OptionsOf(Address, apart=frozenset({"uri"}))]


@dataclass(frozen=True)
class EvalSpec(EnvSpec):
    """Evaluate a policy in furnished homes; write records, a summary, films and a report.

    A whole task: `mjhab eval --task set_table --policy expert --episodes 20 --out runs/table`

    One subtask: `mjhab eval --subtask pick --target 024_bowl --episodes 50 --out runs/pick_bowl`

    A policy of your own: `mjhab eval --policy my_policy.py:MyPolicy --subtask pick --out runs/mine`

    A policy that runs elsewhere: `mjhab eval --policy ws://host:8000 --dialect openpi --subtask pick --out runs/vla`

    Ctrl-C and SIGTERM keep the finished episodes; the same command with `--resume` continues.

    Raises:
        UsageError: a name is unknown, a number out of range, or options exclude each other.
    """

    WHAT: ClassVar[str] = "an evaluation"
    APART: ClassVar[frozenset[str]] = frozenset({"policy", "served"})

    policy: PolicyName = "expert"
    """The policy: expert (scripted, reads the simulator state), learned (a trained one of the package, with --subtask
    and --target), random, zero (stands still), a CHECKPOINT.safetensors, a POLICIES.json or a FOLDER
    of training runs with one policy per subtask, ms_hab:CHECKPOINT.pt of MS-HAB (see docs/ms_hab.md), your own:
    FILE.py:CLASS (see docs/evaluation.md), or one that is served elsewhere: ws://host:port (see docs/serving.md). In
    Python also an object, a class or a function that makes one."""
    style: Annotated[tuple[str, ...], Flag(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, e.g. speed=0.5..1.0 grasp=side release=drop noise=0.05; every episode draws its own value
    from a range or a list (a,b). Names: speed, grasp, release, drop_height, close, pull, open_further, waits,
    plan, look, hand, noise, base_noise, noise_kind, hold, dither, mishap (see docs/data/record.md)."""
    instruction: Annotated[
        str | None, Flag(metavar="SENTENCE", shown="default: the episodes'")
    ] = None
    """With a subtask: tell the policy this sentence in place of the episodes' own, e.g. "shut the drawer". For a
    student that was trained with sentences (see docs/training.md) and for a served policy."""
    episodes: Annotated[int, Bound(1, MAX_EPISODES)] = 20
    """Number of episodes, with indices 0 to N-1. The same index is the same episode for every policy."""
    env: OfEnv = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`; they take precedence over those that the policy needs."""
    served: OfServer = field(default_factory=dict)
    """With a served policy: how it is asked, fields of `serving.address.Address`."""
    films: Annotated[int, Bound(most=10_000)] = 4
    """Film the first N episodes; 0 for none."""
    film_size: Annotated[
        tuple[int, int] | None,
        Flag(metavar="WIDTH HEIGHT", shown="default: 1280 720, with shader path 320 180"),
        Bound(16, 4096),
    ] = None
    """Width and height of films [px]. Of a whole task in 1280 x 720, drawing takes about as long as acting."""
    out: Annotated[
        Path | None,
        Flag(
            metavar="FOLDER", shown="default: runs/<task>_<subtask>_<policy>_seed<seed>"
        ),
        Output(),
    ] = None
    """Folder of the results."""
    workers: Annotated[int, Bound(most=256)] = 0
    """Number of processes to start, of --worlds each; 0 takes this process. A script needs
    ``if __name__ == "__main__":`` for some. Changes the speed, never the records."""
    ray: Annotated[str | None, Flag(metavar="ADDRESS", shown="default: none")] = None
    """Evaluate with actors of this Ray cluster ("local" starts one here), see docs/cluster.md."""
    resume: bool = False
    """Continue the run in the folder: only episodes without a record are run."""
    overwrite: bool = False
    """Start the run in the folder again; deletes the files of the earlier run and nothing else."""
    alone: Annotated[tuple[Path, ...], Flag(metavar="FOLDER ...")] = ()
    """Folders of runs of single subtasks, whose success rates give the upper bound of progressive completion."""

    @property
    def film_px(self) -> tuple[int, int]:
        """Width and height of films [px]."""
        return self.film_size or FILM_SIZES[self.asked.shader]

    def __post_init__(self) -> None:
        super().__post_init__()
        asked = self.asked
        Styles.parse(self.style)
        if asked.target and not asked.subtask:
            raise wrong_value(
                "target",
                asked.target,
                "left out without a subtask: a whole task has its targets in its plan",
            )
        if self.instruction is not None:
            check(
                bool(telling_words(self.instruction)),
                "instruction",
                self.instruction,
                "a sentence, or left out for those of the episodes",
            )
            check(
                bool(asked.subtask),
                "instruction",
                self.instruction,
                "left out without a subtask: in a whole task every subtask has a sentence of its own",
            )
        # The class is frozen; from here on the specification is complete by itself.
        object.__setattr__(self, "policy", named_policy(self.policy, asked, self.served))
        served = isinstance(self.policy, str) and self.policy.startswith(SCHEMES)
        if served and (self.workers or self.ray):
            raise wrong_value(
                "workers",
                self.workers,
                "0, and no --ray, with a served policy, which answers one process",
                "Take more --worlds, and --batch where the server takes it.",
            )


NO_IMAGES = "none"
TRIES_PER_EPISODE = 20
"""Number of episodes tried per episode to keep, if ``episodes`` is not given."""
NOT_GENERATED = frozenset({"cameras", "camera_size", "spawns", "episodes_file"})
"""Environment options that a data set has no use for, or has fields for that tell of stored images."""
MAX_TARGETS = 10
"""Upper bound on the number of object types of a task."""


@dataclass(frozen=True)
class GenerateSpec(EnvSpec):
    """Record episodes in a data set until every target has its quota; failures are kept by default.

    `mjhab generate --subtask pick --per-target 1000 --keep "label == 'straightforward_success'" --workers 2 --out
    runs/pick`

    Ctrl-C and SIGTERM keep the finished episodes; the same command with `--resume` continues. Of the episodes that pass
    the filter, those with the lowest indices are kept, whatever the number of workers.

    Raises:
        UsageError: a name is unknown, a number out of range, a filter invalid, or options exclude each other.
    """

    WHAT: ClassVar[str] = "a data set"
    APART: ClassVar[frozenset[str]] = frozenset({"policy"})

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """Folder of the shards."""
    policy: PolicyName = "expert"
    """The policy, as in `mjhab eval`."""
    style: Annotated[tuple[str, ...], Flag(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, e.g. speed=0.5..1.0 grasp=side release=drop noise=0.05; every episode draws its own value
    from a range or a list (a,b). Names: speed, grasp, release, drop_height, close, pull, open_further, waits,
    plan, look, hand, noise, base_noise, noise_kind, hold, dither, mishap (see docs/data/record.md)."""
    per_target: int = 0
    """Episodes to keep per target (in total for whole tasks and Navigate); 0 for no limit."""
    per_label: int = 0
    """Episodes to keep per target and label; 0 for no limit."""
    episodes: Annotated[
        int | None,
        Flag(shown="default: 20 times those to keep"),
        Bound(1, MAX_EPISODES),
    ] = None
    """Try at most the episodes 0 to N-1; needed without a number per target."""
    keep: Annotated[str | None, Flag(metavar="FILTER", shown="default: all")] = None
    """Which episodes to keep, as in `mjhab data query`."""
    preset: Annotated[str | None, Flag(metavar="NAME", shown="default: none")] = None
    """A filter with a name, see `mjhab data fields`; with --keep, both must hold."""
    rest: Annotated[
        Path | None, Flag(metavar="FOLDER", shown="default: dropped"), Output()
    ] = None
    """Folder for the episodes that were tried and did not pass the filter, such as failures; outside of --out."""
    until: Annotated[str, Flag(metavar="success+N", shown="default: the horizon")] = ""
    """End an episode of a single subtask N control steps after its first success, or when it exceeds the force limit.
    Whole tasks end with their success."""
    env: Annotated[
        Mapping[str, Any],
        OptionsOf(
            EnvConfig,
            apart=RUN_BY_EVALUATION | NOT_GENERATED,
            defaults={"num_envs": 4},
        ),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`; they take precedence over those that the policy needs. Whole
    tasks are driven by the policy unless ``navigate`` says otherwise."""
    states: bool = True
    """Store positions and velocities. Without them (--no-states) files are smaller, but images cannot be rendered
    later."""
    images: Annotated[str, Flag(metavar="none|depth|rgb|rgbd|seg")] = NO_IMAGES
    """Camera images to store; several joined by +. `mjhab replay --render` can also render them later."""
    cameras: Annotated[
        tuple[str, ...] | None, Flag(metavar="NAME ...", shown="default: all")
    ] = None
    """Cameras of the robot whose images are stored."""
    camera_size: Annotated[int | tuple[int, int], Bound(1, 4096)] = 128
    """Pixels of the stored images: their side, or height and width."""
    rgb: Annotated[str, Flag(metavar="png|jpeg")] = "png"
    """Format of colour images; png is lossless."""
    workers: Annotated[int, Bound(most=256)] = 0
    """Number of processes to start; 0 takes this process (`mjhab generate`: one process). A script needs
    ``if __name__ == "__main__":`` for more. Changes the speed, never the results."""
    ray: Annotated[str | None, Flag(metavar="ADDRESS", shown="default: none")] = None
    """Record with actors of this Ray cluster ("local" starts one here)."""
    resume: bool = False
    """Continue the data set in the folder; episodes, worlds, workers and threads may differ from before."""

    def __post_init__(self) -> None:
        # Here: the help of a command waits neither for gymnasium nor for h5py.
        from mjhab.data.select.until import Until

        super().__post_init__()
        object.__setattr__(self, "policy", named_policy(self.policy, self.asked, {}))
        Until.parse(self.until)
        robot = robot_named(self.asked.robot)
        if self.cameras is None:
            object.__setattr__(self, "cameras", robot.camera_names)
        if self.episodes is None and not self.per_target:
            raise missing_field(
                "episodes",
                advice="Give per_target (episodes to keep per target) or episodes (episodes to try).",
            )
        # Checks the options that both have.
        self.as_evaluation()
        self.filter()
        out = self.out.resolve()
        if self.rest is not None and self.rest.resolve().is_relative_to(out):
            raise wrong_value(
                "rest",
                str(self.rest),
                f"outside of {self.out}, whose episodes all passed",
            )
        if self.stores_images:
            self._check_images(robot)

    def _check_images(self, robot: Robot) -> None:
        from mjhab.data.store.images import ImageFormat
        from mjhab.envs.observations.modes import camera_names, image_size, mode_outputs

        ImageFormat(self.rgb)
        mode_outputs(self.images)
        camera_names(robot, self.cameras or ())
        image_size(self.camera_size)

    @property
    def env_defaults(self) -> Mapping[str, Any]:
        """Worlds, and whole tasks that the policy drives; a single subtask ignores ``navigate``."""
        drives = not self.env.get("subtask")
        return {"num_envs": 4, "navigate": "drive" if drives else "teleport"}

    @property
    def stores_images(self) -> bool:
        """Whether camera images are stored."""
        return self.images != NO_IMAGES

    @property
    def max_tries(self) -> int:
        """Largest number of episodes to try."""
        if self.episodes is not None:
            return self.episodes
        return min(MAX_EPISODES, TRIES_PER_EPISODE * MAX_TARGETS * self.per_target)

    def filter(self) -> Filter | None:
        """The filter of ``keep`` and ``preset``; None keeps every episode."""
        from mjhab.data.select.query import read_filter

        return read_filter(self.keep, self.preset)

    def as_evaluation(self) -> EvalSpec:
        """The `EvalSpec` of the same episodes with the same policy."""
        return EvalSpec(
            policy=self.policy,
            style=self.style,
            episodes=self.max_tries,
            env=self.env_options,
        )


def given_to_server(served: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a served policy that were given, checked.

    Raises:
        UsageError: an option is unknown or invalid.
    """
    known = [field.name for field in dataclasses.fields(Address)]
    for name in served:
        if name not in known:
            raise unknown_name("option of a served policy", name, known)
    # The command line gives None for what was not said.
    given = {name: value for name, value in served.items() if value is not None}
    return {name: taken(Address, name, value) for name, value in given.items()}


def named_policy(
    policy: PolicyLike, asked: EnvConfig, served: Mapping[str, Any]
) -> PolicyLike:
    """A policy with the names that complete its specification: subtask of a student, options of a server.

    Raises:
        UsageError: options of a server are given for another policy.
    """
    if not isinstance(policy, str):
        return policy
    named: str = fitting("policy", str, policy)
    given = given_to_server(served)
    return full_spec(
        with_options(named, given),
        asked.task,
        asked.subtask or None,
        asked.target or None,
    )


@dataclass(frozen=True)
class DemoSpec:
    """Run a demonstration: the expert sets the table in four furnished homes; films and report go to runs/demo.

    The same as `mjhab eval --task set_table --policy expert --episodes 4 --worlds 4 --seed 0 --films 4`, with smaller
    films. The first run compiles for about a minute; then it takes half a minute on two cores.
    """

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()] = Path("runs/demo")
    """Folder of the results; results of an earlier run are replaced."""

    def __post_init__(self) -> None:
        take_options(self)
