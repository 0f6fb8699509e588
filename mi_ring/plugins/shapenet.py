"""The `shapenet` shape: the reconstructed surface as a mesh (Mitsuba plugin)."""

import mitsuba as mi
import numpy as np

from mi_ring.plugins.properties import beside_scene, number, vector
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.scene.plain_mesh import FACES, POSITIONS

#: Parameters for a fit and for exports of its result. A finished fit in ``weights`` has its own.
FOR_FITS = "center", "radius", "domain", "ground", "up", "metres"


class ShapeNetMesh(mi.Mesh):
    """The reconstructed surface: Shape-Net's deformation of a domain, sampled as a mesh of any resolution.

    ================ ========= ========================================================================== =======
    Parameter        Type      Description                                                                Flags
    ================ ========= ========================================================================== =======
    ``weights``      string    a saved fit (``ring.pt``). Default: none, the shape is the undeformed
                               domain
    ``subdivisions`` integer   level of the icosphere, 0 to 8: 10 · 4ⁿ + 2 vertices. Default: 5
    ``domain``       string    file of a closed mesh [scene units] that replaces the sphere as domain.
                               Not together with ``weights``. Default: none
    ``center``       point     centre of the normalising sphere [scene units]. Not together with
                               ``weights``. Default: the middle of ``domain``, else the origin; a fit
                               estimates it from masks or cameras
    ``radius``       float     radius of the normalising sphere [scene units]. Not together with
                               ``weights``. Default: the mean radius of ``domain``, else 1
    ``ground``       point     point of the table on which the object stands [scene units]. A fit keeps
                               the surface above it. Not together with ``weights``. Default: none
    ``up``           vector    normal of the table, and up direction of exports. Not together with
                               ``weights``. Default: z for the table; exports are not turned
    ``metres``       float     length of a scene unit [m], for exports. Not together with ``weights``.
                               Default: not known
    ``to_world``     transform applied to the surface at the end. Default: none
    ``flash``        boolean   show every integrator the light of the `photograph` it renders. Set it to
                               false to place a fit into a scene of your own. Default: true
    (nested)         bsdf      usually `cooktorrance`, which reads the attributes below; exposed as       P, ∂
                               ``bsdf``
    ================ ========= ========================================================================== =======

    ==================== ===== ========================================================================== =======
    Exposed              Type  Description                                                                Flags
    ==================== ===== ========================================================================== =======
    ``vertex_positions`` float 3 per vertex [scene units]                                                 P, ∂, D
    ``vertex_normals``   float 3 per vertex; recomputed when positions change                             P, ∂, D
    ``faces``            int   3 vertices per triangle                                                    P
    ``vertex_diffuse``   float 3 per vertex; this and the next two if the fit has a `cooktorrance`        P, ∂
    ``vertex_specular``  float 1 per vertex                                                               P, ∂
    ``vertex_roughness`` float 1 per vertex                                                               P, ∂
    ==================== ===== ========================================================================== =======

    The mesh has smooth normals, and an attribute ``vertex_<parameter>`` for each parameter that the fit in ``weights``
    predicts. For `cooktorrance` these are ``vertex_diffuse`` (3 channels), ``vertex_specular``, ``vertex_roughness``
    and, unless the fit had ``--diffuse lambert``, ``vertex_diffuse_roughness`` (1 each). Without ``weights`` the mesh
    has the first three, with the values 0.5, 0 and 0.5. An error is raised if the nested BSDF needs an attribute that
    the mesh does not have, or reads one with another number of channels. If the fit has a texture that is finer than
    the mesh, each `fine_attribute` that reads the albedo shows it, such as the colour of a `cooktorrance`.

    What it does not do: texture coordinates; colours in spectral variants, where Mitsuba reads attributes of three
    channels as coefficients of a spectrum.

    .. tab-set-code::

        .. code-block:: xml

            <shape type="shapenet" id="object">
              <string name="weights" value="ring.pt"/><integer name="subdivisions" value="6"/>
              <bsdf type="cooktorrance"/>
            </shape>

        .. code-block:: python

            {
                "type": "shapenet", "weights": "ring.pt", "subdivisions": 6,
                "bsdf": {"type": "cooktorrance"},
            }
    """

    def __init__(self, props):
        import torch  # imported here so that `import mi_ring` is quick

        from mi_ring.geometry.domain import Sphere, closed_domain
        from mi_ring.geometry.meshes import load_closed_mesh
        from mi_ring.objects.ring_file import load_fit
        from mi_ring.scene.mesh_texture import write_texture

        self.subdivisions = props.get("subdivisions", 5)
        if not isinstance(self.subdivisions, int) or self.subdivisions not in range(9):
            raise ValueError(f'shapenet "{props.id()}": subdivisions is {self.subdivisions}, must be 0 to 8')
        given = {key: props[key] for key in (*FOR_FITS, "weights") if key in props}
        for key in FOR_FITS:
            if key in given and "weights" in given:
                raise ValueError(f'shapenet "{props.id()}": weights carry their own {key}; give only one of the two')
        to_world = props.get("to_world", mi.ScalarTransform4f())
        if isinstance(to_world, str | int | float):
            raise ValueError(f'shapenet "{props.id()}": to_world is {to_world}, must be a <transform>')
        to_world = np.array(to_world.matrix)
        if props.get("flash", True):
            # The scene collects the emitters of its shapes. So stock integrators see nested lights.
            props["flash"] = mi.load_dict({"type": "flash"})

        #: The given normalising sphere, for the fit; None if it is not given.
        self.center = vector(props, "center", "point")
        self.radius = number(props, "radius", positive=True) if "radius" in given else None
        #: Unit vector (3,) and length of a scene unit [m], for exports; None if they are not given.
        self.up, self.metres = vector(props, "up", "vector"), None
        if self.up is not None:
            if not self.up.any():
                raise ValueError(f'shapenet "{props.id()}": up is {given["up"]}, must be a <vector> that is not 0')
            self.up = self.up / np.linalg.norm(self.up)
        if "metres" in given:
            self.metres = number(props, "metres", positive=True)
        #: (2, 3) a point of the table and its unit normal, for the fit; None if they are not given.
        self.ground = vector(props, "ground", "point")
        if self.ground is not None:
            self.ground = np.stack([self.ground, [0.0, 0.0, 1.0] if self.up is None else self.up])
        #: The given domain with its normalising sphere, and its file; None if it is not given.
        self.domain, self.domain_file = None, None
        if "domain" in given:
            self.domain_file = beside_scene(given["domain"])
            self.domain = closed_domain(load_closed_mesh(self.domain_file, "domain"), self.center, self.radius)
        sphere = Sphere(), np.zeros(3) if self.center is None else self.center, self.radius or 1.0
        domain, center, radius = self.domain or sphere
        self.ring = load_fit(beside_scene(given["weights"])) if "weights" in given else None
        if self.ring is not None:
            self.up, self.metres = self.ring.up, self.ring.metres
            self.ground = None if self.ring.ground is None else self.ring.ground.numpy(force=True).astype(float)

        material = {"diffuse": torch.tensor([0.5, 0.5, 0.5]), "specular": torch.tensor(0.0),
                    "roughness": torch.tensor(0.5)}  # fmt: skip
        if self.ring is None:
            s, faces = domain.sample(self.subdivisions)
            vertices = torch.as_tensor(center, dtype=torch.float32) + radius * s
            material = {name: m.expand(len(s), *m.shape) for name, m in material.items()}
        else:
            s, faces = self.ring.domain.sample(self.subdivisions)
            with torch.no_grad():
                vertices, material = self.ring(s)
        matrix = torch.tensor(to_world, dtype=torch.float32)
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(to_world[:3, :3]) < 0:
            faces = np.fliplr(faces)  # a mirror turns the surface inside out

        super().__init__(props.id(), len(vertices), len(faces), props, True, False)
        if not self.id():
            self.set_id("object")
        params = mi.traverse(self)
        # Scalar variants have array types of their own.
        params[POSITIONS] = type(params[POSITIONS])(vertices.numpy().ravel())
        params[FACES] = type(params[FACES])(np.asarray(faces, np.uint32).ravel())
        params.update()
        for name, value in material.items():
            self.add_attribute(f"vertex_{name}", value[0].numel(), value.contiguous().numpy().ravel())
        if self.ring is not None:
            write_texture(self, self.ring.brdf_net, s, faces)
        require_attributes(self)

    def to_string(self):
        return f"ShapeNetMesh[id={self.id()}, vertices={self.vertex_count()}, subdivisions={self.subdivisions}]"


mi.register_shape("shapenet", ShapeNetMesh)
