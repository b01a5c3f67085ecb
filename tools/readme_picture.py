"""Write the README's picture, three moments of the video whose path `make run` prints.

python tools/readme_picture.py runs/.../videos/frames_000000524288.mp4
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "quickstart.jpg"
MOMENTS = (0.05, 0.45, 0.85)  # as fractions of the video
WIDTH = 400  # width of each moment's picture, pixels


def frames(video: Path) -> list[Image.Image]:
    """Return the frames of a video."""
    reader = imageio_ffmpeg.read_frames(str(video))
    width, height = next(reader)["size"]
    shape = (height, width, 3)
    return [Image.fromarray(np.frombuffer(raw, np.uint8).reshape(shape)) for raw in reader]


def main(video: Path) -> None:
    """Write the picture."""
    pictures = frames(video)
    chosen = [pictures[int(share * len(pictures))] for share in MOMENTS]
    height = WIDTH * chosen[0].height // chosen[0].width
    strip = Image.new("RGB", (WIDTH * len(chosen), height))
    for i, picture in enumerate(chosen):
        strip.paste(picture.resize((WIDTH, height), Image.Resampling.LANCZOS), (i * WIDTH, 0))
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    strip.save(PICTURE, quality=85, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
