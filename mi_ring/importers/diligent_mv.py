"""Importer of objects of the data set DiLiGenT-MV."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import camera_to_world, pinhole_lens
from mi_ring.importers.frames import OPENGL, Frame, Light, Source
from mi_ring.importers.reading import chosen, entry, existing, image_size, load_lines, load_mat, load_table


@dataclass(frozen=True)
class DiligentMV(Source):
    """DiLiGenT-MV: an object on a turntable, 20 views under 96 distant lights each.

    SRC is the folder of one object, such as mvpmsData/bearPNG. It contains Calib_Results.mat, view_01, view_02, …
    """

    fields = Fields(
        used={
            "KK": "calibration matrix", "Rc_* Tc_*": "poses, world-to-camera",
            "light_directions.txt light_intensities.txt": "lights", "mask.png": "masks", "mesh_Gt.ply": "the truth",
            "filenames.txt": "the photograph of each light",
        },
        told={"kc alpha_c": "distortion and skew, where they are not 0"},
        harmless={
            "fc cc inv_KK omc_* H_*": "the same as other fields",
            "fc_error cc_error kc_error alpha_c_error omc_error_* Tc_error_* err_std ex_* ex": "errors",
            "x_* y_* X_* Y_* dX* dY* n_sq_x* n_sq_y* wintx* winty* nx ny map": "the pattern that calibrated the camera",
            "n_ima active_images ind_active image_numbers calib_name format_image type_numbering": "its pictures",
            "first_num N_slots solution* param* est_* center_optim check_cond MaxIter recompute_extrinsic": "settings",
            "__*": "the head of the file", "normal_gt.* *.jpg": "other files",
        },
    )  # fmt: skip

    views: tuple[int, ...] = ()
    """Numbers of the views to take, 1 to 20, for example 1 6 11 16. Without this option: all."""
    lights: tuple[int, ...] = ()
    """Numbers of the lights to take for each view, 1 to 96, for example 1 33 65. Without this option: all."""
    fill_holes: bool = False
    """Fill holes in the masks.
    Use this option for the object bear: the holes in its masks are wrong. The holes of pot2 and cow are real."""

    def frames(self) -> Iterator[Frame]:
        file = self.src / "Calib_Results.mat"
        calibration = load_mat(file)
        numbers = {int(f.name[5:]): f for f in self.src.glob("view_*") if f.name[5:].isdigit()}
        if not numbers:
            raise InputError(f"{self.src}: SRC: no folders view_01, view_02, …; give the folder of one object")
        self.tell_unused(file, [k for k, v in calibration.items() if k not in ("kc", "alpha_c") or np.any(v)])
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
            listed = folder / "filenames.txt"
            names = [f"{k:03}.png" for k in range(1, len(directions) + 1)]
            if listed.is_file() and len(names := load_lines(listed)) != len(directions):
                raise InputError(f"{listed}: has {len(names)} lines, light_directions.txt {len(directions)}; must be "
                                 "as many")  # fmt: skip
            for light in chosen(self.lights, range(1, len(directions) + 1), "--lights", folder):
                to_light = pose[:3, :3] @ OPENGL[:3, :3] @ directions[light - 1]
                yield Frame(
                    existing(folder / names[light - 1].strip(), "photograph"), camera, pose, mask,
                    Light("directional", -to_light, intensities[light - 1]), name=f"{view:02}_{light:03}",
                    fill_mask=self.fill_holes,
                )  # fmt: skip

    @property
    def truth(self) -> Path | None:
        """Path of the ground-truth mesh; None if the folder has none."""
        mesh = self.src / "mesh_Gt.ply"
        return mesh if mesh.is_file() else None
