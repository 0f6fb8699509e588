"""The printed sheet of markers: its page, where photographs show it, and what that tells: scale, cameras, white."""

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from trimesh.registration import procrustes

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens, camera_to_world

COLUMNS, ROWS = 9, 13  #: squares, of which each white one has a marker of MARKER times its size in its middle
SQUARE, MARKER = 20, 0.75  #: [mm] as it is printed
DOTS = 14  #: per mm of the page: edges of squares and of the markers' seven modules fall on whole dots
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}  #: [mm]
NOTE = "Print at 100 %. Five squares must measure 100 mm; if not, give what one measures by --square-mm."

LONGEST = 2000  #: markers are looked for in pictures of so many pixels at most; corners are then refined at full size
FEWEST = 6  #: corners that are worth something
STRAY = 0.25  #: of a square: a corner that is so far from where the others want it is something else
FIT = 0.02  #: of the width that is seen: how well corners of a true sheet lie where they should
CLIPPED = 0.95  #: of full scale, linear: a colour above may be brighter than a file can say
#: Where paper is white, in squares from the first corner of a square: half way between its edge and its marker's, one
#: side after another; and in the page's margin left, right and above, if that square is the outermost but one.
INNER = (1 - MARKER) / 4
RIM = np.linspace(INNER, 1 - INNER, 9)[:, None] * [1, 0] + [0, INNER]
RIMS = np.concatenate([RIM, RIM[:, ::-1], 1 - RIM, 1 - RIM[:, ::-1]])
BESIDE = np.array([[-1.2, 0.5], [2.2, 0.5], [0.5, -1.2]])  # a line is printed below
PATCH = np.stack(np.meshgrid(np.linspace(-0.08, 0.08, 5), np.linspace(-0.08, 0.08, 5)), -1).reshape(-1, 2)
OFF = 0.002  #: of a photograph's longer side: a corner so far from where other photographs see it is wrong

Pose = np.ndarray  #: (4, 4) camera-to-world, OpenCV's axes


class Sighting(NamedTuple):
    """Corners of squares in a photograph. Frame: origin in the sheet's middle, x right, y up, z out of the paper."""

    ids: np.ndarray  #: (n,) int, row by row from the top left
    points: np.ndarray  #: (n, 3) [mm], z = 0
    pixels: np.ndarray  #: (n, 2) [px]; the first pixel's centre is (0.5, 0.5)


class Similarity(NamedTuple):
    """x ↦ scale · rotation x + shift, from the frame of cameras into that of the sheet [mm]; and what it rests on."""

    scale: float
    rotation: np.ndarray  #: (3, 3)
    shift: np.ndarray  #: (3,)
    rms: float  #: [mm] of the corners
    corners: int

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) moved."""
        return self.scale * points @ self.rotation.T + self.shift


def charuco() -> cv2.aruco.CharucoBoard:
    """The sheet as OpenCV knows it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    return cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE, MARKER * SQUARE, dictionary)


def page(paper: Literal["a4", "letter"]) -> Image.Image:
    """The sheet in black and white, true to scale at `DOTS` per mm, with a line that says what to measure."""
    size = DOTS * SQUARE * np.array([COLUMNS, ROWS])
    sheet = Image.new("1", (round(DOTS * PAPERS[paper][0]), round(DOTS * PAPERS[paper][1])), 1)
    left, top = (np.array(sheet.size) - size) // 2
    sheet.paste(Image.fromarray(charuco().generateImage(tuple(size.tolist()), marginSize=0)), (int(left), int(top)))
    place, font = (sheet.width // 2, int(top + size[1]) + DOTS), ImageFont.load_default(3 * DOTS)
    ImageDraw.Draw(sheet).text(place, NOTE, 0, font, anchor="ma")
    return sheet


class Board:
    """The sheet as it was printed, its squares so long [mm]."""

    def __init__(self, square: float = SQUARE) -> None:
        self.square = square
        corner = np.arange((COLUMNS - 1) * (ROWS - 1))
        x, y = corner % (COLUMNS - 1) + 1 - COLUMNS / 2, ROWS / 2 - 1 - corner // (COLUMNS - 1)
        self.points = square * np.stack([x, y, 0 * x], 1)  #: (96, 3) of all corners
        params = cv2.aruco.CharucoParameters()
        params.tryRefineMarkers = True  # small ones are read where the others say that they are
        self.detector = cv2.aruco.CharucoDetector(charuco(), params)

    def detect(self, picture: np.ndarray) -> Sighting | None:
        """Where a photograph (H, W, 3) or (H, W) uint8 shows the sheet; None where it shows too little of it."""
        grey = picture if picture.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
        scale = -(-max(grey.shape) // LONGEST)
        height, width = (side // scale for side in grey.shape)
        small = cv2.resize(grey[: height * scale, : width * scale], (width, height), interpolation=cv2.INTER_AREA)
        found, ids = self.detector.detectBoard(small)[:2]
        if ids is None or len(ids) < FEWEST:
            return None
        ids, pixels = ids.ravel(), (found.reshape(-1, 2).astype(float) + 0.5) * scale
        points = self.points[ids]
        if not spread(points):
            return None
        _, near = cv2.findHomography(points[:, :2], pixels, cv2.RANSAC, STRAY * self.pitch(points, pixels).max())
        keep = near.ravel() > 0 if near is not None else np.zeros(len(ids), bool)
        if keep.sum() < FEWEST or not spread(points[keep]):
            return None
        ids, points, pixels = ids[keep], points[keep], pixels[keep]
        for pixel, pitch in zip(pixels, self.pitch(points, pixels)):
            # A window that no marker reaches into.
            reach = max(2, int(pitch * (1 - MARKER) / 2))
            pixel[:] = refined(grey, pixel, reach)
        return Sighting(ids, points, pixels)

    def pitch(self, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """How long the shorter sides of squares at corners (n, 3) are in a photograph (n,) [px]."""
        plane, _ = cv2.findHomography(points[:, :2], pixels, cv2.RANSAC, 0.05 * np.ptp(pixels, 0).max())
        if plane is None:
            return np.zeros(len(points))
        here, *there = (
            cv2.perspectiveTransform(points[None, :, :2] + shift, plane)[0]
            for shift in self.square * np.array([[0, 0], [1, 0], [0, 1]])
        )
        return np.min([np.linalg.norm(end - here, axis=1) for end in there], 0)


def refined(grey: np.ndarray, pixel: np.ndarray, reach: int) -> np.ndarray:
    """A corner (2,), where squares meet within `reach` pixels of it."""
    end = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3
    place = (pixel - 0.5).astype(np.float32).reshape(1, 1, 2)  # OpenCV counts from the first pixel's centre
    return cv2.cornerSubPix(grey, place, (reach, reach), (-1, -1), end).reshape(2) + 0.5


def spread(points: np.ndarray) -> bool:
    """Are points (n, 3) of a plane not all on a line?"""
    values = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(values[1] > 0.01 * values[0])


def calibrate(
    sightings: Mapping[str, Sighting], size: tuple[int, int]
) -> tuple[Lens, dict[str, Pose], dict[str, float]]:
    """Cameras from the sheet alone, of photographs of one size (width, height) by one lens.

    Returns the lens (SIMPLE_RADIAL, its principal point in the middle), poses in the frame of the sheet [mm], and rms
    errors [px]; photographs that do not fit are left out. Raises InputError if fewer than three do.
    """
    names = list(sightings)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    while len(names) >= 3:
        points = [sightings[name].points.astype(np.float32) for name in names]
        pixels = [(sightings[name].pixels - 0.5).astype(np.float32) for name in names]
        guess = cv2.initCameraMatrix2D(points, pixels, size, 1.0)
        if not (np.isfinite(guess).all() and 0.2 < guess[0, 0] / max(size) < 20):  # all photographs from straight above
            guess[0, 0] = guess[1, 1] = max(size)
        guess[:2, 2] = (np.array(size) - 1) / 2
        _, K, distortion, turns, shifts, _, _, found = cv2.calibrateCameraExtended(
            points, pixels, size, guess, np.zeros(5), flags=flags
        )
        errors = found.ravel()
        fits = errors <= max(1.0, 3 * float(np.median(errors)))
        if fits.all():
            lens = Lens("SIMPLE_RADIAL", size, (K[0, 0], size[0] / 2, size[1] / 2, distortion.ravel()[0]))
            moved = zip(names, turns, shifts)
            poses = {name: camera_to_world(cv2.Rodrigues(turn)[0], shift.ravel()) for name, turn, shift in moved}
            return lens, poses, dict(zip(names, errors.tolist()))
        names = [name for name, fit in zip(names, fits) if fit]
    raise InputError(f"sheet of markers: {len(names)} photographs show enough of it and fit each other; must be 3 or "
                     "more: photograph it, flat, from all around")  # fmt: skip


def align(sightings: Mapping[str, Sighting], cameras: Mapping[str, tuple[Lens, Pose]]) -> Similarity:
    """How the frame of cameras, in units of its own, is brought into that of the sheet.

    Corners that two photographs or more show are put into space by their cameras; wrong ones are left out. Raises
    InputError if fewer than six are left, or if they do not form the sheet.
    """
    seen = np.array([pair for _, *pair in triangulate(sightings, cameras)]).reshape(-1, 2, 3)
    found, true = seen[:, 0], seen[:, 1]
    if len(found) < FEWEST or not spread(true):
        raise InputError(f"sheet of markers: photographs with a camera show {len(found)} of its corners together; must "
                         f"be {FEWEST} or more, not on one line: let more of them show more of it")  # fmt: skip
    keep = consistent(found, true)
    for _ in range(3):
        scale, rotation, shift = umeyama(found[keep], true[keep])
        away = np.linalg.norm(scale * found @ rotation.T + shift - true, axis=1)
        keep = away <= max(4 * float(np.median(away)), 1e-6 * np.ptp(true))
    rms, width = float(np.sqrt(np.mean(away[keep] ** 2))), float(np.ptp(true[keep], 0).max())
    if keep.sum() < FEWEST or not rms < FIT * width:
        raise InputError(f"sheet of markers: its corners are {rms:.2g} mm off in {width:.0f} mm; is it flat, did it "
                         "stay in its place, and is there only one?")  # fmt: skip
    return Similarity(scale, rotation, shift, rms, int(keep.sum()))


def triangulate(
    sightings: Mapping[str, Sighting], cameras: Mapping[str, tuple[Lens, Pose]]
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Corners that two photographs or more agree on, and where they are for the cameras (3,), and on the sheet (3,)."""
    rays: dict[int, list[tuple[np.ndarray, np.ndarray, float]]] = {}  # origins, directions, what they may be off
    places: dict[int, np.ndarray] = {}
    for name in filter(cameras.__contains__, sightings):
        (lens, pose), sighting = cameras[name], sightings[name]
        local = np.column_stack([lens.colmap.cam_from_img(sighting.pixels), np.ones(len(sighting.ids))])
        directions = local / np.linalg.norm(local, axis=1, keepdims=True) @ pose[:3, :3].T
        for corner, point, direction in zip(sighting.ids.tolist(), sighting.points, directions):
            if np.isfinite(direction).all():  # NaN where the lens's model ends
                rays.setdefault(corner, []).append((pose[:3, 3], direction, OFF * max(lens.size) / lens.focal[0]))
                places[corner] = point
    random = np.random.default_rng(0)
    for corner in sorted(rays):
        origins, directions, allowed = (np.array(a) for a in zip(*rays[corner]))
        pairs = np.stack(np.triu_indices(len(origins), 1), 1)
        pairs = random.permutation(pairs[np.linalg.norm(np.cross(*directions[pairs.T]), axis=1) > 0.02])[:100]
        if not len(pairs):
            continue
        points = nearest(origins[pairs], directions[pairs])
        fits = np.stack([off(point, origins, directions) < allowed for point in points])
        best = fits[fits.sum(1).argmax()]
        if best.sum() >= 2:
            yield corner, nearest(origins[best], directions[best]), places[corner]


def nearest(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The points (..., 3) nearest to rays (..., n, 3), which are not parallel."""
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    return np.linalg.solve(across.sum(-3), (across @ origins[..., None]).sum(-3))[..., 0]


def off(point: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Sines (n,) of the angles between rays (n, 3) and a point (3,); infinite behind them."""
    way = point - origins
    sine = np.linalg.norm(np.cross(way, directions), axis=1) / np.linalg.norm(way, axis=1)
    return np.where((way * directions).sum(1) > 0, sine, np.inf)


def consistent(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """The half (n,) bool of points (n, 3) that one similarity moves best to the true ones, by three at a time."""
    random, least = np.random.default_rng(0), np.inf
    keep = np.ones(len(found), bool)
    for _ in range(500):
        three = random.choice(len(found), 3, replace=False)
        if not spread(true[three]) or not spread(found[three]):
            continue
        scale, rotation, shift = umeyama(found[three], true[three])
        away = np.linalg.norm(scale * found @ rotation.T + shift - true, axis=1)
        if np.median(away) < least:
            least, keep = float(np.median(away)), away <= np.median(away)
    return keep


def umeyama(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation (3, 3), shift (3,) that move points (n, 3) to the true ones by least squares (Umeyama 1991)."""
    matrix = procrustes(found, true, reflection=False, return_cost=False)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return scale, matrix[:3, :3] / scale, matrix[:3, 3]


class White(NamedTuple):
    """White paper that a photograph shows."""

    places: np.ndarray  #: (n, 3) on the sheet, as the sighting has them
    colours: np.ndarray  #: (n, 3) linear
    beside: np.ndarray  #: (n,) bool: in the margin? If that was cut off it is whatever the sheet lies on


def white(linear: np.ndarray, sighting: Sighting) -> White:
    """White paper that a photograph (H, W, 3) float32 shows: white squares about the markers, and the page's margin.

    Where all four corners are seen that tell where that is, and where it is not too bright for the file to tell how
    bright. Colours are medians.
    """
    pixels = dict(zip(sighting.ids.tolist(), sighting.pixels))
    places = dict(zip(sighting.ids.tolist(), sighting.points))
    unit = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    found: list[tuple[np.ndarray, np.ndarray, bool]] = []
    for corner in pixels:
        row, column = divmod(corner, COLUMNS - 1)
        ring = [corner, corner + 1, corner + COLUMNS - 1, corner + COLUMNS]
        if column == COLUMNS - 2 or not all(k in pixels for k in ring):
            continue
        four = np.array([pixels[k] for k in ring], np.float32)
        first, right, down, _ = (places[k] for k in ring)
        across = np.stack([right - first, down - first])
        if INNER * min(np.linalg.norm(four[1] - four[0]), np.linalg.norm(four[2] - four[0])) < 1:  # [px]: too blurred
            continue
        plane = cv2.getPerspectiveTransform(unit, four)
        if (row + column) % 2:
            # Seen at a slant two opposite sides are so narrow that they mix with what is black beside them.
            sides = np.median(sampled(linear, RIMS, plane).reshape(2, 2, -1, 3), 2).mean(0)
            found.append((first + [0.5, 0.5] @ across, sides[sides.sum(1).argmax()], False))
        for beside, outermost in zip(BESIDE, (column == 0, column == COLUMNS - 3, row == 0)):
            if outermost:
                colour = np.median(sampled(linear, beside + PATCH, plane), 0)  # NaN if some of it is not seen
                found.append((first + beside @ across, colour, True))
    found = [(place, colour, beside) for place, colour, beside in found if colour.max() < CLIPPED]
    where, colours, margin = zip(*found) if found else ((), (), ())
    return White(np.reshape(where, (-1, 3)), np.reshape(colours, (-1, 3)), np.array(margin, bool))


def sampled(linear: np.ndarray, points: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """A photograph (H, W, 3) at points (n, 2) that a homography (3, 3) takes to pixels: (n, 3), NaN beyond."""
    at = (cv2.perspectiveTransform(points[None], plane) - 0.5).astype(np.float32)
    x, y = np.ascontiguousarray(np.moveaxis(at, -1, 0))  # (1, n): of one axis they mean other things to versions
    return cv2.remap(linear, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[np.nan] * 4)[0]
