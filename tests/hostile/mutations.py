"""Changed copies of sound files: bytes turned and cut off, and values of the structure replaced by unfit ones."""

from __future__ import annotations

import copy
import io
import json
import math
import random
import re
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

Mutator = Callable[[bytes, random.Random], bytes]
"""A changed copy of the content of a file."""
Path = tuple[str | int, ...]

UNFIT: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1,
    0.5,
    2**31,
    2**63,
    10**30,
    -(10**400),
    1e300,
    -1e300,
    math.nan,
    math.inf,
    "",
    "null",
    "x" * 5000,
    "../../x",
    "a\0b",
    "\ud800",
    [],
    [[]],
    [None],
    [1e300] * 3,
    {},
    {"a": 1},
)
"""What may stand in a file in place of any value."""
UNFIT_TEXTS = (
    "",
    "nan",
    "1e300",
    "-1",
    "x",
    "0 0",
    "0 0 0 0",
    "inf inf inf",
    "../../x",
    "a" * 5000,
    "root",
    "true",
)


def changed_bytes(raw: bytes, rng: random.Random) -> bytes:
    """Some bytes turned, cut out, doubled or cut off."""
    data = bytearray(raw)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(max(1, len(data)))
        end = min(len(data), at + rng.choice((1, 2, 8, 64)))
        match rng.randrange(5):
            case 0:
                data[at:end] = rng.randbytes(end - at)
            case 1:
                del data[at:end]
            case 2:
                data[at:at] = data[at:end]
            case 3:
                del data[at:]
            case _:
                data[at:end] = rng.choice(
                    (b"-1", b"1e999", b"null", b"[]", b'""', b"99999999999")
                )
    return bytes(data)


def changed_json(raw: bytes, rng: random.Random) -> bytes:
    """One or two values of a JSON text, leaves or whole branches, replaced, moved by one, or left out."""
    root = [json.loads(raw)]
    for _ in range(rng.randint(1, 2)):
        _change(root, rng)
    return json.dumps(root[0]).encode()


def _change(root: list[Any], rng: random.Random) -> None:
    path = rng.choice([path for path in _places(root, ()) if path])
    holder: Any = root
    for key in path[:-1]:
        holder = holder[key]
    key = path[-1]
    value = holder[key]
    kind = rng.random()
    if kind < 0.15 and path != (0,):
        del holder[key]
    elif kind < 0.3 and isinstance(value, int | float):
        # Wrong by little: counts, indices and offsets.
        holder[key] = value + rng.choice((-1, 1, 3, 1000))
    elif kind < 0.4 and isinstance(value, list) and value:
        holder[key] = value * 2 if rng.random() < 0.5 else value[:-1]
    else:
        holder[key] = copy.deepcopy(rng.choice(UNFIT))


def _places(value: Any, path: Path) -> Iterator[Path]:
    yield path
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _places(entry, (*path, key))
    if isinstance(value, list):
        for number, entry in enumerate(value):
            yield from _places(entry, (*path, number))


def changed_glb(raw: bytes, rng: random.Random) -> bytes:
    """`changed_json` in the JSON chunk of a binary glTF file, whose lengths stay right."""
    length = struct.unpack_from("<I", raw, 12)[0]
    text = changed_json(raw[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + raw[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def changed_xml(raw: bytes, rng: random.Random) -> bytes:
    """An attribute replaced, and sometimes a tag left out."""
    text = raw.decode()
    found = rng.choice(list(re.finditer(r'"([^"]*)"', text)))
    value = rng.choice((*UNFIT_TEXTS, f"{found.group(1)} 1"))
    text = text[: found.start(1)] + value + text[found.end(1) :]
    if rng.random() < 0.3:
        tag = rng.choice(list(re.finditer(r"<[^>]+>", text)))
        text = text[: tag.start()] + text[tag.end() :]
    return text.encode()


def changed_arrays(raw: bytes, rng: random.Random) -> bytes:
    """An array of an ``.npz`` file with another shape, another type, other values, or left out."""
    with np.load(io.BytesIO(raw), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    for _ in range(rng.randint(1, 2)):
        if arrays:
            name = rng.choice(sorted(arrays))
            made = _changed_array(arrays.pop(name), rng)
            if made is not None:
                arrays[name] = made
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _changed_array(array: np.ndarray, rng: random.Random) -> np.ndarray | None:
    if array.dtype.kind == "U" and not array.ndim and rng.random() < 0.7:
        return _changed_text(array, rng)
    with np.errstate(all="ignore"):
        match rng.randrange(9):
            case 0:
                return None
            case 1:
                return array[..., None]
            case 2:
                return array[:0] if array.ndim else np.zeros(3)
            case 3:
                return np.concatenate([array, array]) if array.ndim else array[None]
            case 4:
                return array.ravel()
            case 5:
                return np.full(array.shape, rng.choice((math.nan, 1e300, -5.0, 0.5)))
            case 6:
                return np.full(array.shape, rng.choice((2**62, -1, 0)))
            case 7:
                return np.full(array.shape, rng.choice(("", "../../x", "x" * 500)))
            case _:
                return np.full(array.shape, rng.choice((True, 1j, b"x")))


def _changed_text(array: np.ndarray, rng: random.Random) -> np.ndarray:
    try:
        text = changed_json(str(array).encode(), rng).decode()
    except ValueError:
        text = rng.choice(UNFIT_TEXTS)
    return np.array(text)


def changed_safetensors(raw: bytes, rng: random.Random) -> bytes:
    """A value in the header of a safetensors file replaced, mostly in the JSON that its metadata hold."""
    length = struct.unpack_from("<Q", raw)[0]
    head = raw[8 : 8 + length]
    if rng.random() < 0.8:
        values = json.loads(head)
        told = values["__metadata__"]
        name = rng.choice(sorted(told))
        told[name] = changed_json(told[name].encode(), rng).decode()
        text = json.dumps(values).encode()
    else:
        text = changed_json(head, rng)
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + raw[8 + length :]


TENSORS: tuple[Callable[[torch.Tensor], Any], ...] = (
    lambda t: t[:0],
    lambda t: t[None],
    lambda t: t.flatten(),
    lambda t: t.double(),
    lambda t: t.to(torch.complex64),
    lambda t: t.bool(),
    lambda t: t.to_sparse(),
    lambda t: torch.full_like(t, float("nan")),
    lambda t: torch.zeros(()),
    lambda t: t.tolist(),
    lambda t: None,
)


def changed_torch(raw: bytes, rng: random.Random) -> bytes:
    """A checkpoint of torch with one tensor changed, renamed or gone, or other content around the tensors."""
    content: dict[str, Any] = torch.load(io.BytesIO(raw), weights_only=True)
    weights = content["agent"]
    name = rng.choice(sorted(weights))
    way = rng.random()
    if way < 0.6:
        weights[name] = rng.choice(TENSORS)(weights[name])
    elif way < 0.8:
        weights[rng.choice(["", "actor.", 3, f"{name}.weight"])] = weights.pop(name)
    else:
        content["agent"] = rng.choice(
            [weights[name], {}, [], None, 3, "text", {"agent": weights}]
        )
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()
