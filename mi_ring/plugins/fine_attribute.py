"""The `fine_attribute` texture: a mesh attribute with detail that is finer than the mesh (Mitsuba plugin)."""

import weakref

import drjit as dr
import mitsuba as mi


class FineAttribute(mi.Texture):
    """A mesh attribute of three channels, times factors on a lattice in each triangle.

    ============== ========= ==================================================================== =====
    Parameter      Type      Description                                                          Flags
    ============== ========= ==================================================================== =====
    ``name``       string    the mesh attribute, for instance ``vertex_diffuse``
    ``scale``      float     factor of the attribute. Default: 1
    ============== ========= ==================================================================== =====

    Without factors, the texture is the attribute itself. The `shapenet` shape writes them if its fit has a texture that
    is finer than the mesh, as in "Mesh Colors" (Yuksel, Keyser and House 2010). Then ``mi.traverse`` lists ``factors``,
    3 per point of the lattices, one triangle after the other. They are differentiable. A lattice of n divisions has
    (n + 1)(n + 2) / 2 points. Point (i, j), i + j ≤ n, has the barycentric coordinates i/n and j/n with respect to the
    second and the third vertex. Points are in the order of j, then of i. Between them, factors are linear. Triangles
    share no points, but factors at common edges should be equal.

    Products are clipped to the range of the fitted colour. Several shapes may share the texture. Each has its own
    factors, which are then called ``factors_<id of the shape>``.

    What it does not do: factors in scalar, spectral and monochrome variants; factors on meshes with texture
    coordinates, whose ``uv`` are not barycentric; factors of a single channel.

    Raises ValueError if there is no ``name``.

    .. tab-set-code::

        .. code-block:: xml

            <texture type="fine_attribute" name="base_color">
              <string name="name" value="vertex_base_color"/>
            </texture>

        .. code-block:: python

            {"type": "fine_attribute", "name": "vertex_base_color"}
    """

    def __init__(self, props):
        super().__init__(props)
        self.attribute = props.get("name", "")
        if not self.attribute:
            raise ValueError(f'fine_attribute "{props.id()}": name is missing, must be that of a mesh attribute')
        scale = props.get("scale", 1.0)
        self.base = mi.load_dict({"type": "mesh_attribute", "name": self.attribute, "scale": scale})
        self.lattices = weakref.WeakKeyDictionary()  #: by shape; weak, so that a texture keeps no shape alive

    def set_lattice(self, shape, lattice):
        """Set the factors of a shape. `lattice`: a `Lattice`; None: the shape has none."""
        if lattice is not None:
            self.lattices[shape] = lattice
        elif len(self.lattices):  # meshes that are not Python's have none, and cannot be asked for
            self.lattices.pop(shape, None)

    def factored(self, value, si, active):
        """Multiply the attribute's values at the surface interactions `si` by the factors."""
        for shape, lattice in self.lattices.items():
            here = active & (si.shape == mi.ShapePtr(shape))
            fine = value * factor(lattice, si, here)
            value = dr.select(here, dr.clip(fine, lattice.low, lattice.high), value)
        return value

    def eval(self, si, active=True):
        return self.factored(self.base.eval(si, active), si, active)

    def eval_1(self, si, active=True):
        return self.base.eval_1(si, active)

    def eval_3(self, si, active=True):
        return self.factored(self.base.eval_3(si, active), si, active)

    def mean(self):
        return self.base.mean()

    def is_spatially_varying(self):
        return True

    def traverse(self, callback):
        for shape, lattice in self.lattices.items():
            name = "factors" if len(self.lattices) == 1 else f"factors_{shape.id()}"
            callback.put(name, lattice.factors, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys):
        for shape, lattice in self.lattices.items():
            needed = 3 * shape.face_count() * points_of(lattice)
            if (found := dr.width(lattice.factors)) != needed:
                raise ValueError(f'fine_attribute "{self.attribute}": factors: has {found} numbers, must have {needed}:'
                                 " three for each point of each triangle's lattice")  # fmt: skip

    def to_string(self):
        divisions = ", ".join(str(lattice.divisions) for lattice in self.lattices.values())
        return f'FineAttribute[name="{self.attribute}", divisions=[{divisions}]]'


def points_of(lattice):
    """Return the number of points that a `Lattice` has in each triangle."""
    return (lattice.divisions + 1) * (lattice.divisions + 2) // 2


def factor(lattice, si, active):
    """Interpolate the factors of a `Lattice` at surface interactions on its shape. Returns a colour."""
    n = lattice.divisions
    x, y = n * si.uv.x, n * si.uv.y
    j = dr.clip(mi.Int32(y), 0, n - 1)
    i = dr.clip(mi.Int32(x), 0, n - 1 - j)
    u, v = x - i, y - j
    upper = (u + v > 1) & (i + j < n - 1)  # the triangle that points the other way; the last of a row has none
    corner = dr.select(upper, 1, 0)
    around = [(i + corner, j + corner, dr.abs(1 - u - v)),
              (i + 1, j, dr.select(upper, 1 - v, u)), (i, j + 1, dr.select(upper, 1 - u, v))]  # fmt: skip
    result = mi.Color3f(0)
    for a, b, weight in around:
        place = b * (n + 1) - b * (b - 1) // 2 + a
        index = si.prim_index * points_of(lattice) + mi.UInt32(place)
        result += weight * dr.gather(mi.Color3f, lattice.factors, index, active)
    return result


mi.register_texture("fine_attribute", FineAttribute)
