"""Makes large photographs small: crops them to the object and averages pixels. The cache folder keeps the results."""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike

from mi_ring.capture.brightness_masks import bright, with_masks_by_brightness
from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import LinearImage, clip_value, decode, is_linear, read_mask, read_photograph
from mi_ring.capture.pixels import Pixels, Reader
from mi_ring.images import ROWS, box_filter
from mi_ring.scene.shot import Shot, Window
from mi_ring.scene.tone_curve import ToneCurve
from mi_ring.system import cache
from mi_ring.system.cached_arrays import archived, key_of, read_archive, remembered
from mi_ring.system.files import digest
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import progress

WIDTH = 512  #: to which photographs are reduced for check, and for fits that do not need more [px]
HIGHEST = 1.5  #: largest height of a reduced photograph, as a multiple of its largest width
MARGIN = 0.06  #: around the object in a crop, as a share of its size
WORTH_CROPPING = 0.8  #: a crop must be less wide or less high than this share of the photograph
SMALL = 512  #: photographs up to this width are never cropped [px]
COARSE = 512  #: width at which the object is searched in photographs without masks [px]
DECODING = 2**30  #: memory for photographs that are decoded at the same time [bytes]
JPEG_BYTES, PIXEL_BYTES = 8, 40  #: of it for a pixel of a JPEG file, and of any other photograph
MORE = np.array([[-1], [1]])  #: bounds found in a reduced mask are widened by one of its pixels


def reduced(capture: Capture, width: int = WIDTH, by_brightness: bool = False, crop: bool = True) -> Capture:
    """Return a copy of the capture whose photographs are at most `width` [px] wide.

    They may also be cropped to the object. `by_brightness`: True replaces the masks by masks of the bright pixels.
    `crop`: False never crops; True crops where this saves enough pixels. If all photographs are small, or if the
    capture was reduced before, its pixels do not change. Raises InputError if an image file is invalid.
    """
    small = all(shot.size[0] <= SMALL and reduction_factor(shot.size, width) == 1 for shot in capture.shots)
    if any(shot.window for shot in capture.shots) or not capture.images or small:
        return with_masks_by_brightness(capture) if by_brightness else capture
    large = any(reduction_factor(shot.size, width) > 1 for shot in capture.shots)
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


def reduction_factor(size: tuple[int, ...], width: int) -> float:
    """Return the factor, at least 1, by which an image must shrink to be at most `width` [px] wide.

    `size`: (width, height) [px] of the image. The height of the reduced image is at most 1.5 `width`.
    """
    return max(1.0, size[0] / width, size[1] / (HIGHEST * width))


def windowed(whole: tuple[int, int], low: ArrayLike, extent: Sequence[int], width: int) -> Window:
    """Make a window: a rectangle of a photograph, and the size, at most `width` [px] wide, to which it is reduced.

    `whole`: (width, height) of the photograph [px]. `low` (2,): upper left corner of the rectangle (column, row).
    `extent`: its (width, height), which may become slightly smaller.
    """
    scale = reduction_factor(tuple(extent), width)
    blocks = int(scale)  # the first step of the reduction averages squares of so many pixels
    extent = [blocks * (side // blocks) for side in extent]
    width, height = (max(1, round(side / scale)) for side in extent)
    left, top = np.asarray(low, int).tolist()
    return Window((left, top), (extent[0], extent[1]), (width, height), whole)


def crop_windows(shots: Sequence[Shot], bounds: Sequence[np.ndarray | None], width: int) -> list[Window]:
    """Choose for each photograph a window around the object: a rectangle, and the size to which it is reduced.

    `bounds`: for each photograph, the lowest and highest corner (2, 2) [px] of the object; None if it has no mask.
    `width`: largest width of a reduced window [px]. Photographs of one size get windows of one size, so that one launch
    can render them together. If one of these has no mask, none of them is cropped.
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
    """Return the lowest and the highest corner (2, 2) of the object in each mask: (column, row) [px].

    A missing or empty mask gives None. `large`: True keeps the corners in the cache folder, because masks take long to
    read.
    """
    several = {reader: k for k, reader in enumerate(capture.masks.readers) if reader}  # some may share a mask

    def bounds(k: int) -> np.ndarray:
        read, shot = capture.masks.readers[k], capture.shots[k]
        assert read is not None
        file = source(read) if large else None
        make = partial(corners, read, shot)
        (found,) = remembered(key_of("bounds", file, shot.window), make) if file else make()
        return found

    found = dict(zip(several, in_turn(bounds, capture, list(several.values()), "reading masks")))
    return [found[reader] if reader and found[reader].any() else None for reader in capture.masks.readers]


def corners(read: Reader, shot: Shot) -> tuple[np.ndarray]:
    """Find the lowest and the highest corner of the object in a mask.

    Returns them in a tuple of one array, (2, 2) int32: (column, row) [px of the photograph]. If the mask is empty, they
    are 0.
    """
    inside = read() > 127  # not kept: it may be large
    columns, rows = np.flatnonzero(inside.any(0)), np.flatnonzero(inside.any(1))
    found = np.zeros((2, 2), np.int32)
    if len(rows):
        found[:] = (columns[0], rows[0]), (columns[-1] + 1, rows[-1] + 1)
        if shot.window:  # in pixels of the photograph
            found = np.clip((found + MORE) * shot.window.scale, 0, shot.window.whole).astype(np.int32)
    return (found,)


def through(capture: Capture, windows: Sequence[Window], doing: str) -> Capture:
    """Return a copy of the capture in which each photograph shows only its window, reduced to the window's size.

    `windows`: one for each photograph. Photographs that are files are read now, and the results are stored in the cache
    folder. `doing`: label of the progress bar.
    """
    shots = tuple(shot.through(window) for shot, window in zip(capture.shots, windows))

    def parts(k: int) -> dict[str, Callable[[], Any]]:
        """Readers of photograph `k` and its masks, which are in the cache folder now, if that can be written."""
        shot, window = capture.shots[k], windows[k]
        sources = {name: getattr(capture, name).readers[k] for name in ("images", "masks", "valid")}
        make: dict[str, Callable[[], Any]] = {"images": partial(reduced_image, shot, sources["images"], window)}
        if sources["masks"]:
            make["masks"] = partial(reduced_mask, sources["masks"], window)
        if sources["valid"]:
            make["valid"] = partial(reduced_valid, sources["valid"], window)
        files = [source(sources[name]) for name in make]
        if not all(files):  # arrays of the user
            return make
        key = key_of("photograph", *make, files, shot.encoding, shot.saturation, *shot.response.curve, window)
        stored: dict[str, Callable[[], Any]]
        stored = {name: partial(unpacked, key, name, made) for name, made in make.items()}
        if cache.cached(key):
            return stored
        arrays = {name: made() for name, made in make.items()}
        if cache.store(key, packed(key, arrays)):
            return stored
        return {name: partial(arrays.get, name) for name in arrays}

    readers = in_turn(parts, capture, range(len(shots)), doing)
    cache.prune()
    shared: dict[tuple, Reader] = {}

    def pixels(name: str) -> Pixels:
        """One reader for photographs that share a file and a window."""
        before = getattr(capture, name).readers
        return Pixels(own.get(name) and shared.setdefault((name, before[k], windows[k]), own[name])
                      for k, own in enumerate(readers))  # fmt: skip

    return replace(capture, shots=shots, images=pixels("images"), masks=pixels("masks"), valid=pixels("valid"))


def in_turn(function: Callable[[int], Any], capture: Capture, index: Sequence[int], doing: str) -> list[Any]:
    """Call `function(k)` for each photograph k of `index`, in as many threads as memory allows.

    `function` decodes photograph k. Returns a list of its results, in the order of `index`. `doing`: label of the
    progress bar.
    """

    def memory(shot: Shot) -> int:
        file = shot.files.filename
        small = file is not None and file.suffix.lower() in (".jpg", ".jpeg") and not shot.files.ambient
        return math.prod(shot.whole.size) * (JPEG_BYTES if small else PIXEL_BYTES)

    most = max(1, DECODING // max(map(memory, capture.shots)))
    results = in_threads(function, index, most=most)
    return list(progress(results, doing, total=len(index), unit="photograph", disable=None))


def reduced_image(shot: Shot, read: Reader, window: Window) -> LinearImage:
    """Decode a photograph to linear radiance, crop it to the window, and resize it to the window's size.

    `read`: returns the encoded pixels (H, W, 3). Memory is saved by decoding in strips. The radiance is float16 for a
    photograph of 8 bits, otherwise float32.
    """
    image = read()
    clipped_from = clip_value(image, shot.saturation)
    kept = np.float16 if image.dtype == np.uint8 else np.float32
    blocks, (left, top), (width, height) = window.blocks, window.corner, window.extent
    radiance = np.empty((height // blocks, width // blocks, 3), np.float32)
    clipped = np.zeros(radiance.shape, bool)
    rows = max(1, ROWS // blocks)
    for first in range(0, len(radiance), rows):
        part = image[top + blocks * first : top + min(blocks * (first + rows), height), left : left + width]
        linear, over = decode(part, is_linear(shot.encoding, part), clipped_from, shot.response.curve)
        radiance[first : first + rows] = averaged(linear, blocks)
        if over.any():
            clipped[first : first + rows] = averaged(over, blocks) > 0
    image = part = linear = np.empty(0)  # views keep the photograph in memory; it is larger than what was made of it
    over = resized(clipped.astype(np.float32), window) > 0
    return LinearImage(resized(radiance, window).astype(kept), over, shot.response.curve)


def reduced_mask(read: Reader, window: Window) -> np.ndarray:
    """Crop a mask to a window and resize it: (H, W) uint8, the object's coverage from 0 to 255.

    `read`: returns the mask of the whole photograph, uint8.
    """
    return means(read(), window).round().astype(np.uint8)


def reduced_valid(read: Reader, window: Window) -> np.ndarray:
    """Crop a mask of valid pixels to a window and resize it: (H, W) uint8.

    `read`: returns the mask of the whole photograph. A pixel of the result is 255 if all pixels of the photograph that
    it covers are valid, otherwise 0.
    """
    return np.where(means(read() > 127, window) > 1 - 1e-5, np.uint8(255), np.uint8(0))


def means(mask: np.ndarray, window: Window) -> np.ndarray:
    """Crop a mask (H, W) of a whole photograph to a window, and resize it to the window's size by area means."""
    (left, top), (width, height) = window.corner, window.extent
    part = mask[top : top + height, left : left + width, None]
    return resized(averaged(part, window.blocks), window)[..., 0]


def averaged(pixels: np.ndarray, blocks: int) -> np.ndarray:
    """Average blocks of `blocks` × `blocks` pixels of an image (H, W, C). Returns float32."""
    return box_filter(torch.from_numpy(np.ascontiguousarray(pixels, np.float32)), blocks).numpy()


def resized(pixels: np.ndarray, window: Window) -> np.ndarray:
    """Resize an image (H, W, C) to the size of `window` by area means. It shows the rectangle of the window already."""
    if pixels.shape[1::-1] == window.size:
        return pixels
    return cv2.resize(pixels, window.size, interpolation=cv2.INTER_AREA).reshape(*window.size[::-1], -1)


def whole_mask(mask: np.ndarray, window: Window | None) -> np.ndarray:
    """Enlarge the mask (h, w) uint8 of a window, and paste it into a mask (H, W) of the whole photograph.

    Outside the window, the result is 0. If `window` is None, `mask` is returned unchanged.
    """
    if window is None:
        return mask
    (left, top), (width, height) = window.corner, window.extent
    result = np.zeros(window.whole[::-1], np.uint8)
    result[top : top + height, left : left + width] = cv2.resize(mask, window.extent, interpolation=cv2.INTER_LINEAR)
    return result


def source(read: Reader | None) -> tuple | None:
    """Return a tuple that identifies what a reader of image files returns. It contains hashes of the files.

    Two readers with equal tuples read equal arrays. Returns None if `read` does not read files.
    """
    if not isinstance(read, partial) or read.func not in (read_photograph, read_mask):
        return None
    shot, *field = read.args[:-1]
    files = [getattr(shot.files, name) for name in field] or [shot.files.filename, shot.files.ambient]
    return read.func.__name__, *(file and digest(file) for file in files), files[0] == shot.files.filename


def packed(key: str, arrays: dict[str, Any]) -> memoryview:
    """Convert a reduced photograph and its masks to bytes for the entry `key` of the cache folder.

    `arrays`: a dict with "images" (a `LinearImage`), and "masks" and "valid" if the photograph has them.
    """
    image = arrays["images"]
    own = {"images": image.rgb, "clipped": np.packbits(image.clipped), "curve": np.array(image.curve)}
    return archived(key, arrays | own)


def unpacked(key: str, name: str, make: Callable[[], Any]) -> np.ndarray | LinearImage:
    """Read one array from the entry `key` of the cache folder.

    If the entry is missing or damaged, return `make()` instead. `name`: "images", "masks" or "valid". "images" gives a
    `LinearImage`. A damaged entry is removed.
    """
    try:
        with read_archive(key) as file:
            array = file[name]
            if name != "images":
                return array
            clipped = np.unpackbits(file["clipped"], count=array.size).reshape(array.shape)
            return LinearImage(array, clipped.astype(bool), ToneCurve(*file["curve"].tolist()))
    except OSError:  # it cannot be read now
        return make()
    except ValueError:  # it is missing or damaged
        with contextlib.suppress(OSError):  # there is none, or the folder may be read-only
            (cache.cache_folder() / key).unlink()  # so that it is made anew the next time
        return make()
