"""The HAB file format: nothing is lost on the way through, frames are those of the benchmark, bad files are named."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.rotations import mat_from_quat, quat_from_axis_angle
from mjhab.episodes.hab.format import (
    HabFile,
    from_json,
    pose_from_hab,
    pose_to_hab,
    read_hab,
    to_json,
    write_hab,
)
from tests.real_data import real_data
from tests.refusals import refused

FILES = (
    "tidy_house_v3_sc1_staging_01.json.gz",
    "habitat_lab_rearrange_format_demo.json.gz",
)
EYE = np.eye(4).tolist()


def row(**changes: Any) -> dict[str, Any]:
    """A small whole episode as JSON."""
    return {
        "episode_id": "7",
        "scene_id": "data/x/configs/scenes/v3_sc0_staging_00.scene_instance.json",
        "scene_dataset_config": "x.json",
        "start_position": [0, 0, 0],
        "start_rotation": [0, 0, 0, 1],
        "info": {
            "object_labels": {"024_bowl_:0001": "any_targets|0"},
            "difficulty": "easy",
        },
        "ao_states": {"fridge_:0000": {"2": 1.5}},
        "rigid_objs": [
            ["024_bowl.object_config.json", EYE],
            ["a/b/024_bowl.object_config.json", EYE],
        ],
        "targets": {"013_apple_:0000": EYE, "024_bowl_:0001": EYE},
        "markers": [
            {
                "name": "fridge_push_point",
                "type": "articulated_object",
                "params": {
                    "offset": [0.1, -0.62, 0.2],
                    "link": "top_door",
                    "object": "fridge_:0000",
                },
            }
        ],
        "target_receptacles": [
            ["kitchen_counter_:0000", 7],
            ["frl_apartment_table_01_:0000", None],
        ],
        "goal_receptacles": [],
        "name_to_receptacle": {"024_bowl_:0000": "kitchen_counter_:0000|sink"},
    } | changes


@pytest.mark.parametrize("name", FILES)
def test_real_files_come_back_as_they_were(name: str, tmp_path: Path) -> None:
    path = real_data("hab_episodes", name)
    copy = tmp_path / name
    write_hab(copy, read_hab(path))
    with gzip.open(path) as a, gzip.open(copy) as b:
        assert json.load(a) == json.load(b)


def test_names_of_an_episode() -> None:
    episode = from_json(row())
    assert to_json(episode) == row()
    assert episode.scene == "v3_sc0_staging_00"
    assert episode.types == ("024_bowl", "024_bowl")
    assert episode.instances == ("024_bowl_:0000", "024_bowl_:0001")
    assert episode.target_names == ("024_bowl_:0001",), (
        "object_labels say which and in which order"
    )
    assert from_json(row(info={})).target_names == ("013_apple_:0000", "024_bowl_:0001")
    assert episode.target_receptacles == (
        ("kitchen_counter_:0000", 7),
        ("frl_apartment_table_01_:0000", None),
    )
    assert episode.markers[0].link == "top_door"


def test_the_same_episodes_give_the_same_bytes(tmp_path: Path) -> None:
    file = HabFile((from_json(row()), from_json(row(episode_id="8"))), {"config": None})
    for name in ("a.json.gz", "b.json.gz", "c.json"):
        write_hab(tmp_path / name, file)
    assert (tmp_path / "a.json.gz").read_bytes() == (tmp_path / "b.json.gz").read_bytes()
    assert json.loads((tmp_path / "c.json").read_text()) == {
        "config": None,
        "episodes": [row(), row(episode_id="8")],
    }
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.json.gz",
        "b.json.gz",
        "c.json",
    ], "nothing half-written"


def test_up_becomes_up_and_scans_keep_their_heading() -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = (1.0, 0.8, -2.0)
    np.testing.assert_allclose(
        pose_from_hab(matrix), (1.0, 2.0, 0.8, 1, 0, 0, 0), atol=1e-12
    )
    # A quarter turn about +y of theirs is one about +z of ours.
    matrix[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    np.testing.assert_allclose(
        mat_from_quat(pose_from_hab(matrix)[3:])[:, 0], (0, 1, 0), atol=1e-12
    )
    # In our frame of the object the scan is turned by scan_yaw, so we are turned back by it.
    turned = mat_from_quat(pose_from_hab(matrix, np.pi / 2)[3:])
    np.testing.assert_allclose(turned, np.eye(3), atol=1e-12)


@given(
    st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(
        lambda v: np.linalg.norm(v) > 0.1
    ),
    st.floats(-3.1, 3.1),
    st.floats(-3.1, 3.1),
)
@settings(max_examples=100, deadline=None)
def test_poses_survive_the_file(
    place: list[float], axis: list[float], angle: float, scan_yaw: float
) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    pose = np.concatenate([place, quat_from_axis_angle(unit, np.array(angle))])
    back = pose_from_hab(pose_to_hab(pose, scan_yaw), scan_yaw)
    np.testing.assert_allclose(back[:3], pose[:3], atol=1e-6)
    np.testing.assert_allclose(
        mat_from_quat(back[3:]), mat_from_quat(pose[3:]), atol=3e-6
    )


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with refused(where="none.json", said="cannot be read"):
        read_hab(tmp_path / "none.json")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_a_file_that_was_cut_off_is_named(tmp_path: Path, share: float) -> None:
    whole = tmp_path / "whole.json.gz"
    write_hab(whole, HabFile(tuple(from_json(row(episode_id=str(i))) for i in range(5))))
    data = whole.read_bytes()
    cut = tmp_path / "cut.json.gz"
    cut.write_bytes(data[: int(share * len(data))])
    with refused(where="cut.json.gz", said="the gzip data is cut off"):
        read_hab(cut)
    text = gzip.decompress(data)
    plain = tmp_path / "cut.json"
    plain.write_bytes(text[: int(share * len(text))])
    with refused(where="cut.json", said="not valid JSON"):
        read_hab(plain)


def moved(x: float) -> list[list[float]]:
    """A pose at x [m]."""
    return [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


FIRST = "episodes[0]"
BAD = [
    ("episodes", {"homes": []}),
    ("episodes", {"episodes": []}),
    ("rigid_objs", {"episodes": [{"scene_id": "a", "targets": {}}]}),
    (
        "episodes[1].targets['a']",
        {"episodes": [row(), row(targets={"a": (2 * np.eye(4)).tolist()})]},
    ),
    *(
        (f"{FIRST}.{option}", {"episodes": [row(**changes)]})
        for option, changes in (
            ("scene_id", {"scene_id": 3}),
            ("scene_id", {"scene_id": "data/.."}),
            ("rigid_objs[0]", {"rigid_objs": [EYE]}),
            ("rigid_objs[0]", {"rigid_objs": [["a/", EYE]]}),
            ("rigid_objs[0]", {"rigid_objs": [["a b", EYE]]}),
            ("rigid_objs[0][1]", {"rigid_objs": [["a", [[1, 2], [3]]]]}),
            ("rigid_objs[0][1].position", {"rigid_objs": [["a", moved(1e300)]]}),
            ("rigid_objs[0][1]", {"rigid_objs": [["a", moved(10**400)]]}),
            ("targets", {"targets": {"../x": EYE}}),
            ("targets['a'].position", {"targets": {"a": moved(-5000.0)}}),
            ("ao_states", {"ao_states": {"/etc": {}}}),
            ("ao_states['a']", {"ao_states": {"a": {"..": 0}}}),
            ("ao_states['fridge']['2']", {"ao_states": {"fridge": {"2": "open"}}}),
            ("ao_states['fridge']['1']", {"ao_states": {"fridge": {"1": 10**400}}}),
            ("markers[0]", {"markers": [{"name": "x"}]}),
            ("goal_receptacles[0]", {"goal_receptacles": [["a", "b"]]}),
            ("target_receptacles[0]", {"target_receptacles": [["..", 1]]}),
            ("name_to_receptacle['a']", {"name_to_receptacle": {"a": "b|.."}}),
            ("info.object_labels", {"info": {"object_labels": []}}),
        )
    ),
]


@pytest.mark.parametrize(("option", "body"), BAD)
def test_bad_fields_are_named(tmp_path: Path, option: str, body: dict[str, Any]) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(body))
    with refused(option, where="bad.json"):
        read_hab(path)
