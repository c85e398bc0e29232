"""What ``mjhab view`` is asked to show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from mjhab.config.env import EnvConfig
from mjhab.config.env_spec import EnvSpec
from mjhab.core.errors import fault
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag, OptionsOf, flag_of
from mjhab.evaluation.specs import NOT_GENERATED, RUN_BY_EVALUATION, EvalSpec
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

OF_RUNNING = ("policy", "policies", "record")
OF_RECORDED = ("where", "preset", "export", "stills")
OF_STILLS = ("shader", "shading")
"""Fields of `ViewSpec` for running worlds, besides ``env``, and for recorded episodes; the others are for both. Fields
of ``env`` that are for stills, too."""

MOST_STILLS = 24
"""So many take 1 of the 5 MB of a page."""


@dataclass(frozen=True)
class ViewSpec(EnvSpec):
    """View recorded episodes or running worlds in the browser, drive by hand, or write an episode as one page.

    Recorded: `mjhab view runs/pick`

    Running: `mjhab view --subtask pick --policy expert`

    By hand, recorded: `mjhab view --subtask pick --policy human --record runs/human/mine.h5`

    Corrected while C is held: `mjhab view --subtask pick --policy mine.safetensors --record runs/human/fixed.h5`

    One episode as a page: `mjhab view runs/pick --export pick.html`

    From another machine: `ssh -L 8080:localhost:8080 HOST`, then open http://localhost:8080. Needs
    the extra `view` (`mjhab doctor` tells how to install it); --export does not.

    Raises:
        UsageError: an option is invalid, or is for running worlds where shards are given, or the other way.
    """

    WHAT: ClassVar[str] = "the viewer"

    places: Annotated[
        tuple[Path, ...], Flag(metavar="[SHARD|FOLDER ...]", positional=True)
    ] = ()
    """Shards (*.h5) or folders of shards to view. Without any, new worlds run."""
    policy: Annotated[str, Flag(metavar="NAME|FILE.py:CLASS|ws://HOST:PORT")] = "expert"
    """The policy, as in `mjhab eval`, or human: a person drives in the page from the first step on. Others can be
    chosen in the page."""
    policies: Annotated[tuple[str, ...], Flag(metavar="NAME ...")] = ()
    """Further policies that the page offers."""
    episode: int = 0
    """Index of the first episode of running worlds; with recorded episodes, position of the one to show, or to write
    with --export, from 0."""
    env: Annotated[
        Mapping[str, Any],
        OptionsOf(
            EnvConfig,
            apart=RUN_BY_EVALUATION | NOT_GENERATED,
            defaults={"num_envs": 1},
        ),
    ] = field(default_factory=dict)
    """Options of running worlds, fields of `EnvConfig`; the reward is dense, with its terms, if absent."""
    where: Annotated[str | None, Flag(metavar="FILTER", shown="default: all")] = None
    """With recorded episodes: only these, as in `mjhab data query`."""
    preset: Annotated[str | None, Flag(metavar="NAME", shown="default: none")] = None
    """With recorded episodes: a filter with a name, see `mjhab data fields`."""
    record: Annotated[
        Path | None, Flag(metavar="FILE.h5", shown="default: none"), Output(".h5")
    ] = None
    """With running worlds: record every finished episode in this shard; existing episodes in it are kept."""
    export: Annotated[
        Path | None, Flag(metavar="FILE.html", shown="default: none"), Output(".html")
    ] = None
    """Write a recorded episode as a self-contained page instead of serving."""
    stills: Annotated[int, Bound(0, MOST_STILLS)] = 0
    """With --export: so many pictures of the episode in the page, by the camera of films; with --shader path as in a
    photograph."""
    host: Annotated[str, Flag(metavar="ADDRESS")] = "localhost"
    """Address to listen on. With addresses other than localhost, everybody who can reach this machine can drive."""
    port: Annotated[int, Bound(most=65_535)] = 8080
    """Port to listen on; if it is in use, the next free one is used and printed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stills and self.export is None:
            raise fault("--stills", "is for a page: give --export FILE.html.")
        for name in self._without_effect():
            shown = f"--{name.replace('_', '-')}"
            if self.places:
                raise fault(
                    shown, "is for running worlds: leave out the shards to look at."
                )
            raise fault(
                shown, "is for recorded episodes: give a shard or a folder of them."
            )

    def _without_effect(self) -> list[str]:
        """Names of given options that are not for what is viewed."""
        names = OF_RUNNING if self.places else OF_RECORDED
        default = ViewSpec.__dataclass_fields__
        given = [name for name in names if getattr(self, name) != default[name].default]
        if not self.places:
            return given
        free = ("threads", *(OF_STILLS if self.stills else ()))
        apart = [name for name in self.env if name not in free]
        return given + [flag_of(EnvConfig, name).name or name for name in apart]

    def as_evaluation(self) -> EvalSpec:
        """The `EvalSpec` of the running worlds."""
        env = {"num_envs": 1, "reward_mode": self._reward(), **self.env}
        return EvalSpec(policy=self.policy, episodes=env["num_envs"], env=env)

    def _reward(self) -> str:
        """The dense reward, whose terms the page shows; "" (that of an evaluation) where a subtask has none."""
        asked = self.asked
        kinds = (asked.subtask,) if asked.subtask else TASKS[asked.task].subtasks
        dense = all(SUBTASKS[kind].reward is not None for kind in kinds)
        return "dense" if dense else ""
