"""Hostile and broken inputs, one line each: what they are, and what reads them.

A case passes if its reader refuses it with an error of ours (`MjhabError`), or if the command ends with exit code 1 or
2; in few words, and with nothing written.
"""

from __future__ import annotations

import gzip
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.cli.main import main
from mjhab.core.files.reading import MAX_JSON_MB
from mjhab.data.select.query import Filter
from mjhab.episodes.hab.format import read_hab
from mjhab.rollout.store import EvaluationFolder, read_records
from mjhab.scenes.formats.gltf import read_glb
from mjhab.scenes.formats.urdf import read_urdf
from mjhab.scenes.home_files import home_pack, read_home_file
from mjhab.scenes.pack_folder import load_pack
from mjhab.scenes.replica_cad.reader import open_replica_cad
from tests.data.fake_world import FakeEnv
from tests.data.make import one_episode, record
from tests.scenes.formats.glb import BOX, BOX_FACES, tiny_data_set, write_glb

Act = Callable[[Path], Any]
DEEP = "[" * 100_000
DEEP_OBJECT = '{"a":' * 100_000
LONG_INTEGER = "9" * 5_000
EYE = np.eye(4).tolist()
LONG_NAME = "x" * 300


@dataclass(frozen=True)
class Case:
    """A hostile input. ``act`` is given an empty folder; it must raise a `MjhabError` or return an exit code."""

    group: str
    name: str
    act: Act

    def __str__(self) -> str:
        return f"{self.group}: {self.name}"


def cases() -> Iterator[Case]:
    """All of them."""
    yield from broken_json()
    yield from run_folders()
    yield from archives()
    yield from meshes()
    yield from homes()
    yield from filters()
    yield from options()
    yield from places()


# -- JSON in every file that is read -----------------------------------------------------------------------------------

BROKEN_JSON: dict[str, bytes] = {
    "empty": b"",
    "null": b"null",
    "a number": b"3",
    "a text": b'"x"',
    "a list": b"[]",
    "a list of null": b"[null]",
    "binary": bytes(range(256)) * 4,
    "nested 100,000 deep": DEEP.encode(),
    "objects 100,000 deep": DEEP_OBJECT.encode(),
    "an integer of 5,000 digits": LONG_INTEGER.encode(),
    "an integer of 5,000 digits in an object": f'{{"episodes": {LONG_INTEGER}}}'.encode(),
    "UTF-16": '{"episodes": []}'.encode("utf-16"),
    "cut off": b'{"episodes": [{"scene_id": "v3',
    "not a number": b'{"episodes": NaN}',
}


def written(name: str, content: bytes, read: Callable[[Path], Any]) -> Act:
    def act(folder: Path) -> Any:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return read(path)

    return act


def in_data_set(name: str, content: bytes) -> Act:
    def act(folder: Path) -> Any:
        (tiny_data_set(folder) / name).write_bytes(content)
        return open_replica_cad(folder, (), None, ())

    return act


def resumed(folder: Path) -> Any:
    return EvaluationFolder.open(folder, CONFIG, resume=True)


CONFIG = {"task": "set_table", "policy": "zero", "seed": 0, "episodes": 6, "worlds": 2}
SCENE_FILE = "configs/scenes/v3_sc3_staging_07.scene_instance.json"
OBJECT_FILE = "configs/objects/frl_apartment_table.object_config.json"
JSON_READERS: dict[str, Callable[[bytes], Act]] = {
    "episodes": lambda content: written("e.json", content, read_hab),
    "episodes.gz": lambda content: written("e.json.gz", gzip.compress(content), read_hab),
    "home file": lambda content: written("h.json", content, read_home_file),
    "pack folder": lambda content: written("pack.json", content, packed),
    "scene": lambda content: in_data_set(SCENE_FILE, content),
    "object": lambda content: in_data_set(OBJECT_FILE, content),
    "config of a run": lambda content: written(
        "config.json", content, lambda p: resumed(p.parent)
    ),
    "config of a data set": lambda content: written(
        "d/generation.json", content, lambda p: generate(p.parent)
    ),
    "score": lambda content: written(
        "score.json", content, lambda p: main(["score", "--check", str(p)])
    ),
}


def packed(path: Path) -> Any:
    np.savez(path.parent / "meshes.npz", a=np.zeros(1))
    return load_pack(path.parent)


def generate(folder: Path) -> int:
    words = "generate --subtask close --policy zero --episodes 1 --resume".split()
    return main([*words, "--out", str(folder)])


def broken_json() -> Iterator[Case]:
    for reader, act in JSON_READERS.items():
        for name, content in BROKEN_JSON.items():
            yield Case("JSON", f"{reader}, {name}", act(content))


# -- run folders edited by hand ----------------------------------------------------------------------------------------

RECORDS: dict[str, bytes] = {
    "a list": b"[]\n",
    "null": b"null\n",
    "a number": b"7\n",
    "nested 100,000 deep": DEEP.encode() + b"\n",
    "an integer of 5,000 digits": LONG_INTEGER.encode() + b"\n",
    "binary": b"\xff\xfe\x00\n",
}
FIELDS: tuple[tuple[str, Any], ...] = (
    ("index", -1),
    ("seed", -1),
    ("steps", -5),
    ("plan", 3),
    ("subtasks", None),
    ("subtasks", {}),
    ("events", [[1]]),
    ("force", ["x"]),
    ("force", ""),
    ("taint", 7),
    ("taint", "dropped"),
    ("success_once", None),
)


def run_folders() -> Iterator[Case]:
    for name, line in RECORDS.items():
        yield Case("run folder", f"record is {name}", with_records(line + line, resumed))
    for field, value in FIELDS:
        yield Case(
            "run folder", f"record with {field} = {value!r}", with_field(field, value)
        )
    for field in ("index", "steps"):
        yield Case(
            "run folder", f"record with {field} = NaN", with_field(field, float("nan"))
        )
        yield Case("run folder", f"record with {field} = 1e300", with_field(field, 1e300))
    for name, content in BROKEN_JSON.items():
        yield Case("run folder", f"summary is {name}", with_summary(content))


def with_records(lines: bytes, read: Callable[[Path], Any]) -> Act:
    def act(folder: Path) -> Any:
        (folder / "config.json").write_text(json.dumps(CONFIG))
        (folder / "episodes.jsonl").write_bytes(lines)
        return read(folder)

    return act


def with_field(field: str, value: Any) -> Act:
    def act(folder: Path) -> Any:
        record = sample_record(folder) | {field: value}
        line = json.dumps(record).encode() + b"\n"
        return with_records(line + line, read_records)(folder)

    return act


def sample_record(folder: Path) -> dict[str, Any]:
    return one_episode(folder).record.to_dict()


def with_summary(content: bytes) -> Act:
    """A summary that is no summary costs its seconds, nothing else."""

    def act(folder: Path) -> Any:
        (folder / "summary.json").write_bytes(content)
        with EvaluationFolder.open(folder, CONFIG, overwrite=True) as run:
            (folder / "summary.json").write_bytes(content)
            return 2 if run.earlier_seconds() == 0.0 else 0

    return act


# -- archives and sizes ------------------------------------------------------------------------------------------------


def episode(objects: list[Any], **more: Any) -> bytes:
    row = {
        "episode_id": "7",
        "scene_id": "builtin_m0_00",
        "rigid_objs": objects,
        "targets": {},
    }
    return json.dumps({"episodes": [row | more]}).encode()


def bomb() -> bytes:
    """More blanks than are read, which gzip packs into a quarter of a megabyte."""
    return gzip.compress(b" " * 2**24) * (MAX_JSON_MB // 16 + 1)


def at(x: float) -> list[list[float]]:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose.tolist()


def archives() -> Iterator[Case]:
    many = episode([["024_bowl.object_config.json", EYE]] * 12_000)
    yield Case("archive", "a gzip bomb", lambda folder: read_bomb(folder))
    yield Case(
        "archive",
        "gzip cut off",
        written("e.json.gz", gzip.compress(many)[:-9], read_hab),
    )
    yield Case(
        "archive", "gzip header alone", written("e.json.gz", b"\x1f\x8b", read_hab)
    )
    yield Case(
        "archive", "an episode of 12,000 objects", written("e.json", many, read_hab)
    )
    for x in (1e300, -1e300, 1e6, float("inf"), float("nan")):
        content = episode([["024_bowl.object_config.json", at(x)]])
        yield Case("archive", f"an object at {x}", written("e.json", content, read_hab))
    for name in ("a\0b", "x" * 5000, "a\nb", "\u202e", "..", ""):
        content = episode([], scene_id=name)
        yield Case(
            "archive", f"scene id {name[:20]!r}", written("e.json", content, read_hab)
        )
    yield Case("archive", "a folder in place of a file", lambda folder: read_hab(folder))
    yield Case(
        "archive",
        "a device in place of a file",
        lambda folder: read_hab(Path("/dev/zero")),
    )
    yield Case("archive", "a pipe in place of a file", read_pipe)
    yield Case("archive", "a scene of 5,000 objects", crowded)


def read_bomb(folder: Path) -> Any:
    return written("e.json.gz", bomb(), read_hab)(folder)


def read_pipe(folder: Path) -> Any:
    os.mkfifo(folder / "e.json")
    return read_hab(folder / "e.json")


def crowded(folder: Path) -> Any:
    path = tiny_data_set(folder) / SCENE_FILE
    body = json.loads(path.read_text())
    body["object_instances"] *= 2_500
    path.write_text(json.dumps(body))
    return open_replica_cad(folder, (), None, ())


# -- meshes ------------------------------------------------------------------------------------------------------------


def glb(change: Callable[[dict[str, Any]], Any], image: bool = False) -> Act:
    """A file with another document: the chunks are written anew around it."""

    def act(folder: Path) -> Any:
        picture = np.zeros((4, 4, 3), np.uint8) if image else None
        uv = np.zeros((8, 2), np.float32) if image else None
        path = write_glb(folder / "a.glb", [(BOX, BOX_FACES)], uv=uv, image=picture)
        raw = path.read_bytes()
        size = struct.unpack_from("<I", raw, 12)[0]
        document = json.loads(raw[20 : 20 + size])
        text = change(document)
        text = text if isinstance(text, bytes) else json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text + raw[20 + size :]
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
        return read_glb(path)

    return act


def setting(*keys: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        place: Any = document
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


def huge_picture(folder: Path) -> Any:
    picture = np.zeros((4, 4, 3), np.uint8)
    uv = np.zeros((8, 2), np.float32)
    path = write_glb(folder / "a.glb", [(BOX, BOX_FACES)], uv=uv, image=picture)
    raw = path.read_bytes()
    start = raw.index(b"IHDR") + 4
    header = struct.pack(">II", 40_000, 40_000) + raw[start + 8 : start + 13]
    checksum = struct.pack(">I", zlib.crc32(b"IHDR" + header))
    path.write_bytes(raw[:start] + header + checksum + raw[start + 17 :])
    return read_glb(path)


def chained(count: int) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        nodes = [{"children": [k + 1]} for k in range(count)]
        document["nodes"] = [*nodes, {"mesh": 0}]
        document["scenes"] = [{"nodes": [0]}]

    return change


def doubling(levels: int) -> Callable[[dict[str, Any]], None]:
    """Every node has the next one as its child twice: 2**levels meshes."""

    def change(document: dict[str, Any]) -> None:
        nodes = [{"children": [k + 1, k + 1]} for k in range(levels)]
        document["nodes"] = [*nodes, {"mesh": 0}]
        document["scenes"] = [{"nodes": [0]}]

    return change


def meshes() -> Iterator[Case]:
    changes: dict[str, Callable[[dict[str, Any]], Any]] = {
        "a node that is its own child": setting("nodes", 0, "children", value=[0]),
        "a chain of 5,000 nodes": chained(5_000),
        "nodes that double 40 times": doubling(40),
        "JSON nested 100,000 deep": lambda document: DEEP.encode(),
        "a document that is a list": lambda document: b"[]",
        "a document that is null": lambda document: b"null",
        "an accessor of 10**12 elements": setting("accessors", 0, "count", value=10**12),
        "an accessor of 10**30 elements": setting("accessors", 0, "count", value=10**30),
        "an accessor of -1 elements": setting("accessors", 0, "count", value=-1),
        "an accessor of half an element": setting("accessors", 0, "count", value=0.5),
        "an accessor of a text": setting("accessors", 0, "count", value="8"),
        "a stride of zero": lambda document: (
            setting("bufferViews", 0, "byteStride", value=0)(document),
            setting("accessors", 0, "count", value=10**12)(document),
        )[:0],
        "a stride below zero": setting("bufferViews", 0, "byteStride", value=-12),
        "a view that begins before the data": setting(
            "bufferViews", 0, "byteOffset", value=-64
        ),
        "an unknown component": setting("accessors", 0, "componentType", value=5130),
        "a scene that is not there": setting("scene", value=7),
        "nodes that are null": setting("nodes", value=None),
        "a scale of 1e300": setting("nodes", 0, "scale", value=[1e300] * 3),
        "a scale of two": setting("nodes", 0, "scale", value=[1.0, 1.0]),
        "a matrix of 15": setting("nodes", 0, "matrix", value=[1.0] * 15),
        "a mesh that is a list": setting("meshes", 0, value=[1]),
    }
    for name, change in changes.items():
        yield Case("GLB", name, glb(change))
    yield Case(
        "GLB", "a texture that is null", glb(setting("textures", value=None), image=True)
    )
    yield Case("GLB", "a PNG of 1.6 gigapixels", huge_picture)
    for name, text in URDFS.items():
        yield Case("URDF", name, written("a.urdf", text.encode(), read_urdf))


def links(*names: str) -> str:
    return "".join(f'<link name="{name}"/>' for name in names)


def joint(parent: str, child: str) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{parent}_{child}" type="fixed">{ends}</joint>'


URDFS = {
    "joints that form a loop": f"<robot>{links('root', 'a', 'b')}{joint('a', 'b')}{joint('b', 'a')}</robot>",
    "a link that is its own parent": f"<robot>{links('root', 'a')}{joint('a', 'a')}</robot>",
    "entities that double 30 times": (
        '<!DOCTYPE r [<!ENTITY a0 "x">'
        + "".join(f'<!ENTITY a{k + 1} "&a{k};&a{k};">' for k in range(30))
        + ']><robot name="&a30;"/>'
    ),
    "an entity of a file": (
        '<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/passwd">]><robot name="a">&f;</robot>'
    ),
    "100,000 elements deep": "<a>" * 100_000 + "</a>" * 100_000,
    "no XML": "{}",
    "empty": "",
    "two roots": f"<robot>{links('a', 'b')}</robot>",
    "an endless axis": (
        f'<robot>{links("a", "b")}<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<axis xyz="inf 0 0"/><limit lower="0" upper="1"/></joint></robot>'
    ),
}


# -- homes -------------------------------------------------------------------------------------------------------------

HOME_FIELDS: dict[str, Any] = {
    "name": ["../../x", "/abs", "", 3, "a\0b", LONG_NAME],
    "floor": [None, {"size": [1e300, 1]}, {"size": [float("nan"), 1]}, {"size": [-1, 4]}],
    "walls": [None, {"outer": 3}, {"outer": "wall_white", "height": 1e300}],
    "furniture": [
        3,
        [{"kind": "no_such", "at": [0, 0]}],
        [{"kind": "../x", "at": [0, 0]}],
    ],
}


def homes() -> Iterator[Case]:
    base = {
        "format": "mjhab-home-1",
        "name": "mine",
        "floor": {"size": [6.0, 5.0]},
        "walls": {"outer": "wall_white"},
    }
    for field, values in HOME_FIELDS.items():
        for value in values:
            content = json.dumps(base | {field: value}).encode()
            shown = str(value)[:40]
            yield Case(
                "home file",
                f"{field} = {shown}",
                written("home.json", content, home_pack),
            )


# -- filters -----------------------------------------------------------------------------------------------------------

FILTERS = {
    "nested 5,000 deep": "(" * 4_000 + "success" + ")" * 4_000,
    "nested 100,000 deep": "(" * 100_000,
    "not, 1,500 times": "not " * 1_500 + "success",
    "an integer of 5,000 digits": f"steps < {LONG_INTEGER}",
    "an integer of 5,000 digits compared": f"{LONG_INTEGER} == {LONG_INTEGER}",
    "a sum of 2,000": "steps < " + "+".join("1" * 2_000),
    "a power": "steps < 9 ** 9 ** 9",
    "a call of the system": "__import__('os').system('true')",
    "an attribute": "steps.__class__",
    "a lambda": "(lambda: 1)()",
    "NUL": "success\0",
    "surrogates": "success == '\ud800'",
    "bytes": "b'x' == target",
    "an f-string": "f'{steps}' == target",
    "empty": "   ",
    "100,000 characters": "success or " * 10_000 + "success",
    "star": "*steps",
    "walrus": "(x := 1) < 2",
}


def filters() -> Iterator[Case]:
    for name, text in FILTERS.items():
        yield Case("filter", name, lambda folder, text=text: Filter(text))


# -- options -----------------------------------------------------------------------------------------------------------

COMMANDS: dict[str, tuple[str, ...]] = {
    "eval": ("eval", "--subtask", "pick", "--out", "{new}"),
    "generate": ("generate", "--subtask", "pick", "--episodes", "2", "--out", "{new}"),
    "homes render": ("homes", "render", "builtin_m0_00", "--out", "{new}/a.png"),
    "episodes make": ("episodes", "make", "--out", "{new}/e.json.gz"),
    "spawns make": ("spawns", "make", "--subtask", "pick", "--out", "{new}/s.npz"),
    "bench env": ("bench", "env"),
}
VALUES = ("-1", "18446744073709551616", "nan", "1e18", "", "x")
NUMBERS = (
    *(("eval", "episodes", value) for value in VALUES),
    ("generate", "workers", "-1"),
    ("homes render", "width", "nan"),
    ("episodes make", "count", "-1"),
    ("spawns make", "pool", "x"),
    ("bench env", "camera-size", "18446744073709551616"),
    ("bench env", "steps", ""),
    ("eval", "films", "1000000000"),
    ("eval", "worlds", "1000000000"),
    ("eval", "camera-size", "1000000000"),
    ("eval", "episodes", "1000000000000000000"),
    ("generate", "workers", "5000"),
    ("generate", "camera-size", "100000"),
    ("generate", "worlds", "1000000000"),
    ("homes render", "width", "1000000"),
    ("homes render", "height", "0"),
)
"""Each kind of value once, then each command, then each number that is too large for one option alone; all options of
all commands are tried by `option_types`."""
TEXTS = {
    "empty": "",
    "10,000 characters": "x" * 10_000,
    "a path": "/proc/self",
    "NUL": "a\0b",
}
NAMES = ("empty", "10,000 characters", "a path", "NUL")
FILES = ("a path", "NUL")
TEXT_OPTIONS = {
    ("eval", "task"): NAMES,
    ("eval", "target"): NAMES[1:],
    ("eval", "policy"): NAMES,
    ("eval", "home"): NAMES[1:],
    ("eval", "assets"): NAMES,
    ("eval", "episodes-file"): FILES,
    ("eval", "spawns"): FILES,
    ("generate", "keep"): NAMES,
    ("generate", "images"): NAMES,
}
"""Texts that each of these options refuses; an empty target or home is the same as none."""


def options() -> Iterator[Case]:
    for command, name, value in NUMBERS:
        yield Case("option", f"{command} --{name} {value!r}", asked(command, name, value))
    for (command, name), texts in TEXT_OPTIONS.items():
        for what in texts:
            act = asked(command, name, TEXTS[what])
            yield Case("option", f"{command} --{name}, {what}", act)


def asked(command: str, name: str, value: str) -> Act:
    def act(folder: Path) -> int:
        words = [word.replace("{new}", str(folder / "new")) for word in COMMANDS[command]]
        return run_main([*words, f"--{name}", value])

    return act


def run_main(words: list[str]) -> int:
    try:
        return main(words)
    except SystemExit as end:
        # The parser ends the process.
        return int(end.code or 0)


# -- places that cannot be written -------------------------------------------------------------------------------------

PLACES = {
    "in /proc": "/proc/mjhab/x",
    "below a file": "{file}/x",
    "a name too long": "{new}/" + LONG_NAME,
    "a device": "/dev/full",
    "NUL": "{new}/a\0b",
    "a path too long": "{new}" + "/x" * 3_000,
}
WRITERS: dict[str, tuple[str, ...]] = {
    "eval": ("eval", "--subtask", "close", "--policy", "zero", "--out"),
    "eval --resume": tuple("eval --subtask close --policy zero --resume --out".split()),
    "eval --overwrite": (
        *"eval --subtask close --policy zero --overwrite --out".split(),
    ),
    "generate": ("generate", "--subtask", "close", "--episodes", "1", "--out"),
    "homes render": tuple(
        "homes render builtin_m0_00 --width 8 --height 8 --out".split()
    ),
    "episodes make": ("episodes", "make", "--count", "1", "--out"),
    "spawns make": ("spawns", "make", "--subtask", "pick", "--count", "1", "--out"),
    "export lerobot": ("export", "lerobot", "{shard}", "--out"),
    "export maniskill": ("export", "maniskill", "{shard}", "--out"),
    "data split": ("data", "split", "{shard}", "--out"),
    "data merge": ("data", "merge", "{shard}", "--out"),
}


def places() -> Iterator[Case]:
    for name, place in PLACES.items():
        yield Case("place", f"eval --out {name}", wrote(WRITERS["eval"], place))
    for command, words in WRITERS.items():
        act = wrote(words, PLACES["below a file"])
        yield Case("place", f"{command} --out below a file", act)
    yield Case("place", "eval --out is a file", wrote(WRITERS["eval"], "{file}"))
    yield Case("place", "generate --out is a file", wrote(WRITERS["generate"], "{file}"))
    yield Case(
        "place", "homes render --out is a folder", wrote(WRITERS["homes render"], "{dir}")
    )
    long = f"{LONG_NAME}=0.5,b=0.5"
    split = ("data", "split", "{shard}", "--parts", *long.split(","), "--out")
    yield Case("place", "data split with a part of 300 characters", wrote(split, "{new}"))


def wrote(words: tuple[str, ...], place: str) -> Act:
    def act(folder: Path) -> int:
        (folder / "file").write_text("")
        (folder / "dir").mkdir()
        names = {
            "{new}": str(folder / "new"),
            "{file}": str(folder / "file"),
            "{dir}": str(folder / "dir"),
        }
        if any("{shard}" in word for word in words):
            names["{shard}"] = str(shard(folder / "a.h5"))
        line = [*words, place]
        for name, value in names.items():
            line = [word.replace(name, value) for word in line]
        return run_main(line)

    return act


def shard(path: Path) -> Path:
    record(path, range(1), FakeEnv(subtask="pick"))
    return path
