"""The `table` shape: a surface below the object that reflects light onto it (Mitsuba plugin)."""

import mitsuba as mi
import numpy as np

from mi_ring.scene.plain_mesh import FACES, POSITIONS

CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


class Table(mi.Mesh):
    """A rectangle on which the object stands. It reflects light onto the object and blocks the room's light from below.

    ============ ========= ========================================================================= =====
    Parameter    Type      Description                                                               Flags
    ============ ========= ========================================================================= =====
    ``to_world`` transform of the square from −1 to 1 in x and y that faces z. Default: the identity
    (nested)     bsdf      usually diffuse with a bitmap; the first row of a bitmap is at y = −1     P, ∂
    ============ ========= ========================================================================= =====

    Mitsuba's own integrators render it like any other rectangle. In the photographs that a fit predicts, the table only
    takes part in interreflection; cameras do not see it. ``mi-ring photos`` writes a table if it finds the printed
    sheet.

    What it does not do: in the predictions of a fit, the table hides nothing from a camera or a lamp.

    .. tab-set-code::

        .. code-block:: xml

            <shape type="table">
                <transform name="to_world"><scale value="200"/></transform>
                <bsdf type="diffuse"><rgb name="reflectance" value="0.4 0.3 0.2"/></bsdf>
            </shape>

        .. code-block:: python

            {
                "type": "table", "to_world": mi.ScalarTransform4f().scale(200),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.3, 0.2]}},
            }
    """

    of_tables = True  #: for `mi_ring.scene.assembly.is_table`

    def __init__(self, props):
        to_world = props.get("to_world", mi.ScalarTransform4f())
        if not isinstance(to_world, mi.ScalarTransform4f | mi.ScalarTransform4d):
            raise ValueError(f'table "{props.id()}": to_world is {to_world}, must be a <transform>')
        matrix = np.array(to_world.matrix)
        if np.linalg.det(matrix[:3, :3]) <= 0:
            raise ValueError(f'table "{props.id()}": to_world is flat or a mirror; its z must be up from the table')
        super().__init__(props.id(), 4, 2, props, False, True)
        if self.is_emitter():
            raise ValueError(f'table "{props.id()}": has an emitter; give light to a rectangle instead')
        square = np.column_stack([2 * CORNERS - 1, np.zeros(4)])
        values = {
            POSITIONS: square @ matrix[:3, :3].T + matrix[:3, 3], "vertex_texcoords": CORNERS, FACES: TRIANGLES,
        }  # fmt: skip
        params = mi.traverse(self)
        for name, value in values.items():  # scalar variants have array types of their own
            params[name] = type(params[name])(value.astype(np.uint32 if name == FACES else np.float32).ravel())
        params.update()

    def to_string(self):
        return f"Table[id={self.id()}]"


mi.register_shape("table", Table)
