"""Readers of files with a sound file for each, and how its copies are changed."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.data.store.reading import open_shard
from mjhab.episodes.episode import Episode
from mjhab.episodes.hab.format import from_json, read_hab, to_json
from mjhab.episodes.spawn_sets import SpawnRow, SpawnSet, content_digest, pack_rows, write
from mjhab.learning.by_subtask import PoliciesFile
from mjhab.learning.checkpoint import load_student, save_student
from mjhab.learning.policy_kind import CheckpointFiles
from mjhab.learning.students.heads import make_student
from mjhab.paper.ms_hab.checkpoint import load_network
from mjhab.scenes.formats.gltf import read_glb
from mjhab.scenes.formats.urdf import read_urdf
from mjhab.scenes.home_files import home_pack
from mjhab.scenes.object_glb import object_from_glb
from mjhab.scenes.pack_folder import load_pack, save_pack
from mjhab.scenes.replica_cad.reader import open_replica_cad
from mjhab.scenes.replica_cad.ycb import read_scan
from mjhab.tasks.plan import Target
from tests.hostile.cases import EYE, OBJECT_FILE, SCENE_FILE, episode, shard
from tests.hostile.mutations import (
    Mutator,
    changed_arrays,
    changed_bytes,
    changed_glb,
    changed_json,
    changed_safetensors,
    changed_torch,
    changed_xml,
)
from tests.learning import small
from tests.paper.ms_hab_checkpoints import ppo_shapes, random_weights, save
from tests.scenes.formats.glb import BOX, BOX_FACES, URDF, tiny_data_set, write_glb


@dataclass(frozen=True)
class Reader:
    """A reader of files. file: where the copies lie. make: writes what else is needed into an empty folder and returns
    the content of a sound file. read: of a copy; raises a `MjhabError` if it refuses it. mutate: changes a copy by its
    structure; copies whose bytes are changed are read, too. draws: copies in a test, about half a second."""

    file: str
    make: Callable[[Path], bytes]
    read: Callable[[Path], Any]
    mutate: Mutator = changed_bytes
    draws: int = 60

    def changed(self, raw: bytes, rng: random.Random) -> bytes:
        """A changed copy."""
        return (self.mutate if rng.random() < 0.8 else changed_bytes)(raw, rng)


CABINET = """<robot name="cabinet"><link name="root"/><joint name="up" type="fixed"><origin rpy="1.57 0 0"/>
<parent link="root"/><child link="body"/></joint>
<link name="body"><inertial><mass value="9"/></inertial>
<visual><geometry><mesh filename="cabinet.glb" scale="1 1 1"/></geometry></visual>
<collision><origin xyz="0 0.5 0"/><geometry><box size="0.4 1.0 0.6"/></geometry></collision></link>
<joint name="slide" type="prismatic"><origin xyz="0 0.5 0.4"/><parent link="body"/><child link="drawer"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.3" effort="10" velocity="1"/></joint>
<link name="drawer"><inertial><mass value="2"/></inertial>
<visual><geometry><mesh filename="cabinet.glb" scale="1 1 1"/></geometry></visual>
<collision><geometry><box size="0.3 0.02 0.4"/></geometry></collision></link></robot>"""
"""Furniture with a drawer."""
CABINET_CONFIG = {
    "user_defined": {
        "receptacle_aabb_drawer_cabinet": {
            "parent_object": "cabinet",
            "parent_link": "drawer",
            "position": [0, 0.05, 0],
            "scale": [0.1, 0.05, 0.1],
        }
    }
}


def data_set(folder: Path) -> Path:
    """A tiny data set with furniture that opens and a stage."""
    tiny_data_set(folder)
    scene = json.loads((folder / SCENE_FILE).read_text())
    cabinet = {
        "template_name": "cabinet",
        "translation": [3, 0, 0],
        "rotation": [1, 0, 0, 0],
    }
    scene["articulated_object_instances"].append(cabinet)
    (folder / SCENE_FILE).write_text(json.dumps(scene))
    urdf = folder / "urdf" / "cabinet" / "cabinet.urdf"
    urdf.parent.mkdir()
    urdf.write_text(CABINET)
    urdf.with_suffix(".ao_config.json").write_text(json.dumps(CABINET_CONFIG))
    box = [(BOX, BOX_FACES)]
    write_glb(urdf.with_suffix(".glb"), box)
    write_glb(folder / "stages" / "Stage.glb", box)
    return folder


def in_data_set(file: str, mutate: Mutator) -> Reader:
    """The reader of ReplicaCAD, with one file changed."""

    def read(path: Path) -> Any:
        return open_replica_cad(
            Path(str(path).removesuffix(file)), (), None, ("cabinet",)
        )

    return Reader(
        file, lambda folder: (data_set(folder) / file).read_bytes(), read, mutate, 15
    )


def glb(read: Callable[[Path], Any], size: float = 1.0) -> Reader:
    """A reader of binary glTF files of a textured box. size: of its half [m]."""

    def make(folder: Path) -> bytes:
        uv = np.zeros((8, 2), np.float32)
        picture = np.zeros((4, 4, 3), np.uint8)
        moved = {"scale": [2, 2], "offset": [0, 0.5], "rotation": 0.1}
        parts = [(size * BOX, BOX_FACES)]
        nodes: list[dict[str, Any]] = [
            {"children": [1], "scale": [1, 1, 1], "rotation": [0, 0, 0, 1]},
            {"mesh": 0, "translation": [0, 0, 0]},
        ]
        path = write_glb(folder / "a.glb", parts, nodes, uv, picture, moved)
        return path.read_bytes()

    return Reader("b.glb", make, read, changed_glb)


def home_bytes(folder: Path) -> bytes:
    inner = {"start": [3.0, 0.0], "end": [3.0, 2.0], "doorways": [[0.5, 1.0]]}
    walls = {"outer": "wall_white", "inner": [inner], "height": 2.5}
    rack = {
        "furniture": "table_03",
        "name": "rack",
        "center": [0.0, 0.0, 0.8],
        "half": [0.1, 0.1],
    }
    home = {
        "format": "mjhab-home-1",
        "name": "mine",
        "floor": {"size": [6.0, 5.0], "material": "floor_oak"},
        "walls": walls,
        "furniture": [{"kind": "table_03", "at": [1.5, 2.5], "yaw_degrees": 90.0}],
        "receptacles": [{**rack, "roles": []}],
        "lights": [[1.0, 1.0, 2.0]],
    }
    return json.dumps(home).encode()


def pack_bytes(name: str) -> Callable[[Path], bytes]:
    def make(folder: Path) -> bytes:
        save_pack(
            open_replica_cad(data_set(folder / "set"), (), None, ("cabinet",)), folder
        )
        return (folder / name).read_bytes()

    return make


def pack_of(path: Path) -> Any:
    return load_pack(path.parent)


def spawn_bytes(folder: Path) -> bytes:
    recipe = {
        "task": "set_table",
        "subtask": "pick",
        "target": "",
        "split": "train",
        "seed": 0,
    }
    header = {
        "format": "mjhab-spawns-1",
        "recipe": {**recipe, "count": 2},
        "pack": "builtin",
        "layout": "0" * 16,
        "grasps": {"024_bowl": "0" * 16},
        "versions": {"mjhab": "1"},
    }
    point = (0.0, 0.0, 0.0)
    target = Target("024_bowl_:0000", point, point, "", "", point)
    pose = np.zeros((3, 7))
    row = SpawnRow(
        Episode(0, 0, "set_table", "train", "home", pose, np.zeros(2), (target,)),
        np.zeros(9),
        0,
        False,
        1,
    )
    return write(folder / "a.npz", header, pack_rows([row, row])).path.read_bytes()


def use_spawns(path: Path) -> None:
    found = SpawnSet.read(path)
    found.describe()
    found.check(EnvConfig(task="set_table", subtask="pick"))
    for index in (0, 1, 5):
        found.row(index)


def changed_spawns(raw: bytes, rng: random.Random) -> bytes:
    """A changed set of starts, mostly with the digest of its content, which anyone can compute."""
    data = changed_arrays(raw, rng)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(str(arrays.pop("header")))
        header.pop("digest", None)
        header["digest"] = content_digest(header, arrays)
    except (ValueError, KeyError, TypeError, AttributeError):
        return data
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def policies_bytes(folder: Path) -> bytes:
    entries = [
        {"subtask": "pick", "target": "024_bowl", "checkpoint": "expert"},
        {"subtask": "place", "target": "", "checkpoint": "zero"},
    ]
    return json.dumps({"policies": entries}).encode()


def use_policies(path: Path) -> None:
    _ = PoliciesFile(str(path)).facts


def checkpoint_bytes(folder: Path) -> bytes:
    path = folder / "a.safetensors"
    save_student(path, make_student(small.config(), small.layout()), {"seconds": 1.0})
    return path.read_bytes()


def use_checkpoint(path: Path) -> None:
    _ = CheckpointFiles(str(path)).facts
    student = load_student(path)
    student.layout.check_env(small.fake_env())


def ms_hab_bytes(folder: Path) -> bytes:
    return save(folder / "policy.pt", random_weights(ppo_shapes())).read_bytes()


def read_shard(path: Path) -> None:
    with open_shard(path) as opened:
        for one in opened:
            for name in one.paths:
                one.array(name)


def marked_episode(folder: Path) -> bytes:
    body = json.loads(episode([["024_bowl.object_config.json", EYE]]))
    offset = {"offset": [0, 0, 0], "link": "drawer1", "object": "kitchen_counter_:0000"}
    body["episodes"][0] |= {
        "ao_states": {"fridge_:0000": {"1": 0.5}},
        "markers": [{"name": "m", "type": "articulated_object", "params": offset}],
        "target_receptacles": [["fridge_:0000", 1]],
        "goal_receptacles": [["table_:0000", None]],
        "name_to_receptacle": {"024_bowl_:0000": "fridge_:0000|shelf"},
        "info": {"object_labels": {"024_bowl_:0000": "any_targets|0"}},
    }
    return json.dumps(body).encode()


def use_episodes(path: Path) -> None:
    file = read_hab(path)
    for one in file.episodes:
        assert from_json(to_json(one)).types == one.types
        assert len(one.target_names) == len(one.targets)


STAGE_FILE = "configs/stages/Stage.stage_config.json"
SCENES = {
    "scene": (SCENE_FILE, changed_json),
    "object": (OBJECT_FILE, changed_json),
    "stage": (STAGE_FILE, changed_json),
    "receptacles": ("urdf/cabinet/cabinet.ao_config.json", changed_json),
    "cabinet": ("urdf/cabinet/cabinet.urdf", changed_xml),
    "stage mesh": ("stages/Stage.glb", changed_glb),
    "hulls": ("objects/convex/frl_apartment_table_cv_decomp.glb", changed_glb),
}
READERS: dict[str, Reader] = {
    "episodes": Reader("e.json", marked_episode, use_episodes, changed_json),
    "GLB": glb(read_glb),
    "object from GLB": glb(lambda path: object_from_glb("mug", path, 0.2), 0.1),
    "scan": glb(read_scan, 0.02),
    "URDF": Reader("a.urdf", lambda folder: URDF.encode(), read_urdf, changed_xml),
    "home": Reader("home.json", home_bytes, home_pack, changed_json),
    **{name: in_data_set(*given) for name, given in SCENES.items()},
    "pack": Reader("pack.json", pack_bytes("pack.json"), pack_of, changed_json, 20),
    "pack meshes": Reader(
        "meshes.npz", pack_bytes("meshes.npz"), pack_of, changed_arrays, 20
    ),
    "spawn set": Reader("s.npz", spawn_bytes, use_spawns, changed_spawns),
    "policies": Reader("p.json", policies_bytes, use_policies, changed_json),
    "checkpoint": Reader(
        "c.safetensors", checkpoint_bytes, use_checkpoint, changed_safetensors
    ),
    "MS-HAB checkpoint": Reader("p.pt", ms_hab_bytes, load_network, changed_torch, 10),
    "shard": Reader(
        "b.h5", lambda folder: shard(folder / "made" / "a.h5").read_bytes(), read_shard
    ),
}
