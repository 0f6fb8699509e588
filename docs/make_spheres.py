"""The picture of `cooktorrance`: GGX above, Beckmann below, roughness 0.1, 0.2, 0.4 and 0.8.

python docs/make_spheres.py docs/reference/plugins/cooktorrance.png
"""

import sys

import mi_ring  # isort: skip  # noqa: F401  (before Mitsuba)
import mitsuba as mi


def main(picture: str) -> None:
    """The command."""
    scene = {
        "type": "scene",
        "light": {"type": "directional", "direction": [1, -1, -1.5], "irradiance": 2.5},
        "sky": {"type": "constant", "radiance": 0.15},
        "camera": {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0]).scale([4.4, 4.4, 1]),
            "film": {"type": "hdrfilm", "width": 880, "height": 440, "rfilter": {"type": "box"}},
        },
    }
    for row, distribution in enumerate(("ggx", "beckmann")):
        for column, roughness in enumerate((0.1, 0.2, 0.4, 0.8)):
            scene[f"{distribution}_{column}"] = {
                "type": "sphere", "center": [2.2 * column - 3.3, 1.1 - 2.2 * row, 0],
                "bsdf": {
                    "type": "cooktorrance", "diffuse": {"type": "rgb", "value": [0.16, 0.05, 0.02]},
                    "specular": 0.03, "roughness": roughness, "distribution": distribution,
                },
            }  # fmt: skip
    direct = mi.load_dict({"type": "direct", "hide_emitters": True})  # the spheres do not light each other
    mi.util.write_bitmap(picture, mi.render(mi.load_dict(scene), integrator=direct, spp=1024)[..., :3])


if __name__ == "__main__":
    main(sys.argv[1])
