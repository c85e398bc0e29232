"""Video files: frames are piped to the ffmpeg of imageio-ffmpeg and encoded as H.264, which every browser plays."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np

from mjhab.core.errors import MjhabError, fault
from mjhab.core.typed.checks import check


class FilmWriter:
    """Write an mp4 (H.264, yuv420p, index before the frames) to a temporary file that `close` renames to its path.

    Use it as a context manager; an exception inside leaves no file behind. Odd sizes are extended by one repeated row
    or column, because yuv420p needs even sizes.

    Args:
        path: the mp4 to write; its folder is made if necessary.
        fps: frames per second.
        quality: x264 constant rate factor, 18 (large file) to 30 (small file).
        keyframes: distance between keyframes [frames]; 0 lets x264 choose. A small number makes random access fast.
    """

    def __init__(
        self, path: str | Path, fps: float = 20.0, quality: int = 23, keyframes: int = 0
    ) -> None:
        self.path = Path(path)
        self.fps = fps
        self.quality = quality
        self.keyframes = keyframes
        self.frames = 0
        self._shape: tuple[int, int] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._part: Path | None = None
        # A file and not a pipe: ffmpeg would stand still once nobody empties a full pipe.
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the writer)

    def __enter__(self) -> FilmWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def add(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3) uint8 sRGB; all frames have the size of the first.

        Raises:
            UsageError: the frame has another shape or dtype.
            MjhabError: ffmpeg failed.
        """
        good = frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3
        check(good, "film frame", (frame.shape, frame.dtype), "(H, W, 3) uint8")
        size = (frame.shape[0], frame.shape[1])
        if self._shape is None:
            self._shape = size
            self._process = self._start(size[0] + size[0] % 2, size[1] + size[1] % 2)
        check(
            size == self._shape,
            "film frame",
            size,
            f"{self._shape} as those before it",
            where=self.path.name,
        )
        if size[0] % 2 or size[1] % 2:
            frame = np.pad(
                frame, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge"
            )
        assert self._process is not None and self._process.stdin is not None
        try:
            # The buffer itself, without a copy as bytes.
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError as error:
            raise self._failed() from error
        self.frames += 1

    def close(self) -> None:
        """Finish the file and rename it to its path.

        Raises:
            UsageError: no frame was added.
            MjhabError: ffmpeg failed.
        """
        if self._process is None or self._part is None:
            self._log.close()
            raise fault(self.path.name, "a film needs at least one frame.")
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError as error:
            raise self._failed() from error
        # Only then is the file whole: ffmpeg writes the index when its input ends.
        if self._process.wait() != 0:
            raise self._failed()
        # Nobody ever sees half a film under its name.
        os.replace(self._part, self.path)
        self._log.close()

    def abort(self) -> None:
        """Stop ffmpeg and remove the unfinished file."""
        if self._process is not None:
            self._process.kill()
            if self._process.stdin is not None:
                # Closing flushes the buffer into a pipe that may be closed.
                with suppress(OSError):
                    self._process.stdin.close()
            self._process.wait()
        if self._part is not None:
            self._part.unlink(missing_ok=True)
        self._log.close()

    def _failed(self) -> MjhabError:
        self._log.seek(0)
        tail = self._log.read().decode(errors="replace").strip()[-400:]
        self.abort()
        return MjhabError(
            f"ffmpeg could not write {self.path}: {tail or 'it ended early'}."
        )

    def _start(self, height: int, width: int) -> subprocess.Popen[bytes]:
        # On use: environments without films need no ffmpeg.
        import imageio_ffmpeg

        self.path.parent.mkdir(parents=True, exist_ok=True)
        # In the same folder, as a rename works within one file system only; with the process, since several may write.
        self._part = self.path.with_name(f".{self.path.stem}.{os.getpid()}.part.mp4")
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y"]
        command += [
            "-f",
            "rawvideo",
            "-pix_fmt",
            "rgb24",
            "-s",
            f"{width}x{height}",
            "-r",
            str(self.fps),
            "-i",
            "-",
        ]
        command += [
            "-an",
            "-c:v",
            "libx264",
            "-preset",
            "veryfast",
            "-crf",
            str(self.quality),
            "-threads",
            "2",
        ]
        if self.keyframes:
            command += ["-g", str(self.keyframes), "-bf", "0"]
        command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", _url(self._part)]
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._log
        )


def _url(path: Path) -> str:
    """A file for ffmpeg, which takes what stands before a colon in a name for a protocol."""
    return f"file:{path}"


def join_films(parts: Sequence[Path], path: Path) -> None:
    """Concatenate videos of equal size and encoding without re-encoding.

    Args:
        parts: the videos, in order.
        path: the file to write.

    Raises:
        MjhabError: ffmpeg failed.
    """
    import imageio_ffmpeg

    quoted = (_url(part.resolve()).replace("'", r"'\''") for part in parts)
    # By standard input, which needs no file for the list.
    listed = "".join(f"file '{name}'\n" for name in quoted)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y"]
    command += [
        "-f",
        "concat",
        "-safe",
        "0",
        "-protocol_whitelist",
        "file,pipe",
        "-i",
        "pipe:0",
    ]
    command += ["-c", "copy", "-movflags", "+faststart", _url(path)]
    done = subprocess.run(command, input=listed.encode(), capture_output=True)
    if done.returncode != 0:
        tail = done.stderr.decode(errors="replace").strip()[-400:]
        raise MjhabError(f"ffmpeg could not write {path}: {tail or 'it ended early'}.")
