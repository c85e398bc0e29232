"""Reader of the ReplicaCAD format, on a tiny data set made here: frames, welding, receptacles, bad input."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.core.rotations import quat_rotate
from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import placed_receptacles
from mjhab.scenes.pack_folder import load_pack, save_pack
from mjhab.scenes.pack_source import PackRequest, pack_request
from mjhab.scenes.packs import open_pack
from mjhab.scenes.replica_cad.reader import open_replica_cad
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.spec import Pack
from tests.refusals import refused
from tests.scenes.formats.glb import box_glb, tiny_data_set, write

SCENE = "v3_sc3_staging_07"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tiny_data_set(tmp_path / "data")


def corners(pack: Pack, template: str) -> np.ndarray:
    """World points of what collides of the first placement of a template."""
    at = next(p for p in pack.homes[0].props if p.template == template)
    geoms = [g for g in pack.props[template].geoms if g.collide]
    local = np.concatenate([outline(g, pack.meshes) for g in geoms])
    return quat_rotate(np.array(at.rotation), local) + at.pos


def test_names_split_and_templates(folder: Path) -> None:
    pack = open_pack(str(folder))
    (home,) = pack.homes
    assert (home.name, home.split, home.macro, home.micro) == (SCENE, "val", 3, 7)
    # Prefixes and folders go; doors between rooms stay out.
    assert sorted(pack.props) == ["chest", "mat", "table"] and not pack.articulations
    assert not pack.props["mat"].blocks_base and pack.props["table"].blocks_base
    assert sorted(pack.objects)[0] == "002_master_chef_can" and len(pack.objects) == 10


def test_y_up_becomes_z_up(folder: Path) -> None:
    pack = open_pack(str(folder))
    # Translation (1, 0.4, 2); (0.6, 0, 0.8, 0) turns about the data set's y by 2 acos(0.6).
    points = corners(pack, "table")
    assert np.allclose(points.mean(0)[:2], [1, -2]) and points[
        :, 2
    ].max() == pytest.approx(0.8)
    at = next(p for p in pack.homes[0].props if p.template == "table")
    assert at.quat is None and at.yaw == pytest.approx(2 * np.arccos(0.6))
    low = corners(pack, "mat").min(0)
    high = corners(pack, "mat").max(0)
    assert np.allclose(low, [-1.4, -0.3, 0.0], atol=1e-6) and np.allclose(
        high, [-0.6, 0.3, 0.02], atol=1e-6
    )


def test_a_scaled_piece_on_its_side_stands_upright(folder: Path) -> None:
    pack = open_pack(str(folder))
    points = corners(pack, "chest")
    # The scene turns it by -90 deg about x, the URDF by 1.565 rad: almost nothing is left. Scale 0.5.
    assert np.allclose(points.min(0), [-0.1, 1.85, 0.0], atol=0.004)
    assert np.allclose(points.max(0), [0.1, 2.15, 0.5], atol=0.004)
    assert next(p for p in pack.homes[0].props if p.template == "chest").quat is None


def test_hulls_merge_points_and_carry_the_render_mesh(folder: Path) -> None:
    pack = open_pack(str(folder))
    hulls = [g for g in pack.props["table"].geoms if g.collide]
    assert [g.shape for g in hulls] == ["mesh", "mesh"]
    assert all(len(pack.meshes[g.mesh].vertices) == 8 for g in hulls)  # type: ignore[attr-defined]
    assert [g.mesh for g in pack.props["table"].geoms if g.visual] == ["table/look"]
    assert [g.shape for g in pack.props["mat"].geoms if g.collide] == ["box"]


def test_receptacles_lie_on_the_surface_and_inside_its_edges(folder: Path) -> None:
    pack = open_pack(str(folder))
    (top,) = pack.props["table"].receptacles
    # The box of the config is negative, 1.2 m x 0.4 m, and floats 1 cm under the board of 1.0 m x 0.6 m.
    assert top.name == "top" and top.pos == pytest.approx((0, 0, 0.4), abs=1e-6)
    assert 0.45 < top.half[0] <= 0.5 and top.half[1] == pytest.approx(0.2)
    (placed,) = placed_receptacles(Layout(pack, ()), pack.homes[0])
    assert placed.id == "table_0/top" and placed.pos == pytest.approx(
        (1, -2, 0.8), abs=1e-6
    )


def test_it_compiles_and_survives_the_disk(folder: Path, tmp_path: Path) -> None:
    pack = open_pack(str(folder))
    model = compile_home(Layout(pack, ()), pack.homes[0])
    assert {model.geom(k).name for k in range(model.ngeom)} >= {
        "table_0/0",
        "table_0/1",
        "mat_0/0",
        "chest_0/0",
    }
    save_pack(pack, tmp_path / "saved")
    again = load_pack(tmp_path / "saved")
    assert again.homes == pack.homes and again.props == pack.props


def test_tilted_things_keep_their_tilt(folder: Path) -> None:
    path = folder / "configs" / "scenes" / f"{SCENE}.scene_instance.json"
    body = json.loads(path.read_text())
    half = np.sqrt(0.5)
    body["object_instances"][0]["rotation"] = [half, half, 0, 0]
    write(path, body)
    pack = open_replica_cad(folder)
    at = next(p for p in pack.homes[0].props if p.template == "table")
    assert at.quat is not None and np.allclose(at.quat, [half, half, 0, 0])
    points = corners(pack, "table")
    assert points[:, 2].max() == pytest.approx(0.7) and points[
        :, 2
    ].min() == pytest.approx(0.1)


def test_a_missing_stage_gives_floor_and_one_warning(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "mjhab"):
        pack = open_replica_cad(folder)
        open_replica_cad(folder)
    (record,) = caplog.records
    assert (
        "stages/Stage.glb missing" in record.message
        and "--stage-mesh FILE" in record.message
    )
    home = pack.homes[0]
    assert home.walls == ()
    x0, y0, x1, y1 = home.floor
    assert x0 < -2 and x1 > 2 and y0 < -3 and y1 > 2.5


def test_stage_mesh_of_the_data_set_or_of_the_user(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    box_glb(folder / "stages" / "Stage.glb", (4.0, 1.5, 3.0), at=((0, 1.5, 0),))
    with caplog.at_level(logging.WARNING, "mjhab"):
        home = open_replica_cad(folder).homes[0]
    assert (
        not caplog.records
        and len(home.walls) == 4
        and home.floor == pytest.approx((-4, -3, 4, 3))
    )
    other = box_glb(folder.parent / "other.glb", (5.0, 1.5, 3.0), at=((0, 1.5, 0),))
    staged = open_pack(PackRequest(str(folder), stage_mesh=str(other)))
    assert staged.homes[0].floor == pytest.approx((-5, -3, 5, 3))
    with refused(where="none.glb", said="this stage mesh does not exist"):
        open_pack(PackRequest(str(folder), stage_mesh=str(folder / "none.glb")))
    with refused("stage_mesh", str(other), expected="kind 'builtin'"):
        open_pack(PackRequest(stage_mesh=str(other)))


def test_options_of_a_pack_travel_as_a_dataclass_and_through_files(folder: Path) -> None:
    stage = box_glb(folder.parent / "stage.glb", (5.0, 1.5, 3.0), at=((0, 1.5, 0),))
    request = PackRequest(
        str(folder), ("kitchen_cupboards", "cabinet"), str(stage), (SCENE,)
    )
    assert open_pack(request).homes[0].floor == pytest.approx((-5, -3, 5, 3))
    assert open_pack(json.loads(json.dumps(request.as_json()))) is open_pack(request)
    assert pack_request(f"{folder}?articulate=cabinet?stage={stage}") == PackRequest(
        str(folder), ("cabinet",), str(stage), stage="own"
    )
    assert PackRequest("builtin").as_json() == "builtin"
    with refused("furniture to articulate", "cabinets", expected="cabinet"):
        open_pack(PackRequest(str(folder), ("cabinets",)))
    with refused("articulate", ("cabinet",), expected="replica_cad"):
        open_pack(PackRequest("builtin", ("cabinet",)))
    with refused("field of assets", "stage_meshes", expected="stage_mesh"):
        open_pack({"place": str(folder), "stage_meshes": str(stage)})


def test_scenes_may_be_an_option(folder: Path) -> None:
    scenes = folder / "configs" / "scenes"
    shutil.copy(
        scenes / f"{SCENE}.scene_instance.json", scenes / "apt_0.scene_instance.json"
    )
    (home,) = open_pack(PackRequest(str(folder), scenes=("apt_*",))).homes
    assert home.name == "apt_0"


def test_other_scenes_by_their_file(folder: Path) -> None:
    scenes = folder / "configs" / "scenes"
    shutil.copy(
        scenes / f"{SCENE}.scene_instance.json", scenes / "apt_0.scene_instance.json"
    )
    assert [h.name for h in open_replica_cad(folder).homes] == [SCENE]
    (home,) = open_pack(str(scenes / "apt_0.scene_instance.json")).homes
    assert (home.name, home.split) == ("apt_0", "train")
    with refused("scene", "apt_1", expected="apt_0"):
        open_replica_cad(folder, ("apt_1",))


def test_other_scenes_by_their_names(folder: Path) -> None:
    scenes = folder / "configs" / "scenes"
    for name in ("apt_0", "apt_1"):
        shutil.copy(
            scenes / f"{SCENE}.scene_instance.json",
            scenes / f"{name}.scene_instance.json",
        )
    for names, expected in {
        "apt_0": ["apt_0"],
        "apt_*": ["apt_0", "apt_1"],
        f"{SCENE},apt_1": ["apt_1", SCENE],
    }.items():
        assert [home.name for home in open_pack(f"{folder}/{names}").homes] == expected
    (outer := folder.parent / "outer").mkdir()
    folder.rename(outer / "replica_cad")
    assert [home.name for home in open_pack(f"{outer}/apt_1").homes] == ["apt_1"]
    with refused("scene", "apt_2", expected="apt_1"):
        open_pack(f"{outer}/apt_0,apt_2")


def test_objects_that_may_move_stand_fixed_with_one_warning(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = folder / "configs" / "scenes" / f"{SCENE}.scene_instance.json"
    body = json.loads(path.read_text())
    still = open_replica_cad(folder).homes[0].props
    body["object_instances"][0]["motion_type"] = "DYNAMIC"
    write(path, body)
    with caplog.at_level(logging.WARNING, "mjhab"):
        assert open_replica_cad(folder).homes[0].props == still
        open_replica_cad(folder)
    (told,) = [r.message for r in caplog.records if "DYNAMIC" in r.message]
    assert (
        f"objects that may move in {SCENE} (motion_type DYNAMIC) stand fixed here" in told
    )


def test_the_data_set_inside_a_folder_is_found(folder: Path) -> None:
    outer = folder.parent / "outer"
    shutil.copytree(folder, outer / "replica_cad")
    assert open_pack(str(outer)).homes[0].name == SCENE


# -- bad input -------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_not_the_data_set(folder: Path) -> None:
    shutil.rmtree(folder / "urdf")
    with refused(
        where="data",
        said="not a whole ReplicaCAD data set: urdf missing; `mjhab assets fetch",
    ):
        open_pack(str(folder))


OBJECTS = "configs/objects/frl_apartment_table.object_config.json"
SCENES = f"configs/scenes/{SCENE}.scene_instance.json"


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            OBJECTS,
            '"render_asset"',
            '"rendered_asset"',
            "table.object_config.json: field 'render_asset' is missing",
        ),
        (
            OBJECTS,
            '"position": [0, 0.5, 0]',
            '"position": [0, 0.5]',
            "Top_frl_apartment_table.position: expected 3",
        ),
        (OBJECTS, "}", "", "table.object_config.json: not valid JSON"),
        (
            SCENES,
            '"translation": [1, 0.4, 2]',
            '"translation": "up"',
            "object_instances[0].translation: expect",
        ),
        (
            SCENES,
            '"rotation": [0.6, 0, 0.8, 0]',
            '"rotation": [0, 0, 0, 0]',
            "object_instances[0].rotation: not a",
        ),
        (
            SCENES,
            "frl_apartment_mat",
            "frl_apartment_mouse",
            "frl_apartment_mouse.object_config.json: cannot",
        ),
        (
            SCENES,
            '"template_name": "chest"',
            '"template_name": "desk"',
            "urdf: has no desk.urdf, which a scene names",
        ),
        (
            SCENES,
            '"template_name": "chest"',
            '"template_nam": "chest"',
            "articulated_object_instances[0].templ",
        ),
        (
            SCENES,
            '"stage_instance"',
            '"stage"',
            "staging_07.scene_instance.json: field 'stage_instance' is missing",
        ),
        (
            "urdf/chest/chest.urdf",
            'type="fixed"',
            'type="floating"',
            "chest.urdf: joint 'up': unknown type 'float",
        ),
        (
            SCENES,
            '"template_name": "frl_apartment_mat"',
            '"template_name": "../../mat"',
            "[1].template_name must be a name",
        ),
        (
            SCENES,
            '"template_name": "chest"',
            '"template_name": "/chest"',
            "[0].template_name must be a name",
        ),
        (
            SCENES,
            '"translation": [1, 0.4, 2]',
            '"translation": [1e300, 0.4, 2]',
            "[0].translation: expected 3",
        ),
        (
            SCENES,
            '"translation": [1, 0.4, 2]',
            '"translation": [900, 0.4, 2]',
            "floor must be in the range",
        ),
        (
            SCENES,
            '"uniform_scale": 0.5',
            '"uniform_scale": 1e300',
            "[0].uniform_scale: expected 1 numbers",
        ),
        (
            SCENES,
            '"uniform_scale": 0.5',
            '"uniform_scale": -1',
            "[0].uniform_scale must be a number above 0, got -1",
        ),
        (
            SCENES,
            '"uniform_scale": 0.5',
            '"uniform_scale": "big"',
            "[0].uniform_scale: expected 1 numbers",
        ),
        (
            OBJECTS,
            '"position": [0, 0.5, 0]',
            '"position": [0, 1e300, 0]',
            "frl_apartment_table.position: expected 3",
        ),
        (
            "urdf/chest/chest.urdf",
            "chest.glb",
            "cheese.glb",
            ("render mesh ", "cheese.glb does not exist"),
        ),
    ],
)
def test_a_broken_file_is_one_error_that_names_file_and_field(
    file: str, old: str, new: str, message: str | tuple[str, ...], folder: Path
) -> None:
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with refused(said=message) as error:
        open_replica_cad(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "file",
    [
        "objects/frl_apartment_table.glb",
        "objects/convex/frl_apartment_table_cv_decomp.glb",
        SCENES,
        OBJECTS,
    ],
)
def test_a_cut_off_file_leaves_nothing_in_the_cache(
    file: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path / "cache"))
    raw = (folder / file).read_bytes()
    (folder / file).write_bytes(raw[: len(raw) // 2])
    with pytest.raises(UsageError, match=Path(file).name):
        open_replica_cad(folder)
    assert not list((tmp_path / "cache").rglob("*.*"))


def test_a_broken_cache_file_is_made_anew(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path / "cache"))
    open_replica_cad(folder)
    cached = sorted((tmp_path / "cache" / "replica_cad").glob("*.npz"))
    whole = [file.read_bytes() for file in cached]
    assert whole
    for file, content in zip(cached, whole, strict=True):
        file.write_bytes(content[:50])
    assert len(open_replica_cad(folder).meshes["table/look"].faces) == 12  # type: ignore[attr-defined]
    assert all(file.stat().st_size > 50 for file in cached)
