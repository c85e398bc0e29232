"""The tree of commands that tyro turns into ``mjhab --help``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mjhab.cli import data_options as data
from mjhab.cli import env_options as env
from mjhab.cli import expert_options as expert
from mjhab.cli import export_options as export
from mjhab.cli import generate_options as gen
from mjhab.cli import gpu_options as gpu
from mjhab.cli import options as opt
from mjhab.cli import reproduce_options as rep
from mjhab.cli import spawn_options as spawn
from mjhab.cli import train_options as learn
from mjhab.cli.options import Sub


@dataclass(frozen=True)
class BenchCommand:
    """Measure this machine and the physics."""

    command: (
        Annotated[opt.BenchSimOptions, Sub("sim")]
        | Annotated[opt.BenchGraspOptions, Sub("grasp")]
        | Annotated[env.BenchEnvOptions, Sub("env")]
        | Annotated[spawn.BenchSpawnOptions, Sub("spawn")]
        | Annotated[env.BenchSoakOptions, Sub("soak")]
        | Annotated[env.BenchRewardOptions, Sub("reward")]
        | Annotated[expert.BenchExpertsOptions, Sub("experts")]
        | Annotated[gpu.BenchInteractOptions, Sub("interact")]
        | Annotated[gpu.BenchParityOptions, Sub("parity")]
    )


Command = (
    Annotated[opt.EvalOptions, Sub("eval")]
    | Annotated[env.EnvsCommand, Sub("envs")]
    | Annotated[opt.HomesCommand, Sub("homes")]
    | Annotated[opt.AssetsCommand, Sub("assets")]
    | Annotated[opt.EpisodesCommand, Sub("episodes")]
    | Annotated[spawn.SpawnsCommand, Sub("spawns")]
    | Annotated[BenchCommand, Sub("bench")]
    | Annotated[gen.GenerateOptions, Sub("generate")]
    | Annotated[gen.ReplayOptions, Sub("replay")]
    | Annotated[learn.TrainCommand, Sub("train")]
    | Annotated[rep.ReproduceOptions, Sub("reproduce")]
    | Annotated[data.DataCommand, Sub("data")]
    | Annotated[data.LabelOptions, Sub("label")]
    | Annotated[export.ExportCommand, Sub("export")]
    | Annotated[gpu.WarmupOptions, Sub("warmup")]
    | Annotated[opt.DoctorOptions, Sub("doctor")]
)

RUNNERS: dict[type, tuple[str, str]] = {
    opt.EvalOptions: ("evaluate", "run_eval"),
    env.EnvsCommand: ("envs", "run_envs"),
    opt.HomesCommand: ("homes", "run_homes"),
    opt.AssetsCommand: ("assets", "run_assets"),
    opt.EpisodesCommand: ("episodes", "run_episodes"),
    spawn.SpawnsCommand: ("spawns", "run_spawns"),
    opt.BenchSimOptions: ("bench", "bench_sim"),
    opt.BenchGraspOptions: ("bench", "bench_grasp"),
    env.BenchEnvOptions: ("bench_env", "bench_env"),
    spawn.BenchSpawnOptions: ("spawns", "bench_spawn"),
    env.BenchSoakOptions: ("bench_soak", "bench_soak"),
    env.BenchRewardOptions: ("bench_reward", "bench_reward"),
    expert.BenchExpertsOptions: ("bench_experts", "bench_experts"),
    gpu.BenchInteractOptions: ("bench_interact", "bench_interact"),
    gpu.BenchParityOptions: ("bench_parity", "bench_parity"),
    gen.GenerateOptions: ("generate", "run_generate"),
    gen.ReplayOptions: ("replay", "run_replay"),
    learn.TrainCommand: ("train", "run_train"),
    rep.ReproduceOptions: ("reproduce", "run_reproduce"),
    data.DataCommand: ("data", "run_data"),
    data.LabelOptions: ("data", "run_data"),
    export.ExportCommand: ("export", "run_export"),
    gpu.WarmupOptions: ("warmup", "run_warmup"),
    opt.DoctorOptions: ("doctor", "run_doctor"),
}
"""Module of `mjhab.cli` and function that run a command, by its options or by those of its group; imported when it is
asked for, so that --help is quick."""
