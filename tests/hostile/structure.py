"""Structure-aware fuzz of data: one part of a valid file becomes something else, and every reader is asked.

The outcome is data or an error of ours (`MjhabError`, exit code 1 or 2). `python -m tests.hostile.structure 2000` tries
as many draws of every kind of file, and prints what ended in a traceback.
"""

from __future__ import annotations

import contextlib
import io
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.cli.main import main
from mjhab.core.errors import MjhabError
from mjhab.data.record.generation import generate
from mjhab.data.record.job import GENERATION_CONFIG, TRIED
from mjhab.data.select.sets import stats
from mjhab.data.store.checking import check, repair
from mjhab.data.store.episode_data import episode_digest
from mjhab.data.store.hdf5 import put_attributes, read_arrays
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes
from mjhab.evaluation import evaluate
from tests.data.export.exporting import to_maniskill
from tests.data.fake_world import FakeEnv
from tests.data.make import record, record_pictures
from tests.data.record.worker_pools import KEEP, InlinePool, job
from tests.hostile.mutations import changed_json
from tests.rollout.fake_env import FakeEnv as RolloutEnv

SLOW_SECONDS = 5.0


@dataclass(frozen=True)
class Subject:
    """A kind of file. make: writes valid ones into a folder. change: changes a part. read: all readers of them; whether
    none refused."""

    make: Callable[[Path], None]
    change: Callable[[Path, random.Random], None]
    read: Callable[[Path], bool]


# -- changes -----------------------------------------------------------------------------------------------------------


def change_json_file(path: Path, draw: random.Random) -> None:
    path.write_bytes(changed_json(path.read_bytes(), draw))


def change_json_line(path: Path, draw: random.Random) -> None:
    lines = path.read_bytes().splitlines()
    number = draw.randrange(len(lines))
    lines[number] = changed_json(lines[number], draw)
    path.write_bytes(b"".join(line + b"\n" for line in lines))


ARRAYS: tuple[Callable[[np.ndarray], Any], ...] = (
    lambda a: a[:0],
    lambda a: a[:-1] if a.ndim else a,
    lambda a: a[..., None],
    lambda a: a.ravel(),
    lambda a: a.astype("f4"),
    lambda a: a.astype("c8"),
    lambda a: a.astype("i8") - 2**62,
    lambda a: np.full(a.shape, 255, a.dtype),
    lambda a: np.full(a.shape, np.nan),
    lambda a: np.zeros((3, 3)),
    lambda a: np.bytes_(b"\xff\x00text"),
    lambda a: "a text of any length",
    lambda a: np.zeros(2, [("a", "f4"), ("b", "i2")]),
    lambda a: 3,
)
ATTRIBUTES: tuple[Any, ...] = (
    np.zeros((3, 3)),
    np.bytes_(b"\xff\xfe../../x"),
    "text",
    "",
    -5,
    2**62,
    float("nan"),
    True,
    h5py.Empty("f4"),
    np.zeros(2, [("a", "f4")]),
)


def change_hdf5(path: Path, draw: random.Random) -> None:
    """Replace a dataset, an attribute or a group of an HDF5 file; where episodes have digests, they fit mostly."""
    with h5py.File(path, "r+") as file:
        items: list[h5py.Group | h5py.Dataset] = [file]
        file.visititems(lambda _, item: items.append(item))
        datasets = [item for item in items if isinstance(item, h5py.Dataset)]
        way = draw.random()
        if way < 0.35:
            _change_json_dataset(draw.choice(_texts(datasets) or datasets), draw)
        elif way < 0.65:
            _replace(draw.choice(datasets), draw)
        elif way < 0.9:
            item = draw.choice([item for item in items if len(item.attrs)] or items)
            name = draw.choice([*item.attrs] or ["format"])
            if name in item.attrs:
                del item.attrs[name]
            if draw.random() < 0.9:
                item.attrs[name] = draw.choice(ATTRIBUTES)
        else:
            _replace_group(draw.choice(items[1:]), draw)
        if draw.random() < 0.9:
            _fit_digests(file)


def _texts(datasets: list[h5py.Dataset]) -> list[h5py.Dataset]:
    """Datasets that hold JSON."""
    return [
        item
        for item in datasets
        if item.dtype == np.uint8 and item.ndim == 1 and item.size and item[0] == ord("{")
    ]


def _change_json_dataset(item: h5py.Dataset, draw: random.Random) -> None:
    try:
        text = changed_json(bytes(item[()]), draw).decode()
    except (ValueError, TypeError):
        _replace(item, draw)
        return
    _put(item, np.frombuffer(text.encode(), np.uint8))


def _replace(item: h5py.Dataset, draw: random.Random) -> None:
    with contextlib.suppress(ValueError, TypeError, IndexError):
        _put(item, draw.choice(ARRAYS)(item[()]))


def _put(item: h5py.Dataset, value: Any) -> None:
    parent: Any = item.parent
    name = item.name
    attributes = dict(item.attrs)
    del parent[name]
    parent[name] = value
    parent[name].attrs.update(attributes)


def _replace_group(item: h5py.Group | h5py.Dataset, draw: random.Random) -> None:
    parent: Any = item.parent
    name = item.name
    del parent[name]
    kind = draw.randrange(4)
    if kind == 0:
        parent.create_group(name)
    elif kind == 1:
        parent[name] = h5py.SoftLink("/")
    elif kind == 2:
        parent[name] = h5py.ExternalLink("other.h5", "/")


def _fit_digests(file: h5py.File) -> None:
    found = file.get("episodes")
    if not isinstance(found, h5py.Group):
        return
    for episode in found.values():
        if isinstance(episode, h5py.Group) and "digest" in episode.attrs:
            with contextlib.suppress(Exception):
                put_attributes(episode, {"digest": episode_digest(read_arrays(episode))})


# -- readers -----------------------------------------------------------------------------------------------------------


def asked(*acts: Callable[[], Any]) -> bool:
    """Call readers, each of which gives data or raises an error of ours; whether all gave data."""
    refused = 0
    for act in acts:
        try:
            act()
        except MjhabError:
            refused += 1
    return not refused


def command(*words: object) -> bool:
    """Run a command; its exit code says that it succeeded, failed or refused, and errors are one line. Whether it
    succeeded."""
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    assert code in (0, 1, 2), f"exit code {code} of {words}"
    assert "Traceback" not in err.getvalue()
    return code == 0


def make_shard(folder: Path) -> None:
    env = FakeEnv(subtask="pick", images=True)
    record(folder / "a.h5", range(2), env, images=ImageFormat())


def read_shard(folder: Path) -> bool:
    path = folder / "a.h5"

    def read_all() -> None:
        for episode in episodes(path):
            for name in episode.paths:
                episode.array(name)
                episode.columns(name)
            episode.observation("extra/is_grasped")
            episode.history(0)
            episode.initial()
            for camera, output in episode.images:
                episode.frame(camera, output, episode.steps)

    return all(
        [
            asked(
                lambda: check(path),
                read_all,
                lambda: stats(path),
                lambda: to_maniskill(path, folder / "m"),
            ),
            command(
                "data", "query", path, "--where", "steps > 0 and seed >= 0", "--json"
            ),
            command("data", "stats", path, "--json"),
            command("label", path),
            asked(lambda: repair(path)),
        ]
    )


def replay_shard(folder: Path) -> bool:
    """Takes seconds: it builds an environment for every draw."""
    return command("replay", folder / "a.h5", "--verify")


def make_export(folder: Path) -> None:
    record_pictures(folder / "a.h5", range(2))
    to_maniskill(folder / "a.h5", folder / "set")
    for file in (folder / "set").rglob("*.*"):
        if file.suffix in (".h5", ".json"):
            shutil.move(file, folder / f"b{file.suffix}")
    shutil.rmtree(folder / "set")


def read_import(folder: Path) -> bool:
    taken = command(
        "data",
        "import",
        "ms_hab",
        folder / "b.h5",
        "--task",
        "set_table",
        "--out",
        folder / "in",
    )
    written = [*(folder / "in").rglob("*.h5")] if (folder / "in").is_dir() else []
    for path in written:
        report = check(path)
        assert not report.damaged, report.damaged
    return taken and bool(written)


RUN = ("--policy", "zero", "--episodes", "4", "--worlds", "2", "--films", "0", "--json")


def make_run(folder: Path) -> None:
    with _without_physics():
        command("eval", *RUN, "--out", folder / "run")


def read_run(folder: Path) -> bool:
    with _without_physics():
        resumed = command("eval", *RUN, "--resume", "--out", folder / "run")
        # Read, and refused: these are not runs of one subtask.
        command("eval", *RUN, "--alone", folder / "run", "--out", folder / "other")
    return resumed


@contextlib.contextmanager
def _without_physics() -> Iterator[None]:
    real = evaluate.make_env
    evaluate.make_env = lambda spec, options: RolloutEnv(2)  # type: ignore[assignment,return-value]
    try:
        yield
    finally:
        evaluate.make_env = real


def make_set(folder: Path) -> None:
    generate(job(folder / "set", KEEP, episodes=6), InlinePool())


def read_set(folder: Path) -> bool:
    again = job(folder / "set", KEEP, episodes=6)
    return asked(lambda: generate(again, InlinePool(), resume=True))


def _changing(
    change: Callable[[Path, random.Random], None], name: str
) -> Callable[[Path, random.Random], None]:
    return lambda folder, draw: change(folder / name, draw)


SUBJECTS: dict[str, Subject] = {
    "shard": Subject(make_shard, _changing(change_hdf5, "a.h5"), read_shard),
    "replay": Subject(make_shard, _changing(change_hdf5, "a.h5"), replay_shard),
    "ms_hab JSON": Subject(
        make_export, _changing(change_json_file, "b.json"), read_import
    ),
    "ms_hab HDF5": Subject(make_export, _changing(change_hdf5, "b.h5"), read_import),
    "run config": Subject(
        make_run, _changing(change_json_file, "run/config.json"), read_run
    ),
    "run summary": Subject(
        make_run, _changing(change_json_file, "run/summary.json"), read_run
    ),
    "generation config": Subject(
        make_set, _changing(change_json_file, f"set/{GENERATION_CONFIG}"), read_set
    ),
    "tried episodes": Subject(
        make_set, _changing(change_json_line, f"set/{TRIED}"), read_set
    ),
    "run records": Subject(
        make_run, _changing(change_json_line, "run/episodes.jsonl"), read_run
    ),
}


def try_draws(
    name: str, seeds: range, template: Path, work: Path
) -> Iterator[tuple[int, float]]:
    """Change a fresh copy of ``template`` for every seed and read it; yields seed and duration [s].

    Raises:
        Exception: of a reader that ended in a traceback.
    """
    subject = SUBJECTS[name]
    for seed in seeds:
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(template, work)
        subject.change(work, random.Random(f"{name}{seed}"))
        begun = time.perf_counter()
        subject.read(work)
        yield seed, time.perf_counter() - begun


def _count(draws: int, names: list[str]) -> None:
    for name in names or SUBJECTS:
        with tempfile.TemporaryDirectory() as folder:
            template = Path(folder) / "template"
            template.mkdir()
            SUBJECTS[name].make(template)
            seen: Counter[str] = Counter()
            for seed in range(draws):
                try:
                    for _, seconds in try_draws(
                        name, range(seed, seed + 1), template, Path(folder) / "work"
                    ):
                        if seconds > SLOW_SECONDS:
                            print(f"{name} {seed}: {seconds:.0f} s", flush=True)
                except Exception as error:
                    places = traceback.extract_tb(error.__traceback__)[-4:]
                    where = " ".join(
                        f"{Path(p.filename).name}:{p.lineno}" for p in places
                    )
                    seen[where] += 1
                    if seen[where] == 1:
                        print(
                            f"{name} {seed}: {type(error).__name__}: {str(error)[:200]} at {where}",
                            flush=True,
                        )
            print(f"{name}: {draws} draws, {sum(seen.values())} tracebacks", flush=True)


if __name__ == "__main__":
    _count(int(sys.argv[1]), sys.argv[2:])
