"""``mjhab envs``: list environments and describe their observations, actions and rewards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.config.env_spec import PROFILE, EnvSpec, env_options
from mjhab.core.typed.flags import Flag


@dataclass(frozen=True)
class EnvsListSpec:
    """List the environment ids of `gymnasium.make` and `gymnasium.make_vec` after `import mjhab`."""


@dataclass(frozen=True)
class EnvsDescribeSpec(EnvSpec):
    """Show the observations, the action table and the reward terms of an environment.

    For instance: `mjhab envs describe mjhab/PickSubtaskTrain-v1 --obs rgbd`
    """

    id: Annotated[str, Flag(metavar="ID", positional=True)]
    """The environment, e.g. mjhab/PickSubtaskTrain-v1 (see: mjhab envs list)."""
    env: Annotated[
        Mapping[str, Any], env_options(*PROFILE, "obs_mode", "control_mode")
    ] = field(default_factory=dict)
    """Its options."""


def list_envs(spec: EnvsListSpec, json: bool) -> int:
    """Print the ids."""
    from mjhab.envs.catalog import env_ids, plugin_of
    from mjhab.robots.registry import DEFAULT_ROBOT

    found = [
        {
            "id": env_id,
            "robot": DEFAULT_ROBOT,
            "subtask": None,
            "plugin": plugin_of(env_id),
            **chosen,
        }
        for env_id, chosen in env_ids().items()
    ]
    rows = [
        (env["id"], env["task"], env["subtask"] or "the whole chain", env["plugin"])
        for env in found
    ]
    report(
        json,
        {"envs": found},
        Listing("environments", ("id", "task (default)", "subtask", "plugin"), rows),
        'gymnasium.make_vec("mjhab/PickSubtaskTrain-v1", num_envs=16, task="set_table", obs_mode="depth", ...)',
    )
    return 0


def describe_env(spec: EnvsDescribeSpec, json: bool) -> int:
    """Print observations, actions and rewards of one environment."""
    found = description(spec)
    parts = {
        "observations": "observations",
        "actions": "actions",
        "reward_terms": "dense reward",
    }
    tables = [
        Listing(
            f"{found['id']}: {title}",
            list(found[part][0]),
            [[_text(v) for v in row.values()] for row in found[part]],
        )
        for part, title in parts.items()
        if found[part]
    ]
    modes = f"reward mode {found['reward_mode']}; horizons {found['horizons']} control steps of 50 ms"
    report(json, found, *tables, modes)
    return 0


def description(spec: EnvsDescribeSpec) -> dict[str, Any]:
    """Observations, actions and rewards of an environment, as JSON data."""
    from mjhab.envs import make_by_id
    from mjhab.tasks.household.registry import TASKS
    from mjhab.tasks.subtasks.registry import SUBTASKS, limits_of

    env = make_by_id(spec.id, num_envs=1, **spec.env)
    subtask = env.config.subtask
    kinds = [subtask] if subtask else TASKS[env.config.task].subtasks
    tables = {kind: SUBTASKS[kind].reward for kind in kinds}
    found = {
        "id": spec.id,
        "profile": env.config.profile,
        "observations": [
            {k: _plain(v) for k, v in row.items()} for row in env.observer.describe(kinds)
        ],
        "actions": [
            {k: _plain(v) for k, v in asdict(row).items()} for row in env.action_table
        ],
        "reward_mode": env.config.reward,
        "reward_terms": [
            {
                "subtask": kind,
                **{k: _plain(v) for k, v in asdict(row).items()},
            }
            for kind, table in tables.items()
            if table is not None
            for row in table.terms
        ],
        "horizons": {kind: limits_of(env.task_config, kind).horizon for kind in kinds},
    }
    env.close()
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and abs(value) == float("inf"):
        # JSON has no infinity, which bounds of observations are full of.
        return str(value)
    return (
        value if isinstance(value, int | float | str | list | bool | None) else str(value)
    )


def _text(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:g}"
    return "×".join(str(v) for v in value) if isinstance(value, list) else value
