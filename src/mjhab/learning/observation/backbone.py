"""Pretrained image networks whose frozen features a learned policy sees: ONNX files, run by onnxruntime on the CPU.

ONNX, since such a file is data: a graph of known operators with its weights. What the archives of TorchScript and
`torch.export` hold is run when they are read, and a state dict needs the classes of the library it comes from.
"""

from __future__ import annotations

import hashlib
import shutil
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from PIL import Image

from mjhab.core.arrays import Array, as_like, namespace, to_numpy
from mjhab.core.errors import fault
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.checksums import sha256_of
from mjhab.core.files.reading import is_file, read_bytes, reason
from mjhab.core.libraries import check_imports, require_libraries
from mjhab.core.typed.bounds import Bound

COPY = "backbone.onnx"
"""Name of the copy beside the checkpoints of a run."""
MOST_MB = 2048.0
"""Largest file; protobuf allows no larger one [MB]."""
MEAN, STD = "mean", "std"
"""Keys of the file's metadata: of red, green and blue, in units of the full range."""
KEPT = 4096
"""Number of images whose features are kept: worlds that did not change are not computed again."""
EXPORT = (
    "Export it with one image (1, 3, H, W) as input and features (1, F) as output, weights inside, and the metadata "
    "mean and std: see docs/training.md."
)


@dataclass(frozen=True)
class BackboneSpec:
    """What a checkpoint records of a frozen network.

    sha256: of its file. size: side of the images it takes [px]; others are resized. features: their number per image.
    """

    sha256: str
    size: Annotated[int, Bound(1, 4096)]
    features: Annotated[int, Bound(1, 16_384)]


class Backbone:
    """A frozen network: RGB images to features.

    Every image is computed by itself, so that its features depend neither on the other images nor on threads.

    Args:
        path: its file.

    Raises:
        UsageError: onnxruntime is missing, or the file is no such network.
    """

    def __init__(self, path: Path) -> None:
        require_libraries("inputs.backbone", ("onnxruntime",), "vision")
        check_imports(("onnxruntime",), "vision")
        if not is_file(path):
            raise fault(path, f"does not exist. Give a backbone as ONNX. {EXPORT}")
        # The hash and the network are of the same bytes, even if the file changes in between.
        content = read_bytes(path, MOST_MB)
        self._path = path
        self._session = _session(path, content)
        (given,) = self._inputs()
        self._input = given.name
        size = _side(path, given.shape)
        self._mean, self._std = (
            _metadata(path, self._session, key) for key in (MEAN, STD)
        )
        if not (self._std > 0).all():
            raise fault(path, f"its metadata {STD} must be above 0. {EXPORT}")
        self._kept: OrderedDict[bytes, np.ndarray] = OrderedDict()
        # The file's own description of outputs may leave sizes open.
        shape = np.shape(self._run(np.zeros((size, size, 3), np.uint8), size))
        if len(shape) != 2 or shape[0] != 1:
            raise fault(path, f"its first output is {shape} for one image. {EXPORT}")
        self.spec = BackboneSpec(hashlib.sha256(content).hexdigest(), size, shape[1])

    def _inputs(self) -> list[Any]:
        inputs = self._session.get_inputs()
        fits = len(inputs) == 1 and inputs[0].type == "tensor(float)"
        if not fits or len(inputs[0].shape) != 4 or inputs[0].shape[1] != 3:
            found = ", ".join(f"{each.name} {each.type} {each.shape}" for each in inputs)
            raise fault(self._path, f"its inputs are {found}. {EXPORT}")
        return inputs

    def features(self, images: np.ndarray) -> np.ndarray:
        """Features (N, F) float32 of images (N, H, W, 3) uint8 in sRGB.

        Raises:
            UsageError: a feature is not finite.
        """
        keys = [
            # The content is the key: images of worlds that stand still are equal.
            hashlib.blake2b(image.tobytes(), digest_size=16).digest()
            for image in images
        ]
        new = {
            key: image
            for key, image in zip(keys, images, strict=True)
            if key not in self._kept
        }
        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            computed = pool.map(
                lambda image: self._run(image, self.spec.size), new.values()
            )
            found = dict(zip(new, computed, strict=True))
        for key, row in found.items():
            if not np.isfinite(row).all():
                raise fault(self._path, "its features of an image are not finite.")
            self._kept[key] = row[0]
        rows = np.stack([self._kept[key] for key in keys])
        # After the rows are taken, because a batch may be larger than what is kept.
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return rows

    def _run(self, image: np.ndarray, size: int) -> np.ndarray:
        if image.shape[:2] != (size, size):
            resized = Image.fromarray(image).resize(
                (size, size), Image.Resampling.BICUBIC
            )
            image = np.asarray(resized)
        pixels = (image.astype(np.float32) / np.float32(255.0) - self._mean) / self._std
        given = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None])
        return self._session.run(None, {self._input: given})[0]


def _session(path: Path, content: bytes) -> Any:
    """The network; from bytes, so that weights in other files, which no hash here covers, are refused."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # The images share the threads, see `Backbone.features`.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # onnxruntime prints warnings and errors itself; its errors are raised as well.
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(
            content, options, providers=["CPUExecutionProvider"]
        )
    # onnxruntime's errors have no base class but Exception.
    except Exception as error:
        raise fault(
            path, f"cannot be read as an ONNX network ({reason(error)}). {EXPORT}"
        ) from error


def _side(path: Path, shape: list[Any]) -> int:
    """Side of the images of an input (N, 3, H, W)."""
    batch, _, height, width = shape
    square = isinstance(height, int) and height == width
    if not square or (isinstance(batch, int) and batch != 1):
        raise fault(path, f"its input is {shape}: no single square image. {EXPORT}")
    return height


def _metadata(path: Path, session: Any, key: str) -> np.ndarray:
    """Three numbers (3,) of the file's metadata."""
    told = session.get_modelmeta().custom_metadata_map.get(key, "")
    try:
        values = np.array([float(word) for word in told.split()], np.float32)
    except ValueError:
        values = np.empty(0, np.float32)
    if len(values) != 3 or not np.isfinite(values).all():
        raise fault(
            path, f"its metadata {key} must be three numbers, got {told[:80]!r}. {EXPORT}"
        )
    return values


@lru_cache(maxsize=4)
def _opened(path: str, changed: int) -> Backbone:
    return Backbone(Path(path))


def opened(path: str) -> Backbone:
    """The network of a file, kept for the process as long as the file stays as it is.

    Raises:
        UsageError: see `Backbone`.
    """
    # A file that was replaced has another time, and is opened again.
    return _opened(path, Path(path).stat().st_mtime_ns if is_file(Path(path)) else 0)


def frozen_features(path: str, spec: BackboneSpec, images: Array) -> Array:
    """Features (N, F) float32, of the library and device of the images (N, H, W, 3) uint8.

    Raises:
        UsageError: see `Backbone`; or the file is not the one that ``spec`` tells of.
    """
    backbone = opened(path)
    if backbone.spec != spec:
        raise fault(
            path,
            "is not the backbone that the policy was trained with, whose SHA-256 is "
            f"{spec.sha256}; its own is {backbone.spec.sha256}.",
        )
    return as_like(backbone.features(to_numpy(images)), images, namespace(images).float32)


def keep_copy(path: str, spec: BackboneSpec, folder: Path) -> None:
    """Copy a file beside the checkpoints of a run.

    Raises:
        UsageError: the run was begun with another one.
    """
    copy = folder / COPY
    if not copy.is_file():
        write_atomic(copy, lambda temporary: shutil.copyfile(path, temporary))
    elif sha256_of(copy) != spec.sha256:
        raise fault(copy, f"the run was begun with another backbone than {path}.")


def find_backbone(checkpoint: Path, path: str, spec: BackboneSpec) -> str:
    """Where the backbone of a checkpoint lies: beside it, a folder above (those of rounds), or where it was given.

    Raises:
        UsageError: in none of these places.
    """
    folder = checkpoint.resolve().parent
    places = [folder / COPY, folder.parent / COPY, Path(path)]
    for place in places:
        if is_file(place) and sha256_of(place) == spec.sha256:
            return str(place)
    raise fault(
        checkpoint,
        f"needs its backbone, the ONNX file with SHA-256 {spec.sha256}, which is in none of "
        f"{', '.join(map(str, places))}. Put it beside the checkpoint as {COPY}.",
    )
