"""Training and evaluation of the policies of a reproduction; finished parts are reused."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.core.errors import fault
from mjhab.core.files.cache import write_json, write_text
from mjhab.core.files.reading import read_json_object
from mjhab.core.files.run_folder import CONFIG, RunFolder
from mjhab.evaluation.evaluate import EvalSpec, run_evaluation
from mjhab.learning.assigned.entries import Entry
from mjhab.learning.assigned.files import entries_text
from mjhab.learning.require import require_learn
from mjhab.learning.runs.run import TrainingFolder
from mjhab.paper.reproduce.results import measured, untrained, write_results
from mjhab.paper.reproduce.rows import (
    FOR_ALL,
    STUDENTS,
    TableRow,
    algorithm_of,
    policy_targets,
)
from mjhab.paper.reproduce.spec import (
    TRAINED_IN,
    TableSpec,
    chosen_rows,
    chosen_variants,
    env_of,
    policy_rows,
    table_config,
)
from mjhab.paper.reproduce.variants import REWARDED, STUDIES, Reinforcement, Variant
from mjhab.rollout.sinks import Sink

if TYPE_CHECKING:
    from mjhab.learning.runs.run import TrainingResult

ROW = "row.json"
TRAIN = "train"
STUDENT = "student.safetensors"
POLICIES = "policies.json"
EPISODES_ON_THE_WAY = 32
"""Of each evaluation on the way of a study of reinforcement learning; the paper has 189, every 100,000 samples."""


class TableFolder(RunFolder):
    """The folder of a table of the paper."""

    WORK = (*TrainingFolder.WORK, ROW)


Sinks = Callable[[EvalSpec], Sequence[Sink]]
"""Makes the listeners of an evaluation, for instance a progress bar."""


def reproduce(
    spec: TableSpec,
    sinks: Sinks = lambda judging: (),
    tell: Callable[[TableRow], object] = bool,
) -> tuple[list[dict[str, Any]], bool]:
    """Train and evaluate the policies of every row, and write the results after each row. Finished parts are reused.

    With ``spec.variants`` only these are made; the results show those that the folder has from earlier starts, too.

    Args:
        spec: the request.
        sinks: makes the listeners of each evaluation.
        tell: called with every row before it starts.

    Returns:
        The rows as `results.result_of` returns them, and whether Ctrl-C interrupted the run (finished parts are kept).

    Raises:
        UsageError: a name is unknown, or the folder holds another run; then nothing was written.
    """
    require_learn()
    rows = chosen_rows(spec)
    config = table_config(spec)
    interrupted = False
    with TableFolder.open(spec.out, config, resume=spec.resume):
        try:
            for row in rows:
                tell(row)
                make_row(spec, row, sinks)
                write_results(spec.out, rows)
        except KeyboardInterrupt:
            interrupted = True
    return write_results(spec.out, rows), interrupted


def make_row(spec: TableSpec, row: TableRow, sinks: Sinks) -> None:
    """Train and evaluate the policies of the requested variants of a row, unless that is done already.

    Every variant is kept as soon as it is done. One with a policy that was never updated, because the budget ended
    before, is not evaluated.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; finished parts are kept.
    """
    folder = spec.out / row.folder
    path = folder / ROW
    found = read_json_object(path) if path.is_file() else {}
    missing = [variant for variant in chosen_variants(spec) if variant.name not in found]
    if not missing:
        return
    trained: list[Trained] = []
    if spec.what not in (*STUDIES, *REWARDED):
        trained = [
            (part, target, policy_run(spec, part, target))
            for part in policy_rows(row)
            for target in policy_targets(part, spec.column)
        ]
    for variant in missing:
        if variant.imitation is not None:
            trained = [(row, row.target, study_run(spec, row, variant))]
        if variant.reinforcement is not None:
            trained = rewarded_runs(spec, row, variant.name, variant.reinforcement)
        runs = [run for _, _, run in trained]
        if untrained(runs):
            judged = []
        elif row.subtask:
            judged = _judge_policies(spec, row, trained, variant, sinks)
        else:
            judged = [_judge_task(spec, row, trained, variant, sinks)]
        found[variant.name] = measured(runs, judged)
        # After every variant: training takes hours, and an interrupt must cost one only.
        write_json(path, found)


Trained = tuple[TableRow, str, Path]
"""Row and target of a policy, and the folder of its training run."""


def _judge_policies(
    spec: TableSpec,
    row: TableRow,
    trained: Sequence[Trained],
    variant: Variant,
    sinks: Sinks,
) -> list[Path]:
    """Evaluate each policy of a row in its share of the episodes; returns the run folders."""
    # Rounded up, so that every policy is judged as often as the others.
    share = -(-spec.episodes // len(trained))
    return [
        judge(
            spec,
            EvalSpec.of(
                policy=str(run / STUDENT),
                task=row.task,
                subtask=row.subtask,
                target=target or None,
                episodes=share,
                env=variant.env_options(spec.of_profile, row.subtask),
                out=_policy_folder(spec.out, row, target) / variant.name,
            ),
            sinks,
        )
        for _, target, run in trained
    ]


def _judge_task(
    spec: TableSpec,
    row: TableRow,
    trained: Sequence[Trained],
    variant: Variant,
    sinks: Sinks,
) -> Path:
    """Evaluate the policies of all subtasks together in a whole task; returns the run folder."""
    folder = spec.out / row.folder
    entries = []
    for part, target, run in trained:
        # The policies file refers to checkpoints below its own folder, so that both can be moved together.
        copy = (
            folder
            / POLICIES.removesuffix(".json")
            / f"{_name_of(part, target)}.safetensors"
        )
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(run / STUDENT, copy)
        entries.append(Entry(part.subtask, target, str(copy)))
    policies = folder / POLICIES
    write_text(policies, entries_text(policies, entries))
    judging = EvalSpec.of(
        policy=str(policies),
        task=row.task,
        episodes=spec.episodes,
        env=variant.env_options(spec.of_profile, ""),
        out=folder / variant.name,
    )
    return judge(spec, judging, sinks)


def judge(spec: TableSpec, judging: EvalSpec, sinks: Sinks) -> Path:
    """Run or complete an evaluation with the options that all evaluations of a reproduction share."""
    from mjhab.learning.runs.evaluation import EVALUATION_SEED

    assert judging.out is not None
    shared = {
        "num_envs": spec.asked.num_envs,
        # Apart from the seeds of training, so that policies meet other episodes.
        "seed": EVALUATION_SEED + spec.asked.seed,
        "split": spec.asked.split,
        "assets": spec.asked.assets,
        "threads": spec.asked.threads,
    }
    full = dataclasses.replace(
        judging,
        env={**judging.env, **shared},
        films=spec.films,
        resume=(judging.out / CONFIG).is_file(),
    )
    run_evaluation(full, sinks(full))
    return judging.out


def study_run(spec: TableSpec, row: TableRow, variant: Variant) -> Path:
    """Return the training folder of a policy of a study; trains the policy if necessary.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; finished parts are kept.
    """
    from mjhab.paper.reproduce.studies import train_imitation

    assert variant.imitation is not None
    folder = spec.out / row.folder
    run = folder / TRAIN / variant.name
    resume = (run / CONFIG).is_file()
    if train_imitation(spec, row, variant.imitation, folder, run, resume).interrupted:
        # The training has saved itself; what follows would need its policy.
        raise KeyboardInterrupt
    return run


def rewarded_runs(
    spec: TableSpec, row: TableRow, name: str, training: Reinforcement
) -> list[Trained]:
    """Return the policies of a row in a study of reinforcement learning; trains them if necessary.

    Args:
        spec: the request.
        row: of Table 1.
        name: of the variant.
        training: how they are trained.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; finished parts are kept.
    """
    found = []
    for target in policy_targets(row, training.column):
        run = spec.out / row.folder / TRAIN / name / target.replace("/", ".")
        if _train_rewarded(spec, row, target, run, training).interrupted:
            raise KeyboardInterrupt
        found.append((row, target, run))
    return found


def policy_run(spec: TableSpec, row: TableRow, target: str) -> Path:
    """Return the training folder of a policy; trains the policy if necessary.

    Raises:
        UsageError: ``spec.policies`` names an earlier reproduction that lacks the policy.
        KeyboardInterrupt: Ctrl-C was pressed; finished parts are kept.
    """
    if spec.policies is not None:
        run = _policy_folder(spec.policies, row, target) / TRAIN
        if not (run / STUDENT).is_file():
            raise fault(
                spec.policies,
                f"has no policy for {_name_of(row, target)}: there is no {run / STUDENT}.",
            )
        return run
    run = _policy_folder(spec.out, row, target) / TRAIN
    result = _train(spec, row, target, run)
    if result.interrupted:
        raise KeyboardInterrupt
    return run


def _policy_folder(out: Path, row: TableRow, target: str) -> Path:
    """Folder of a policy's runs: that of its row, or a subfolder if the row has several policies."""
    folder = out / row.folder
    return folder if target == row.target else folder / target.replace("/", ".")


def _name_of(row: TableRow, target: str) -> str:
    return row.folder if target == row.target else f"{row.folder}.{target}"


def _train(spec: TableSpec, row: TableRow, target: str, run: Path) -> TrainingResult:
    """Train a policy, or continue its training."""
    if spec.column != STUDENTS:
        return _train_rewarded(spec, row, target, run, Reinforcement(spec.column))
    from mjhab.learning.devices import CPU
    from mjhab.learning.runs.specs import DaggerSpec
    from mjhab.learning.train import train_spec

    common = _training_options(spec, row, target, run)
    # Only imitation: presets of reinforcement learning have their own number of worlds.
    common["env"]["num_envs"] = spec.asked.num_envs
    return train_spec(
        DaggerSpec(device=spec.device or CPU, preset=spec.preset_name, **common)
    )


def _train_rewarded(
    spec: TableSpec, row: TableRow, target: str, run: Path, training: Reinforcement
) -> TrainingResult:
    """Train a policy by reinforcement learning, or continue its training."""
    from mjhab.learning.reinforcement.configs import reinforcement_preset
    from mjhab.learning.reinforcement.specs import ReinforcementSpec
    from mjhab.learning.train import train_spec

    common = _training_options(spec, row, target, run)
    common["env"] |= {
        "backend": spec.asked.backend,
        "device": spec.device,
        "seed": spec.asked.seed + training.seed_shift,
    }
    algorithm = training.algorithm or algorithm_of(row, training.column)
    # Studies show how the policies learn; the others only what they are worth in the end.
    watched = EPISODES_ON_THE_WAY if spec.what in REWARDED else 0
    return train_spec(
        ReinforcementSpec(
            preset=reinforcement_preset(algorithm, spec.preset_name),
            **{**common, "round_episodes": watched},
        )
    )


def _training_options(
    spec: TableSpec, row: TableRow, target: str, run: Path
) -> dict[str, Any]:
    """Options that all trainings of a reproduction have in common."""
    return {
        "out": run,
        "set": spec.set,
        "env": env_of(spec, row, target or FOR_ALL),
        "budget_minutes": spec.budget_minutes,
        # Rows are judged together afterwards, by the rules of every variant.
        "eval_episodes": 0,
        "round_episodes": 0,
        "eval_split": TRAINED_IN,
        "resume": (run / CONFIG).is_file(),
    }
