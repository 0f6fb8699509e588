"""Evaluates measured reflectance: tables of the MERL database, and networks that were fitted to such tables."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import InputError
from mi_ring.foreign import load_npz

CELLS = 90, 90, 180  #: of a table: numbers of cells of θh, θd, φd
SCALES = np.array([1.0, 1.15, 1.66]) / 1500  #: of its red, green and blue plane
FITTED_ANGLES = np.radians([80.0, 65.0])  #: θh and θd up to which the networks were fitted to enough data
RGL = b"tensor_file"  #: how a file of the RGL database begins
LAYERS = {"w1": (6, 21), "b1": (21,), "w2": (21, 21), "b2": (21,), "w3": (21, 3), "b3": (3,)}  #: of each network


class MerlTable:
    """A ``.binary`` file of the MERL database (Matusik et al. 2003), interpolated between its cells.

    Cell i of θh is at the angle (i / 90)² · 90°. The cells of θd and φd are 1° wide. Because of reciprocity, φd and
    φd + π have the same value. A cell with a negative value was not measured; it gets the value of the cells around it.

    Raises ValueError if the file is not such a table.
    """

    def __init__(self, path: Path):
        with path.open("rb") as file:
            if file.read(len(RGL)) == RGL:
                raise ValueError(f"{path}: is of the RGL database, not of MERL; give Mitsuba's plugin measured "
                                 "with this filename")  # fmt: skip
            file.seek(0)
            sizes = np.fromfile(file, "<i4", 3)
            if tuple(sizes) != CELLS:
                raise ValueError(f"{path}: is no table of MERL: begins with {sizes.tolist()}, must be {list(CELLS)}")
            values = np.fromfile(file, "<f8")
        if values.size != 3 * np.prod(CELLS):
            raise ValueError(f"{path}: has {values.size} numbers, must have {3 * np.prod(CELLS)}")
        planes = values.reshape(3, *CELLS)
        measured = (np.isfinite(planes) & (planes >= 0)).all(0)
        planes = np.where(measured, planes * SCALES[:, None, None, None], 0)
        weights = np.concatenate([planes, measured[None]]).transpose(1, 2, 3, 0)
        weights = np.concatenate([weights, weights[:, :, :1]], 2)  # the first φd follows the last
        tensor = mi.TensorXf(np.ascontiguousarray(weights, np.float32))
        self.texture = mi.Texture3f(tensor, wrap_mode=dr.WrapMode.Clamp)

    def value(self, theta, d):
        """Evaluate the BRDF. Returns Color3f [1/sr].

        `theta`: angle θh between normal and half vector [rad]. `d`: difference vector of Rusinkiewicz, the direction to
        the viewer in the frame of the half vector.
        """
        half = dr.sqrt(dr.clip(theta / (dr.pi / 2), 0, 1)) * CELLS[0]
        difference = dr.acos(dr.clip(d.z, 0, 1)) / (dr.pi / 2) * CELLS[1]
        turn = dr.atan2(d.y, d.x) / dr.pi
        turn = (turn - dr.floor(turn)) * CELLS[2]
        place = [(turn + 0.5) / (CELLS[2] + 1), (difference + 0.5) / CELLS[1], (half + 0.5) / CELLS[0]]
        red, green, blue, weight = self.texture.eval(mi.Point3f(place))
        return mi.Color3f(red, green, blue) / dr.maximum(weight, 1e-6)


class MerlNetwork:
    """A network of 6-21-21-3 neurons that was fitted to a table ("Neural BRDF Representation", Sztrajman 2021).

    `path`: an NPZ file of networks. `material`: name of one of them. Raises InputError if the file contains no such
    networks, and for an unknown material.
    """

    def __init__(self, path: Path, material: str):
        arrays = load_npz(path)
        for name in ("names", *LAYERS):
            if name not in arrays:
                raise InputError(f"{path}: has no array {name}; is it one of networks fitted to MERL?")
        names = np.ravel(arrays["names"]).astype(str).tolist()
        for name, shape in LAYERS.items():
            if arrays[name].shape != (len(names), *shape) or arrays[name].dtype.kind not in "fiu":
                found, wanted = list(arrays[name].shape), [len(names), *shape]
                raise InputError(f"{path}: {name} is of shape {found}, must be {wanted}, of numbers")
        if material not in names:
            raise InputError(f'{path}: has no material "{material}"; must be one of {", ".join(names)}')
        self.layers = [arrays[name][names.index(material)].astype(float).tolist() for name in LAYERS]

    def value(self, theta, d):
        """Evaluate the BRDF. Returns Color3f [1/sr].

        `theta`: angle θh between normal and half vector [rad]. `d`: difference vector of Rusinkiewicz, the direction to
        the viewer in the frame of the half vector. Angles outside of the fitted range are clamped.
        """
        theta = dr.minimum(theta, float(FITTED_ANGLES[0]))
        sin = dr.sqrt(dr.maximum(1 - d.z * d.z, 0))
        narrowed = dr.minimum(sin, float(np.sin(FITTED_ANGLES[1])))
        share = narrowed / dr.maximum(sin, 1e-9)
        x = [dr.sin(theta), mi.Float(0), dr.cos(theta), d.x * share, d.y * share, dr.sqrt(1 - narrowed * narrowed)]
        w1, b1, w2, b2, w3, b3 = self.layers
        y = [dr.maximum(sum_, 0) for sum_ in dense_layer(x, w1, b1)]
        y = [dr.maximum(sum_, 0) for sum_ in dense_layer(y, w2, b2)]
        return dr.maximum(dr.exp(mi.Color3f(*dense_layer(y, w3, b3))) - 1, 0)


def dense_layer(x: list, weights: list, biases: list) -> list:
    """Multiply the n Floats `x` by `weights` (n, m), and add `biases` (m). Returns a list of m Floats.

    Dr.Jit's own layers need half precision on a GPU.
    """
    sums = [mi.Float(bias) for bias in biases]
    for value, row in zip(x, weights):
        sums = [dr.fma(value, weight, sum_) for weight, sum_ in zip(row, sums)]
    return sums
