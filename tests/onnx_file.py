"""Small networks as ONNX files, written byte by byte: the library that writes them is no dependency of mjhab."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tests.missing import in_ci

HAS_ONNX = in_ci() or find_spec("onnxruntime") is not None
"""Whether tests run a backbone, too. In CI they do, and fail where it is absent."""
FLOAT = 1
TENSOR_FLOAT, INTS = 1, 7
IMAGENET = {"mean": "0.485 0.456 0.406", "std": "0.229 0.224 0.225"}
FEATURES = 5
SIDE = 8


def tiny_backbone(
    path: Path,
    metadata: dict[str, str] | None = None,
    shape: tuple[int, ...] = (1, 3, SIDE, SIDE),
    pooled: bool = True,
) -> Path:
    """Write a convolution of 4 x 4 pixels, the mean of its outputs, and features (1, FEATURES); weights: `WEIGHT`.

    ``pooled`` False leaves out the mean: the output is no vector.
    """
    nodes = [_node("Conv", ["pixels", "weight"], "maps", {"strides": (4, 4)})]
    if pooled:
        nodes.append(_node("GlobalAveragePool", ["maps"], "means"))
        nodes.append(_node("Flatten", ["means"], "features"))
    weight = b"".join(_number(1, size) for size in WEIGHT.shape)
    weight += _number(2, FLOAT) + _text(8, "weight") + _block(9, WEIGHT.tobytes())
    graph = b"".join(_block(1, node) for node in nodes) + _text(2, "tiny")
    graph += _block(5, weight) + _block(11, _value("pixels", shape))
    graph += _block(12, _value("features" if pooled else "maps", ()))
    model = _number(1, 8) + _block(7, graph) + _block(8, _number(2, 17))
    for key, value in (IMAGENET if metadata is None else metadata).items():
        model += _block(14, _text(1, key) + _text(2, value))
    path.write_bytes(model)
    return path


WEIGHT = np.random.default_rng(0).normal(size=(FEATURES, 3, 4, 4)).astype("<f4")


def _node(
    kind: str,
    inputs: list[str],
    output: str,
    ints: dict[str, tuple[int, ...]] | None = None,
) -> bytes:
    node = b"".join(_text(1, name) for name in inputs) + _text(2, output) + _text(4, kind)
    for name, values in (ints or {}).items():
        attribute = _text(1, name) + _number(20, INTS)
        attribute += b"".join(_number(8, value) for value in values)
        node += _block(5, attribute)
    return node


def _value(name: str, shape: tuple[int, ...]) -> bytes:
    tensor = _number(1, TENSOR_FLOAT)
    if shape:
        tensor += _block(2, b"".join(_block(1, _number(1, size)) for size in shape))
    return _text(1, name) + _block(2, _block(1, tensor))


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _block(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _block(field, text.encode())
