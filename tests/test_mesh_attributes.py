"""Which mesh attributes and textures a BSDF has, by what Mitsuba exposes of it."""

import mitsuba as mi
import pytest

import mi_ring  # noqa: F401  (registers the plugins)
from mi_ring.errors import SceneError
from mi_ring.scene import mesh_attributes


def attribute(name):
    return {"type": "mesh_attribute", "name": name}


def test_attributes_of_nested_bsdfs_are_found():
    bsdf = mi.load_dict({
        "type": "twosided",
        "inner": {"type": "bumpmap", "arbitrary": attribute("vertex_bump"),
                  "bsdf": {"type": "principled", "base_color": attribute("vertex_colour"), "roughness": 0.3}},
    })  # fmt: skip
    assert mesh_attributes.attributes_of(bsdf) == {"vertex_bump", "vertex_colour"}
    names = {name for name, _ in mesh_attributes.textures_of(bsdf)}
    assert {"base_color", "roughness", "nested_texture"} <= names


def test_attributes_of_our_own_bsdf():
    bsdf = mi.load_dict({"type": "cooktorrance", "specular": 0.1, "diffuse": attribute("vertex_rho")})
    assert mesh_attributes.attributes_of(bsdf) == {"vertex_rho", "vertex_roughness", "vertex_diffuse_roughness"}
    assert mesh_attributes.optional_of(bsdf) == {"vertex_diffuse_roughness"}


@pytest.mark.parametrize("kind", ["twosided", "blendbsdf"])
def test_what_a_nested_bsdf_may_lack_is_not_required(kind):
    inner = {"type": "cooktorrance", "diffuse": {"type": "rgb", "value": 0.2}, "specular": 0.1, "roughness": 0.3}
    nested = {"type": kind, "first": inner} | (
        {"second": {"type": "diffuse"}, "weight": 0.5} if "blend" in kind else {}
    )
    shape = mi.load_dict({"type": "rectangle", "bsdf": nested})
    mesh_attributes.require_attributes(shape)


def test_names_that_look_like_more_than_a_name():
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": attribute("vertex_a = [name = 3]")})
    assert mesh_attributes.attributes_of(bsdf) == {"vertex_a = [name = 3]"}


def test_what_a_bsdf_does_not_expose_is_refused():
    class Secretive(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.texture = mi.load_dict(attribute("vertex_secret"))

        def to_string(self):
            return f"Secretive[{self.texture}]"

    mi.register_bsdf("secretive", Secretive)
    with pytest.raises(SceneError, match="reads mesh attributes, but does not expose which"):
        mesh_attributes.attributes_of(mi.load_dict({"type": "secretive"}))
