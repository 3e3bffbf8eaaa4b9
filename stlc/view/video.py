"""Pictures one after the other as an MP4, where there is an ffmpeg."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.diagnostics import Diagnostic, MissingError
from stlc.files import atomic_path

if TYPE_CHECKING:
    from PIL.Image import Image

ADVICE = "pip install 'stlc[video]', or ffmpeg on the path"
_CODING = ("-c:v", "libx264", "-preset", "veryfast", "-crf", "23", "-pix_fmt", "yuv420p")


def encoder() -> str | None:
    """The program that writes videos: `ffmpeg` on the path, else that of imageio-ffmpeg."""
    found = shutil.which("ffmpeg")
    if found is not None or find_spec("imageio_ffmpeg") is None:
        return found
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        return str(get_ffmpeg_exe())
    except RuntimeError:  # a platform for which the package brings none
        return None


@contextmanager
def video(path: Path, size: tuple[int, int], milliseconds: int) -> Iterator[Callable[[Image], None]]:
    """Write H.264 for every browser and player: what is yielded takes the next RGB picture.

    Args:
        path: of the file, replaced when the block ends well.
        size: width and height of all pictures; an odd last row or column is cut off.
        milliseconds: that each is seen.

    Raises:
        MissingError: R301, there is no ffmpeg, or it fails; R201, the file cannot be written.
    """
    program = encoder()
    if program is None:
        raise MissingError(Diagnostic("R301", "a video needs ffmpeg, which is not installed", help=(ADVICE,)))
    width, height = (side - side % 2 for side in size)
    with atomic_path(path) as beside:
        command = [program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        command += ["-s", f"{width}x{height}", "-r", f"{1000 / milliseconds:.6g}", "-i", "-", "-an"]
        command += [*_CODING, "-movflags", "+faststart", "-f", "mp4", str(beside)]
        running = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        assert running.stdin is not None

        def write(picture: Image) -> None:
            assert running.stdin is not None
            with suppress(BrokenPipeError):  # why it went away is told below
                running.stdin.write(picture.crop((0, 0, width, height)).tobytes())

        try:
            yield write
        except BaseException:
            running.kill()
            raise
        finally:
            _, complaint = running.communicate()
        if running.returncode:
            said = complaint.decode(errors="replace").strip().splitlines()
            raise MissingError(Diagnostic("R301", "ffmpeg cannot write the video", note=tuple(said[-1:])))
