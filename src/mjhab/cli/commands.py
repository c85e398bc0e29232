"""The commands of ``mjhab``: what each is called, what it takes, what runs it.

Specifications and functions are named, not imported, so that help is fast: `load` imports those of one command.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mjhab.core.errors import UsageError, unknown_name


@dataclass(frozen=True)
class Command:
    """A command.

    name: its words, e.g. "homes list". summary: a line for the overview. options: module (below ``mjhab``) and name of
    the dataclass that its command line is made of. run: module (below ``mjhab.cli``, of the paper's studies below
    ``mjhab``) and name of the function that takes it. memory: whether it has the option --cache-mb. spec: whether the
    dataclass is a specification, see `parsing.parse_spec`; else it is parsed as it is.
    """

    name: str
    summary: str
    options: str
    run: str
    memory: bool = False
    spec: bool = False

    @property
    def words(self) -> tuple[str, ...]:
        """The words of its name."""
        return tuple(self.name.split())

    def load_run(self) -> Any:
        """Import the function that runs it."""
        return load(self.run if self.run.startswith("paper.") else f"cli.{self.run}")


def load(path: str) -> Any:
    """Import what ``module:name`` names."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"mjhab.{module}"), name)


GROUPS = {
    "envs": "list environments and describe their observations, actions and rewards",
    "robots": "list and describe robots",
    "homes": "look at homes, check and draw them",
    "assets": "fetch public assets and episodes, and check them",
    "episodes": "files of episodes",
    "spawns": "precomputed start states",
    "bench": "measure environments, experts and the paper's Interact",
    "train": "train a policy",
    "data": "recorded episodes: list, query, check, merge, import",
    "export": "recorded episodes in other formats",
}
"""Commands of two words by their first one."""

DEVELOPERS_BENCHES = frozenset(
    [
        "curves",
        "grasp",
        "learner",
        "parity",
        "reward",
        "scaling",
        "serving",
        "sim",
        "soak",
        "spawn",
        "view",
        "windows",
    ]
)
"""Benches that were commands; they are in the folder ``benchmarks`` of a checkout."""

COMMANDS: tuple[Command, ...] = (
    Command(
        "demo",
        "a robot sets the table in four homes; films and a report",
        "cli.options.policies.evaluate:DemoOptions",
        "policies.evaluate:run_demo",
    ),
    Command(
        "eval",
        "evaluate a policy: records, summary, films, report",
        "evaluation.specs:EvalSpec",
        "policies.evaluate:run_eval",
        memory=True,
        spec=True,
    ),
    Command(
        "generate",
        "record episodes of a policy in a data set",
        "evaluation.specs:GenerateSpec",
        "datasets.generate:run_generate",
        memory=True,
        spec=True,
    ),
    Command(
        "train bc",
        "behaviour cloning",
        "learning.runs.specs:BcSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train flow",
        "flow matching",
        "learning.runs.specs:FlowSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train act",
        "action chunking with a transformer",
        "learning.runs.specs:ActSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train diffusion",
        "the diffusion policy of MS-HAB",
        "learning.runs.specs:DiffusionSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train dagger",
        "take-over DAgger: the expert finishes what the policy begins",
        "learning.runs.specs:DaggerSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train ppo",
        "proximal policy optimization",
        "learning.reinforcement.specs:PpoSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train sac",
        "soft actor-critic",
        "learning.reinforcement.specs:SacSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "train rlpd",
        "soft actor-critic with demonstrations",
        "learning.reinforcement.specs:RlpdSpec",
        "policies.train:run_train",
        spec=True,
    ),
    Command(
        "score",
        "a comparable score of a policy, checked by replay",
        "cli.options.policies.score:ScoreOptions",
        "policies.score:run_score",
    ),
    Command(
        "reproduce",
        "the tables and figures of the MS-HAB paper",
        "cli.options.policies.reproduce:ReproduceOptions",
        "paper.reproduce.command:run_reproduce",
    ),
    Command(
        "serve",
        "serve a policy over websockets",
        "cli.options.policies.serve:ServeOptions",
        "policies.serve:run_serve",
    ),
    Command(
        "view",
        "watch worlds or recorded episodes in a browser, drive by hand",
        "viewer.spec:ViewSpec",
        "view:run_view",
        spec=True,
    ),
    Command(
        "replay",
        "simulate recorded actions again, or render recorded states",
        "evaluation.datasets.specs:ReplaySpec",
        "datasets.replay:run_replay",
        spec=True,
    ),
    Command(
        "label",
        "label recorded episodes again by the present rules",
        "evaluation.datasets.specs:LabelSpec",
        "datasets.data:run_relabelling",
        spec=True,
    ),
    Command(
        "data query",
        "select episodes by an expression",
        "cli.options.datasets.data:DataQueryOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data stats",
        "count episodes, labels and targets",
        "cli.options.datasets.data:DataStatsOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data report",
        "a page about a data set",
        "cli.options.datasets.data:DataReportOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data merge",
        "join data sets",
        "cli.options.datasets.data:DataMergeOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data split",
        "divide a data set",
        "cli.options.datasets.data:DataSplitOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data pack",
        "make shards of a recorded data set",
        "cli.options.datasets.data:DataPackOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data import",
        "read the data of MS-HAB",
        "cli.options.datasets.data:DataImportOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data check",
        "compare hashes and sizes",
        "cli.options.datasets.data:DataCheckOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data repair",
        "save what can be read of damaged files",
        "cli.options.datasets.data:DataRepairOptions",
        "datasets.data:run_data",
    ),
    Command(
        "data fields",
        "what expressions can name",
        "cli.options.datasets.data:DataFieldsOptions",
        "datasets.data:run_data",
    ),
    Command(
        "export lerobot",
        "for LeRobot",
        "evaluation.datasets.specs:LerobotSpec",
        "datasets.export:run_export",
        spec=True,
    ),
    Command(
        "export maniskill",
        "for ManiSkill and MS-HAB",
        "evaluation.datasets.specs:ManiskillSpec",
        "datasets.export:run_export",
        spec=True,
    ),
    Command(
        "envs list",
        "environment ids",
        "cli.options.env:EnvsListOptions",
        "worlds.envs:run_envs",
    ),
    Command(
        "envs describe",
        "observations, actions and rewards of one",
        "cli.options.env:EnvsDescribeOptions",
        "worlds.envs:run_envs",
    ),
    Command(
        "robots list",
        "the robots",
        "cli.options.env:RobotsListOptions",
        "worlds.robots:run_robots",
    ),
    Command(
        "robots show",
        "joints and cameras of one",
        "cli.options.env:RobotsShowOptions",
        "worlds.robots:run_robots",
    ),
    Command(
        "homes list",
        "homes of a pack",
        "cli.options.homes:HomesListOptions",
        "worlds.homes:run_homes",
    ),
    Command(
        "homes show",
        "rooms and furniture of one",
        "cli.options.homes:HomesShowOptions",
        "worlds.homes:run_homes",
    ),
    Command(
        "homes check",
        "what can be done in homes",
        "cli.options.homes:HomesCheckOptions",
        "worlds.homes:run_homes",
    ),
    Command(
        "homes render",
        "pictures of homes",
        "cli.options.homes:HomesRenderOptions",
        "worlds.homes:run_homes",
    ),
    Command(
        "assets list",
        "what can be fetched",
        "cli.options.assets:AssetsListOptions",
        "worlds.assets:run_assets",
    ),
    Command(
        "assets fetch",
        "download and install",
        "cli.options.assets:AssetsFetchOptions",
        "worlds.assets:run_assets",
    ),
    Command(
        "assets verify",
        "compare files with their hashes",
        "cli.options.assets:AssetsVerifyOptions",
        "worlds.assets:run_assets",
    ),
    Command(
        "assets where",
        "where they are",
        "cli.options.assets:AssetsWhereOptions",
        "worlds.assets:run_assets",
    ),
    Command(
        "episodes make",
        "write a file of episodes",
        "cli.options.episodes:EpisodesMakeOptions",
        "worlds.episodes:run_episodes",
    ),
    Command(
        "episodes check",
        "check one against homes",
        "cli.options.episodes:EpisodesCheckOptions",
        "worlds.episodes:run_episodes",
    ),
    Command(
        "spawns make",
        "compute start states once",
        "cli.options.spawn:SpawnsMakeOptions",
        "worlds.spawns:run_spawns",
    ),
    Command(
        "spawns list",
        "sets of start states",
        "cli.options.spawn:SpawnsListOptions",
        "worlds.spawns:run_spawns",
    ),
    Command(
        "bench env",
        "steps per second of an environment, by stage",
        "cli.options.env:BenchEnvOptions",
        "bench.env:bench_env",
    ),
    Command(
        "bench experts",
        "success of the scripted experts",
        "cli.options.expert:BenchExpertsOptions",
        "bench.experts:bench_experts",
    ),
    Command(
        "bench interact",
        "the benchmark Interact of the paper",
        "cli.options.gpu:BenchInteractOptions",
        "bench.interact:bench_interact",
    ),
    Command(
        "config",
        "print the resolved options of a command without running it",
        "cli.parsing:Parsed",
        "machine.config:run_config",
    ),
    Command(
        "examples",
        "copy the examples",
        "cli.options.machine:ExamplesOptions",
        "machine.examples:run_examples",
    ),
    Command(
        "warmup",
        "compile kernels before they are needed",
        "cli.options.gpu:WarmupOptions",
        "machine.warmup:run_warmup",
    ),
    Command(
        "doctor",
        "what is installed, and what it can do",
        "cli.options.machine:DoctorOptions",
        "machine.doctor:run_doctor",
    ),
)
"""All commands, in the order of the overview."""
BY_WORDS: dict[tuple[str, ...], Command] = {
    command.words: command for command in COMMANDS
}


def find(args: Sequence[str]) -> tuple[Command, Sequence[str]]:
    """The command that a command line names, and the words after it.

    Raises:
        UsageError: there is no such command; the message names the nearest, or where a bench is now.
    """
    first = args[0]
    if first in GROUPS:
        inside = [command.words[1] for command in COMMANDS if command.words[0] == first]
        second = args[1] if len(args) > 1 else ""
        if first == "bench" and second in DEVELOPERS_BENCHES:
            raise UsageError(
                f"`mjhab bench {second}` is `python -m benchmarks.{second}` now, in a checkout of mjhab."
            )
        if second not in inside:
            raise unknown_name(f"command of {first}", second, inside)
        return BY_WORDS[first, second], args[2:]
    if (first,) not in BY_WORDS:
        names = [*(command.words[0] for command in COMMANDS), *GROUPS]
        raise unknown_name("command", first, list(dict.fromkeys(names)))
    return BY_WORDS[(first,)], args[1:]


def overview(group: str = "") -> str:
    """The commands with a line for each, of one group or all."""
    lines = []
    shown: set[str] = set()
    for command in COMMANDS:
        first = command.words[0]
        if group:
            if first == group:
                lines.append((command.words[1], command.summary))
        elif first in GROUPS:
            if first not in shown:
                lines.append((first, GROUPS[first]))
            shown.add(first)
        else:
            lines.append((first, command.summary))
    width = max(len(name) for name, _ in lines)
    return "\n".join(f"  {name:{width}}  {summary}" for name, summary in lines)
