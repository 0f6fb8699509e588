"""Lists and renders the views of the command mi-ring render: the photographs of a scene, or the frames of a film."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation
from tyro.conf import Positional, arg

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import photographs_in, reason
from mi_ring.capture.scenefile import photograph_element
from mi_ring.errors import InputError, require_file
from mi_ring.geometry.camera import Camera, moved_pose
from mi_ring.metrics.image_errors import SPP
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import MaterialOptions
from mi_ring.output.atlas import flow_points
from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import LANES, Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.assembly import assembled, is_table, top_level_emitters
from mi_ring.scene.lights import is_flash, is_room
from mi_ring.scene.shot import Files, Shot
from mi_ring.scene.xml_elements import load_element
from mi_ring.system.progress import progress

SLANT = 45.0  #: angle between light and camera in a light orbit, seen from the object [deg]


@dataclass(frozen=True, kw_only=True)
class RenderConfig(MaterialOptions):
    """Render the object of a finished fit: every photograph of a scene, or a film.

    Without --turntable, --light-orbit and --flow the command renders one picture per photograph of SCENE.xml, with the
    file name of the photograph. With one of these options it renders a film: numbered pictures in a folder, or an MP4
    file.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit, or its ring.pt."""
    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the cameras and lights to render. The image files that it names need not exist."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder for the pictures, or a file FILE.mp4 for a film.
    Each picture has the file name of its photograph in the scene: linear for .exr, 8-bit sRGB for .png and .jpg."""
    turntable: int = 0
    """Render a film with this number of pictures, for example 120: camera and light move once around the object.
    0: no such film."""
    light_orbit: int = 0
    """Render a film with this number of pictures, for example 120: the light moves in a circle around the line of
    sight, and the camera stands still. Seen from the object, the angle between light and camera is always 45 degrees.
    0: no such film."""
    flow: int = 0
    """Render a film with this number of pictures, for example 60: the start surface deforms into the object.
    0: no such film."""
    view: str | None = None
    """File name of a photograph: --turntable, --light-orbit and --flow start from its camera and light.
    Without this option: the first photograph."""
    width: int | None = None
    """Width of the pictures of --turntable, --light-orbit and --flow [px].
    Without this option: the width of the photograph that --view names."""
    up: tuple[float, float, float] | None = None
    """Up direction of the scene, for example 0 0 1. It is the axis of --turntable and the direction to the top of
    --envmap.
    Without this option: the mean up direction of the cameras."""
    envmap: Path | None = None
    """EXR or HDR file of an environment map (latitude, longitude). It replaces the lights of the photographs.
    Lamps of the scene file stay on. The command ignores a `table` shape of the scene."""
    integrator: str | None = None
    """Name of the Mitsuba integrator that computes the light. Without this option: photometric, or path with --envmap.
    photometric is fast and predicts photographs as the fit does. It does not work with --envmap.
    path traces all reflections, also in scenes with other objects. It has more noise and ignores a `table` shape."""
    format: Literal["png", "exr"] | None = None
    """Format of the pictures. png: 8-bit sRGB. exr: linear radiance.
    Without this option: the format of the file names in the scene; png for --turntable, --light-orbit and --flow."""
    fps: float = 24.0
    """Pictures per second of an MP4 film, above 0, at most 240. The film is slower with fewer pictures per second."""
    time: float = 1.0
    """Which state of the deformation to render, 0 to 1. 0: the start surface of the fit. 1: the finished object.
    0.5: the surface after half of the deformation. Do not give it together with --flow, which shows all states."""
    subdivisions: int | None = None
    """Level of the mesh, with about 10 · 4^level vertices. Without this option: the level of the fit.
    Higher levels show finer detail and take more memory."""
    spp: int = SPP
    """Samples per pixel. More samples give less noise and take longer."""

    @property
    def count(self) -> int:
        """Number of pictures that --turntable, --light-orbit or --flow asks for; 0 without these options."""
        return self.turntable or self.light_orbit or self.flow

    @property
    def film(self) -> bool:
        """True if the output is an MP4 file, False if it is a folder of pictures."""
        return self.out.suffix.lower() == ".mp4"


@dataclass(frozen=True)
class RenderedView:
    """A picture to render: camera, light, file name and state of the deformation."""

    shot: Shot
    name: str  #: of the picture's file
    time: float  #: of the flow
    sensor: Any = None  #: the scene's own sensor with its film, if there is one


def integrator_of(config: RenderConfig) -> mi.Integrator | None:
    """Make the Mitsuba integrator that the options name. Returns None if they name mi_ring's own renderer, photometric.

    Raises InputError for an unknown name, and for an integrator that does not start its paths at the camera.
    """
    name = config.integrator or ("path" if config.envmap else "photometric")
    if name == "photometric":
        return None
    try:
        integrator = mi.load_dict({"type": name})
    except RuntimeError as error:
        raise InputError(f"--integrator: {name}: {reason(error)}") from error
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise InputError(f"--integrator: {name}: is not an integrator that starts at the camera; try path or direct")
    return integrator


def views_of(capture: Capture, ring: FittedObject, config: RenderConfig) -> list[RenderedView]:
    """List the views to render: the photographs of the scene, or the frames of a film. Renders nothing.

    `ring`: the object; the camera of a film is turned and zoomed to it. Raises InputError if --view names no
    photograph, or if --light-orbit is given and the photographs have no light of their own.
    """
    count = config.count
    if not count:
        names = [str(Path(name).with_suffix(f".{config.format}")) if config.format else name for name in capture.names]
        # A picture shows all light of the scene, also if a fit subtracts a part of it from the photograph.
        shots = [replace(shot, files=shot.files._replace(ambient=None)) for shot in capture.shots]
        several = zip(shots, names, photographs_in(capture.scene), strict=True)
        return [RenderedView(shot, name, config.time, sensor) for shot, name, sensor in several]
    if config.view is not None and config.view not in capture.names:
        first = capture.names[0]
        raise InputError(f"{config.scene}: --view: {config.view} is no photograph of it; the first is {first}")
    shot = capture.shots[capture.names.index(config.view) if config.view else 0]
    up = up_of(capture, config)
    width, height = shot.size
    size = (config.width, round(height * config.width / width)) if config.width else shot.size
    camera, middle = framed(shot.camera._replace(size=size), ring, up)
    light = shot.own_light
    if config.light_orbit and not light.rgb.any():
        raise InputError(f"{config.scene}: --light-orbit: the photographs have no light of their own to move; "
                         "give --turntable")  # fmt: skip
    views, digits, nowhere = [], max(3, len(str(count - 1))), Files(Path("none"))
    for k in range(count):
        seen_from, lit_from, time = camera, light, config.time
        if config.turntable:
            turn = Rotation.from_rotvec(2 * np.pi * k / count * up).as_matrix()
            to_world = moved_pose(camera.to_world, 1.0, turn, middle - turn @ middle)
            around = middle if light.kind == "point" else 0.0
            lit_from = light._replace(vector=around + turn @ (light.vector - around))
            seen_from = camera._replace(to_world=to_world)
        elif config.light_orbit:
            slant = np.radians(SLANT)
            aside = np.sin(slant) * camera.up - np.cos(slant) * camera.forward  # direction to the light
            aside = Rotation.from_rotvec(2 * np.pi * k / count * camera.forward).apply(aside)
            reach = np.linalg.norm(light.vector - middle)
            lit_from = light._replace(vector=middle + reach * aside if light.kind == "point" else -aside)
        else:
            time = k / max(count - 1, 1)
        name = f"{k:0{digits}}.{config.format or 'png'}"
        # The cone is fixed to the camera, so a light that moves by itself has none.
        falloff, tilt = (0.0, (0.0, 0.0)) if config.light_orbit else (shot.falloff, shot.tilt)
        views.append(RenderedView(Shot("view", seen_from, lit_from, falloff, tilt, files=nowhere), name, time))
    return views


def up_of(capture: Capture, config: RenderConfig) -> np.ndarray:
    """Return the up direction, a unit vector (3,): from --up if this option is given, otherwise from the capture."""
    return capture.up if config.up is None else np.array(config.up) / np.linalg.norm(config.up)


def framed(camera: Camera, ring: FittedObject, up: np.ndarray) -> tuple[Camera, np.ndarray]:
    """Rotate and zoom a camera so that object and start surface fill the picture. The camera keeps its position.

    `up` (3,): unit vector that points up in the picture. Returns (new camera, centre (3,) of the object's bounding box
    [scene units]).
    """
    s = ring.domain.sample(3)[0].numpy()
    points = np.concatenate([flow_points(ring, s, time) for time in (0.0, 1.0)]).astype(float)
    points = ring.center.cpu().numpy() + float(ring.radius) * points
    middle = (points[len(s) :].min(0) + points[len(s) :].max(0)) / 2
    to_world = camera.to_world.astype(float)
    distance = np.linalg.norm(camera.position - middle)
    forward = (middle - camera.position) / distance
    if np.linalg.norm(np.cross(up, forward)) < 1e-2:  # it looks along `up`: use the up direction of the photograph
        up = camera.up
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    to_world[:3, :3] = np.stack([left, np.cross(forward, left), forward], 1)
    sine = min(np.linalg.norm(points - middle, axis=1).max() / distance, 0.98)
    focal = 0.47 * min(camera.size) * np.sqrt(1 - sine**2) / sine
    return Camera(to_world, np.full(2, focal), np.array(camera.size) / 2, camera.size), middle


def lit_surface(capture: Capture, ring: FittedObject, config: RenderConfig) -> Surface:
    """Make the surface to render: the object with the lights and the other shapes of the scene.

    With --envmap, the environment map replaces the lights of the photographs, and `table` shapes are left out. Raises
    InputError if the environment map cannot be read.
    """
    if not config.envmap:
        return Surface(capture.scene, capture.shape, ring, in_scene_units=integrator_of(config) is not None)
    to_world = np.eye(4)
    to_world[:3, :3] = Rotation.align_vectors([up_of(capture, config)], [[0.0, 1.0, 0.0]])[0].as_matrix()  # y is up
    require_file(config.envmap, "an EXR or HDR file of latitude and longitude", "--envmap")
    try:
        turn = mi.ScalarTransform4f(to_world.tolist())
        light = mi.load_dict({"type": "envmap", "filename": str(config.envmap), "to_world": turn})
    except RuntimeError as error:
        raise InputError(f"{config.envmap}: --envmap: cannot be read ({reason(error).rsplit('] ', 1)[-1]})") from error
    lamps = [e for e in top_level_emitters(capture.scene) if not (e.is_environment() or is_flash(e) or is_room(e))]
    others = [s for s in capture.scene.shapes() if s != capture.shape and not is_table(s)]
    object_ = mi.load_dict({"type": "shapenet", "subdivisions": 0, "flash": False, "bsdf": {"type": "cooktorrance"}})
    return Surface(assembled([object_, *others], [light, *lamps]), object_, ring, in_scene_units=True)


def render_views(
    surface: Surface, ring: FittedObject, views: list[RenderedView], integrator: mi.Integrator | None,
    capture: Capture, config: RenderConfig,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Render the views one by one. Yields pictures (H, W, 3) of linear radiance.

    `surface`: has the scene to render; `ring` is written to its mesh. `integrator`: Mitsuba integrator; None: mi_ring's
    own renderer, photometric. `capture`: for photometric, it gives the room light and says whether there are shadows.
    """
    s, faces = ring.domain.sample(ring.subdivisions if config.subdivisions is None else config.subdivisions)
    shown = None
    for k, view in enumerate(progress(views, "rendering", unit="picture", leave=True)):
        if view.time != shown:
            surface.show(ring, s, faces, view.time)
            shown = view.time
        if integrator:
            sensor = view.sensor or load_element(photograph_element(view.shot))
            yield render_passes(surface.scene, sensor, integrator, config.spp, seed=k)
        else:
            one = Photographs.of([view.shot], capture.room, capture.lobes)
            rgb, _ = prediction.draw(surface, one, spp=config.spp, shadows=capture.shadows, indirect=ring.indirect)
            yield rgb[0].numpy()


def render_passes(scene: mi.Scene, sensor: Any, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
    """Render a picture with a Mitsuba integrator. Returns linear radiance (H, W, 3).

    It is the mean of several passes, so that memory does not grow with `spp`, the samples per pixel. A pass has at most
    `LANES` rays, but at least one per pixel. `sensor`: Mitsuba's sensor with its film.
    """
    width, height = sensor.camera.size
    at_once = min(spp, max(1, LANES // (width * height)))
    total = np.zeros(3, np.float32)
    for number, first in enumerate(range(0, spp, at_once)):
        samples = min(at_once, spp - first)
        pass_seed: Any = seed + (number << 16)  # unlike the seeds of other pictures; Mitsuba's annotation lacks int
        picture = mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=pass_seed)
        total = total + samples / spp * np.array(picture)[..., :3]
    return total
