"""The options of `mi-ring synthesize`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from mi_ring.errors import InputError, require_file
from mi_ring.synthesis.degradation import Format
from mi_ring.synthesis.light_sources import LightKind, RoomKind
from mi_ring.synthesis.viewpoints import CameraKind


@dataclass(frozen=True)
class SynthesizeConfig:
    """Path trace a capture of a mesh: photographs, masks, scene file, and the truth beside them.

    The middle of the mesh's bounding box is moved to the origin and its farthest vertex to --radius; its axes stay.
    A material is a file .xml with one <bsdf>, a table .binary of MERL, FILE.npz:MATERIAL of networks fitted to such
    tables, or a plugin of Mitsuba's and its parameters in one text: "principled base_color=0.6,0.2,0.1 roughness=0.3".
    As a value, vertex_color means the colours of the mesh's file.

    Interrupted, the same command goes on.
    """

    mesh: Positional[Annotated[Path, arg(metavar="MESH")]]
    """Mesh to photograph: PLY, OBJ, GLB, STL or what else trimesh reads. It should be closed."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder to write."""

    material: str | None = None
    """What the object is made of. Default: principled with the colours of the mesh's file, or with one colour."""
    second: str | None = None
    """A second material, which shares the surface with the first as --pattern says."""
    pattern: Annotated[str, arg(metavar="stripes|checks|PICTURE")] = "stripes"
    """Where the second material is: stripes across the object, checks, or where a picture, projected onto it from the
    front, is bright."""
    bands: int = 8
    """Number of stripes or checks over the height of the object."""
    smooth: bool = False
    """Subdivide the mesh, by Loop's rule, until it has 10,000 vertices."""
    radius: float = 50.0
    """Size of the object [scene units, which are millimetres if the sheet is printed]."""
    up: Literal["x", "y", "z"] = "y"
    """Axis of the mesh that is up: of a turntable, a table, an environment."""

    views: int = 50
    """Number of photographs."""
    novel: int = 10
    """Number of further ones, truth/images, that a fit does not see: from elsewhere, without noise or error."""
    size: tuple[int, int] = (512, 512)
    """Width and height [px]."""
    fov: float = 60.0
    """Horizontal field of view [degrees]."""
    cameras: CameraKind = "around"
    """around: evenly, all looking at the middle; free: as if by hand, leaning, and nearer or farther; turntable: the
    object turns, camera and --room stand."""
    elevations: tuple[float, ...] = (20.0, 55.0)
    """Of the rings of a turntable [degrees]."""
    distance: float | None = None
    """From the cameras to the middle of the object, in its radii. Default: so that it just fills the photograph."""

    light: LightKind = "flash"
    """flash: a point light at the lens; point: anywhere as far away; distant: parallel light; lamp: a point light
    that is in one place for all photographs."""
    lamps: int = 1
    """How many lamps there are with --light lamp. The scene has those beside the first as emitters of its own."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the flash from the lens: left, up and forward, by the distance from the camera to the object."""
    spread: float = 40.0
    """How far point and distant lights are from the camera at most, seen from the object [degrees]."""
    room: float = 0.0
    """Light of the room: what it brings from all sides together to a surface, by the photographs' light that faces
    it."""
    room_kind: RoomKind = "constant"
    """constant: alike from all sides; harmonics: brighter from some, as spherical harmonics of order 2."""
    pairs: bool = False
    """Take each view without the photograph's own light, too, by the --room alone: what fits subtract, as `ambient`."""
    environment: Path | None = None
    """Environment, an EXR or HDR file of latitude and longitude, to light the object instead of --light."""
    table: Literal["none", "plain", "sheet"] = "none"
    """What the object stands on: nothing, a table, or a table with the printed sheet of mi-ring board (--radius is then
    in millimetres). No camera is below it."""

    format: Format = "exr"
    """exr: linear, half precision; png16: linear, 16 bits; png8: sRGB, 8 bits."""
    exposure: float | None = None
    """Linear value of a white surface that faces the light from where the object is. Default: such that --clipped."""
    clipped: float = 0.02
    """Share of the object's pixels at or above full scale."""
    electrons: float = 0.0
    """Of a pixel at full scale, which makes the shot noise. Default: 0, none."""
    read: float = 0.0
    """Noise of reading, a standard deviation in such electrons; in 1/10,000 of full scale without --electrons."""

    wrong_cameras: float = 0.0
    """How wrong the scene file says that cameras are: turned about each axis by so many degrees and moved along each by
    so many per cent of their distance, standard deviations."""
    wrong_light: float = 0.0
    """How far beside their place all point lights are said to be, in the camera's axes, by their distance [%]."""
    wrong_power: float = 0.0
    """How wrong the power of each light is said to be, standard deviation [%]."""
    wrong_exposure: float = 0.0
    """How differently photographs are exposed, which the scene file does not say: standard deviation of a factor [%],
    and by a third of that of each colour, for the white balance."""
    wrong_room: bool = False
    """Say nothing of --room, of --environment or of more --lamps than one in the scene file."""

    spp: int = 64
    """Paths per pixel; a square number, or the next one is taken."""
    depth: int = 5
    """Longest path, as Mitsuba counts: 2 is direct light alone."""
    seed: int = 0
    """Of cameras, lights, noise and paths."""

    @property
    def exact(self) -> bool:
        """Is all calibration in the scene file exact?"""
        unknown = self.wrong_room and bool(self.room > 0 or self.environment or self.lamps > 1)
        return not (self.wrong_cameras or self.wrong_light or self.wrong_power or self.wrong_exposure or unknown)

    @property
    def up_axis(self) -> np.ndarray:
        """(3,) unit vector that points up."""
        return np.eye(3)["xyz".index(self.up)]

    @property
    def camera_distance(self) -> float:
        """From the cameras to the middle of the object [scene units]."""
        half = np.arctan(min(self.size) / self.size[0] * np.tan(np.radians(self.fov / 2)))
        return float(self.radius * (1.04 / np.sin(half) if self.distance is None else self.distance))


#: Least and greatest value of numeric options.
RANGES = {
    "views": (1, 10_000), "novel": (0, 10_000), "fov": (1, 150), "bands": (1, 1000), "radius": (1e-6, 1e6),
    "lamps": (1, 8), "spread": (0, 80), "room": (0, 10), "clipped": (0, 0.9), "electrons": (0, 1e7), "read": (0, 1e5),
    "spp": (1, 65536), "depth": (2, 100), "wrong_cameras": (0, 20), "wrong_light": (0, 50), "wrong_power": (0, 100),
    "wrong_exposure": (0, 100), "seed": (0, 100_000),
}  # fmt: skip


def require_options(config: SynthesizeConfig) -> None:
    """Raise InputError for options that are out of range or contradict each other."""
    for name, (least, most) in RANGES.items():
        if not least <= getattr(config, name) <= most:
            raise InputError(f"--{name.replace('_', '-')}: is {getattr(config, name)}, must be {least} to {most}")
    if not all(8 <= side <= 8192 for side in config.size):
        raise InputError(f"--size: is {config.size[0]} {config.size[1]}, must be 8 to 8192")
    if not (config.elevations and all(-89 <= angle <= 89 for angle in config.elevations)):
        raise InputError(f"--elevations: is {config.elevations}, must be angles of -89 to 89 degrees")
    if config.table != "none" and config.cameras == "turntable" and min(config.elevations) < 1:
        raise InputError("--elevations: has cameras below the table; give 1 degree or more, or leave out --table")
    if config.cameras == "turntable" and (config.environment or config.light == "lamp"):
        raise InputError("--cameras: is turntable, beside which an --environment or a --light lamp would turn with the "
                         "object; give --room 0.2 --room-kind harmonics, which stands with the camera")  # fmt: skip
    if config.distance is not None and not 1.05 <= config.distance <= 1000:
        raise InputError(f"--distance: is {config.distance}, must be 1.05 to 1000 radii of the object")
    if config.pattern != "stripes" and not config.second:
        raise InputError(f"--pattern: is {config.pattern}, for which a second material is missing; give --second")
    if config.light in ("distant", "lamp") and config.wrong_light:
        raise InputError(f"--wrong-light: is for point lights near cameras, not for {config.light}; leave it out")
    if config.lamps > 1 and (config.light != "lamp" or config.environment or config.pairs):
        raise InputError(f"--lamps: is {config.lamps}, which is for --light lamp without --environment and --pairs")
    if config.exposure is not None and not 0 < config.exposure <= 1e6:
        raise InputError(f"--exposure: is {config.exposure}, must be above 0")
    if config.exposure is not None and config.clipped != SynthesizeConfig.clipped:
        raise InputError("--clipped: is what the exposure is chosen by; leave it out, or --exposure")
    if not np.linalg.norm(config.offset) < 1:
        raise InputError("--offset: reaches the object; it is in distances from camera to object, for instance 0.1 0 0")
    if config.environment:
        require_file(config.environment, "an EXR or HDR file of latitude and longitude", "--environment")
        given = [name for name in ("room", "wrong_light", "wrong_power") if getattr(config, name)]
        if config.light != "flash" or any(config.offset) or given:
            raise InputError("--environment: is instead of the photographs' lights and the room; leave out --light, "
                             "--offset, --room, --wrong-light and --wrong-power")  # fmt: skip
    if config.pairs and (config.room == 0 or config.wrong_room):
        raise InputError("--pairs: need a room; give --room, for instance 0.2, and leave out --wrong-room")
    if not config.environment and config.room == 0 and config.lamps == 1 and config.wrong_room:
        raise InputError("--wrong-room: there is no room; give --room, for instance 0.1, --environment or --lamps")
