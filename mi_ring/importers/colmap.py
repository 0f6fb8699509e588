"""COLMAP's sparse models, text or binary."""

from collections.abc import Iterator
from dataclasses import dataclass
from os.path import splitext
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError
from mi_ring.foreign import require_readable
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import existing
from mi_ring.system.optional import need

#: Reads a model, for `require_readable`.
TRIAL = """
import pycolmap
pycolmap.logging.minloglevel = pycolmap.logging.FATAL
pycolmap.Reconstruction(sys.argv[1])
"""


@dataclass(frozen=True)
class Colmap(Photogrammetry):
    """COLMAP, text or binary. The light is beside the camera.

    SRC is the folder of the model (cameras, images), or a folder that has the model in sparse/0 or sparse.
    """

    @staticmethod
    def model(src: Path) -> Path | None:
        """The folder of the model, if there is one."""
        folders = (src, src / "sparse" / "0", src / "sparse")
        return next((f for f in folders if (f / "images.bin").is_file() or (f / "images.txt").is_file()), None)

    def posed(self) -> Iterator[tuple[str, Frame]]:
        model = self.model(self.src)
        if model is None:
            raise InputError(f"{self.src}: SRC: neither images.bin nor images.txt, nor a folder sparse/0 with them")
        pycolmap = need("pycolmap", f"{model}")
        if size := sum(file.stat().st_size for file in model.glob("*.bin")):
            require_readable(TRIAL, model, size, "a COLMAP model")
        try:
            pycolmap.logging.minloglevel = pycolmap.logging.FATAL  # what it has to say is in the exception
            reconstruction = pycolmap.Reconstruction(str(model))
            registered = {*reconstruction.reg_image_ids()}
            named = sorted((image.name, key) for key, image in reconstruction.images.items())  # names may be no text
        except Exception as error:
            raise InputError(f"{model}: not a COLMAP model ({' '.join(str(error).split())})") from error
        if not reconstruction.num_reg_images():
            raise InputError(f"{model}: images: no photograph has a pose")
        beside = [f / "images" for f in (self.src, model, model.parent, model.parent.parent)]
        images = self.images or next((f for f in beside if f.is_dir()), None)
        if images is None and self.photographs is None:
            raise InputError(f"{self.src}: --images: no folder images beside or above {model}; give it")
        for photograph, key in named:
            image = reconstruction.images[key]
            if key not in registered:
                self.left_out.add(photograph)
                continue
            if images and self.photographs is None:
                path: Path | None = existing(images / photograph, "photograph")
            else:
                path = self.photograph(photograph, str(model))
            if path is None:
                continue
            turn, shift = np.split(image.cam_from_world().matrix(), [3], axis=1)
            pose = np.vstack([np.hstack([turn.T, -turn.T @ shift]), [0, 0, 0, 1]])
            name = Path(splitext(photograph)[0]).as_posix().replace("/", "_")
            own = reconstruction.cameras[image.camera_id]
            lens = Lens(own.model_name, (own.width, own.height), own.params)
            yield photograph, Frame(path, lens, pose, name=name)
