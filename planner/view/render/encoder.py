"""Write frames as H.264 that a browser plays, as GIF or as animated PNG, by the ffmpeg that imageio-ffmpeg brings.

imageio's own writer ignores ffmpeg's exit code: a disk that fills up at the end would leave a broken file and no error.
"""

from __future__ import annotations

import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np

from planner.base.errors import FileError
from planner.base.files import PathLike, file_error

# Filters, where the last frame is repeated among them, and the form of the file.
_H264 = (
    # Say which YUV it is: players guess by picture size, and half of them would shift the colours.
    "scale=out_color_matrix=bt709:out_range=tv,{held}",
    "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv",
    "-c:v", "libx264", "-preset", "veryfast", "-crf", "18", "-pix_fmt", "yuv420p",
    # The index in front lets a browser start before it has everything.
    "-movflags", "+faststart", "-f", "mp4",
)  # fmt: skip
_GIF = (
    # The palette is the first frame's, which has all colours: one from all frames would keep the film in memory.
    "{held},split[a][b];[a]trim=end_frame=1,palettegen[p];[b][p]paletteuse=dither=none:diff_mode=rectangle",
    "-loop", "0", "-f", "gif",
)  # fmt: skip

# Every frame in full colour; a browser plays it wherever it shows a picture.
_APNG = ("{held}", "-plays", "0", "-f", "apng")
_FORMS = {".mp4": _H264, ".gif": _GIF, ".apng": _APNG}
FILMS = tuple(_FORMS)


class Encoder:
    """A video being written; a context manager. Memory does not grow with the number of frames."""

    def __init__(
        self, path: Path, width: int, height: int, fps: float, target: PathLike, hold: float = 0.0
    ) -> None:  # fmt: skip
        """Start ffmpeg, which shows the last frame for `hold` s more.

        Width and height are even; an error names the path `target`, as `path` may be temporary.
        """
        self._target = target
        self._log = tempfile.TemporaryFile()  # noqa: SIM115, closed by __exit__
        filters, *form = _FORMS[Path(target).suffix.lower()]
        command = [
            _ffmpeg(target), "-loglevel", "error", "-y",
            "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "pipe:0",
            "-vf", filters.format(held=f"tpad=stop_mode=clone:stop_duration={hold:g}"), *form, str(path),
        ]  # fmt: skip
        try:
            self._ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._log)
        except OSError as error:
            self._log.close()
            raise FileError(f"cannot write {str(target)!r}: ffmpeg does not start ({error.strerror}).") from error

    def write(self, frame: np.ndarray) -> None:
        """Append a frame (height, width, 3), uint8; FileError where ffmpeg fails, e.g. on a full disk."""
        assert self._ffmpeg.stdin is not None
        try:
            self._ffmpeg.stdin.write(frame.tobytes())
        except OSError as error:
            raise self._complaint() from error

    def _finish(self) -> None:
        assert self._ffmpeg.stdin is not None
        try:
            self._ffmpeg.stdin.close()
        except OSError as error:
            raise self._complaint() from error
        if self._ffmpeg.wait() != 0:
            raise self._complaint()

    def __enter__(self) -> Encoder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._finish()
        finally:
            self._ffmpeg.kill()  # does nothing to a finished process
            self._ffmpeg.wait()
            if self._ffmpeg.stdin is not None:
                with suppress(OSError):  # a dead ffmpeg reads no more
                    self._ffmpeg.stdin.close()
            self._log.close()

    def _complaint(self) -> FileError:
        self._ffmpeg.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        # The first line is the cause. An OSError without errno makes file_error look whether the disk is full.
        return file_error(OSError(f"ffmpeg says: {lines[0]}" if lines else "ffmpeg died"), self._target)


def _ffmpeg(target: PathLike) -> str:
    import imageio_ffmpeg

    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        cure = "there is no ffmpeg; install it with: pip install imageio-ffmpeg."
        raise FileError(f"cannot write {str(target)!r}: {cure}") from error
