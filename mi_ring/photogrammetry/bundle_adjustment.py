"""Bundle adjustment of COLMAP's models (`pycolmap.Reconstruction`), with corners of the printed sheet as points."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mi_ring.importers.camera_models import Lens
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.image_features import grey_file
from mi_ring.photogrammetry.marker_sheet import Detections, triangulate
from mi_ring.system.optional import LazyPackage
from mi_ring.system.progress import Progress

pycolmap = LazyPackage("pycolmap", "structure from motion")
ROBUST = 0.5  #: scale of the Cauchy loss [px]: highlights and shadows move with the flash and are outliers
DETERMINED = 1e-3  #: largest standard deviation of a refined principal point [longer side of the photograph]
CORNER_WEIGHT = 12  #: weight of a corner of the sheet, relative to a feature: it is found more precisely
MAX_WORSE = 1.1  #: factor by which corners may increase the features' reprojection error
CONVERGED = 1e-5  #: relative decrease of the error at which an adjustment ends
ITERATIONS = 10  #: of the solver per call; a call of pycolmap cannot be interrupted


def adjust(model: Any, pictures: Sequence[Picture], detections: Detections, progress: Progress) -> Any:
    """Bundle-adjust a COLMAP model with a robust loss, and refine principal points. Returns the adjusted model.

    `detections`: corners of the printed sheet by the photograph's name; they are used as points, unless they increase
    the error of the image features too much. Empty: no sheet. `model` is changed.
    """
    model.tear_down()  # covariances are refused if an image has no pose
    list(progress(robust_adjustment(model), "bundle adjustment"))
    held = pycolmap.Reconstruction(model)
    if not (corners := add_corners(held, pictures, detections)):
        return refine_principal_points(model, progress)
    list(progress(robust_adjustment(held), "bundle adjustment by the sheet"))
    held = refine_principal_points(held, progress)
    for corner in filter(held.exists_point3D, corners):
        held.delete_point3D(corner)
    held.update_point_3d_errors()
    fewer = held.compute_num_observations() / model.compute_num_observations()
    worse = held.compute_mean_reprojection_error() / model.compute_mean_reprojection_error()
    return held if worse < MAX_WORSE * min(1.0, fewer) else refine_principal_points(model, progress)


def add_corners(model: Any, pictures: Sequence[Picture], detections: Detections) -> list[int]:
    """Add the sheet's corners as points to a COLMAP model, which is changed. Returns the ids of the new points.

    `detections`: corners by the photograph's name. Each corner becomes `CORNER_WEIGHT` equal points, because it is more
    precise than an image feature.
    """
    seen: dict[int, list[tuple[Any, np.ndarray]]] = {}
    for image, picture, scale in registered(model, pictures):
        if detection := detections.get(picture.name):
            for corner, pixel in zip(detection.ids.tolist(), detection.pixels / scale):
                seen.setdefault(corner, []).append((image, pixel))
    added: list[int] = []
    for corner, point, _ in triangulate(detections, model_cameras(model, pictures)):
        for _ in range(CORNER_WEIGHT):
            track = pycolmap.Track()
            for image, pixel in seen[corner]:
                image.points2D.append(pycolmap.Point2D(pixel))
                track.add_element(image.image_id, len(image.points2D) - 1)
            added.append(model.add_point3D(point, track))
    return added


def robust_adjustment(model: Any) -> Iterator[None]:
    """Bundle-adjust a COLMAP model with a robust loss, and remove outliers. `model` is changed.

    It is an iterator for a progress bar: it yields None before each call of the solver, and the caller must exhaust it.
    """
    observations = pycolmap.ObservationManager(model)
    for _ in range(3):
        yield from solve(model, *adjustment_problem(model), 100 // ITERATIONS)
        if observations.filter_all_points3D(4 * ROBUST, 2.0) < 1e-3 * model.num_points3D():
            break


def adjustment_problem(model: Any) -> tuple[Any, Any]:
    """Return COLMAP's (options, configuration) for a bundle adjustment of all images with poses, with a robust loss."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = CONVERGED
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, ROBUST
    config = pycolmap.BundleAdjustmentConfig()
    for k in model.reg_image_ids():
        config.add_image(k)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return options, config


def solve(model: Any, options: Any, config: Any, calls: int) -> Iterator[None]:
    """Call COLMAP's solver until it converges, at most `calls` times. `model` is changed.

    It is an iterator for a progress bar: it yields None before each call, and the caller must exhaust it. `options`,
    `config`: COLMAP's objects for the bundle adjustment.
    """
    for _ in range(calls):
        yield
        summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        if summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE:
            break


def refine_principal_points(model: Any, progress: Progress) -> Any:
    """Refine the principal points of a COLMAP model by bundle adjustment. Returns the refined model.

    `model` does not change. If the data do not determine the principal point of a camera well, this point keeps its
    value. Returns `model` itself if this is so for all cameras.
    """
    lenses = {model.images[k].camera_id for k in model.reg_image_ids()}
    fixed: set[int] = set()
    while fixed < lenses:
        refined = pycolmap.Reconstruction(model)
        options, config = adjustment_problem(refined)
        options.refine_principal_point = True
        for k in fixed:
            config.set_constant_cam_intrinsics(k)
        list(progress(solve(refined, options, config, 3), "principal points"))
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, refined)
        covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), refined, adjuster)
        undetermined = {k for k in lenses - fixed if not is_determined(refined.cameras[k], covariance)}
        if not undetermined:
            return refined
        fixed |= undetermined
    return model


def is_determined(camera: Any, covariance: Any) -> bool:
    """Return True if a bundle adjustment determines the principal point of a camera well.

    `covariance`: `pycolmap.BACovariance` of the adjustment; None: it could not be computed, so the result is False.
    """
    own = covariance and covariance.get_other_params_cov(camera.params)
    if own is None:
        return False
    variance = np.diag(own)[camera.principal_point_idxs()].max()
    return bool(variance < (DETERMINED * max(camera.width, camera.height)) ** 2)


def registered(model: Any, pictures: Sequence[Picture]) -> Iterator[tuple[Any, Picture, int]]:
    """Yield (image of the model, photograph, factor) for each image of a COLMAP model that has a pose.

    The photograph is `factor` times as wide as the image, a whole number.
    """
    by_file = {grey_file(picture): picture for picture in pictures}
    for image in [model.images[k] for k in model.reg_image_ids()]:
        camera, picture = model.cameras[image.camera_id], by_file[image.name]
        yield image, picture, max(picture.size) // max(camera.width, camera.height)


def model_cameras(model: Any, pictures: Sequence[Picture]) -> dict[str, tuple[Lens, np.ndarray]]:
    """Return the cameras of a COLMAP model: (lens, camera-to-world pose (4, 4)), by the photograph's name.

    The lens is for the photograph at full size. Photographs without a pose are left out. Camera axes are OpenCV's.
    """
    cameras = {}
    for image, picture, scale in registered(model, pictures):
        f, cx, cy, radial = model.cameras[image.camera_id].params
        lens = Lens("SIMPLE_RADIAL", picture.size, (scale * f, scale * cx, scale * cy, radial))
        cameras[picture.name] = lens, np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
    return dict(sorted(cameras.items()))
