"""The tree of commands that tyro turns into ``mjhab --help``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mjhab.cli import env_options as env
from mjhab.cli import options as opt
from mjhab.cli.options import Sub


@dataclass(frozen=True)
class BenchCommand:
    """Measure this machine and the physics."""

    command: (
        Annotated[opt.BenchSimOptions, Sub("sim")]
        | Annotated[opt.BenchGraspOptions, Sub("grasp")]
        | Annotated[env.BenchEnvOptions, Sub("env")]
        | Annotated[env.BenchSoakOptions, Sub("soak")]
        | Annotated[env.BenchRewardOptions, Sub("reward")]
    )


Command = (
    Annotated[opt.EvalOptions, Sub("eval")]
    | Annotated[env.EnvsCommand, Sub("envs")]
    | Annotated[opt.HomesCommand, Sub("homes")]
    | Annotated[opt.AssetsCommand, Sub("assets")]
    | Annotated[opt.EpisodesCommand, Sub("episodes")]
    | Annotated[BenchCommand, Sub("bench")]
    | Annotated[opt.DoctorOptions, Sub("doctor")]
)
