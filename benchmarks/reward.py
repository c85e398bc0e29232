"""Whether returns of successful episodes are higher than those of failures: ``python -m benchmarks.reward``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import rankdata

from benchmarks.command import run_command
from benchmarks.profile_choice import ProfileChoice, profile_options
from mjhab.cli.output import Listing, report
from mjhab.core.errors import unknown_name
from mjhab.core.files.cache import write_text
from mjhab.core.files.outputs import check_folder
from mjhab.core.progress import progress_bar
from mjhab.reports.pages import Section, render_sections
from mjhab.reports.plots import Figure
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.tasks.household.registry import task_with
from mjhab.tasks.subtasks.registry import SUBTASKS

REPORT = "report.html"
COLORS = {"success": "#16a34a", "failure": "#dc2626"}


@dataclass(frozen=True)
class RewardSpec(ProfileChoice):
    """Measure how well the dense reward separates success from failure, in episodes of the expert.

    Writes a page with the reward over time of every subtask. The AUC is the probability that a successful episode has a
    higher return than a failed one: 1 is ideal, 0.5 is chance.
    """

    episodes: int = 100
    """Episodes of every subtask."""
    worlds: int = 8
    """Number of parallel episodes. Changes the speed, never the results."""
    seed: int = 0
    """Seed of the episodes."""
    subtasks: str = "pick,place,open,close"
    """Which subtasks, separated by commas."""
    threads: int = 0
    """Threads of the physics; 0 takes all cores."""
    out: Path = Path("runs/reward")
    """Folder of report.html."""
    json: bool = False
    """Print one line of JSON at the end."""


def expert_kinds() -> tuple[str, ...]:
    """Kinds of subtasks with a dense reward that an expert does alone, without a way to drive."""
    return tuple(
        name
        for name, spec in zip(SUBTASKS, SUBTASKS.values(), strict=True)
        if spec.reward and spec.expert and not spec.navigates
    )


class RewardSink(Sink[RolloutEnv]):
    """Keeps the rewards of every episode: ``curves`` of (successful, (T,) rewards)."""

    def __init__(self, num_envs: int, advance: Any) -> None:
        self.curves: list[tuple[bool, np.ndarray]] = []
        self._running: list[list[float]] = [[] for _ in range(num_envs)]
        self._advance = advance

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Note the rewards of the worlds in which an episode runs."""
        for world in np.flatnonzero(step.active):
            self._running[world].append(float(step.reward[world]))

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Close the curve of a world."""
        self.curves.append((record.success_once, np.array(self._running[world])))
        self._running[world] = []
        self._advance()


def measure_rewards(spec: RewardSpec) -> dict[str, dict[str, Any]]:
    """Run the expert in every subtask of ``spec`` and write report.html into its folder.

    Returns:
        `summary` of every subtask.

    Raises:
        UsageError: a subtask that has no expert with a dense reward.
    """
    kinds = spec.subtasks.split(",")
    for kind in kinds:
        if kind not in expert_kinds():
            raise unknown_name("subtask", kind, expert_kinds())
    curves = {kind: measure_reward(kind, spec) for kind in kinds}
    found = {kind: summary(curve) for kind, curve in curves.items()}
    figures = {f"reward-{kind}": figure(curve) for kind, curve in curves.items()}
    sections = [
        Section(kind, _sentence(found[kind]), chart=f"reward-{kind}") for kind in kinds
    ]
    about = f"Profile {spec.profile}."
    page = render_sections("Dense reward of the expert", sections, figures, about)
    write_text(spec.out / REPORT, page)
    return found


def measure_reward(kind: str, spec: RewardSpec) -> list[tuple[bool, np.ndarray]]:
    """Run the expert; returns (successful at least once, normalised dense rewards (T,)) of every episode."""
    from mjhab.envs import make_train
    from mjhab.experts import make_expert

    task = task_with(kind)
    env = make_train(
        task=task,
        subtask=kind,
        num_envs=min(spec.worlds, spec.episodes),
        threads=spec.threads,
        seed=spec.seed,
        autoreset="disabled",
        # Links that begin half open would end episodes before the reward can rise.
        open_start=0.0,
        **profile_options(spec),
    )
    with progress_bar(f"expert: {kind}", spec.episodes) as advance:
        sink = RewardSink(env.num_envs, advance)
        rollout(env, make_expert(env), range(spec.episodes), spec.seed, [sink])
    return sink.curves


def summary(curves: list[tuple[bool, np.ndarray]]) -> dict[str, Any]:
    """AUC of the return, mean returns, and how much the reward rises from the first to the last tenth."""
    good = np.array([won for won, _ in curves])
    returns = np.array([rewards.sum() for _, rewards in curves])
    tenth = [max(1, len(rewards) // 10) for _, rewards in curves]
    rise = [
        float(rewards[-n:].mean() - rewards[:n].mean())
        for n, (won, rewards) in zip(tenth, curves, strict=True)
        if won
    ]
    return {
        "episodes": len(curves),
        "successes": int(good.sum()),
        "auc": auc(returns, good),
        "return_success": _mean(returns[good]),
        "return_failure": _mean(returns[~good]),
        "rise_success": _mean(np.array(rise)),
        "rising": _mean(np.array(rise) > 0),
    }


def auc(score: np.ndarray, good: np.ndarray) -> float | None:
    """Area under the ROC curve: probability that a success has a higher score than a failure, ties counting half.

    ``good`` (n,) bool and ``score`` (n,) of n episodes; None if all or none of them are successes.
    """
    wins = int(good.sum())
    losses = int((~good).sum())
    if not wins or not losses:
        return None
    return round(
        float((rankdata(score)[good].sum() - wins * (wins + 1) / 2) / (wins * losses)), 4
    )


def figure(curves: list[tuple[bool, np.ndarray]]) -> Figure:
    """Mean reward over the steps with the middle half of the episodes, of successes and of failures."""
    data: list[dict[str, Any]] = []
    for name, wanted in (("success", True), ("failure", False)):
        chosen = [rewards for won, rewards in curves if won == wanted]
        if not chosen:
            continue
        length = max(len(r) for r in chosen)
        # Percentiles leave NaN out: episodes end at different steps.
        table = np.full((len(chosen), length), np.nan)
        for row, rewards in zip(table, chosen, strict=True):
            row[: len(rewards)] = rewards
        low, middle, high = (
            np.nanpercentile(table, p, axis=0).round(4).tolist() for p in (25, 50, 75)
        )
        x = list(range(1, length + 1))
        color = COLORS[name]
        band = {
            "type": "scatter",
            "x": x,
            "mode": "lines",
            "line": {"width": 0},
            "showlegend": False,
            "hoverinfo": "skip",
        }
        data += [
            {**band, "y": low},
            {**band, "y": high, "fill": "tonexty", "fillcolor": f"{color}33"},
            {
                "type": "scatter",
                "x": x,
                "y": middle,
                "mode": "lines",
                "name": f"{name} ({len(chosen)} episodes)",
                "line": {"width": 3, "color": color},
                "hovertemplate": "step %{x}<br>reward %{y:.3f}<extra></extra>",
            },
        ]
    layout = {
        "height": 320,
        "legend": {"orientation": "h", "y": 1.14},
        "xaxis": {"title": {"text": "control step"}},
        "yaxis": {"range": [0, 1.02], "title": {"text": "normalised dense reward"}},
    }
    return {"data": data, "layout": layout}


def _mean(values: np.ndarray) -> float | None:
    return round(float(values.mean()), 3) if len(values) else None


def _sentence(found: dict[str, Any]) -> str:
    told = (
        "no failure to compare with"
        if found["auc"] is None
        else f"AUC {found['auc']:.3f}"
    )
    return (
        f"{found['successes']} of {found['episodes']} episodes succeed; {told}. Lines: median of the episodes; bands: "
        "the middle half."
    )


def bench_reward(spec: RewardSpec) -> int:
    """Print and write the results of `measure_rewards`."""
    check_folder(spec.out)
    found = measure_rewards(spec)
    page = spec.out / REPORT
    columns = list(next(iter(found.values())))
    rows = [[kind, *(numbers[c] for c in columns)] for kind, numbers in found.items()]
    title = f"normalised dense reward, profile {spec.profile}"
    report(
        spec.json,
        {"profile": spec.profile, "subtasks": found, "report": str(page)},
        Listing(title, ("subtask", *columns), rows),
        f"Curves: {page}",
    )
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(
        "reward", RewardSpec, bench_reward, words, {"episodes": 1, "worlds": 1}
    )


if __name__ == "__main__":
    sys.exit(main())
