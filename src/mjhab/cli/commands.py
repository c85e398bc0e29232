"""The tree of commands that tyro turns into ``mjhab --help``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mjhab.cli.options import (
    assets,
    engine,
    env,
    episodes,
    expert,
    gpu,
    homes,
    machine,
    spawn,
)
from mjhab.cli.options import view as look
from mjhab.cli.options.common import Sub
from mjhab.cli.options.datasets import data, export
from mjhab.cli.options.datasets import generate as gen
from mjhab.cli.options.policies import evaluate as evals
from mjhab.cli.options.policies import reproduce as rep
from mjhab.cli.options.policies import score as sco
from mjhab.cli.options.policies import serve as srv
from mjhab.cli.options.policies import train as learn


@dataclass(frozen=True)
class BenchCommand:
    """Measure this machine and the physics."""

    command: (
        Annotated[engine.BenchSimOptions, Sub("sim")]
        | Annotated[engine.BenchScalingOptions, Sub("scaling")]
        | Annotated[engine.BenchGraspOptions, Sub("grasp")]
        | Annotated[env.BenchEnvOptions, Sub("env")]
        | Annotated[spawn.BenchSpawnOptions, Sub("spawn")]
        | Annotated[env.BenchSoakOptions, Sub("soak")]
        | Annotated[data.BenchWindowsOptions, Sub("windows")]
        | Annotated[env.BenchRewardOptions, Sub("reward")]
        | Annotated[expert.BenchExpertsOptions, Sub("experts")]
        | Annotated[gpu.BenchInteractOptions, Sub("interact")]
        | Annotated[gpu.BenchParityOptions, Sub("parity")]
        | Annotated[srv.BenchServingOptions, Sub("serving")]
        | Annotated[look.BenchViewOptions, Sub("view")]
        | Annotated[learn.BenchLearnerOptions, Sub("learner")]
        | Annotated[learn.BenchCurvesOptions, Sub("curves")]
    )


Command = (
    Annotated[evals.DemoOptions, Sub("demo")]
    | Annotated[evals.EvalOptions, Sub("eval")]
    | Annotated[env.EnvsCommand, Sub("envs")]
    | Annotated[env.RobotsCommand, Sub("robots")]
    | Annotated[homes.HomesCommand, Sub("homes")]
    | Annotated[assets.AssetsCommand, Sub("assets")]
    | Annotated[episodes.EpisodesCommand, Sub("episodes")]
    | Annotated[spawn.SpawnsCommand, Sub("spawns")]
    | Annotated[BenchCommand, Sub("bench")]
    | Annotated[sco.ScoreOptions, Sub("score")]
    | Annotated[srv.ServeOptions, Sub("serve")]
    | Annotated[gen.GenerateOptions, Sub("generate")]
    | Annotated[gen.ReplayOptions, Sub("replay")]
    | Annotated[look.ViewOptions, Sub("view")]
    | Annotated[learn.TrainCommand, Sub("train")]
    | Annotated[rep.ReproduceOptions, Sub("reproduce")]
    | Annotated[data.DataCommand, Sub("data")]
    | Annotated[data.LabelOptions, Sub("label")]
    | Annotated[export.ExportCommand, Sub("export")]
    | Annotated[machine.ExamplesOptions, Sub("examples")]
    | Annotated[gpu.WarmupOptions, Sub("warmup")]
    | Annotated[machine.DoctorOptions, Sub("doctor")]
)

RUNNERS: dict[type, tuple[str, str]] = {
    evals.DemoOptions: ("cli.policies.evaluate", "run_demo"),
    evals.EvalOptions: ("cli.policies.evaluate", "run_eval"),
    env.EnvsCommand: ("cli.worlds.envs", "run_envs"),
    env.RobotsCommand: ("cli.worlds.robots", "run_robots"),
    homes.HomesCommand: ("cli.worlds.homes", "run_homes"),
    assets.AssetsCommand: ("cli.worlds.assets", "run_assets"),
    episodes.EpisodesCommand: ("cli.worlds.episodes", "run_episodes"),
    spawn.SpawnsCommand: ("cli.worlds.spawns", "run_spawns"),
    engine.BenchSimOptions: ("cli.bench.engine", "bench_sim"),
    engine.BenchScalingOptions: ("cli.bench.scaling", "bench_scaling"),
    engine.BenchGraspOptions: ("cli.bench.engine", "bench_grasp"),
    env.BenchEnvOptions: ("cli.bench.env", "bench_env"),
    spawn.BenchSpawnOptions: ("cli.worlds.spawns", "bench_spawn"),
    env.BenchSoakOptions: ("cli.bench.soak", "bench_soak"),
    data.BenchWindowsOptions: ("cli.bench.windows", "bench_windows"),
    env.BenchRewardOptions: ("cli.bench.reward", "bench_reward"),
    expert.BenchExpertsOptions: ("cli.bench.experts", "bench_experts"),
    gpu.BenchInteractOptions: ("cli.bench.interact", "bench_interact"),
    gpu.BenchParityOptions: ("cli.bench.parity", "bench_parity"),
    srv.BenchServingOptions: ("cli.bench.serving", "bench_serving"),
    look.BenchViewOptions: ("cli.bench.view", "bench_view"),
    learn.BenchLearnerOptions: ("cli.bench.learner", "bench_learner"),
    learn.BenchCurvesOptions: ("cli.bench.curves", "bench_curves"),
    sco.ScoreOptions: ("cli.policies.score", "run_score"),
    srv.ServeOptions: ("cli.policies.serve", "run_serve"),
    gen.GenerateOptions: ("cli.datasets.generate", "run_generate"),
    gen.ReplayOptions: ("cli.datasets.replay", "run_replay"),
    look.ViewOptions: ("cli.view", "run_view"),
    learn.TrainCommand: ("cli.policies.train", "run_train"),
    rep.ReproduceOptions: ("cli.policies.reproduce", "run_reproduce"),
    data.DataCommand: ("cli.datasets.data", "run_data"),
    data.LabelOptions: ("cli.datasets.data", "run_data"),
    export.ExportCommand: ("cli.datasets.export", "run_export"),
    machine.ExamplesOptions: ("cli.machine.examples", "run_examples"),
    gpu.WarmupOptions: ("cli.machine.warmup", "run_warmup"),
    machine.DoctorOptions: ("cli.machine.doctor", "run_doctor"),
}
"""Module (below ``mjhab``) and function that run a command, by the class of its options or of its group. Modules are
imported when the command runs, so that --help is fast."""
