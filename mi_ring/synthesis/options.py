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
    """Path trace a capture of a mesh: photographs, masks and scene file, and the ground truth.

    The middle of the mesh's bounding box is moved to the origin, and its farthest vertex is scaled to --radius. The
    mesh is not rotated.

    A material is one of these: brass (polished) or varnish (over wood); an .xml file with one <bsdf>; a .binary file of
    the MERL database; FILE.npz:MATERIAL, a network fitted to such a file; or a Mitsuba plugin with its parameters, as
    in "principled base_color=0.6,0.2,0.1 roughness=0.3". The value vertex_color stands for the colours in the file of
    the mesh.

    After an interruption, give the same command again: it continues.
    """

    mesh: Positional[Annotated[Path, arg(metavar="MESH")]]
    """Mesh to render: PLY, OBJ, GLB, STL or any other format of trimesh. It should be closed."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder to write."""

    material: str | None = None
    """Material of the object, for example "principled base_color=0.6,0.2,0.1 roughness=0.3". The description of the
    command lists all forms. Without this option: principled, with the colours of the mesh file, or with one colour if
    the file has no colours."""
    second: str | None = None
    """Second material, in one of the forms of --material. --pattern says where on the object it is.
    Without this option the object has a single material."""
    pattern: Annotated[str, arg(metavar="stripes|checks|PICTURE")] = "stripes"
    """Where on the object the second material is. Only with --second.
    stripes: in stripes across the object. checks: in a checkerboard.
    PICTURE: where an image file is bright. The image is projected onto the object from the front."""
    bands: int = 8
    """Number of stripes or checks from the bottom of the object to its top, 1 to 1000. Only with --second."""
    smooth: bool = False
    """Subdivide the mesh by Loop's rule until it has at least 10,000 vertices.
    Use this option for coarse meshes of round objects."""
    radius: float = 50.0
    """Distance of the object's farthest vertex from its middle, after scaling [scene units].
    With the printed sheet the unit is the millimetre."""
    up: Literal["x", "y", "z"] = "y"
    """Axis of the mesh that points up. It is the axis of the turntable, the normal of the table and the direction to
    the top of the environment map."""

    views: int = 50
    """Number of photographs for the fit. More photographs show more of the object and take longer to render."""
    novel: int = 10
    """Number of further photographs, in truth/images, to test a fit with. 0: none.
    These photographs have other viewpoints, no noise and exact calibration."""
    size: tuple[int, int] = (512, 512)
    """Width and height of the photographs [px]."""
    fov: float = 60.0
    """Horizontal field of view of the cameras [deg], 1 to 150."""
    cameras: CameraKind = "around"
    """Where the cameras are.
    around: evenly around the object, aimed at its middle.
    free: as if hand-held: at random places and varying distances, and tilted.
    turntable: the object turns, while the camera and the light of --room stand still."""
    elevations: tuple[float, ...] = (20.0, 55.0)
    """Angles of the cameras above the plane of the turntable [deg]: one number for each ring of cameras, -89 to 89.
    20 55: two rings. Only for --cameras turntable."""
    distance: float | None = None
    """Distance of the cameras from the middle of the object [--radius], 1.05 to 1000. 3: three times --radius.
    Without this option: the object just fills the photograph."""

    light: LightKind = "flash"
    """The light in each photograph.
    flash: a point light at the lens, or beside the lens by --offset.
    point: a point light elsewhere, in another place for each photograph, as far from the object as the camera.
    distant: parallel light, from another direction for each photograph.
    lamp: a point light that is in the same place for all photographs.
    none: there is only the light of --room."""
    lamps: int = 1
    """Number of lamps that shine in all photographs, 1 to 8. Only with --light lamp.
    Give 2 or more to test the command fit with --light lamps or --refine lamps.
    In the scene file, the first lamp is the light in each <sensor>. The others are emitters outside <sensor>."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the flash relative to the lens: left, up and forward [distance from the camera to the object].
    0.1 0.2 0: to the left by a tenth of this distance and up by a fifth of it. Only for --light flash."""
    spread: float = 40.0
    """Largest angle between camera and light, seen from the object [deg], 0 to 80.
    Only for --light point and distant."""
    room: float = 0.0
    """Strength of additional light from all sides, as in a room that is not dark, 0 to 10. 0: none.
    1: a surface that faces the light of --light gets equally much light from the room. Give 0.05 to 0.2 to test fits of
    photographs from a room that is not dark."""
    room_kind: RoomKind = "constant"
    """How the light of --room depends on the direction.
    constant: the same from all sides. harmonics: stronger from some sides, by spherical harmonics of order 2.
    windows: like harmonics, but most of it comes from three small lights."""
    pairs: bool = False
    """Render each view a second time, under the light of --room alone. The scene file names these second photographs as
    `ambient`. A fit subtracts them from the others."""
    environment: Path | None = None
    """EXR or HDR file of an environment map (latitude, longitude). It replaces the lights of --light and --room."""
    table: Literal["none", "plain", "sheet"] = "none"
    """Put a table below the object. The table hides the underside of the object and reflects light onto the object.
    none: no table. plain: a table of one colour.
    sheet: a table with the printed sheet of mi-ring board, by whose markers mi-ring photos finds scale and cameras.
    The sheet has a size in millimetres. So --radius, the size of the object, is then in millimetres, too."""

    format: Format = "exr"
    """Format of the photographs.
    exr: linear, half precision. png16: linear, 16 bits. png8: sRGB, 8 bits, like those of most cameras."""
    exposure: float | None = None
    """Brightness of the photographs: the linear pixel value of a white surface that faces the light at the object.
    1: such a surface just reaches full scale. Without this option, --clipped determines the brightness."""
    clipped: float = 0.02
    """Choose the exposure so that this share of the object's pixels is overexposed, 0 to 0.9. 0.02: 2 % of the pixels.
    Do not give it together with --exposure."""
    electrons: float = 0.0
    """Electrons that a pixel counts at full scale, for example 10000. Fewer electrons give more shot noise.
    0: no shot noise."""
    read: float = 0.0
    """Standard deviation of the read noise, the same for all pixels [electrons], for example 10. 0: no read noise.
    Without --electrons the unit is 1/10,000 of full scale."""

    wrong_cameras: float = 0.0
    """Random errors of the cameras in the scene file, to test --refine cameras. 0: exact cameras.
    1: each camera turns by 1 degree about each axis and moves by 1 % of its distance along each axis. These numbers
    are standard deviations."""
    wrong_light: float = 0.0
    """Error of the positions of point lights in the scene file [% of the camera's distance], for example 2. 0: exact.
    The error has the same direction relative to each camera. Use this option to test --refine light."""
    wrong_power: float = 0.0
    """Random errors of the intensities of the lights in the scene file: their standard deviation [%], for example 10.
    0: exact intensities. Use this option to test --refine power."""
    wrong_exposure: float = 0.0
    """Random differences of exposure between photographs: their standard deviation [%], for example 10. 0: none.
    The white balance varies by a third of this number. The scene file does not say how exposure and white balance vary.
    Use this option to test --refine gain."""
    wrong_room: bool = False
    """Leave these lights out of the scene file, to test fits in unknown light: the room, the environment, and all lamps
    but the first."""

    spp: int = 64
    """Light paths per pixel, rounded up to a square number. More paths give less noise and take longer."""
    depth: int = 5
    """Largest length of light paths, 2 to 100 (`max_depth` of Mitsuba's path tracer). 2: no interreflection.
    Longer paths make concave parts brighter, as in reality, and take longer."""
    seed: int = 0
    """Random seed of cameras, lights, noise and paths. Another seed gives another capture of the same kind."""

    @property
    def exact(self) -> bool:
        """True if the calibration in the scene file is exact, False if an option --wrong-… changes it."""
        unknown = self.wrong_room and bool(self.room > 0 or self.environment or self.lamps > 1)
        return not (self.wrong_cameras or self.wrong_light or self.wrong_power or self.wrong_exposure or unknown)

    @property
    def up_axis(self) -> np.ndarray:
        """Unit vector (3,) that points up: the x, y or z axis."""
        return np.eye(3)["xyz".index(self.up)]

    @property
    def camera_distance(self) -> float:
        """Distance from the cameras to the middle of the object [scene units]."""
        half = np.arctan(min(self.size) / self.size[0] * np.tan(np.radians(self.fov / 2)))
        return float(self.radius * (1.04 / np.sin(half) if self.distance is None else self.distance))


#: Least and greatest value of each numeric option.
RANGES = {
    "views": (1, 10_000), "novel": (0, 10_000), "fov": (1, 150), "bands": (1, 1000), "radius": (1e-6, 1e6),
    "lamps": (1, 8), "spread": (0, 80), "room": (0, 10), "clipped": (0, 0.9), "electrons": (0, 1e7), "read": (0, 1e5),
    "spp": (1, 65536), "depth": (2, 100), "wrong_cameras": (0, 20), "wrong_light": (0, 50), "wrong_power": (0, 100),
    "wrong_exposure": (0, 100), "seed": (0, 100_000),
}  # fmt: skip


def require_options(config: SynthesizeConfig) -> None:
    """Raise InputError if an option is out of range, or if two options contradict each other."""
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
        raise InputError("--cameras: is turntable; an --environment or a --light lamp would turn with the object; give "
                         "--room 0.2 --room-kind windows, which stands still like the camera")  # fmt: skip
    if config.light == "none" and (not config.room or config.environment or config.pairs):
        raise InputError("--light: is none; give --room 1, and neither --environment nor --pairs")
    if config.light == "none" and (config.wrong_light or config.wrong_power or any(config.offset)):
        raise InputError("--light: is none; leave out --offset, --wrong-light and --wrong-power")
    if config.room_kind == "windows" and not config.room:
        raise InputError("--room-kind: there is no room; give --room, for instance 0.2")
    if config.room_kind == "windows" and config.table != "none":
        raise InputError("--room-kind: is windows, which may be below the table; leave out --table")
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
        raise InputError("--clipped: determines the exposure, as --exposure does; leave out one of them")
    if not np.linalg.norm(config.offset) < 1:
        raise InputError("--offset: reaches the object; its unit is the camera's distance; give for instance 0.1 0 0")
    if config.environment:
        require_file(config.environment, "an EXR or HDR file of latitude and longitude", "--environment")
        given = [name for name in ("room", "wrong_light", "wrong_power") if getattr(config, name)]
        if config.light != "flash" or any(config.offset) or given:
            raise InputError("--environment: replaces the photographs' lights and the room; leave out --light, "
                             "--offset, --room, --wrong-light and --wrong-power")  # fmt: skip
    if config.pairs and (config.room == 0 or config.wrong_room):
        raise InputError("--pairs: need a room; give --room, for instance 0.2, and leave out --wrong-room")
    if not config.environment and config.room == 0 and config.lamps == 1 and config.wrong_room:
        raise InputError("--wrong-room: there is no room; give --room, for instance 0.1, --environment or --lamps")
