"""Writes rendered pictures and films to files."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from mi_ring.errors import InputError
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.system.files import partial_path, writing


def write_picture(linear: np.ndarray, path: Path) -> None:
    """Write a picture of linear radiance (H, W, 3): unchanged to an .exr file, to other files as 8-bit sRGB."""
    exr = path.suffix.lower() == ".exr"
    write_image(linear.astype(np.float32) if exr else to_bytes(linear_to_srgb(linear)), path)


def write_film(pictures: Iterator[np.ndarray], path: Path, size: tuple[int, int], fps: float) -> None:
    """Write pictures (H, W, 3) of linear radiance as an MP4 file (H.264) that browsers can play.

    `size`: (width, height) of the pictures [px]; an odd side is extended by one pixel. `fps`: pictures per second.
    Raises InputError if the file cannot be written. An interruption is printed. After an error or an
    interruption, no incomplete file remains.
    """
    partial = partial_path(path)  # without .mp4, so that ffmpeg must be told the format
    odd_columns, odd_rows = size[0] % 2, size[1] % 2
    # Not by imageio, which does not notice a truncated film, for instance on a full disk.
    ffmpeg = subprocess.Popen(
        [
            imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-s", f"{size[0] + odd_columns}x{size[1] + odd_rows}", "-r", str(fps), "-i", "-",
            "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-movflags", "+faststart",
            # The colour space; otherwise browsers guess it from the size of the pictures.
            "-vf", "scale=out_color_matrix=bt709,setparams=color_primaries=bt709:color_trc=iec61966-2-1",
            "-f", "mp4", f"file:{partial}",
        ],
        stdin=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,  # so that Ctrl-C does not stop it
    )  # fmt: skip
    try:
        assert ffmpeg.stdin is not None  # it is a pipe
        with contextlib.suppress(OSError):  # ffmpeg has ended; its message is read below
            for picture in pictures:
                image = to_bytes(linear_to_srgb(picture))
                ffmpeg.stdin.write(np.pad(image, ((0, odd_rows), (0, odd_columns), (0, 0)), "edge").tobytes())
        complaint = ffmpeg.communicate()[1].decode(errors="replace").split("\n")[0]
        if ffmpeg.returncode:
            raise InputError(f"{path}: cannot be written ({complaint or 'ffmpeg was killed'}); make room or choose "
                             "another place")  # fmt: skip
        with writing(path):
            os.replace(partial, path)
    except KeyboardInterrupt:
        print(f"{path}: interrupted; no film is written", file=sys.stderr)
        raise
    finally:
        ffmpeg.kill()
        ffmpeg.wait()
        partial.unlink(missing_ok=True)
