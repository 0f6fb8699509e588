"""Importer of VisualSFM's models."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.interpolate import pade

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens, pose_of, rotation_of
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import image_size, load_lines, matrix

#: VisualSFM's model undistorts: ru = rd (1 + r rd²). The power series of rd / ru in -r ru² has the coefficients of Fuss
#: and Catalan. FULL_OPENCV takes a quotient of polynomials, here the Padé approximant, without their constants, 1.
NUMERATOR, DENOMINATOR = (p.coeffs[-2::-1] for p in pade([comb(3 * n, n) / (2 * n + 1) for n in range(7)], 3))
MAX_ERROR = 0.01  #: of the approximant in the corner of a photograph [px]


@dataclass(frozen=True)
class VisualSfm(Photogrammetry):
    """VisualSFM: .nvm, version NVM_V3. The light is fixed to the camera.

    SRC is the file. If it has several models, the one with the most photographs is used. The file does not give the
    size of the photographs. They must have their original size.
    """

    fields = Fields(
        used={
            "name": "the photograph; a double quote stands for a space", "focal radial FixedK": "lens",
            "qw qx qy qz cx cy cz": "pose: world to camera, and place",
        },
        harmless={"points PLY": "the surface starts from masks"},
    )  # fmt: skip

    def posed(self) -> Iterator[Frame]:
        first, *lines = load_lines(self.src) or [""]
        word, *fixed = first.split() or [""]
        if word != "NVM_V3":
            raise InputError(f"{self.src}: SRC: begins with {word[:40]!r}; must be a file of VisualSFM's, NVM_V3")
        K = None
        if fixed:
            K = matrix(fixed[1:5] if fixed[0] == "FixedK" else fixed, (4,), f"{self.src}: FixedK fx cx fy cy")
        models = self.models([line for line in lines if not line.startswith("#")])
        if not models:
            raise InputError(f"{self.src}: SRC: has no model with cameras")
        for line in models[self.largest(models, "models")]:
            name, *values = line.rsplit(maxsplit=10)
            name = name.replace('"', " ")
            what = f"{self.src}: camera {name[:99]!r}"
            f, *quaternion, x, y, z, r, _ = matrix(values, (10,), what)
            if len(fixed) > 5 and matrix(fixed[5], (), f"{self.src}: FixedK: r") not in (0, r):
                raise InputError(f"{what}: radial distortion: is {r:g}, but that of FixedK is {fixed[5]}; undistort "
                                 "the photographs in VisualSFM")  # fmt: skip
            R = rotation_of(np.roll(quaternion, -1), f"{what}: quaternion")
            if not f:
                self.without_pose.add(name)
            elif image := self.photograph(name, what, relative=True):
                size = image_size(image)
                fx, cx, fy, cy = (f, size[0] / 2, f, size[1] / 2) if K is None else K
                if not (0.2 < cx / size[0] < 0.8 and 0.2 < cy / size[1] < 0.8):  # some writers count from the middle
                    raise InputError(f"{self.src}: FixedK: the principal point, {cx:g} {cy:g}, is far from the middle "
                                     f"of {image.name}; must be in pixels from its upper left corner")  # fmt: skip
                lens = undistorting_lens(size, (fx, fy, cx, cy), r, what)
                yield Frame(image, lens, pose_of(R.T, np.array([x, y, z])), said=name)

    def models(self, lines: list[str]) -> list[list[str]]:
        """Split the lines of the file into models. Returns for each model the lines of its cameras.

        A model is written as the number of cameras, a line for each camera, the number of points, and a line for each
        point.
        """
        models, at = [], 0

        def count() -> int:
            word = lines[at].strip() if at < len(lines) else "0"
            if not word.isdecimal() or len(word) > 9:
                raise InputError(f"{self.src}: found {word[:60]!r} where the number of cameras or points must be")
            return int(word)

        while number := count():
            models.append(lines[at + 1 : at + 1 + number])
            if len(models[-1]) < number:
                raise InputError(f"{self.src}: has {len(models[-1])} of the {number} cameras that it announces")
            at += 1 + number
            at += 1 + count()
        return models


def undistorting_lens(size: tuple[int, int], intrinsics: tuple[float, ...], r: float, what: str) -> Lens:
    """Make a lens that approximates VisualSFM's radial distortion.

    `size`: (width, height) [px]. `intrinsics`: fx, fy, cx, cy [px]. `r`: VisualSFM's coefficient, with undistorted
    radius = distorted radius · (1 + r · distorted radius²) in focal lengths. Raises InputError if the distortion is too
    strong for the approximation. The message begins with `what`.
    """
    if not r:
        return Lens("PINHOLE", size, intrinsics)
    powers = (-r) ** np.arange(1, 4)
    k1, k2, k3 = NUMERATOR * powers
    k4, k5, k6 = DENOMINATOR * powers
    fx, fy, cx, cy = intrinsics
    distorted = np.hypot(max(cx, size[0] - cx) / fx, max(cy, size[1] - cy) / fy)
    straight = distorted * (1 + r * distorted**2)
    u2 = straight ** (2 * np.arange(4))
    found = straight * (u2 @ (1, k1, k2, k3)) / (u2 @ (1, k4, k5, k6))
    if not 1 + 3 * r * distorted**2 > 0 or not abs(found - distorted) * max(fx, fy) < MAX_ERROR:
        raise InputError(f"{what}: radial distortion: is {r:g}, too strong for this field of view; undistort the "
                         "photographs in VisualSFM")  # fmt: skip
    return Lens("FULL_OPENCV", size, (*intrinsics, k1, k2, 0, 0, k3, k4, k5, k6))
