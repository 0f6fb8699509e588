"""Large photographs made small: cropped to the object and averaged once, and kept in the cache folder."""

import hashlib
import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike

from mi_ring.capture.brightness_masks import bright, with_masks_by_brightness
from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import LinearImage, decode, is_linear
from mi_ring.capture.pixels import Pixels, Reader
from mi_ring.images import box_filter
from mi_ring.scene.shot import Shot, Window
from mi_ring.system import cache
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import progress

FORMAT = "1"  #: of the cache's files; another one makes them anew
WIDTH = 512  #: to which photographs are reduced for check, and for fits that do not need more [px]
HIGHEST = 1.5  #: largest height, in units of this width
MARGIN = 0.06  #: around the object in a crop, as a share of its size
WORTH_CROPPING = 0.8  #: a crop must be less wide or less high than this share of the photograph
SMALL = 512  #: photographs up to this width are never cropped [px]
COARSE = 512  #: width at which the object is searched in photographs without masks [px]
ROWS = 256  #: of a photograph that are decoded at once: all of its pixels as floats would take too much memory
DECODING = 2**30  #: bytes for photographs that are decoded at the same time
PIXEL_BYTES = 8  #: that decoding a pixel takes
MORE = np.array([[-1], [1]])  #: by how many pixels bounds are widened that were found in a small picture


class Reduced(NamedTuple):
    """A photograph cropped and reduced to a window, with its masks; None where it has no such file."""

    image: LinearImage
    mask: np.ndarray | None  #: (H, W) uint8, the object's coverage
    valid: np.ndarray | None  #: (H, W) uint8, 255 where all pixels of the photograph are valid, else 0


def reduced(capture: Capture, width: int = WIDTH, by_brightness: bool = False, crop: bool = True) -> Capture:
    """Reduce the photographs of a capture to at most this `width` [px], and crop them to the object where that helps.

    `by_brightness`: masks are found by brightness, as `with_masks_by_brightness` does. Without `crop` photographs are
    only made smaller. Returns the capture itself if no photograph changes, or if it was reduced before. Raises
    InputError like `load_capture`.
    """
    small = all(shot.size[0] <= SMALL and fitting(shot.size, width) == 1 for shot in capture.shots)
    if any(shot.window for shot in capture.shots) or not capture.images or small:
        return with_masks_by_brightness(capture) if by_brightness else capture
    large = any(fitting(shot.size, width) > 1 for shot in capture.shots)
    searched = capture
    if by_brightness:
        if large:
            whole = [windowed(shot.size, (0, 0), shot.size, COARSE) for shot in capture.shots]
            searched = through(capture, whole, "searching the object")
        searched = with_masks_by_brightness(searched)
    bounds = mask_bounds(searched, large) if crop else [None] * len(capture)
    windows = crop_windows(capture.shots, bounds, width)
    if all(window.extent == window.size == window.whole for window in windows):
        return searched
    result = through(capture, windows, "reading")
    if searched.threshold is not None:
        found = {k: partial(bright, result, k, searched.threshold) for k, is_found in enumerate(searched.masks.given)
                 if is_found}  # fmt: skip
        result = replace(result, masks=result.masks.replaced(found), threshold=searched.threshold)
    return result


def fitting(size: tuple[int, ...], width: int) -> float:
    """The factor, at least 1, by which a picture (width, height) [px] must be reduced to be at most `width` wide."""
    return max(1.0, size[0] / width, size[1] / (HIGHEST * width))


def windowed(whole: tuple[int, int], low: ArrayLike, extent: Sequence[int], width: int) -> Window:
    """Make a window of a photograph of size `whole` [px]: corner `low`, size `extent`, reduced to `width` or less."""
    scale = fitting(tuple(extent), width)
    blocks = int(scale)  # the first step of the reduction averages squares of so many pixels
    extent = [blocks * (side // blocks) for side in extent]
    width, height = (max(1, round(side / scale)) for side in extent)
    left, top = np.asarray(low, int).tolist()
    return Window((left, top), (extent[0], extent[1]), (width, height), whole)


def crop_windows(shots: Sequence[Shot], bounds: Sequence[np.ndarray | None], width: int) -> list[Window]:
    """Choose a window around the object in each photograph, reduced to at most `width` [px].

    `bounds`: lowest and highest corner (2, 2) [px] of each mask, None without one. Photographs of one size get windows
    of one size, so that they are rendered together. They are not cropped if one of them has no mask.
    """
    windows = []
    sizes = [shot.size for shot in shots]
    for size, own in zip(sizes, bounds):
        alike = [b for other, b in zip(sizes, bounds) if other == size]
        extent, low = np.array(size), np.zeros(2, int)
        if size[0] > SMALL and own is not None and all(b is not None for b in alike):
            object_ = np.max([b[1] - b[0] for b in alike if b is not None], 0)
            crop = np.minimum(np.ceil(object_ + 2 * MARGIN * object_.max()).astype(int), size)
            if (crop < WORTH_CROPPING * extent).any():
                extent, low = crop, np.clip(np.round(own.mean(0) - crop / 2), 0, np.array(size) - crop).astype(int)
        windows.append(windowed(size, low, extent.tolist(), width))
    return windows


def mask_bounds(capture: Capture, large: bool) -> list[np.ndarray | None]:
    """The lowest and the highest corner (2, 2) [px] of each mask; None if there is no mask or it is empty.

    Results of `large` masks are kept in the cache folder.
    """

    def bounds(k: int) -> np.ndarray | None:
        shot = capture.shots[k]
        key = None
        if large and not shot.window and shot.files.mask:
            key = key_of("bounds", digest(shot.files.mask), shot.files.mask == shot.files.filename)
            if path := cache.cached(key):
                return unless_empty(np.frombuffer(path.read_bytes(), np.int32).reshape(2, 2))
        mask = capture.masks[k] > 127
        columns, rows = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
        found = np.zeros((2, 2), np.int32)
        if len(rows):
            found[:] = (columns[0], rows[0]), (columns[-1] + 1, rows[-1] + 1)
            if shot.window:  # in pixels of the photograph
                found = np.clip((found + MORE) * shot.window.scale, 0, shot.window.whole).astype(np.int32)
        if key:
            cache.store(key, found.tobytes())
        return unless_empty(found)

    def unless_empty(found: np.ndarray) -> np.ndarray | None:
        return found if found.any() else None

    given = [k for k, is_given in enumerate(capture.masks.given) if is_given]
    result: list[np.ndarray | None] = [None] * len(capture)
    threads = concurrent(max(shot.size for shot in capture.shots))
    for k, found in zip(given, progress(in_threads(bounds, given, most=threads), "reading masks", total=len(given),
                                        unit="mask", disable=None)):  # fmt: skip
        result[k] = found
    return result


def through(capture: Capture, windows: Sequence[Window], doing: str) -> Capture:
    """Cut a capture down to one window of each photograph, all read at once. `doing`: name of the progress bar."""
    shots = [shot.through(window) for shot, window in zip(capture.shots, windows)]
    of_files = not capture.in_memory

    def made(k: int) -> Callable[[], Reduced]:
        """Make a reader of photograph `k` through its window, and keep the result in the cache folder if possible."""
        make = partial(reduce, capture, k, windows[k])
        if not of_files:
            return make
        key = key_of("photograph", *map(digest, capture.shots[k].files), *decoded_by(capture.shots[k]), windows[k])
        if cache.cached(key) or cache.store(key, packed(make())):
            return partial(unpacked, key, make)
        return make

    several = range(len(shots))
    threads = concurrent(max(shot.size for shot in capture.shots))
    readers = list(progress(in_threads(made, several, most=threads), doing, total=len(shots), unit="photograph",
                            disable=None))  # fmt: skip
    cache.prune()
    shared: dict[tuple, Reader] = {}

    def part(field: str, k: int, given: bool) -> Reader | None:
        reader = partial(member, readers[k], field)
        # Photographs that share a mask and a window share its array.
        several = capture.masks if field == "mask" else capture.valid
        key = field, several.readers[k], windows[k]
        return shared.setdefault(key, reader) if given else None

    images = Pixels(partial(member, reader, "image") for reader in readers)
    masks = Pixels(part("mask", k, given) for k, given in enumerate(capture.masks.given))
    valid = Pixels(part("valid", k, given) for k, given in enumerate(capture.valid.given))
    return replace(capture, shots=tuple(shots), images=images, masks=masks, valid=valid)


def member(read: Callable[[], Reduced], field: str) -> Any:
    """Read one field of a reduced photograph."""
    return getattr(read(), field)


def concurrent(size: tuple[int, int]) -> int:
    """How many photographs of this size [px] may be decoded at the same time."""
    return max(1, DECODING // (PIXEL_BYTES * size[0] * size[1]))


def reduce(capture: Capture, k: int, window: Window) -> Reduced:
    """Read photograph `k` of a capture, and crop and reduce it to a window."""
    shot = capture.shots[k]
    read = capture.images.readers[k]
    assert read is not None
    image = read()  # not kept: it is large
    radiance, clipped = [], []
    blocks, rows = int(window.scale.min()), max(1, ROWS // int(window.scale.min()))
    (left, top), (width, height) = window.corner, window.extent
    for first in range(0, height, rows * blocks):
        part = image[top + first : top + min(first + rows * blocks, height), left : left + width]
        linear, over = decode(part, is_linear(shot.encoding, part), shot.saturation, shot.response.gamma,
                              shot.response.contrast)  # fmt: skip
        radiance.append(averaged(linear, blocks))
        clipped.append(averaged(over, blocks) > 0 if over.any() else np.zeros(radiance[-1].shape, bool))
    kind = np.float16 if image.dtype == np.uint8 else np.float32
    rgb = resized(np.concatenate(radiance), window).astype(kind)
    over = resized(np.concatenate(clipped).astype(np.float32), window) > 0
    del image
    mask, valid = capture.masks.readers[k], capture.valid.readers[k]
    return Reduced(
        LinearImage(rgb, over),
        None if mask is None else covered(mask(), window).round().astype(np.uint8),
        None if valid is None else np.where(covered(255 * (valid() > 127), window) > 254.9, np.uint8(255), np.uint8(0)),
    )


def covered(mask: np.ndarray, window: Window) -> np.ndarray:
    """Reduce a mask (H, W) to a window: the mean of the mask over each pixel of the window."""
    (left, top), (width, height) = window.corner, window.extent
    part = mask[top : top + height, left : left + width, None]
    return resized(averaged(part, int(window.scale.min())), window)[..., 0]


def averaged(pixels: np.ndarray, blocks: int) -> np.ndarray:
    """Reduce pixels to the means of squares of `blocks` × `blocks` pixels, float32."""
    return box_filter(torch.from_numpy(np.ascontiguousarray(pixels, np.float32)), blocks).numpy()


def resized(pixels: np.ndarray, window: Window) -> np.ndarray:
    """Resize pixels (H, W, C) to the size of a window, by the means of areas."""
    if pixels.shape[1::-1] == window.size:
        return pixels
    return cv2.resize(pixels, window.size, interpolation=cv2.INTER_AREA).reshape(*window.size[::-1], -1)


def whole_mask(mask: np.ndarray, window: Window | None) -> np.ndarray:
    """Extend a mask (h, w) uint8 in a window to the whole photograph (H, W); nothing is outside the window."""
    if window is None:
        return mask
    (left, top), (width, height) = window.corner, window.extent
    result = np.zeros(window.whole[::-1], np.uint8)
    result[top : top + height, left : left + width] = cv2.resize(mask, window.extent, interpolation=cv2.INTER_LINEAR)
    return result


def decoded_by(shot: Shot) -> tuple:
    """The settings by which a photograph's pixels are decoded, for the key of the cache."""
    return shot.encoding, shot.saturation, shot.response.gamma, shot.response.contrast, *same_files(shot)


def same_files(shot: Shot) -> tuple[bool, bool]:
    """Does a photograph's alpha channel hold its mask; does it hold the map of valid pixels?"""
    return shot.files.mask == shot.files.filename, shot.files.valid == shot.files.filename


def digest(file: Path | None) -> str:
    """A hash of the content of a file; empty if there is no file."""
    if file is None:
        return ""
    result = hashlib.blake2b(digest_size=16)
    with file.open("rb") as opened:
        while part := opened.read(2**22):
            result.update(part)
    return result.hexdigest()


def key_of(*parts: Any) -> str:
    """The key in the cache for a result that is made of these parts."""
    return hashlib.blake2b(repr((FORMAT, *parts)).encode(), digest_size=16).hexdigest()


def packed(photograph: Reduced) -> memoryview:
    """Convert a reduced photograph to the content of its file in the cache."""
    image, mask, valid = photograph
    arrays: dict[str, Any] = {"rgb": image.rgb, "clipped": np.packbits(image.clipped), "mask": mask, "valid": valid}
    buffer = io.BytesIO()
    np.savez(buffer, **{name: array for name, array in arrays.items() if array is not None})
    return buffer.getbuffer()


def unpacked(key: str, make: Callable[[], Reduced]) -> Reduced:
    """Read the reduced photograph with this key from the cache, or `make` it if its file is gone or damaged."""
    try:
        with np.load(cache.place_of(key)) as file:
            rgb = file["rgb"]
            clipped = np.unpackbits(file["clipped"], count=rgb.size).reshape(rgb.shape).astype(bool)
            return Reduced(LinearImage(rgb, clipped), *(file.get(name) for name in ("mask", "valid")))
    except (OSError, ValueError, LookupError, EOFError, zipfile.BadZipFile):
        return make()
