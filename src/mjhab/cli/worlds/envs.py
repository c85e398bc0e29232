"""``mjhab envs``: list environments and describe their observations, actions and rewards."""

from __future__ import annotations

from typing import Any

from mjhab.cli.options.env import EnvsDescribeOptions, EnvsListOptions
from mjhab.cli.output import print_json, print_table
from mjhab.config.profile_choice import profile_options


def run_envs(options: EnvsListOptions | EnvsDescribeOptions) -> int:
    """Run one of the commands and return the exit code."""
    return (
        list_envs(options)
        if isinstance(options, EnvsListOptions)
        else describe_env(options)
    )


def list_envs(options: EnvsListOptions) -> int:
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
    if options.json:
        print_json({"envs": found})
    else:
        rows = [
            (env["id"], env["task"], env["subtask"] or "the whole chain", env["plugin"])
            for env in found
        ]
        print_table("environments", ("id", "task (default)", "subtask", "plugin"), rows)
        print(
            'gymnasium.make_vec("mjhab/PickSubtaskTrain-v1", num_envs=16, task="set_table", obs_mode="depth", ...)'
        )
    return 0


def describe_env(options: EnvsDescribeOptions) -> int:
    """Print observations, actions and rewards of one environment."""
    found = description(options)
    if options.json:
        print_json(found)
        return 0
    for title, part in (
        ("observations", "observations"),
        ("actions", "actions"),
        ("dense reward", "reward_terms"),
    ):
        rows: list[dict[str, Any]] = found[part]
        if rows:
            print_table(
                f"{found['id']}: {title}",
                list(rows[0]),
                [[_text(v) for v in r.values()] for r in rows],
            )
    print(
        f"reward mode {found['reward_mode']}; horizons {found['horizons']} control steps of 50 ms"
    )
    return 0


def description(options: EnvsDescribeOptions) -> dict[str, Any]:
    """Observations, actions and rewards of an environment, as JSON data."""
    import dataclasses

    from mjhab.envs import make_by_id
    from mjhab.tasks.household.registry import TASKS
    from mjhab.tasks.subtasks.registry import SUBTASKS, limits_of

    env = make_by_id(
        options.env,
        num_envs=1,
        obs_mode=options.obs,
        control_mode=options.control,
        **profile_options(options),
    )
    subtask = env.config.subtask
    kinds = [subtask] if subtask else TASKS[env.config.task].subtasks
    tables = {kind: SUBTASKS[kind].reward for kind in kinds}
    found = {
        "id": options.env,
        "profile": env.config.profile,
        "observations": [
            {k: _plain(v) for k, v in row.items()} for row in env.observer.describe(kinds)
        ],
        "actions": [
            {k: _plain(v) for k, v in dataclasses.asdict(row).items()}
            for row in env.action_table
        ],
        "reward_mode": env.config.reward,
        "reward_terms": [
            {
                "subtask": kind,
                **{k: _plain(v) for k, v in dataclasses.asdict(row).items()},
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
        return str(value)
    return (
        value if isinstance(value, int | float | str | list | bool | None) else str(value)
    )


def _text(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:g}"
    return "×".join(str(v) for v in value) if isinstance(value, list) else value
