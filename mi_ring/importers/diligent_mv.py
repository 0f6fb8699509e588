"""DiLiGenT-MV's objects."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import camera_to_world, pinhole_lens
from mi_ring.importers.frames import OPENGL, Frame, Light, Source
from mi_ring.importers.reading import chosen, entry, existing, image_size, load_mat, load_table


@dataclass(frozen=True)
class DiligentMV(Source):
    """DiLiGenT-MV: an object on a turntable, 20 views under 96 distant lights each.

    SRC is the folder of an object, such as mvpmsData/bearPNG, with Calib_Results.mat, view_01, view_02, …
    """

    views: tuple[int, ...] = ()
    """Numbers of the views to take, from 1. Without it: all."""
    lights: tuple[int, ...] = ()
    """Numbers of the lights to take, from 1. Without it: all."""
    fill_holes: bool = False
    """Fill holes in the masks.
    Use it for the object bear, whose masks have wrong holes. The holes in the masks of pot2 and cow are real."""

    def frames(self) -> Iterator[Frame]:
        file = self.src / "Calib_Results.mat"
        calibration = load_mat(file)
        numbers = {int(f.name[5:]): f for f in self.src.glob("view_*") if f.name[5:].isdigit()}
        if not numbers:
            raise InputError(f"{self.src}: SRC: no folders view_01, view_02, …; give the folder of one object")
        K = entry(calibration, "KK", (3, 3), file)
        for view in chosen(self.views, numbers, "--views", self.src):
            folder = numbers[view]
            t = entry(calibration, f"Tc_{view}", (3, 1), file)
            pose = camera_to_world(entry(calibration, f"Rc_{view}", (3, 3), file), t[:, 0])
            mask = existing(folder / "mask.png", "mask")
            camera = pinhole_lens(K, image_size(mask), 0.5, f"{file}: KK")
            directions = load_table(folder / "light_directions.txt", 3)
            intensities = load_table(folder / "light_intensities.txt", 3)
            if len(directions) != len(intensities):
                raise InputError(f"{folder / 'light_intensities.txt'}: has {len(intensities)} lines, "
                                 f"light_directions.txt {len(directions)}; must be as many")  # fmt: skip
            for light in chosen(self.lights, range(1, len(directions) + 1), "--lights", folder):
                to_light = pose[:3, :3] @ OPENGL[:3, :3] @ directions[light - 1]
                yield Frame(
                    existing(folder / f"{light:03}.png", "photograph"), camera, pose, mask,
                    Light("directional", -to_light, intensities[light - 1]), name=f"{view:02}_{light:03}",
                    fill_mask=self.fill_holes,
                )  # fmt: skip

    @property
    def truth(self) -> Path | None:
        """File of the true mesh; None if there is none."""
        mesh = self.src / "mesh_Gt.ply"
        return mesh if mesh.is_file() else None
