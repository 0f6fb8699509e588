"""The `fine_attribute` texture: a mesh attribute with detail that is finer than the mesh (Mitsuba plugin)."""

import drjit as dr
import mitsuba as mi


class FineAttribute(mi.Texture):
    """A mesh attribute of three channels, times factors on a lattice in each triangle.

    ============== ========= ==================================================================== =====
    Parameter      Type      Description                                                          Flags
    ============== ========= ==================================================================== =====
    ``name``       string    the mesh attribute, for instance ``vertex_diffuse``
    ============== ========= ==================================================================== =====

    ============== ========= ==================================================================== =====
    Exposed        Type      Description                                                          Flags
    ============== ========= ==================================================================== =====
    ``factors``    float     3 per point of the lattices, one triangle after the other. None at   P, ∂
                             first: the texture is the attribute itself
    ============== ========= ==================================================================== =====

    The `shapenet` shape writes the factors: they are the texture of a fit that is finer than its mesh, on "Mesh Colors"
    (Yuksel, Keyser and House 2010). A lattice of n divisions has (n + 1)(n + 2) / 2 points. Point (i, j), i + j ≤ n,
    has the barycentric coordinates i/n and j/n with respect to the second and the third vertex. Points are in the order
    of j, then of i. Between them, factors are linear. Triangles share no points, but factors at common edges should be
    equal.

    What it does not do: factors in scalar and spectral variants, and on meshes with texture coordinates.

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
        self.base = mi.load_dict({"type": "mesh_attribute", "name": self.attribute})
        self.set_factors(None, 0)

    def set_factors(self, factors, divisions):
        """Set the factors. `factors`: flat Float in the order above; None: there are none. `divisions`: n of them."""
        self.factors, self.divisions = factors, 0 if factors is None else divisions

    def factor(self, si, active):
        """Interpolate the factors at surface interactions: a colour."""
        n = self.divisions
        x, y = n * si.uv.x, n * si.uv.y
        j = dr.clip(mi.Int32(y), 0, n - 1)
        i = dr.clip(mi.Int32(x), 0, n - 1 - j)
        u, v = x - i, y - j
        upper = u + v > 1  # the triangle of the lattice that points the other way
        corner = dr.select(upper, 1, 0)
        around = [(i + corner, j + corner, dr.abs(1 - u - v)),
                  (i + 1, j, dr.select(upper, 1 - v, u)), (i, j + 1, dr.select(upper, 1 - u, v))]  # fmt: skip
        result = mi.Color3f(0)
        for a, b, weight in around:
            place = b * (n + 1) - b * (b - 1) // 2 + a
            index = si.prim_index * ((n + 1) * (n + 2) // 2) + mi.UInt32(place)
            result += weight * dr.gather(mi.Color3f, self.factors, index, active)
        return result

    def eval(self, si, active=True):
        value = self.base.eval(si, active)
        return value * self.factor(si, active) if self.divisions else value

    def eval_1(self, si, active=True):
        return self.base.eval_1(si, active)

    def eval_3(self, si, active=True):
        value = self.base.eval_3(si, active)
        return value * self.factor(si, active) if self.divisions else value

    def mean(self):
        return self.base.mean()

    def is_spatially_varying(self):
        return True

    def traverse(self, callback):
        if self.divisions:
            callback.put("factors", self.factors, mi.ParamFlags.Differentiable)

    def to_string(self):
        return f'FineAttribute[name="{self.attribute}", divisions={self.divisions}]'


mi.register_texture("fine_attribute", FineAttribute)
