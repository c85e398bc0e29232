"""Export of an episode as one self-contained HTML page: geometry, poses, time line, curves and camera images.

The page renders with WebGL (`page.js`). All numbers are in one block of bytes, compressed with zlib; a JSON header has
the offset, size and type of every array. Positions are quantized to 16 bits.
"""

from __future__ import annotations

import io
import json
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mjhab.core.errors import MjhabError
from mjhab.core.files.cache import write_atomic
from mjhab.core.timing import STEP_SECONDS
from mjhab.data.store.schema import STORED_CHECKS
from mjhab.render.layout_scene import build_render_scene
from mjhab.render.models import DrawnHome, Look, Model, home_models
from mjhab.render.pictures.follow_camera import FollowCamera
from mjhab.reports.pages import base64_text, render_page
from mjhab.reports.plots import event_tone, kind_color
from mjhab.tasks.scoring import term_names
from mjhab.viewer.drawn.cameras import CameraThread
from mjhab.viewer.drawn.posing import Poser, base_of
from mjhab.viewer.export.stills import Still
from mjhab.viewer.pages.timeline import TONE_COLORS, actor_colors, subtask_spans
from mjhab.viewer.sources.replay import Replay
from mjhab.viewer.sources.track import Track

MAX_BYTES = 5_000_000
"""Largest size of a page [bytes], so that it can be attached to a message."""
DETAILS: tuple[tuple[int | None, int], ...] = (
    (None, 100),
    (1200, 60),
    (400, 40),
    (120, 0),
)
"""Levels of detail that are tried until a page is small enough: most faces per mesh (None: all), images per camera."""
PICTURE_SIDE_PX = 128
JPEG_QUALITY = 70
_ALIGNMENT = 4
_TOP = 65535.0


@dataclass(frozen=True)
class ExportedPage:
    """A page that was written. file: its path. bytes: its size. frames: number of states in it."""

    file: Path
    bytes: int
    frames: int


def export_page(
    replay: Replay, title: str, file: Path, stills: Sequence[Still] = ()
) -> ExportedPage:
    """Write a recorded episode as a page.

    Args:
        replay: has the episode, which it then shows.
        title: title of the episode, of ``replay.choices``.
        file: the file to write.
        stills: pictures of it, see `stills.stills_of`.

    Raises:
        MjhabError: the page is larger than `MAX_BYTES` at every level of detail.
        UsageError, DamagedError: see `Replay.load`.
    """
    replay.choose(title)
    track = replay.load(title)
    scene = build_render_scene(replay.sim.layout, replay.sim.model(track.home))
    home = [h.name for h in replay.sim.layout.pack.homes].index(track.home)
    size = 0
    shown = [{"step": still.step, "picture": _jpeg_url(still.image)} for still in stills]
    for max_faces, pictures in DETAILS:
        models = home_models(scene, home, max_faces)
        page = _page(track, models, replay, pictures, shown)
        size = len(page)
        if size <= MAX_BYTES:
            write_atomic(file, lambda temporary, page=page: temporary.write_bytes(page))
            return ExportedPage(file, size, len(track.moments))
    raise MjhabError(
        f"the page of episode {title} takes {size:,} bytes, more than {MAX_BYTES:,}: its {track.last} steps are too "
        "many for one file."
    )


def _page(
    track: Track,
    models: DrawnHome,
    replay: Replay,
    pictures: int,
    stills: list[dict[str, Any]],
) -> bytes:
    block = _Block()
    header = _header(track, models, block)
    header["stills"] = stills
    header["pose"] = _poses(track, models, replay, block)
    header["pictures"] = _pictures(track, replay, pictures, block)
    # JavaScript does not read NaN in JSON.
    head = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    packed = zlib.compress(
        # Padded, because typed arrays of JavaScript begin at multiples of their size.
        len(head).to_bytes(4, "little") + _padded(head) + block.bytes(),
        9,
    )
    page = render_page(
        "viewer/export/page.html", title=track.title, data=base64_text(packed)
    )
    return page.encode()


class _Block:
    """Concatenated bytes of arrays; ``add`` returns offset, size and type of an array."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: np.ndarray) -> dict[str, Any]:
        data = _padded(np.ascontiguousarray(array).tobytes())
        place = {"at": self._size, "n": int(array.size), "type": array.dtype.name}
        self._parts.append(data)
        self._size += len(data)
        return place

    def add_quantized(self, array: np.ndarray) -> dict[str, Any]:
        """Add columns (n, k), each quantized to uint16 between its smallest and largest value."""
        low = array.min(axis=0)
        # A flat mesh has no extent in one direction.
        span = np.maximum(array.max(axis=0) - low, 1e-9)
        place = self.add(np.round((array - low) / span * _TOP).astype(np.uint16))
        return {**place, "low": low.tolist(), "span": span.tolist()}

    def bytes(self) -> bytes:
        return b"".join(self._parts)


def _padded(data: bytes) -> bytes:
    return data + b" " * (-len(data) % _ALIGNMENT)


def _header(track: Track, models: DrawnHome, block: _Block) -> dict[str, Any]:
    moments = track.moments
    limits = [track.limit_at(step) for step in range(len(moments))]
    terms = list(dict.fromkeys(name for moment in moments for name in moment.terms))
    series = {
        "force": [m.robot_force for m in moments],
        "sum": [m.cumulative_force for m in moments],
        "limit": [0.0 if math.isinf(limit) else limit for limit in limits],
        "reward": [m.reward for m in moments],
        "active": [m.active for m in moments],
    }
    packed = {
        name: block.add(np.array(values, np.float32)) for name, values in series.items()
    }
    actors = actor_colors(track)
    places = {name: place for place, name in enumerate(actors)}
    return {
        "title": track.title,
        "home": track.home,
        "instruction": track.instruction,
        "over": track.over,
        "step": STEP_SECONDS,
        "frames": len(moments),
        "plan": [
            {
                "name": track.describe(index),
                "color": kind_color(entry.kind),
                "ended": track.ended.get(index, ""),
                "instruction": track.instruction_of(index),
                "terms": list(term_names(entry.kind)),
            }
            for index, entry in enumerate(track.plan)
        ],
        "spans": subtask_spans(track),
        "events": [
            {"step": step, "name": name, "color": TONE_COLORS[event_tone(name)]}
            for step, name in track.events
        ],
        "actors": [{"name": name, "color": color} for name, color in actors.items()],
        "actor": block.add(np.array([places[m.actor] for m in moments[1:]], np.uint8)),
        "series": packed,
        "terms": terms,
        "term": block.add(
            np.array(
                [[m.terms.get(name, 0.0) for name in terms] for m in moments], np.float32
            )
        ),
        "checks": list(STORED_CHECKS),
        "check": block.add(np.stack([m.checks for m in moments])),
        "looks": [_look(look) for look in models.looks],
        "home_model": _model(models.home, block),
        "movable": [_model(model, block) for model in models.movable],
        "lamps": [
            {"pos": pos.tolist(), "color": color.tolist()}
            for pos, color in zip(models.lamp_pos, models.lamp_color, strict=True)
        ],
    }


def _look(look: Look) -> dict[str, Any]:
    return {
        "color": np.round(look.color, 4).tolist(),
        "gloss": look.gloss,
        "texture": None if look.texture is None else _jpeg_url(look.texture),
    }


def _jpeg_url(picture: np.ndarray) -> str:
    return f"data:image/jpeg;base64,{base64_text(_jpeg(picture))}"


def _jpeg(picture: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=JPEG_QUALITY)
    return file.getvalue()


def _model(model: Model, block: _Block) -> dict[str, Any]:
    parts = []
    for part in model.parts:
        wide = np.uint32 if len(part.vertices) > _TOP else np.uint16
        parts.append(
            {
                "look": part.look,
                "vertices": block.add_quantized(part.vertices),
                "normals": block.add(np.round(127 * part.normals).astype(np.int8)),
                "uv": block.add_quantized(part.uv),
                "faces": block.add(part.faces.astype(wide)),
            }
        )
    return {"bodies": list(model.bodies), "parts": parts}


def _poses(
    track: Track, models: DrawnHome, replay: Replay, block: _Block
) -> dict[str, Any]:
    """Quantized positions and orientations of the movable bodies, as differences of states, which compress well."""
    poser = Poser(replay.sim)
    bodies = [body for model in models.movable for body in model.bodies]
    poses = [poser.pose(track.home, moment.qpos) for moment in track.moments]
    pos = np.stack([pose.pos[bodies] for pose in poses])
    quat = np.stack([pose.quat[bodies] for pose in poses])
    low = pos.reshape(-1, 3).min(axis=0)
    # One scale for all axes, so that the page needs one number.
    span = float(np.ptp(pos.reshape(-1, 3), axis=0).max()) + 1e-9
    whole = np.concatenate(
        [np.round((pos - low) / span * _TOP), np.round((quat + 1.0) / 2.0 * _TOP)],
        axis=2,
        # Differences wrap around in uint16, and the sum in the page wraps back.
    ).astype(np.uint16)
    change = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1]))
    # Transposed, so that the differences of one coordinate are adjacent.
    place = block.add(change.reshape(len(change), -1).T)
    eye, target = FollowCamera(replay.sim.model).look(
        track.home, base_of(poses[0], replay.sim)
    )
    base = bodies.index(
        replay.sim.addresses.robot_body[replay.sim.layout.robot.base_link]
    )
    hand = bodies.index(replay.sim.addresses.robot_body[replay.sim.layout.robot.tcp])
    contacts = [pose.contacts for pose in poses]
    counts = np.array([len(points) for points in contacts], np.uint8)
    points = np.concatenate([*contacts, np.zeros((1, 3))]).astype(np.float32)
    return {
        **place,
        "bodies": bodies,
        "low": low.tolist(),
        "span": span,
        "base": base,
        "eye": eye.tolist(),
        "target": target.tolist(),
        "hand": hand,
        "contacts": block.add(points),
        "contact_counts": block.add(counts),
    }


def _pictures(
    track: Track, replay: Replay, count: int, block: _Block
) -> dict[str, Any] | None:
    """JPEG images of the robot's cameras in ``count`` evenly spaced states; None for 0."""
    if not count:
        return None
    states = np.unique(
        np.linspace(0, track.last, min(count, len(track.moments))).astype(int)
    )
    files: dict[str, list[bytes]] = {
        name: [] for name in replay.sim.layout.robot.camera_names
    }
    for views in _views(track, replay, states.tolist()):
        for name, picture in views.items():
            files[name].append(_jpeg(picture))
    return {
        "states": states.tolist(),
        "cameras": {
            name: {
                **block.add(np.frombuffer(b"".join(made), np.uint8)),
                "sizes": [len(file) for file in made],
            }
            for name, made in files.items()
        },
    }


def _views(
    track: Track, replay: Replay, states: list[int]
) -> Iterator[dict[str, np.ndarray]]:
    poser = Poser(replay.sim)
    cameras = CameraThread(lambda _: None, PICTURE_SIDE_PX)
    try:
        for state in states:
            pose = poser.pose(track.home, track.moments[state].qpos)
            yield cameras.draw(replay.sim, track.home, pose)
    finally:
        cameras.close()
