"""The commands of ``mjhab``: what each is called, what runs it, what it takes.

Specifications and functions are named, not imported, so that help is fast: `load` imports those of one command.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mjhab.core.errors import UsageError, unknown_name


@dataclass(frozen=True)
class Command:
    """A command.

    name: its words, e.g. "homes list". summary: a line for the overview. run: module (below ``mjhab.cli``; of the
    paper's studies below ``mjhab``) and name of the function that takes the specification, and whether to print JSON,
    and returns the exit code. spec: module (below ``mjhab``) and name of the dataclass that the command line is made
    of; "" for the one in the annotation of ``run``. memory: whether it has the option --cache-mb.
    """

    name: str
    summary: str
    run: str
    spec: str = ""
    memory: bool = False

    @property
    def words(self) -> tuple[str, ...]:
        """The words of its name."""
        return tuple(self.name.split())

    @property
    def spec_type(self) -> type[Any]:
        """The class of its specification."""
        if self.spec:
            return load(self.spec)
        function = self.load_run()
        # The first parameter of what runs a command is its specification.
        name = next(iter(function.__annotations__.values()))
        return getattr(sys.modules[function.__module__], name)

    def load_run(self) -> Any:
        """Import the function that runs it."""
        return load(self.run if self.run.startswith("paper.") else f"cli.{self.run}")


def load(path: str) -> Any:
    """Import what ``module:name`` names."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"mjhab.{module}"), name)


CONFIG = "config"
"""Its words name another command."""
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
    "dataset": "data sets that can be published: make, check, push, pull",
    "policy": "trained policies to and from the hub",
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
        "policies.evaluate:run_demo",
        "evaluation.specs:DemoSpec",
    ),
    Command(
        "eval",
        "evaluate a policy: records, summary, films, report",
        "policies.evaluate:run_eval",
        "evaluation.specs:EvalSpec",
        memory=True,
    ),
    Command(
        "generate",
        "record episodes of a policy in a data set",
        "datasets.generate:run_generate",
        "evaluation.specs:GenerateSpec",
        memory=True,
    ),
    Command(
        "dataset make",
        "demonstrations of a track, with splits, statistics and a card",
        "datasets.publish:run_make",
        "evaluation.publishing.spec:DatasetSpec",
        memory=True,
    ),
    Command(
        "dataset check",
        "compare the files of a data set with its list",
        "datasets.publish:run_check",
        "evaluation.publishing.spec:DatasetCheckSpec",
    ),
    Command(
        "dataset push",
        "upload a data set to the Hugging Face Hub",
        "datasets.hub:run_push",
        "evaluation.publishing.spec:DatasetPushSpec",
    ),
    Command(
        "dataset pull",
        "download one, and compare its files with its list",
        "datasets.hub:run_pull",
        "evaluation.publishing.spec:PullSpec",
    ),
    Command(
        "policy push",
        "upload a trained policy",
        "datasets.hub:run_policy_push",
        "evaluation.publishing.spec:PolicyPushSpec",
    ),
    Command(
        "policy pull",
        "download one",
        "datasets.hub:run_policy_pull",
        "evaluation.publishing.spec:PullSpec",
    ),
    Command(
        "policy join",
        "join trained policies to one that reads the sentence",
        "policies.join:run_join",
        "learning.assigned.spec:PolicyJoinSpec",
    ),
    Command(
        "policy mean",
        "the mean of the weights of policies that began alike",
        "policies.mean:run_mean",
        "learning.assigned.spec:PolicyMeanSpec",
    ),
    Command(
        "train bc",
        "behaviour cloning",
        "policies.train:run_train",
        "learning.runs.specs:BcSpec",
    ),
    Command(
        "train flow",
        "flow matching",
        "policies.train:run_train",
        "learning.runs.specs:FlowSpec",
    ),
    Command(
        "train act",
        "action chunking with a transformer",
        "policies.train:run_train",
        "learning.runs.specs:ActSpec",
    ),
    Command(
        "train diffusion",
        "the diffusion policy of MS-HAB",
        "policies.train:run_train",
        "learning.runs.specs:DiffusionSpec",
    ),
    Command(
        "train dagger",
        "take-over DAgger: the expert finishes what the policy begins",
        "policies.train:run_train",
        "learning.runs.specs:DaggerSpec",
    ),
    Command(
        "train ppo",
        "proximal policy optimization",
        "policies.train:run_train",
        "learning.reinforcement.specs:PpoSpec",
    ),
    Command(
        "train sac",
        "soft actor-critic",
        "policies.train:run_train",
        "learning.reinforcement.specs:SacSpec",
    ),
    Command(
        "train rlpd",
        "soft actor-critic with demonstrations",
        "policies.train:run_train",
        "learning.reinforcement.specs:RlpdSpec",
    ),
    Command(
        "score",
        "a comparable score of a policy, checked by replay",
        "policies.score:run_score",
        "evaluation.score.spec:ScoreSpec",
    ),
    Command(
        "score check",
        "verify a score by replaying its episodes",
        "policies.score:run_check",
        "evaluation.score.spec:CheckSpec",
    ),
    Command(
        "score table",
        "a table of scores",
        "policies.score:run_table",
        "evaluation.score.spec:LeaderboardSpec",
    ),
    Command(
        "score starts",
        "write missing start digests of a track",
        "policies.score:run_starts",
        "evaluation.score.spec:StartsSpec",
    ),
    Command(
        "compare",
        "runs beside each other, paired by episode",
        "policies.compare:run_compare",
        "evaluation.compare:CompareSpec",
    ),
    Command(
        "reproduce",
        "the tables and figures of the MS-HAB paper",
        "paper.reproduce.command:run_reproduce",
        spec="paper.reproduce.spec:TableSpec",
    ),
    Command(
        "serve",
        "serve a policy over websockets",
        "policies.serve:run_serve",
        "evaluation.served.spec:ServeSpec",
    ),
    Command(
        "view",
        "watch worlds or recorded episodes in a browser, drive by hand",
        "view:run_view",
        "viewer.spec:ViewSpec",
    ),
    Command(
        "replay",
        "simulate recorded actions again, or render recorded states",
        "datasets.replay:run_replay",
        "evaluation.datasets.specs:ReplaySpec",
    ),
    Command(
        "shot",
        "a picture of an episode: still, contact sheet or turntable",
        "datasets.shot:run_shot",
        "evaluation.shots.spec:ShotSpec",
    ),
    Command(
        "label",
        "label recorded episodes again by the present rules",
        "datasets.data:run_relabelling",
        "evaluation.datasets.specs:LabelSpec",
    ),
    Command(
        "data query",
        "select episodes by an expression",
        "datasets.data:query",
        "evaluation.datasets.set_specs:QuerySpec",
    ),
    Command(
        "data stats",
        "count episodes, labels and targets",
        "datasets.data:stats",
        "evaluation.datasets.set_specs:StatsSpec",
    ),
    Command(
        "data report",
        "a page about a data set",
        "datasets.data:write_report",
        "evaluation.datasets.set_specs:ReportSpec",
    ),
    Command(
        "data merge",
        "join data sets",
        "datasets.data:merge",
        "evaluation.datasets.set_specs:MergeSpec",
    ),
    Command(
        "data split",
        "divide a data set",
        "datasets.data:split",
        "evaluation.datasets.set_specs:SplitSpec",
    ),
    Command(
        "data pack",
        "make shards of a recorded data set",
        "datasets.data:pack_files",
        "evaluation.datasets.set_specs:PackSpec",
    ),
    Command(
        "data import",
        "read the data of MS-HAB",
        "datasets.data:import_files",
        "evaluation.datasets.set_specs:ImportSpec",
    ),
    Command(
        "data check",
        "compare hashes and sizes",
        "datasets.data:check",
        "evaluation.datasets.set_specs:ShardCheckSpec",
    ),
    Command(
        "data repair",
        "save what can be read of damaged files",
        "datasets.data:repair",
        "evaluation.datasets.set_specs:RepairSpec",
    ),
    Command("data fields", "what expressions can name", "datasets.data:tell_fields"),
    Command(
        "export lerobot",
        "for LeRobot",
        "datasets.export:run_export",
        "evaluation.datasets.specs:LerobotSpec",
    ),
    Command(
        "export maniskill",
        "for ManiSkill and MS-HAB",
        "datasets.export:run_export",
        "evaluation.datasets.specs:ManiskillSpec",
    ),
    Command("envs list", "environment ids", "worlds.envs:list_envs"),
    Command(
        "envs describe",
        "observations, actions and rewards of one",
        "worlds.envs:describe_env",
    ),
    Command("robots list", "the robots", "worlds.robots:list_robots"),
    Command("robots show", "joints and cameras of one", "worlds.robots:show_robot"),
    Command("homes list", "homes of a pack", "worlds.homes:list_homes"),
    Command("homes show", "rooms and furniture of one", "worlds.homes:show_home"),
    Command("homes check", "what can be done in homes", "worlds.homes_check:check_homes"),
    Command("homes render", "pictures of homes", "worlds.homes_render:render"),
    Command("assets list", "what can be fetched", "worlds.assets:list_assets"),
    Command("assets fetch", "download and install", "worlds.assets:fetch_assets"),
    Command(
        "assets verify", "compare files with their hashes", "worlds.assets:verify_assets"
    ),
    Command("assets where", "where they are", "worlds.assets:where"),
    Command("episodes make", "write a file of episodes", "worlds.episodes:make"),
    Command("episodes check", "check one against homes", "worlds.episodes:check"),
    Command("episodes plans", "task plans and spawns for MS-HAB", "worlds.plans:make"),
    Command("spawns make", "compute start states once", "worlds.spawns:make"),
    Command(
        "spawns from",
        "start states from recorded episodes",
        "worlds.spawns:make_from_chains",
        spec="evaluation.datasets.specs:ChainStartsSpec",
    ),
    Command("spawns list", "sets of start states", "worlds.spawns:list_sets"),
    Command(
        "bench env",
        "steps per second of an environment, by stage",
        "bench.env:bench_env",
        spec="bench.specs:EnvBenchSpec",
    ),
    Command(
        "bench experts",
        "success of the scripted experts",
        "bench.experts:bench_experts",
        spec="bench.specs:ExpertsSpec",
    ),
    Command(
        "bench interact",
        "the benchmark Interact of the paper",
        "bench.interact:bench_interact",
        spec="bench.specs:InteractSpec",
    ),
    Command(
        "bench photo",
        "steps per second with path-traced pictures, as in the paper",
        "bench.photo:bench_photo",
        spec="bench.specs:PhotoSpec",
    ),
    Command("examples", "copy the examples", "machine.examples:run_examples"),
    Command(
        "warmup", "compile kernels before they are needed", "machine.warmup:run_warmup"
    ),
    Command(
        "doctor", "what is installed, and what it can do", "machine.doctor:run_doctor"
    ),
    Command(
        "estimate", "memory of worlds, and how many fit", "machine.estimate:run_estimate"
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
    # Two words first: `score` is a command, and `score check` another.
    if tuple(args[:2]) in BY_WORDS:
        return BY_WORDS[tuple(args[:2])], args[2:]
    if first in GROUPS:
        inside = [command.words[1] for command in COMMANDS if command.words[0] == first]
        second = args[1] if len(args) > 1 else ""
        if first == "bench" and second in DEVELOPERS_BENCHES:
            raise UsageError(
                f"`mjhab bench {second}` is `python -m benchmarks.{second}` now, in a checkout of mjhab."
            )
        raise unknown_name(f"command of {first}", second, inside)
    if (first,) not in BY_WORDS:
        # For the nearest name in the message; groups are no commands by themselves.
        names = [*(command.words[0] for command in COMMANDS), *GROUPS, CONFIG]
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
            lines.append((command.name, command.summary))
    lines += (
        [] if group else [(CONFIG, "print what a command line means, without running it")]
    )
    width = max(len(name) for name, _ in lines)
    return "\n".join(f"  {name:{width}}  {summary}" for name, summary in lines)
