"""The table of all formats, by the names that `mi_ring.convert` knows them by."""


from mi_ring.importers.colmap import Colmap
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.importers.iron import Iron
from mi_ring.importers.neus import Neus
from mi_ring.importers.transforms import Transforms

FORMATS = {
    "diligent-mv": DiligentMV, "transforms": Transforms, "colmap": Colmap, "neus": Neus, "iron": Iron,
}  # fmt: skip
