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
from sim.view.layout import ALARM, PALETTE, SIZE

Picture = NDArray[np.uint8]  # (height, width, 3)

FORMATS = (".gif", ".mp4")
COLOURS = 48  # of a GIF: few, so that it stays small


def check_film(path: Path) -> None:
    """Whether such a film can be written, before any work is done. Raises InputError."""
    if path.suffix not in FORMATS:
        raise InputError(f"--video {path}: the name must end in {' or '.join(FORMATS)}")
    if path.is_dir():
        raise InputError(f"--video {path}: is a folder, expected a file")
    if not path.parent.is_dir():
        raise InputError(f"--video {path}: the folder {path.parent} does not exist")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"--video {path}: cannot write to {path.parent}: {error.strerror}") from None
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(f"--video {path}: MP4 needs ffmpeg, which is not on the PATH; a .gif needs nothing")


def save_film(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Write the film and return its number of pictures. Raises InputError where ffmpeg refuses."""
    return _gif(path, pictures, fps) if path.suffix == ".gif" else _mp4(path, pictures, fps)


def _gif(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    images: list[Image.Image] = []
    palette: Image.Image | None = None
    for picture in pictures:
        # one palette for all: colours do not flicker, and what stands still costs nothing
        palette = palette or _palette(picture)
        images.append(Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE))

    def content(file: BinaryIO) -> None:
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)

    write(path, content)
    return len(images)


def _palette(first: Picture) -> Image.Image:
    """The colours of the first picture, and of what may appear later: forces, in light and in shade."""
    shades = [np.multiply(colour, light) for colour in (*PALETTE, ALARM) for light in (1.0, 0.75, 0.5)]
    strip = np.repeat(np.array(shades) * 255, -(-first.shape[1] // len(shades)), axis=0)[: first.shape[1]]
    later = np.repeat(strip[None].astype(np.uint8), first.shape[0] // 4, axis=0)
    return Image.fromarray(np.concatenate([first, later])).quantize(COLOURS, dither=Image.Dither.NONE)


def _mp4(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """ffmpeg writes elsewhere; the film is put in its place when it is complete."""
    with tempfile.TemporaryDirectory() as folder:
        raw, whole, count = Path(folder) / "film.rgb", Path(folder) / "film.mp4", 0
        with raw.open("wb") as file:
            for picture in pictures:
                file.write(picture.tobytes())
                count += 1
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "{}x{}".format(*SIZE), "-r", f"{fps:g}", "-i", str(raw)]
        command = ["ffmpeg", "-loglevel", "error", "-y", *source, "-pix_fmt", "yuv420p", str(whole)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"--video {path}: ffmpeg: {done.stderr.strip() or done.returncode}")
        write(path, whole.read_bytes())
    return count
