"""From frames to a scene file: the work of `mi-ring convert`."""

import contextlib
import shutil

from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.errors import InputError
from mi_ring.importers.frames import Frame, Source, frames_of, require_frames
from mi_ring.importers.writer import Writer, write_frame
from mi_ring.scene.shot import Shot
from mi_ring.system.progress import progress


def write_scene(source: Source) -> list[Frame]:
    """Write a source's scene file and changed images, and return the frames. After an InputError nothing is written."""
    frames = frames_of(source)
    if source.without_pose and not frames:
        raise InputError(f"{source.src}: SRC: none of {len(source.without_pose)} photographs has a pose")
    require_frames(frames, source.src)
    names = [frame.name or frame.image.stem for frame in frames]
    if len({*names, "object"}) <= len(names):
        names = [f"{k:0{len(str(len(frames)))}}_{name}" for k, name in enumerate(names)]
    root = scene_element()
    if source.scene.suffix != ".xml" or source.scene.exists():
        what = "exists already; give another name" if source.scene.exists() else "must end in .xml"
        raise InputError(f"{source.scene}: SCENE.xml: {what}")
    try:
        with contextlib.closing(Writer(source.scene)) as writer:
            for frame, name in zip(progress(frames, "converting", unit="photograph", disable=None), names):
                encoding = source.encoding if source.encoding != "auto" else frame.encoding
                files = write_frame(writer, frame, name, source.copy, encoding)
                root.append(photograph_element(Shot(name, frame.camera, frame.light, files=files, encoding=encoding,
                                                    saturation=frame.saturation)))  # fmt: skip
            if truth := getattr(source, "truth", None):
                writer.write("truth/mesh.ply", lambda file: shutil.copyfile(truth, file))
            writer.finish(scene_bytes(root))
    except OSError as error:
        raise InputError(f"{source.scene}: cannot be written ({error.strerror or error})") from error
    return frames
