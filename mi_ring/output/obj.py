"""Writes textured meshes as OBJ, MTL and PNG files."""

import io
from pathlib import Path

import numpy as np

from mi_ring.images import write_image
from mi_ring.output import gltf
from mi_ring.output.atlas import Atlas, Texels
from mi_ring.system.files import write_file


def write_obj(path: Path, atlas: Atlas, texels: Texels, material: gltf.Material) -> list[Path]:
    """Write a textured mesh as OBJ, MTL and PNG files. Returns their paths, the OBJ file first.

    `path`: the OBJ file; the other files lie beside it. `material`: the material at the N points of `texels`. Texture
    coordinates are duplicated along seams, vertices are not.
    """
    baked, files, more = gltf.textures(material, texels), {}, []
    images = {
        "diffuse": baked["baseColorTexture"],
        "specular": baked["specularTexture"][..., 3, None],
        "roughness": baked["metallicRoughnessTexture"][..., 1, None],
        "metallic": baked["metallicRoughnessTexture"][..., 2, None],
    }  # fmt: skip
    if "normalTexture" in baked:
        images["normal"] = baked["normalTexture"]
    for name, image in images.items():
        files[name] = path.with_name(f"{path.stem}_{name}.png")
        write_image(image, files[name])
    library = path.with_suffix(".mtl")
    if "normal" in files:
        more.append(f"norm {files['normal'].name}")
    if material.coat is not None and material.coat_roughness is not None:  # programs read no textures of them
        more += [f"Pc {material.coat.mean():.4g}", f"Pcr {material.coat_roughness.mean():.4g}"]
    write_file(library, "\n".join([
        "newmtl fitted", "illum 2", "Kd 1 1 1", f"map_Kd {files['diffuse'].name}",
        "Ks {0:.4g} {0:.4g} {0:.4g}".format(min(0.04 * material.specular_color, 1)), f"map_Ks {files['specular'].name}",
        "Pr 1", f"map_Pr {files['roughness'].name}", "Pm 1", f"map_Pm {files['metallic'].name}",
        *more, "",
    ]))  # fmt: skip
    _, first, uncut = np.unique(atlas.uncut, return_index=True, return_inverse=True)
    corners = np.stack([uncut, np.arange(len(uncut)), uncut], 1)[atlas.faces] + 1
    text = io.StringIO()
    text.write(f"mtllib {library.name}\no object\nusemtl fitted\n")
    np.savetxt(text, atlas.vertices[first], "v %.9g %.9g %.9g")
    np.savetxt(text, atlas.uv * [1, -1] + [0, 1], "vt %.9g %.9g")  # v points up in OBJ
    np.savetxt(text, atlas.normals[first], "vn %.5f %.5f %.5f")
    np.savetxt(text, corners.reshape(-1, 9), "f %d/%d/%d %d/%d/%d %d/%d/%d")
    write_file(path, text.getvalue())
    return [path, library, *files.values()]
