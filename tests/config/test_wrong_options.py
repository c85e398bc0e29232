"""Options of another type or out of range are refused where a configuration is made, in one line that names them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import gymnasium
import numpy as np
import pytest

import mjhab
from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.scenes.pack_source import PackRequest, pack_request
from tests.refusals import refused

WRONG: dict[Any, tuple[Any, ...]] = {
    str: (3, 1.5, True, [], ["a"], {}, b"x", object(), "x" * 20_000, "a\0b", math.nan),
    int: (
        "3",
        1.5,
        True,
        [],
        {},
        -1,
        2**64,
        10**30,
        math.nan,
        np.bool_(True),
        np.float64(2),
    ),
    float: ("a", True, [], {}, math.nan, math.inf, -1.0, 2.0, 10**400),
    bool: ("no", 2, 3.0, [], math.nan),
    tuple: ("x", 3, [3], [None], [["a"]], {"a": 1}, {"a"}, ["x" * 20_000]),
    Mapping: (3, "x", [1], {3: 4}, True),
}
OTHERWISE_READ = {"assets"}
"""An asset pack may be asked for by several types, see below."""


def type_name(value: Any) -> str:
    """Names of tests that are the same in every process."""
    return type(value).__name__


def wrong() -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, hint in get_type_hints(EnvConfig).items():
        if (
            name
            not in {field.name for field in dataclasses.fields(EnvConfig)}
            - OTHERWISE_READ
        ):
            continue
        kinds = {get_origin(kind) or kind for kind in get_args(hint) or (hint,)}
        kinds = {get_origin(hint)} if get_origin(hint) in (tuple, Mapping) else kinds
        # Of options with several types, what fits none of them.
        for kind in kinds & set(WRONG) if len(kinds - {type(None)}) == 1 else {Mapping}:
            found += [(name, value) for value in WRONG[kind]]
    return found


@pytest.mark.parametrize("config", [EnvConfig, TrainConfig])
def test_values_of_another_type_are_refused_by_name(config: type[EnvConfig]):
    # One number of pixels and one name of a camera are taken as well.
    fitting = {"camera_size": int, "cameras": str}
    cases = [
        (name, value) for name, value in wrong() if type(value) is not fitting.get(name)
    ]
    assert len(cases) > 250
    for name, value in cases:
        with refused() as error:
            config(**{"task": "set_table", "subtask": "pick", name: value})
        said = str(error.value)
        assert name.split("_")[0] in said and "\n" not in said and len(said) < 500, (
            name,
            said,
        )


@pytest.mark.parametrize(
    "size", [0, 10**6, (3,), (3, 4, 5), (0, 3), ("a", "b"), 1.5, "128"]
)
def test_sizes_of_images_are_one_or_two_numbers(size: Any):
    with refused("camera_size"):
        EnvConfig(camera_size=size)


def test_paths_lists_and_numbers_of_numpy_are_taken_for_what_they_mean():
    config = EnvConfig(
        num_envs=np.int64(3),  # type: ignore[arg-type]
        camera_size=[32, 64],  # type: ignore[arg-type]
        extra_objects=["024_bowl"],  # type: ignore[arg-type]
        spawns=Path("a.npz"),  # type: ignore[arg-type]
        open_start=np.float32(0.5),  # type: ignore[arg-type]
    )
    assert (type(config.num_envs), config.num_envs) == (int, 3)
    assert config.camera_size == (32, 64) and config.extra_objects == ("024_bowl",)
    assert config.spawns == "a.npz" and config.open_start == 0.5


def test_none_stands_for_the_default():
    names = [field.name for field in dataclasses.fields(EnvConfig)]
    options: dict[str, Any] = dict.fromkeys(names)
    assert EnvConfig(**options) == EnvConfig()


@pytest.mark.parametrize("options", [{"starts": 100}, {"buffers": {"contacts": 1000}}])
def test_options_of_another_backend_are_refused(options: dict[str, Any]):
    with refused(*options, expected="left out with backend 'cpu'"):
        EnvConfig(**options)


@pytest.mark.parametrize(
    "options", [{"spawns": "starts.npz"}, {"extra_objects": ("024_bowl",)}]
)
def test_a_file_of_episodes_leaves_no_room_for_other_places(options: dict[str, Any]):
    with refused(*options, expected="left out with episodes_file"):
        EnvConfig(episodes_file="episodes.json", **options)


@pytest.mark.parametrize("device", ["cuda:7", "cuda", "banana", "CPU"])
def test_the_cpu_backend_has_no_other_device(device: str):
    for device_free in ("", "cpu"):
        assert EnvConfig(device=device_free).device == device_free
    with refused("device", device, expected="left out with backend 'cpu'"):
        mjhab.make(device=device)


def test_auto_does_not_fall_back_from_a_device_that_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("mjhab.sim.backends.cuda_devices", list)
    with refused("device", "cuda:7"):
        mjhab.make(backend="auto", device="cuda:7")


@pytest.mark.parametrize("assets", [None, 3, 1.5, [], ["builtin"], object(), b"x"])
def test_assets_are_a_place_or_a_request(assets: Any):
    with refused("assets"):
        pack_request(assets)


@pytest.mark.parametrize(
    "fields",
    [{"place": 3}, {"articulate": "fridge"}, {"scenes": [3]}, {"stage_mesh": ["a"]}],
)
def test_fields_of_a_request_have_types(fields: dict[str, Any]):
    with refused(*fields, where="assets"):
        PackRequest(**fields)


NO_PATHS = (None, 3, math.nan, [], {}, object(), b"x", ["a"], int)


@pytest.mark.parametrize("value", NO_PATHS, ids=type_name)
def test_functions_that_take_files_name_what_is_none(value: Any):
    with refused("home file"):
        mjhab.home_pack(value)
    with refused("path of the object"):
        mjhab.object_from_glb("mug", value, 0.1)


@pytest.mark.parametrize(
    "value", [None, {}, "x", object(), int, math.nan, math.inf, [1.0]], ids=type_name
)
def test_masses_and_scales_are_numbers(value: Any):
    with refused("mass of 'mug'"):
        mjhab.object_from_glb("mug", "a.glb", value)
    with refused("scale of 'mug'"):
        mjhab.object_from_glb("mug", "a.glb", 0.1, value)


@pytest.mark.parametrize("value", [None, 3, [], "a b", "../x", object()], ids=type_name)
def test_sources_of_packs_have_a_name_and_functions(value: Any):
    with refused("name of a pack source"):
        mjhab.PackSource(value, lambda request: mjhab.open_pack())
    with refused(where="pack source 'mine'", said="must be functions"):
        mjhab.PackSource("mine", value)


def test_a_place_that_cannot_be_is_refused():
    with refused(where="assets", said="is no name of a file"):
        mjhab.open_pack("x" * 300)


@pytest.mark.parametrize(
    "register", [name for name in mjhab.__all__ if name.startswith("register_")]
)
@pytest.mark.parametrize("value", [None, 3, math.nan, [], {}, "x", int], ids=type_name)
def test_registering_functions_say_what_they_expect(register: str, value: Any):
    with refused("argument", where=f"mjhab.{register}"):
        getattr(mjhab, register)(value)


@pytest.mark.parametrize(
    "option", [{"num_envs": 4}, {"autoreset": "same_step"}, {"backend": 3}]
)
def test_a_plain_gymnasium_env_is_one_world(option: dict[str, Any]):
    with refused(*option, *option.values(), advice="make_vec"):
        gymnasium.make("mjhab/SetTable-v1", **option)


SPEC_FIELDS = {"out": (3.5, [], object(), b"x"), "style": ("x", 3, [3]), "subtask": ([], 3),
               "target": ([], 3), "env": (3, "x", [1], {3: 4}), "resume": ("no", 2)}  # fmt: skip


@pytest.mark.parametrize("run", [mjhab.evaluate, mjhab.generate])
def test_evaluations_and_data_sets_refuse_other_types_before_anything_is_written(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    for name, values in SPEC_FIELDS.items():
        for value in values:
            options = {
                "out": tmp_path / "run",
                "subtask": "close",
                "episodes": 1,
                name: value,
            }
            with refused(name):
                run("zero", **options)
    assert not list(tmp_path.iterdir())
