"""Entry point of the ``mjhab`` command: parse, run the command, turn errors into exit codes."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import tyro

import mjhab
from mjhab.cli import commands
from mjhab.cli import data_options as data
from mjhab.cli import env_options as env
from mjhab.cli import export_options as export
from mjhab.cli import generate_options as gen
from mjhab.cli import gpu_options as gpu
from mjhab.cli import options as opt
from mjhab.cli import spawn_options as spawn
from mjhab.core.errors import MjhabError, UsageError

DESCRIPTION = f"""mjhab {mjhab.__version__}: home assistant tasks with low-level whole-body control, on MuJoCo.

A Fetch robot tidies furnished homes with real physics. Begin with `mjhab doctor` and
`mjhab eval --task set_table --policy expert --episodes 4 --out runs/first`."""

Parsed = (
    opt.EvalOptions
    | env.EnvsCommand
    | opt.HomesCommand
    | opt.AssetsCommand
    | opt.EpisodesCommand
    | spawn.SpawnsCommand
    | gen.GenerateOptions
    | gen.ReplayOptions
    | data.DataCommand
    | data.LabelOptions
    | export.ExportCommand
    | commands.BenchCommand
    | gpu.WarmupOptions
    | opt.DoctorOptions
)
OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line ``args`` (``sys.argv`` if None) and return the exit code.

    0: done; 1: a command failed; 2: it was asked for something that cannot work; 130: Ctrl-C.
    """
    try:
        return run(parse(args))
    except UsageError as error:
        print(f"mjhab: {error}", file=sys.stderr)
        return USAGE
    except MjhabError as error:
        print(f"mjhab: failed: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("mjhab: interrupted.", file=sys.stderr)
        return INTERRUPTED


def parse(args: Sequence[str] | None) -> Parsed:
    """Parse a command line; exits with code 2 and a message if it does not fit."""
    return tyro.cli(
        commands.Command,  # type: ignore[arg-type]
        prog="mjhab",
        description=DESCRIPTION,
        args=args,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def staged(options: Any) -> Any:
    """Options whose ``articulate`` and ``stage_mesh`` went into the name of their asset pack, where the rest looks."""
    if hasattr(options, "command"):
        return dataclasses.replace(options, command=staged(options.command))
    joints, stage = getattr(options, "articulate", None), getattr(options, "stage_mesh", None)
    if joints is None and stage is None:
        return options
    from mjhab.scenes.packs import with_joints, with_stage

    assets = with_stage(with_joints(options.assets, joints), stage)
    return dataclasses.replace(options, assets=assets, stage_mesh=None, articulate=None)


def run(command: Parsed) -> int:
    """Run a parsed command and return the exit code."""
    command = staged(command)
    if isinstance(command, opt.EvalOptions):
        from mjhab.cli.evaluate import run_eval

        return run_eval(command)
    if isinstance(command, env.EnvsCommand):
        from mjhab.cli.envs import run_envs

        return run_envs(command.command)
    if isinstance(command, opt.HomesCommand):
        from mjhab.cli.homes import run_homes

        return run_homes(command.command)
    if isinstance(command, opt.AssetsCommand):
        from mjhab.cli.assets import run_assets

        return run_assets(command.command)
    if isinstance(command, opt.EpisodesCommand):
        from mjhab.cli.episodes import run_episodes

        return run_episodes(command.command)
    if isinstance(command, spawn.SpawnsCommand):
        from mjhab.cli.spawns import run_spawns

        return run_spawns(command.command)
    if isinstance(command, gen.GenerateOptions):
        from mjhab.cli.generate import run_generate

        return run_generate(command)
    if isinstance(command, gen.ReplayOptions):
        from mjhab.cli.replay import run_replay

        return run_replay(command)
    if isinstance(command, data.DataCommand | data.LabelOptions):
        from mjhab.cli.data import run_data

        return run_data(command)
    if isinstance(command, export.ExportCommand):
        from mjhab.cli.export import run_export

        return run_export(command.command)
    if isinstance(command, commands.BenchCommand):
        from mjhab.cli.bench import run_bench

        return run_bench(command.command)
    if isinstance(command, gpu.WarmupOptions):
        from mjhab.cli.warmup import run_warmup

        return run_warmup(command)
    from mjhab.cli.doctor import run_doctor

    return run_doctor(command)


if __name__ == "__main__":
    sys.exit(main())
