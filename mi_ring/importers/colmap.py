"""COLMAP's sparse models, text or binary."""

from collections.abc import Iterator
from dataclasses import dataclass
from os.path import splitext
from pathlib import Path

from mi_ring.errors import InputError
from mi_ring.foreign import require_readable
from mi_ring.importers.camera_models import Lens, camera_to_world
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import existing
from mi_ring.system.optional import need

#: Python code that reads a model, for `require_readable`.
READ_MODEL = """
import pycolmap
pycolmap.logging.minloglevel = pycolmap.logging.FATAL
pycolmap.Reconstruction(sys.argv[1])
"""


@dataclass(frozen=True)
class Colmap(Photogrammetry):
    """COLMAP, text or binary. The light is beside the camera.

    SRC is the folder of the model (cameras, images), or a folder with the model in sparse/0 or sparse.
    """

    @staticmethod
    def model(src: Path) -> Path | None:
        """The folder of the model; None if there is no model."""
        folders = (src, src / "sparse" / "0", src / "sparse")
        return next((f for f in folders if (f / "images.bin").is_file() or (f / "images.txt").is_file()), None)

    def posed(self) -> Iterator[tuple[str, Frame]]:
        model = self.model(self.src)
        if model is None:
            raise InputError(f"{self.src}: SRC: neither images.bin nor images.txt, nor a folder sparse/0 with them")
        pycolmap = need("pycolmap", f"{model}")
        if size := sum(file.stat().st_size for file in model.glob("*.bin")):
            require_readable(READ_MODEL, model, size, "a COLMAP model")
        try:
            pycolmap.logging.minloglevel = pycolmap.logging.FATAL  # the exception repeats what it logs
            reconstruction = pycolmap.Reconstruction(str(model))
            registered = {*reconstruction.reg_image_ids()}
            names = sorted((image.name, k) for k, image in reconstruction.images.items())  # fails if not UTF-8
        except Exception as error:
            raise InputError(f"{model}: not a COLMAP model ({' '.join(str(error).split())})") from error
        if not registered:
            raise InputError(f"{model}: images: no photograph has a pose")
        candidates = [f / "images" for f in (self.src, model, model.parent, model.parent.parent)]
        images = self.images or next((f for f in candidates if f.is_dir()), None)
        if images is None and self.photographs is None:
            raise InputError(f"{self.src}: --images: no folder images beside or above {model}; give it")
        for name, k in names:
            image = reconstruction.images[k]
            if k not in registered:
                self.without_pose.add(name)
                continue
            if images and self.photographs is None:
                path: Path | None = existing(images / name, "photograph")
            else:
                path = self.photograph(name, str(model))
            if path is None:
                continue
            world_to_camera = image.cam_from_world().matrix()
            pose = camera_to_world(world_to_camera[:, :3], world_to_camera[:, 3])
            camera = reconstruction.cameras[image.camera_id]
            lens = Lens(camera.model_name, (camera.width, camera.height), camera.params)
            yield name, Frame(path, lens, pose, name=Path(splitext(name)[0]).as_posix().replace("/", "_"))
