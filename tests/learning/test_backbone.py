"""Pretrained image networks: their features, what is refused, and how a checkpoint finds its file again."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from mjhab.core.errors import UsageError
from mjhab.learning.batches import BatchSampler
from mjhab.learning.checkpoint import load_student, save_student
from mjhab.learning.configs import InputConfig
from mjhab.learning.observation.backbone import Backbone, keep_copy
from mjhab.learning.observation.spec import described
from mjhab.learning.publishing import gather
from mjhab.learning.students.heads import make_student
from tests.learning.small import INPUTS, config, demonstrations, layout
from tests.missing import need_onnxruntime
from tests.onnx_file import FEATURES, IMAGENET, SIDE, WEIGHT, tiny_backbone
from tests.refusals import refused

need_onnxruntime()


def images(number: int, side: int = SIDE) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (number, side, side, 3), np.uint8)


def test_features_are_those_of_each_normalized_image(tmp_path: Path) -> None:
    backbone = Backbone(tiny_backbone(tmp_path / "tiny.onnx"))
    assert (backbone.spec.size, backbone.spec.features) == (SIDE, FEATURES)
    seen = images(3)
    found = backbone.features(seen)
    mean, std = (
        np.array([float(x) for x in IMAGENET[key].split()]) for key in ("mean", "std")
    )
    pixels = (seen / 255 - mean) / std
    blocks = pixels.reshape(3, SIDE // 4, 4, SIDE // 4, 4, 3).mean(axis=(1, 3))
    wanted = np.einsum("nijc,fcij->nf", blocks, WEIGHT)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    assert found.dtype == np.float32
    small, large = (
        np.full((1, side, side, 3), (9, 99, 199), np.uint8) for side in (SIDE, 30)
    )
    # Images of another size are resized to that of the network.
    np.testing.assert_array_equal(backbone.features(small), backbone.features(large))


def test_an_image_is_computed_once_and_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_backbone(tmp_path / "tiny.onnx")
    seen = images(6)
    alone = np.concatenate([Backbone(path).features(image[None]) for image in seen])
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    backbone = Backbone(path)
    np.testing.assert_array_equal(backbone.features(seen), alone)
    runs: list[int] = []
    compute = backbone._run
    monkeypatch.setattr(
        backbone, "_run", lambda *given: (runs.append(1), compute(*given))[1]
    )
    again = np.concatenate([seen[2:], 255 - seen[:1], seen[3:4]])
    np.testing.assert_array_equal(backbone.features(again)[:4], alone[2:])
    assert len(runs) == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"metadata": {}}, "metadata mean must be three numbers"),
        ({"metadata": IMAGENET | {"std": "1 0 1"}}, "std must be above 0"),
        ({"shape": (2, 3, SIDE, SIDE)}, "no single square image"),
        ({"shape": (1, 3, SIDE, 12)}, "no single square image"),
        ({"shape": (1, 1, SIDE, SIDE)}, "its inputs are"),
        ({"pooled": False}, "for one image"),
    ],
)
def test_other_networks_are_refused_with_what_to_do(
    options: dict, said: str, tmp_path: Path
) -> None:
    path = tiny_backbone(tmp_path / "wrong.onnx", **options)
    with pytest.raises(UsageError, match=f"(?s){said}.*docs/training.md"):
        Backbone(path)


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.onnx"
    with pytest.raises(UsageError, match="does not exist"):
        Backbone(path)
    path.write_bytes(b"no network")
    with pytest.raises(UsageError, match="cannot be read as an ONNX network"):
        Backbone(path)
    with refused("inputs.backbone", str(path), advice="take a preset that has some"):
        InputConfig(cameras=(), image_size=0, backbone=str(path))


def test_a_checkpoint_finds_its_backbone_again_or_says_which_it_needs(
    tmp_path: Path,
) -> None:
    path = tiny_backbone(tmp_path / "given.onnx")
    inputs = dataclasses.replace(INPUTS, backbone=str(path), shift=1, colour_shift=0.2)
    inputs = dataclasses.replace(inputs, whole_views=False)
    told = dataclasses.replace(layout(inputs), backbone=described(inputs))
    assert told.backbone is not None
    assert told.width == layout(INPUTS).width + FEATURES * len(inputs.cameras)
    assert told.image_keys == () and told.env_options()["obs_mode"] == "rgb"
    assert told.without_images().width == layout(INPUTS).width
    data = demonstrations(told=told)
    data = dataclasses.replace(data, images=data.images[:, :, :0, :0])
    student = make_student(config(inputs=inputs), told)
    student.fit_normalizers(data)
    batch = BatchSampler([data], 4, 0.0, 0).batch(0, 4, inputs)
    noise = np.zeros((4, 0, 4, len(told.actions)), np.float32)
    acted = student.eval().act(batch.vector, batch.images, noise)

    file = tmp_path / "run" / "student.safetensors"
    file.parent.mkdir()
    save_student(file, student, {"step": 1})
    assert load_student(file).layout.inputs.backbone == str(path)
    keep_copy(str(path), told.backbone, file.parent)
    tiny_backbone(path, {**IMAGENET, "std": "1 1 1"})
    with pytest.raises(UsageError, match="was begun with another backbone"):
        keep_copy(str(path), described(inputs) or told.backbone, file.parent)
    path.unlink()
    (tmp_path / "moved").mkdir()
    gather(file, tmp_path / "moved")
    shutil.rmtree(file.parent)
    loaded = load_student(tmp_path / "moved" / file.name)
    np.testing.assert_array_equal(loaded.act(batch.vector, batch.images, noise), acted)
    (tmp_path / "moved" / "backbone.onnx").unlink()
    with pytest.raises(UsageError, match=f"SHA-256 {told.backbone.sha256}"):
        load_student(tmp_path / "moved" / file.name)
