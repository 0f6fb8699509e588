"""Bundle adjustment of cameras, points and lenses together, with the printed sheet's corners where it is seen."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mi_ring.importers.camera_models import Lens
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.marker_sheet import Sighting, triangulate
from mi_ring.photogrammetry.matching import file_of
from mi_ring.system.optional import need
from mi_ring.system.progress import Progress

ROBUST = 0.5  #: [px of the pictures] residuals beyond count less: highlights and shadows move with the flash
TOLD = 1e-3  #: of a picture's longer side, standard deviation to which a principal point must be known to be taken
CORNER = 12  #: features that a corner of the sheet counts like: it is found that much more precisely
WORSE = 1.1  #: how much farther off features may be where the corners count
SETTLED = 1e-5  #: share of the error by which an iteration of a bundle adjustment lessens it that is nearly the last
ITERATIONS = 10  #: of a bundle adjustment at a time: the library does not let go meanwhile


def adjusted(model: Any, pictures: Sequence[Picture], sightings: Mapping[str, Sighting], progress: Progress) -> Any:
    """The model after bundle adjustments, in which the corners of the printed sheet count if the features go with them.

    They do not where the object was moved on its sheet, or the sheet under it.
    """
    pycolmap = need("pycolmap", "bundle adjustment")
    model.tear_down()  # covariances are refused where some images have no pose
    for _ in progress(adjustments(model), "bundle adjustment"):
        pass
    held = pycolmap.Reconstruction(model)
    if not (corners := add_corners(held, pictures, sightings)):
        return with_principal_points(model, progress)
    for _ in progress(adjustments(held), "bundle adjustment by the sheet"):
        pass
    held = with_principal_points(held, progress)
    for corner in filter(held.exists_point3D, corners):
        held.delete_point3D(corner)
    held.update_point_3d_errors()
    fewer = held.compute_num_observations() / model.compute_num_observations()
    worse = held.compute_mean_reprojection_error() / model.compute_mean_reprojection_error()
    return held if worse < WORSE * min(1.0, fewer) else with_principal_points(model, progress)


def add_corners(model: Any, pictures: Sequence[Picture], sightings: Mapping[str, Sighting]) -> list[int]:
    """Put corners of the printed sheet among the points of a model, where they weigh more than others; which these are.

    Where the sheet is seen at a low angle there are few features, and highlights and shadows among them.
    """
    pycolmap = need("pycolmap", "bundle adjustment")
    seen: dict[int, list[tuple[Any, np.ndarray]]] = {}
    by_file = {file_of(picture): picture for picture in pictures}
    for image in [model.images[k] for k in model.reg_image_ids()]:
        picture = by_file[image.name]
        if sighting := sightings.get(picture.name):
            for corner, place in zip(sighting.ids.tolist(), sighting.pixels / reduction(model, image, picture.size)):
                seen.setdefault(corner, []).append((image, place))
    added: list[int] = []
    for corner, point, _ in triangulate(sightings, cameras_of(model, pictures)):
        for _ in range(CORNER):
            track = pycolmap.Track()
            for image, place in seen[corner]:
                image.points2D.append(pycolmap.Point2D(place))
                track.add_element(image.image_id, len(image.points2D) - 1)
            added.append(model.add_point3D(point, track))
    return added


def adjustments(model: Any) -> Iterator[None]:
    """Bundle adjustment with a robust loss, and points that do not fit left out, a few iterations at a time.

    Highlights and the flash's shadows move with the camera: features on them are wrong but match, and by least squares
    alone they would bend all cameras.
    """
    observations = need("pycolmap", "bundle adjustment").ObservationManager(model)
    for _ in range(3):
        yield from solved(model, *adjustment(model), 100 // ITERATIONS)
        if observations.filter_all_points3D(4 * ROBUST, 2.0) < 1e-3 * model.num_points3D():
            break


def adjustment(model: Any) -> tuple[Any, Any]:
    """Options of a bundle adjustment with a robust loss, and what takes part in it: all of a model."""
    pycolmap = need("pycolmap", "bundle adjustment")
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = SETTLED
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, ROBUST
    config = pycolmap.BundleAdjustmentConfig()
    for k in model.reg_image_ids():
        config.add_image(k)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return options, config


def solved(model: Any, options: Any, config: Any, times: int) -> Iterator[None]:
    """Adjust a model so many times, or until it changes no more."""
    pycolmap = need("pycolmap", "bundle adjustment")
    for _ in range(times):
        yield
        summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        if summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE:
            break


def with_principal_points(model: Any, progress: Progress) -> Any:
    """The model with the principal points that the photographs tell, adjusted; those of other lenses stay.

    A long lens tells it hardly, for a shift of the picture is nearly a turn of the camera.
    """
    pycolmap = need("pycolmap", "bundle adjustment")
    lenses = {model.images[k].camera_id for k in model.reg_image_ids()}
    untold: set[int] = set()
    while untold < lenses:
        found = pycolmap.Reconstruction(model)
        options, config = adjustment(found)
        options.refine_principal_point = True
        for k in untold:
            config.set_constant_cam_intrinsics(k)
        for _ in progress(solved(found, options, config, 3), "principal points"):
            pass
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, found)
        covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), found, adjuster)
        more = {k for k in lenses - untold if not told(found.cameras[k], covariance)}
        if not more:
            return found
        untold |= more
    return model


def told(camera: Any, covariance: Any) -> bool:
    """Do photographs tell the principal point of a camera? By a `pycolmap.BACovariance`, None if there is none."""
    own = covariance and covariance.get_other_params_cov(camera.params)
    if own is None:
        return False
    variance = np.diag(own)[camera.principal_point_idxs()].max()
    return bool(variance < (TOLD * max(camera.width, camera.height)) ** 2)


def cameras_of(model: Any, pictures: Sequence[Picture]) -> dict[str, tuple[Lens, np.ndarray]]:
    """By photograph, as `Motion` has them."""
    by_file, cameras = {file_of(picture): picture for picture in pictures}, {}
    for k in model.reg_image_ids():
        image = model.images[k]
        picture, pose = by_file[image.name], np.eye(4)
        scale = reduction(model, image, picture.size)
        f, cx, cy, radial = model.cameras[image.camera_id].params
        pose[:3] = image.cam_from_world().inverse().matrix()
        lens = Lens("SIMPLE_RADIAL", picture.size, (scale * f, scale * cx, scale * cy, radial))
        cameras[picture.name] = lens, pose
    return dict(sorted(cameras.items()))


def reduction(model: Any, image: Any, size: tuple[int, int]) -> int:
    """How many pixels of a photograph of this size one of its image in a model is, across."""
    own = model.cameras[image.camera_id]
    return max(size) // max(own.width, own.height)
