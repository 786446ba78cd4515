"""Video files: captions on frames, MP4 and GIF."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sacformer_jax.config import ConfigError

HOLD_SECONDS = 0.5
"""How long an episode's last frame stays."""
_SMALLEST_FONT = 10
_GIF_COLORS = 128


@dataclasses.dataclass(frozen=True)
class Frame:
    """A picture and what stands on it.

    Attributes:
      image: ``[height, width, 3]`` uint8.
      caption: lines.
      num_shown: for how many frames of the video it stays.
    """

    image: np.ndarray
    caption: tuple[str, ...]
    num_shown: int = 1


def check_packages() -> None:
    """Refuses where the packages that write videos are missing.

    Raises:
      ConfigError: with what to install.
    """
    try:
        import imageio
        import imageio_ffmpeg
        import PIL

        del imageio, imageio_ffmpeg, PIL
    except ImportError as error:
        raise ConfigError(
            f"videos need a package that is not installed ({error.name}): "
            "pip install 'sacformer-jax[video]'"
        ) from error


def captioned(image: np.ndarray, caption: Sequence[str]) -> np.ndarray:
    """The image with lines of text at its top left: white, edged in black, so that they can be read
    on anything.

    Args:
      image: ``[height, width, 3]`` uint8; it stays as it is.
      caption: lines; made smaller (down to 10 pixels) where they would be wider than the image.
    """
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    text, margin = "\n".join(caption), max(2, picture.width // 80)
    size = max(_SMALLEST_FONT, picture.width // 26)
    while True:
        font = ImageFont.load_default(size)
        edge = max(1, size // 9)
        box = draw.multiline_textbbox((margin, margin), text, font=font, stroke_width=edge)
        if size == _SMALLEST_FONT or box[2] <= picture.width - margin:
            break
        size -= 1
    draw.multiline_text(
        (margin, margin), text, font=font, fill="white", stroke_width=edge, stroke_fill="black"
    )
    return np.asarray(picture)


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A path to write to, which becomes ``path`` when all went well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".{path.stem}.new{path.suffix}")
    try:
        yield new
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


class Mp4Writer:
    """Writes frames as they come: H.264, as browsers play it. A context.

    Args:
      path: the file; it appears when all is written.
      fps: frames a second.
    """

    def __init__(self, path: Path, fps: float):
        self._path, self._fps = path, fps

    def __enter__(self) -> Mp4Writer:
        import imageio.v2

        # Otherwise it runs Python between fork and exec, which may hang beside JAX's threads.
        os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
        self._stack = contextlib.ExitStack()
        new = self._stack.enter_context(_whole(self._path))
        self._writer: Any = imageio.v2.get_writer(
            new, format="FFMPEG", mode="I", fps=self._fps, codec="libx264", quality=7,
            macro_block_size=2, ffmpeg_log_level="error",
        )  # fmt: skip
        self._stack.callback(self._writer.close)
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def write(self, frame: Frame) -> None:
        """Appends a frame."""
        image = captioned(frame.image, frame.caption)
        for _ in range(frame.num_shown):
            self._writer.append_data(image)


class GifWriter:
    """Gathers frames for a small GIF: smaller, fewer a second, few colours. A context.

    Args:
      path: the file; it appears when all is written.
      fps: frames a second that come.
      seconds: what comes later is left out.
      width: pixels at most.
      max_fps: frames a second at most.
    """

    def __init__(
        self, path: Path, fps: float, seconds: float, width: int = 320, max_fps: float = 12.5
    ):
        self._path, self._fps, self._seconds = path, fps, seconds
        self._width = width
        self._every = max(1, int(np.ceil(fps / max_fps - 1e-6)))
        self._images: list[Any] = []
        self._starts: list[int] = []
        self._num = 0

    def __enter__(self) -> GifWriter:
        return self

    def write(self, frame: Frame) -> None:
        """Appends a frame, if it is one to be kept."""
        from PIL import Image

        for place in range(self._num, self._num + frame.num_shown):
            if place % self._every == 0 and place < self._seconds * self._fps:
                image = Image.fromarray(frame.image)
                if image.width > self._width:
                    height = round(image.height * self._width / image.width)
                    image = image.resize((self._width, height), Image.Resampling.LANCZOS)
                self._images.append(Image.fromarray(captioned(np.asarray(image), frame.caption)))
                self._starts.append(place)
        self._num += frame.num_shown

    def __exit__(self, *error: Any) -> None:
        from PIL import Image

        if error[0] is not None or not self._images:
            return
        # GIFs count in hundredths of a second: rounded where each starts, so nothing adds up.
        end = min(self._num, int(np.ceil(self._seconds * self._fps)))
        hundredths = [round(100 * place / self._fps) for place in (*self._starts, end)]
        durations = [10 * max(2, b - a) for a, b in itertools.pairwise(hundredths)]
        palette = _common_palette(self._images)
        frames = [
            image.quantize(palette=palette, dither=Image.Dither.NONE) for image in self._images
        ]
        with _whole(self._path) as new:
            frames[0].save(
                new, save_all=True, append_images=frames[1:], duration=durations, loop=0,
                optimize=False,
            )  # fmt: skip


def _common_palette(images: Iterable[Any]) -> Any:
    """One palette for all, so that what stands still does not flicker and need not be stored."""
    from PIL import Image

    images = list(images)
    some = images[:: max(1, len(images) // 8)]
    together = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for place, image in enumerate(some):
        together.paste(image, (0, place * image.height))
    return together.quantize(_GIF_COLORS, method=Image.Quantize.FASTOCTREE)
