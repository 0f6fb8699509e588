"""Render a fitted object, photographs or films of it: `python -m mi_ring.render RUN SCENE.xml OUT`."""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import recorded
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError, require_range
from mi_ring.objects.material_edits import edit_material
from mi_ring.objects.ring_file import load_fit
from mi_ring.output.ambiguity import ambiguity_of
from mi_ring.output.camera_paths import RenderConfig, RenderedView, integrator_of, lit_surface, render_views, views_of
from mi_ring.output.film import write_film, write_picture
from mi_ring.system import command
from mi_ring.system.files import writing


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(RenderConfig, arguments, "mi_ring.render")
    require_options(config)
    ring = load_fit(config.run)
    edit_material(ring, config)
    capture = load_capture(config.scene, images=False)
    views = views_of(capture, ring, config)
    require_writable(views, capture, config)
    integrator, surface = integrator_of(config), lit_surface(capture, ring, config)
    with writing(config.out):
        for folder in {(config.out if config.film else config.out / view.name).parent for view in views}:
            folder.mkdir(parents=True, exist_ok=True)
    pictures = render_views(surface, ring, views, integrator, capture, config)
    if config.film:
        frames = (recorded(picture, view.shot) for picture, view in zip(pictures, views))
        write_film(frames, config.out, views[0].shot.size, config.fps)
        print(config.out)
    else:
        for picture, view in zip(pictures, views):  # `pictures` first, so that its progress bar ends
            write_picture(recorded(picture, view.shot), config.out / view.name)
        print(f"{len(views)} picture{'s' * (len(views) != 1)} in {config.out}/")
    run = config.run if config.run.is_dir() else config.run.parent
    same_light = config.scene.resolve().parent == run.resolve() and not (config.material or config.envmap)
    if (unknown := ambiguity_of(config.material or config.run)) and not same_light:
        print(f"{unknown} In a known light pictures may be too bright, or of another colour", file=sys.stderr)


def require_options(config: RenderConfig) -> None:
    """Raise InputError for options that are out of range or contradict each other."""
    require_range(config, "subdivisions", 0, 8)
    for name in ("turntable", "light_orbit", "flow"):
        require_range(config, name, 0, 10000)
    require_range(config, "width", 8, 8192)
    require_range(config, "spp", 1)
    require_range(config, "time", 0, 1)
    if (config.turntable > 0) + (config.light_orbit > 0) + (config.flow > 0) > 1:
        raise InputError("--turntable, --light-orbit, --flow: give only one of the three")
    if config.view is not None and not config.count:
        raise InputError("--view: is for --turntable, --light-orbit and --flow; otherwise all photographs are rendered")
    if config.flow and config.time != 1:
        raise InputError("--time: selects one time of the flow, --flow shows all; give one of the two")
    if config.width and not config.count:
        raise InputError("--width: is for --turntable, --light-orbit and --flow; photographs have their own size")
    if not 0 < config.fps <= 240:
        raise InputError(f"--fps: is {config.fps}, must be above 0, 240 at most")
    if config.up is not None and not 0 < np.linalg.norm(config.up) < np.inf:
        raise InputError(f"--up: is {config.up}, must be a direction")
    if config.envmap and config.integrator == "photometric":
        raise InputError("--integrator: photometric does not support --envmap; give path or direct")
    if config.envmap and config.light_orbit:
        raise InputError("--light-orbit: moves the photograph's light, but --envmap removes it; give one of the two")
    if config.out.suffix.lower() in (".gif", ".mov", ".avi", ".mkv", ".webm", ".png", ".jpg", ".jpeg", ".exr"):
        raise InputError(f"{config.out}: must be a folder for the pictures, or a film that ends in .mp4")
    if config.film and config.format:
        raise InputError(f"--format: is {config.format}, but {config.out.name} is a film; leave it out")


def require_writable(views: list[RenderedView], capture: Capture, config: RenderConfig) -> None:
    """Raise InputError if the pictures cannot be written, or if they would overwrite each other or photographs.

    `views`: the pictures to render, with their file names. `capture`: the scene with its photographs. No file is
    written.
    """
    if config.film:
        sizes = sorted({view.shot.size for view in views})
        if len(sizes) > 1:
            raise InputError(f"{config.scene}: film: photographs have several sizes, {sizes[0]} and {sizes[1]} [px]; "
                             "a film has one: name a folder")  # fmt: skip
        if config.out.is_dir():
            raise InputError(f"{config.out}: is a folder; a film needs the name of a file")
        return
    own = {file.resolve() for shot in capture.shots for file in shot.files if file}
    names = set()
    for view in views:
        if Path(view.name).suffix.lower() not in (".png", ".exr", ".jpg", ".jpeg"):
            raise InputError(f"{config.scene}: filename: {view.name} must end in .png, .jpg or .exr; or give --format")
        if view.name in names:
            raise InputError(f"{config.scene}: filename: {view.name} occurs twice; one would overwrite the other")
        if (config.out / view.name).resolve() in own:
            raise InputError(f"{config.out}: holds the scene's own photographs; choose another folder")
        names.add(view.name)


if __name__ == "__main__":
    command.run("mi_ring.render", main)
