"""Render a fitted object, photographs or films of it: `python -m mi_ring.render RUN SCENE.xml OUT`."""

import contextlib
import os
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import imageio_ffmpeg
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import Positional, arg

from mi_ring import bridge, capture, command
from mi_ring.atlas import flowed
from mi_ring.capture import Capture, camera_of, linear_to_srgb, to_bytes
from mi_ring.errors import InputError, require_file
from mi_ring.integrator import Photographs, light_of
from mi_ring.material import MaterialOptions, dress
from mi_ring.photograph import Flash, Photograph
from mi_ring.results import write_image, writing
from mi_ring.ring import Ring

SLANT = 45.0  #: between the light and the camera in a light orbit, seen from the object [deg]


@dataclass(frozen=True, kw_only=True)
class RenderConfig(MaterialOptions):
    """Render every photograph of a scene with the object of a finished fit, under the same file names.

    Or a film of it: the camera goes round, the light does, or the start surface flows into the object. OUT is then a
    folder of numbered pictures, or an MP4 file.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit, or its ring.pt."""
    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs to take; their image files need not exist."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder for the pictures: linear where the scene names an EXR file, 8-bit sRGB for PNG and JPEG. Or FILE.mp4."""
    turntable: int = 0
    """So many pictures from a camera that goes once around the object, and its light with it."""
    light_orbit: int = 0
    """So many pictures with a light that goes once around the line from the object to the camera, at 45°."""
    flow: int = 0
    """So many pictures of the flow, from where the fit started to the object."""
    view: str | None = None
    """File name of the photograph from whose place, and under whose light, these three are seen. Default: the first."""
    width: int | None = None
    """Pixels across the pictures of these three. Default: as many as that photograph has."""
    up: tuple[float, float, float] | None = None
    """Axis of the turntable, and up in the environment. Default: the mean up of the cameras."""
    envmap: Path | None = None
    """Environment, an EXR or HDR file of latitude and longitude, to light the object instead."""
    integrator: str | None = None
    """Mitsuba's name of the integrator. Default: photometric; with --envmap path, which sees all interreflection."""
    format: Literal["png", "exr"] | None = None
    """Of the pictures. Default: as the scene's file names say; png for the three films."""
    fps: float = 24.0
    """Pictures per second of an MP4 file."""
    time: float = 1.0
    """Of the flow: 0 is where it starts, 1 the object."""
    subdivisions: int | None = None
    """Level of the mesh: about 10 · 4^level vertices. Default: that of the fit."""
    spp: int = 64
    """Samples per pixel."""

    @property
    def count(self) -> int:
        """Pictures of the turntable, the light orbit or the flow; 0 without them."""
        return self.turntable or self.light_orbit or self.flow

    @property
    def film(self) -> bool:
        """Is one file to be written, not a folder of pictures?"""
        return self.out.suffix.lower() == ".mp4"


@dataclass(frozen=True)
class Frame:
    """A picture to render."""

    sensor: Photograph
    name: str
    time: float  # of the flow


def main(arguments: Sequence[str]) -> None:
    """The command."""
    config = command.parse(RenderConfig, arguments, "mi_ring.render")
    check(config)
    ring = Ring.load(config.run)
    dress(ring, config)
    scene = capture.load(config.scene, images=False)
    frames = frames_of(scene, ring, config)
    check_frames(frames, scene, config)
    integrator, surface = integrator_of(config), surface_of(scene, ring, config)
    with writing(config.out):
        for folder in {(config.out if config.film else config.out / frame.name).parent for frame in frames}:
            folder.mkdir(parents=True, exist_ok=True)
    pictures = render(surface, ring, frames, integrator, scene.shadows, config)
    if config.film:
        write_film(pictures, config.out, frames[0].sensor.size, config.fps)
        print(config.out)
    else:
        for picture, frame in zip(pictures, frames):  # in this order the progress bar gets to its end
            write_picture(picture, config.out / frame.name)
        print(f"{len(frames)} pictures in {config.out}/")


def check(config: RenderConfig) -> None:
    """Raise InputError for options out of range or that contradict each other."""
    if config.subdivisions is not None and not 0 <= config.subdivisions <= 8:
        raise InputError(f"--subdivisions: is {config.subdivisions}, must be 0 to 8")
    for name in ("turntable", "light_orbit", "flow"):
        if not 0 <= getattr(config, name) <= 10000:
            raise InputError(f"--{name.replace('_', '-')}: is {getattr(config, name)}, must be 0 to 10000 pictures")
    if (config.turntable > 0) + (config.light_orbit > 0) + (config.flow > 0) > 1:
        raise InputError("--turntable, --light-orbit, --flow: give one of the three at a time")
    if config.view is not None and not config.count:
        raise InputError("--view: is for --turntable, --light-orbit and --flow; without them every photograph is taken")
    if config.flow and config.time != 1:
        raise InputError("--time: is one moment of the flow, --flow shows all of them; give one of the two")
    if config.width is not None and not 8 <= config.width <= 8192:
        raise InputError(f"--width: is {config.width}, must be 8 to 8192")
    if config.width and not config.count:
        raise InputError("--width: is for --turntable, --light-orbit and --flow; photographs have their own size")
    if config.spp < 1:
        raise InputError(f"--spp: is {config.spp}, must be at least 1")
    if not 0 <= config.time <= 1:
        raise InputError(f"--time: is {config.time}, must be 0 to 1")
    if not 0 < config.fps <= 240:
        raise InputError(f"--fps: is {config.fps}, must be above 0, 240 at most")
    if config.up is not None and not 0 < np.linalg.norm(config.up) < np.inf:
        raise InputError(f"--up: is {config.up}, must be a direction")
    if config.envmap and config.integrator == "photometric":
        raise InputError("--integrator: photometric is for photographs' own lights; with --envmap give path or direct")
    if config.envmap and config.light_orbit:
        raise InputError("--light-orbit: moves a photograph's light, which --envmap switches off; give one of the two")
    if config.out.suffix.lower() in (".gif", ".mov", ".avi", ".mkv", ".webm", ".png", ".jpg", ".jpeg", ".exr"):
        raise InputError(f"{config.out}: must be a folder for the pictures, or a film that ends in .mp4")
    if config.film and config.format:
        raise InputError(f"--format: is {config.format}, but {config.out.name} is a film; leave it out")


def check_frames(frames: list[Frame], scene: Capture, config: RenderConfig) -> None:
    """Raise InputError for pictures that could not be written, or would overwrite each other or the photographs."""
    if config.film:
        sizes = sorted({frame.sensor.size for frame in frames})
        if len(sizes) > 1:
            raise InputError(f"{config.scene}: film: photographs have several sizes, {sizes[0]} and {sizes[1]} [px]; "
                             "a film has one: name a folder")  # fmt: skip
        if config.out.is_dir():
            raise InputError(f"{config.out}: is a folder; a film needs the name of a file")
        return
    names, own = set(), {file.resolve() for sensor in scene.sensors for file in (sensor.filename, sensor.mask) if file}
    for frame in frames:
        if Path(frame.name).suffix.lower() not in (".png", ".exr", ".jpg", ".jpeg"):
            raise InputError(f"{config.scene}: filename: {frame.name} must end in .png, .jpg or .exr; or give --format")
        if frame.name in names:
            raise InputError(f"{config.scene}: filename: {frame.name} occurs twice; one would overwrite the other")
        if (config.out / frame.name).resolve() in own:
            raise InputError(f"{config.out}: holds the scene's own photographs; choose another folder")
        names.add(frame.name)


def integrator_of(config: RenderConfig) -> mi.Integrator | None:
    """The integrator to render with; None for our own photographs. Raises InputError if there is none of that name."""
    name = config.integrator or ("path" if config.envmap else "photometric")
    if name == "photometric":
        return None
    try:
        integrator = mi.load_dict({"type": name})
    except RuntimeError as error:
        raise InputError(f"--integrator: {name}: {capture.reason(error)}") from error
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise InputError(f"--integrator: {name}: is not an integrator that starts at the camera; try path or direct")
    return integrator


def frames_of(scene: Capture, ring: Ring, config: RenderConfig) -> list[Frame]:
    """What to render: the scene's photographs, or those that a film is made of."""
    count = config.count
    if not count:
        names = [str(Path(name).with_suffix(f".{config.format}")) if config.format else name for name in scene.names]
        return [Frame(sensor, name, config.time) for sensor, name in zip(scene.sensors, names)]
    if config.view is not None and config.view not in scene.names:
        raise InputError(f"{config.scene}: --view: {config.view} is no photograph of it; the first is {scene.names[0]}")
    sensor = scene.sensors[scene.names.index(config.view) if config.view else 0]
    up = up_of(scene, config)
    width, height = sensor.size
    size = (config.width, round(height * config.width / width)) if config.width else sensor.size
    to_world, focal, middle = framed(sensor, size, ring, up)
    light = np.ravel(light_of(sensor)).astype(float)
    lamp = light[:3] if light[3] else light[:3] - middle
    toward = to_world[:3, 2]
    frames, digits = [], max(3, len(str(count - 1)))
    for k in range(count):
        camera, shining, time = to_world, lamp, config.time
        if config.turntable:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(2 * np.pi * k / count * up).as_matrix()
            turn[:3, 3] = middle - turn[:3, :3] @ middle
            camera, shining = turn @ to_world, turn[:3, :3] @ lamp
        elif config.light_orbit:
            turn = Rotation.from_rotvec(2 * np.pi * k / count * toward)
            slant = np.radians(SLANT)
            shining = np.linalg.norm(lamp) * turn.apply(np.sin(slant) * to_world[:3, 1] - np.cos(slant) * toward)
        else:
            time = k / max(count - 1, 1)
        name = f"{k:0{digits}}.{config.format or 'png'}"
        where = shining if light[3] else middle + shining
        frames.append(Frame(photograph(size, camera, focal, where, light), name, time))
    return frames


def up_of(scene: Capture, config: RenderConfig) -> np.ndarray:
    """The direction (3,) that is up, unit length."""
    return scene.up if config.up is None else np.array(config.up) / np.linalg.norm(config.up)


def framed(sensor: Photograph, size: tuple[int, int], ring: Ring, up: np.ndarray):
    """A camera in the place of a photograph's, turned so that all of the object and of its start are in the middle.

    `size`: (width, height) of its pictures [px]. Returns to_world (4, 4), the focal length [px] and the middle (3,) of
    the object.
    """
    s = ring.domain.sample(3)[0].numpy()
    points = np.concatenate([flowed(ring, s, time) for time in (0.0, 1.0)]).astype(float)
    points = ring.center.numpy() + float(ring.radius) * points
    middle = (points[len(s) :].min(0) + points[len(s) :].max(0)) / 2
    matrix = camera_of(sensor)[0].astype(float)
    eye = matrix[:3, 3]
    distance = np.linalg.norm(eye - middle)
    forward = (middle - eye) / distance
    if np.linalg.norm(np.cross(up, forward)) < 1e-2:  # from above: up is where it was in the photograph
        up = matrix[:3, 1]
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    matrix[:3, :3] = np.stack([left, np.cross(forward, left), forward], 1)
    sine = min(np.linalg.norm(points - middle, axis=1).max() / distance, 0.98)
    return matrix, 0.47 * min(size) * np.sqrt(1 - sine**2) / sine, middle


def photograph(size: tuple[int, int], to_world: np.ndarray, focal: float, where: np.ndarray, light) -> Photograph:
    """A photograph of (width, height) `size` with a `light` as `light_of` gives it, but elsewhere."""
    strength = {"type": "rgb", "value": light[4:7].tolist()}
    emitter = {"type": "point", "position": where.tolist(), "intensity": strength}
    if light[3]:
        emitter = {"type": "directional", "direction": (-where).tolist(), "irradiance": strength}
    return mi.load_dict({
        "type": "photograph", "filename": "none", "fx": focal, "fy": focal, "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": size[0], "height": size[1]}, "light": emitter,
    })  # fmt: skip


def surface_of(scene: Capture, ring: Ring, config: RenderConfig) -> bridge.Surface:
    """The object in its scene, in the light that the options ask for."""
    if config.envmap:
        return under(config.envmap, up_of(scene, config), scene, ring)
    return bridge.Surface(scene.scene, scene.shape, ring)


def render(
    surface: bridge.Surface, ring: Ring, frames: list[Frame], integrator, shadows: bool, config: RenderConfig
) -> Iterator[np.ndarray]:
    """The pictures, (H, W, 3) linear radiance each."""
    s, faces = ring.domain.sample(ring.subdivisions if config.subdivisions is None else config.subdivisions)
    shown = None
    for k, frame in enumerate(tqdm(frames, desc="rendering", unit="picture")):
        if frame.time != shown:
            surface.show(ring, s, faces, frame.time)
            shown = frame.time
        if integrator:
            picture = mi.render(surface.scene, sensor=frame.sensor, integrator=integrator, spp=config.spp, seed=k)
            yield np.array(picture)[..., :3]
        else:
            one = Photographs.of([frame.sensor])
            rgb, _ = bridge.draw(surface, one, spp=config.spp, shadows=shadows, indirect=ring.indirect)
            yield rgb[0].numpy()


def under(envmap: Path, up: np.ndarray, scene: Capture, ring: Ring) -> bridge.Surface:
    """The object and what else is in the scene, lit by an environment and by fixed lamps."""
    to_world = np.eye(4)
    to_world[:3, :3] = Rotation.align_vectors([up], [[0.0, 1.0, 0.0]])[0].as_matrix()  # Mitsuba's up is y
    shape = mi.load_dict({"type": "shapenet", "subdivisions": 0, "flash": False, "bsdf": {"type": "cooktorrance"}})
    parts = [s for s in scene.scene.shapes() if s != scene.shape]
    for emitter in scene.scene.emitters():  # those of shapes come along with them
        of_shape = isinstance(emitter, Flash) or mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        if not (of_shape or emitter.is_environment()):
            parts.append(emitter)
    require_file(envmap, "an EXR or HDR file of latitude and longitude", "--envmap")
    try:
        light = mi.load_dict({"type": "envmap", "filename": str(envmap), "to_world": mi.ScalarTransform4f(to_world)})
    except RuntimeError as error:
        raise InputError(f"{envmap}: --envmap: cannot be read ({capture.reason(error).rsplit('] ', 1)[-1]})") from error
    everything = {"type": "scene", "object": shape, "light": light} | {f"part{k}": p for k, p in enumerate(parts)}
    return bridge.Surface(mi.load_dict(everything), shape, ring)


def write_picture(linear: np.ndarray, path: Path) -> None:
    """Write (H, W, 3) linear radiance: EXR as it is, anything else 8-bit sRGB."""
    exr = path.suffix.lower() == ".exr"
    write_image(linear.astype(np.float32) if exr else to_bytes(linear_to_srgb(linear)), path)


def write_film(pictures: Iterator[np.ndarray], path: Path, size: tuple[int, int], fps: float) -> None:
    """Write an MP4 file that browsers play, H.264 with an even number of rows and columns, whole or not at all.

    Raises InputError if it cannot be written. `size`: (width, height) [px] of the pictures.
    """
    partial = path.with_name(f".{path.stem}.partial.mp4")
    odd_columns, odd_rows = size[0] % 2, size[1] % 2
    # Not through imageio, which takes a film that was cut short, on a full disk for instance, for a whole one.
    ffmpeg = subprocess.Popen(
        [
            imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-s", f"{size[0] + odd_columns}x{size[1] + odd_rows}", "-r", str(fps), "-i", "-",
            "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-movflags", "+faststart",
            # Which colours are meant: browsers would guess by the size of the pictures.
            "-vf", "scale=out_color_matrix=bt709,setparams=color_primaries=bt709:color_trc=iec61966-2-1",
            f"file:{partial}",
        ],
        stdin=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,  # Ctrl-C is for us alone
    )  # fmt: skip
    try:
        with contextlib.suppress(BrokenPipeError):  # it ended, and says below why
            for picture in pictures:
                image = to_bytes(linear_to_srgb(picture))
                ffmpeg.stdin.write(np.pad(image, ((0, odd_rows), (0, odd_columns), (0, 0)), "edge").tobytes())
        complaint = ffmpeg.communicate()[1].decode(errors="replace").split("\n")[0]
        if ffmpeg.returncode:
            raise InputError(f"{path}: cannot be written ({complaint or 'ffmpeg was killed'}); make room or choose "
                             "another place")  # fmt: skip
        with writing(path):
            os.replace(partial, path)
    finally:
        ffmpeg.kill()
        ffmpeg.wait()
        partial.unlink(missing_ok=True)


if __name__ == "__main__":
    command.run("mi_ring.render", main)
