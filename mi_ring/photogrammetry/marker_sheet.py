"""The printed sheet of ChArUco markers: draws it, finds it in photographs, samples its paper, computes poses."""

from collections.abc import Callable, Iterator, Mapping
from typing import Literal, NamedTuple

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from skimage.measure import ransac
from skimage.transform import SimilarityTransform
from trimesh.registration import procrustes

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens, camera_to_world
from mi_ring.system.optional import LazyPackage

pycolmap = LazyPackage("pycolmap", "the sheet of markers")
COLUMNS, ROWS = 9, 13  #: number of squares
SQUARE, MARKER = 20, 0.75  #: side of a square as printed [mm]; side of the marker in a white square [squares]
DOTS = 14  #: per mm of the page: edges of squares and of the markers' seven modules fall on whole dots
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}  #: [mm]
NOTE = "Print at 100 %. Five squares must measure 100 mm; if not, give the length of one by --square-mm."

LONGEST = 2000  #: longer side of the image in which markers are searched [px]; corners are refined at full size
MIN_CORNERS = 6
MAX_STRAY = 0.25  #: a corner is an outlier if it is farther from where the other corners predict it [squares]
MAX_RMS = 0.02  #: largest rms error of the triangulated corners [width of the sheet that is seen]
MAX_ANGLE = 0.002  #: an observation is an outlier if its ray is farther from the triangulated corner [radians]
MIN_PARALLAX = 0.02  #: between the rays from which a corner is triangulated [radians]
CLIPPED = 0.95  #: linear colour (1 = saturation) from which paper may be overexposed
#: Where paper is white, relative to the first corner of a square [squares]: in a white square, half way between its
#: edge and the marker, one side after another; in the margin, left of, right of and above the outermost squares.
INNER = (1 - MARKER) / 4
RIM = np.linspace(INNER, 1 - INNER, 9)[:, None] * [1, 0] + [0, INNER]
RIMS = np.concatenate([RIM, RIM[:, ::-1], 1 - RIM, 1 - RIM[:, ::-1]])
MARGINS = np.array([[-1.2, 0.5], [2.2, 0.5], [0.5, -1.2]])  # a line is printed below
PATCH = np.stack(np.meshgrid(np.linspace(-0.08, 0.08, 5), np.linspace(-0.08, 0.08, 5)), -1).reshape(-1, 2)

Pose = np.ndarray  #: (4, 4) camera-to-world, OpenCV's axes


class SheetDetection(NamedTuple):
    """The sheet's corners that one photograph shows.

    The sheet's frame has its origin in the middle, x right, y up, and z out of the paper.
    """

    ids: np.ndarray  #: (n,) int, row by row from the top left
    points: np.ndarray  #: (n, 3) [mm], z = 0
    pixels: np.ndarray  #: (n, 2) [px]; the first pixel's centre is (0.5, 0.5)


Detections = Mapping[str, SheetDetection]  #: by the photograph's name
Cameras = Mapping[str, tuple[Lens, Pose]]  #: by the photograph's name


class Similarity(NamedTuple):
    """A similarity transform x ↦ scale · rotation x + shift from the cameras' frame to the sheet's frame [mm]."""

    scale: float
    rotation: np.ndarray  #: (3, 3)
    shift: np.ndarray  #: (3,)
    rms: float  #: of the corners [mm]
    corners: int  #: number that fit


def charuco() -> cv2.aruco.CharucoBoard:
    """Return the sheet as OpenCV's ChArUco board, with lengths in mm."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    return cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE, MARKER * SQUARE, dictionary)


def page(paper: Literal["a4", "letter"]) -> Image.Image:
    """Draw the page to print: the sheet, and below it a line that says what to measure. Writes no file.

    The image has `DOTS` pixels per mm. `paper`: size of the page.
    """
    size = DOTS * SQUARE * np.array([COLUMNS, ROWS])
    sheet = Image.new("1", (round(DOTS * PAPERS[paper][0]), round(DOTS * PAPERS[paper][1])), 1)
    left, top = ((np.array(sheet.size) - size) // 2).tolist()
    sheet.paste(Image.fromarray(charuco().generateImage(tuple(size.tolist()), marginSize=0)), (left, top))
    position, font = (sheet.width // 2, int(top + size[1]) + DOTS), ImageFont.load_default(3 * DOTS)
    ImageDraw.Draw(sheet).text(position, NOTE, 0, font, anchor="ma")
    return sheet


class MarkerSheet:
    """The printed sheet, with a detector for its corners. `square`: side length of the squares [mm]."""

    def __init__(self, square: float = SQUARE) -> None:
        self.square = square
        corner = np.arange((COLUMNS - 1) * (ROWS - 1))
        x, y = corner % (COLUMNS - 1) + 1 - COLUMNS / 2, ROWS / 2 - 1 - corner // (COLUMNS - 1)
        self.points = square * np.stack([x, y, 0 * x], 1)  #: (96, 3) all corners
        params = cv2.aruco.CharucoParameters()
        params.tryRefineMarkers = True  # finds small markers by the position of the others
        self.detector = cv2.aruco.CharucoDetector(charuco(), params)

    def detect(self, picture: np.ndarray) -> SheetDetection | None:
        """Find the sheet's corners in a photograph (H, W, 3) or (H, W) uint8.

        Returns None if the photograph shows too few of them. Their pixels are refined at full size.
        """
        grey = picture if picture.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
        scale = -(-max(grey.shape) // LONGEST)
        height, width = (side // scale for side in grey.shape)
        small = cv2.resize(grey[: height * scale, : width * scale], (width, height), interpolation=cv2.INTER_AREA)
        found, ids = self.detector.detectBoard(small)[:2]
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        ids, pixels = ids.ravel(), (found.reshape(-1, 2).astype(float) + 0.5) * scale
        points = self.points[ids]
        if are_collinear(points):
            return None
        _, near = cv2.findHomography(points[:, :2], pixels, cv2.RANSAC, MAX_STRAY * self.pitch(points, pixels).max())
        keep = near.ravel() > 0 if near is not None else np.zeros(len(ids), bool)
        if keep.sum() < MIN_CORNERS or are_collinear(points[keep]):
            return None
        ids, points, pixels = ids[keep], points[keep], pixels[keep]
        end = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3
        for pixel, pitch in zip(pixels, self.pitch(points, pixels)):
            reach = max(2, int(pitch * (1 - MARKER) / 2))  # half of a window without markers
            place = (pixel - 0.5).astype(np.float32).reshape(1, 1, 2)  # OpenCV's first pixel centre is 0
            pixel[:] = cv2.cornerSubPix(grey, place, (reach, reach), (-1, -1), end).ravel() + 0.5
        return SheetDetection(ids, points, pixels)

    def pitch(self, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return how long a square's side appears at each of n corners, (n,) [px]: the shorter of two sides.

        `points` (n, 3): the corners on the sheet. `pixels` (n, 2): the same corners in the photograph.
        """
        plane, _ = cv2.findHomography(points[:, :2], pixels, cv2.RANSAC, 0.05 * np.ptp(pixels, 0).max())
        if plane is None:
            return np.zeros(len(points))
        here, *ends = (
            cv2.perspectiveTransform(points[None, :, :2] + shift, plane)[0]
            for shift in self.square * np.array([[0, 0], [1, 0], [0, 1]])
        )
        return np.min([np.linalg.norm(end - here, axis=1) for end in ends], 0)


def are_collinear(points: np.ndarray) -> bool:
    """Return True if points (n, 3) are nearly on one line."""
    values = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(values[1] <= 0.01 * values[0])


def calibrate(detections: Detections, size: tuple[int, int]) -> tuple[Lens, dict[str, Pose], dict[str, float]]:
    """Calibrate photographs of one size by the sheet alone. Returns (lens, poses, errors).

    `poses` are camera-to-world (4, 4) [mm], `errors` RMS reprojection errors [px], both by the photograph's name. The
    lens has one radial coefficient, and its principal point is in the middle. `detections`: corners by the photograph's
    name. `size`: (width, height) of the photographs [px]. Photographs that do not fit are left out. Raises InputError
    if fewer than three fit.
    """
    names = list(detections)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    while len(names) >= 3:
        points = [detections[name].points.astype(np.float32) for name in names]
        pixels = [(detections[name].pixels - 0.5).astype(np.float32) for name in names]
        guess = cv2.initCameraMatrix2D(points, pixels, size, 1.0)
        if not (np.isfinite(guess).all() and 0.2 < guess[0, 0] / max(size) < 20):  # all photographs from straight above
            guess[0, 0] = guess[1, 1] = max(size)
        guess[:2, 2] = (np.array(size) - 1) / 2
        _, K, distortion, rotations, shifts, _, _, found = cv2.calibrateCameraExtended(
            points, pixels, size, guess, np.zeros(5), flags=flags
        )
        errors = found.ravel()
        fits = errors <= max(1.0, 3 * float(np.median(errors)))
        if fits.all():
            lens = Lens("SIMPLE_RADIAL", size, (K[0, 0], size[0] / 2, size[1] / 2, distortion.ravel()[0]))
            poses = [camera_to_world(cv2.Rodrigues(R)[0], t.ravel()) for R, t in zip(rotations, shifts)]
            return lens, dict(zip(names, poses)), dict(zip(names, errors.tolist()))
        names = [name for name, fit in zip(names, fits) if fit]
    raise InputError(f"sheet of markers: {len(names)} photographs show enough of it and fit each other; must be 3 or "
                     "more: keep it flat and photograph it from all around")  # fmt: skip


def align(detections: Detections, cameras: Cameras) -> Similarity:
    """Estimate the similarity transform from the cameras' frame to the sheet's frame [mm].

    `detections`: corners by the photograph's name. `cameras`: (lens, pose) by the photograph's name. Raises InputError
    if too few corners fit, or if they fit badly.
    """
    seen = np.array([pair for _, *pair in triangulate(detections, cameras)]).reshape(-1, 2, 3)
    found, true = seen[:, 0], seen[:, 1]
    if len(found) < MIN_CORNERS or are_collinear(true):
        raise InputError(f"sheet of markers: photographs with a camera show {len(found)} of its corners together; must "
                         f"be {MIN_CORNERS} or more, not on one line: let more of them show more of it")  # fmt: skip
    _, keep = ransac((found, true), SimilarityTransform, 3, MAX_RMS * np.ptp(true, 0).max(), max_trials=500, rng=0)
    keep = np.ones(len(found), bool) if keep is None else keep
    for _ in range(3):
        matrix = procrustes(found[keep], true[keep], reflection=False, return_cost=False)
        errors = np.linalg.norm(found @ matrix[:3, :3].T + matrix[:3, 3] - true, axis=1)
        keep = errors <= max(4 * float(np.median(errors)), 1e-6 * np.ptp(true))
    rms, width = float(np.sqrt(np.mean(errors[keep] ** 2))), float(np.ptp(true[keep], 0).max())
    if keep.sum() < MIN_CORNERS or not rms < MAX_RMS * width:
        raise InputError(f"sheet of markers: its corners have an error of {rms:.2g} mm on {width:.0f} mm; is it flat, "
                         "did it not move, and is there only one?")  # fmt: skip
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return Similarity(scale, matrix[:3, :3] / scale, matrix[:3, 3], rms, int(keep.sum()))


def triangulate(detections: Detections, cameras: Cameras) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Triangulate the sheet's corners. Yields (id, point (3,) in the cameras' frame, point (3,) on the sheet [mm]).

    `detections`: corners by the photograph's name. `cameras`: (lens, pose) by the photograph's name. Corners that are
    seen by only one camera or without parallax are left out.
    """
    options = pycolmap.EstimateTriangulationOptions(min_tri_angle=MIN_PARALLAX)
    options.ransac.random_seed = 0
    seen: dict[int, list[tuple]] = {}
    points: dict[int, np.ndarray] = {}
    for name in filter(cameras.__contains__, detections):
        lens, pose = cameras[name]
        world_to_camera = pycolmap.Rigid3d(np.linalg.inv(pose)[:3])
        for corner, point, pixel in zip(detections[name].ids.tolist(), *detections[name][1:]):
            seen.setdefault(corner, []).append((pixel, world_to_camera, lens.colmap))
            points[corner] = point
    for corner, observations in sorted(seen.items()):
        pixels, poses, lenses = zip(*observations)
        options.ransac.max_error = MAX_ANGLE * np.mean([max(c.width, c.height) / c.mean_focal_length() for c in lenses])
        if len(pixels) > 1 and (found := pycolmap.estimate_triangulation(np.array(pixels), poses, lenses, options)):
            yield corner, found["xyz"], points[corner]


class PaperSamples(NamedTuple):
    """Brightness samples of the sheet's white paper in a photograph."""

    points: np.ndarray  #: (n, 3) on the sheet, in the frame of `SheetDetection`
    colours: np.ndarray  #: (n, 3) linear
    in_margin: np.ndarray  #: (n,) bool: in the page's margin; if that was cut off, the sample shows the table


def sample_paper(
    photograph: np.ndarray, detection: SheetDetection, linear: Callable[[np.ndarray], np.ndarray] = np.asarray,
    saturation: float = 1.0,
) -> PaperSamples:  # fmt: skip
    """Sample the colours of the sheet's white squares and of the page's margin in a photograph (H, W, 3).

    Each sample is a median of several pixels. Overexposed samples are left out. `linear`: function that decodes a part
    of the photograph to linear float32; it is called for parts because the whole would need too much memory.
    `saturation`: linear value from which pixels are clipped (1 = full scale).
    """

    def sample(points: np.ndarray, plane: np.ndarray) -> np.ndarray:
        return sample_colours(photograph, linear, points, plane)

    pixels = dict(zip(detection.ids.tolist(), detection.pixels))
    points = dict(zip(detection.ids.tolist(), detection.points))
    unit = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    samples: list[tuple[np.ndarray, np.ndarray, bool]] = []
    for corner in pixels:
        row, column = divmod(corner, COLUMNS - 1)
        ring = [corner, corner + 1, corner + COLUMNS - 1, corner + COLUMNS]
        if column == COLUMNS - 2 or not all(k in pixels for k in ring):
            continue
        four, (first, right, down, _) = np.array([pixels[k] for k in ring], np.float32), (points[k] for k in ring)
        sides = np.stack([right - first, down - first])
        if INNER * np.linalg.norm(four[1:3] - four[0], axis=1).min() < 1:  # [px]: too blurred
            continue
        plane = cv2.getPerspectiveTransform(unit, four)
        if (row + column) % 2:
            # In oblique views two opposite rims are so narrow that they mix with black: take the brighter pair.
            rims = np.median(sample(RIMS, plane).reshape(2, 2, -1, 3), 2).mean(0)
            samples.append((first + [0.5, 0.5] @ sides, rims[rims.sum(1).argmax()], False))
        for place, outermost in zip(MARGINS, (column == 0, column == COLUMNS - 3, row == 0)):
            if outermost:
                colour = np.median(sample(place + PATCH, plane), 0)  # NaN if partly outside
                samples.append((first + place @ sides, colour, True))
    samples = [sample for sample in samples if sample[1].max() < CLIPPED * saturation]
    where, colours, in_margin = zip(*samples) if samples else ((), (), ())
    return PaperSamples(np.reshape(where, (-1, 3)), np.reshape(colours, (-1, 3)), np.array(in_margin, bool))


def sample_colours(
    photograph: np.ndarray, linear: Callable[[np.ndarray], np.ndarray], points: np.ndarray, plane: np.ndarray
) -> np.ndarray:
    """Return the linear colours (n, 3) of a photograph (H, W, 3) at `points` (n, 2) of a plane.

    A colour is NaN if its point is outside the photograph. `plane` (3, 3): homography from the plane to pixels.
    `linear`: function that decodes a part of the photograph to linear float32.
    """
    at = cv2.perspectiveTransform(points[None], plane) - 0.5
    height, width = photograph.shape[:2]
    left, top = (np.floor(at.min((0, 1))).clip(0, [width - 1, height - 1])).astype(int)
    right, bottom = (np.ceil(at.max((0, 1))).clip(0, [width - 1, height - 1])).astype(int) + 1
    part = linear(photograph[top:bottom, left:right])
    # (1, n): versions of OpenCV differ on one-dimensional maps
    x, y = np.ascontiguousarray(np.moveaxis(at - [left, top], -1, 0), np.float32)
    return cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[np.nan] * 4)[0]
