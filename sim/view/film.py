"""Pictures one after the other as a file: GIF by Pillow, MP4 by ffmpeg where it is installed."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sim.files import write
from sim.scenario import InputError

Picture = NDArray[np.uint8]  # (height, width, 3)

FORMATS = (".gif", ".mp4")
COLOURS = 32  # of a GIF: few, so that it stays small


def check_film(path: Path) -> None:
    """Whether such a film can be written, before any work is done. Raises InputError."""
    if path.suffix not in FORMATS:
        raise InputError(f"--video {path}: the name must end in {' or '.join(FORMATS)}")
    if path.is_dir():
        raise InputError(f"--video {path}: is a folder, expected a file")
    if not path.parent.is_dir():
        raise InputError(f"--video {path}: the folder {path.parent} does not exist")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(f"--video {path}: MP4 needs ffmpeg, which is not on the PATH; a .gif needs nothing")


def save_film(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Write the film and return its number of pictures. Raises InputError where ffmpeg refuses."""
    return _gif(path, pictures, fps) if path.suffix == ".gif" else _mp4(path, pictures, fps)


def _gif(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    images: list[Image.Image] = []
    for picture in pictures:
        image = Image.fromarray(picture)
        # one palette for all, from the first: colours do not flicker, and what stands still costs nothing
        first = images[0] if images else None
        images.append(
            image.quantize(COLOURS, dither=Image.Dither.NONE)
            if first is None
            else image.quantize(palette=first, dither=Image.Dither.NONE)
        )

    def content(file: BinaryIO) -> None:
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)

    write(path, content)
    return len(images)


def _mp4(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Pictures go to ffmpeg one by one; the file is written elsewhere and copied when it is complete."""
    with tempfile.TemporaryDirectory() as folder:
        whole, count, encoder = Path(folder) / "film.mp4", 0, None
        for picture in pictures:
            if encoder is None:
                encoder = _ffmpeg(whole, picture, fps)
                assert encoder.stdin
            encoder.stdin.write(picture.tobytes())
            count += 1
        assert encoder  # a film has at least one picture
        _, complaint = encoder.communicate()
        if encoder.returncode:
            raise InputError(f"--video {path}: ffmpeg: {complaint.decode(errors='replace').strip()}")
        write(path, whole.read_bytes())
    return count


def _ffmpeg(path: Path, picture: Picture, fps: float) -> subprocess.Popen[bytes]:
    height, width, _ = picture.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    command = ["ffmpeg", "-loglevel", "error", "-y", *source, "-pix_fmt", "yuv420p", str(path)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
