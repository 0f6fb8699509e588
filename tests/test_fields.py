"""Every field of every format is used, refused, told or harmless; `convert` names the others."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import scipy.io
from helpers import foreign_captures, photogrammetry_files, structure_files
from helpers.foreign_captures import converted, noise, transforms

from mi_ring.errors import InputError
from mi_ring.fields import KINDS, Fields, json_names, xml_names
from mi_ring.importers.formats import FORMATS
from mi_ring.importers.realitycapture import xmp_fields

METASHAPE = """<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1">
<sensor id="0" label="FC550" type="frame"><resolution width="4608" height="3456"/>
<property name="pixel_width" value="0.0037"/><property name="focal_length" value="15"/>
<property name="layer_index" value="0"/><property name="rolling_shutter_flags" value="63"/>
<bands><band label="Red"/></bands><data_type>uint8</data_type>
<calibration type="frame" class="adjusted"><resolution width="4608" height="3456"/><f>1</f><cx>1</cx><cy>1</cy>
<b1>1</b1><b2>0</b2><k1>1</k1><k2>1</k2><k3>1</k3><k4>0</k4><p1>1</p1><p2>1</p2><p3>0</p3><p4>0</p4></calibration>
<covariance><params>f cx</params><coeffs>1 2</coeffs></covariance>
<black_level>0 0 0</black_level><sensitivity>1 1 1</sensitivity>
<meta><property name="Exif/Make" value="DJI"/></meta></sensor></sensors>
<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>
<rotation locked="true">1</rotation>
<translation locked="true">1</translation><scale locked="true">1</scale></transform>
<region><center>1 2 3</center><size>1 2 3</size><R>1</R></region>
<partition><camera_ids>0 1</camera_ids></partition></component></components>
<cameras next_id="2" next_group_id="1"><group id="0" label="Group 1" type="folder"><camera id="0" sensor_id="0"
component_id="0" label="DJI_0151" enabled="true"><transform>1</transform>
<rotation_covariance>1</rotation_covariance><location_covariance>1</location_covariance>
<orientation>1</orientation><reference x="1" y="2" z="3" yaw="1" pitch="0" roll="0" enabled="true"
rotation_enabled="false"/></camera></group></cameras>
<markers next_id="1"><marker id="0" label="target 1"><reference x="1" y="2" z="3"/></marker></markers>
<frames next_id="1"><frame id="0"><markers><marker marker_id="0"><location camera_id="0" x="1" y="2"/></marker>
</markers></frame></frames>
<reference>LOCAL_CS["Local Coordinates (m)"]</reference><transform><rotation locked="false">1</rotation>
<translation locked="false">1</translation><scale locked="false">1</scale></transform>
<region><center>1 2 3</center><size>1 2 3</size><R>1</R></region>
<settings><property name="accuracy_tiepoints" value="1"/></settings>
<meta><property name="Info/LastSavedSoftwareVersion" value="2.0.0"/></meta></chunk></document>"""

XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:PosePrior="locked"
xcr:Coordinates="absolute" xcr:DistortionModel="brown3" xcr:DistortionCoeficients="0 0 0 0 0 0"
xcr:FocalLength35mm="18" xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="0" xcr:PrincipalPointV="0"
xcr:CalibrationPrior="initial" xcr:CalibrationGroup="-1" xcr:DistortionGroup="-1" xcr:Rig="{1}" xcr:RigInstance="{2}"
xcr:RigPoseIndex="3" xcr:InTexturing="1" xcr:InMeshing="1" xcr:InColoring="1" xcr:ComponentId="{3}"
xcr:latitude="1" xcr:longitude="2" xcr:altitude="3"><xcr:Rotation>1</xcr:Rotation><xcr:Position>1</xcr:Position>
</rdf:Description></rdf:RDF></x:xmpmeta>"""

#: Meshroom's scene as AliceVision's compatibility data of versions 1.0 to 1.2.14 have it.
ALICEVISION = {
    "version": ["1", "2", "14"], "featuresFolders": ["a"], "matchesFolders": ["b"],
    "views": [{"viewId": "0", "poseId": "0", "frameId": "3", "intrinsicId": "0", "resectionId": "0", "rigId": "0",
               "subPoseId": "1", "isPoseIndependant": "true", "path": "", "width": "4092", "height": "2048",
               "imageGroupId": "1", "ancestors": ["1"], "metadata": {"Exif:Flash": "16", "Make": "Canon"}}],
    "intrinsics": [{
        "intrinsicId": "0", "width": "4092", "height": "2048", "sensorWidth": "36", "sensorHeight": "24",
        "serialNumber": "", "type": "pinhole", "initializationMode": "none", "initialFocalLength": "-1",
        "pxInitialFocalLength": "1", "pxFocalLength": "1", "focalLength": "17.5", "pixelRatio": "2",
        "pixelRatioLocked": "true", "offsetLocked": "false", "scaleLocked": "false", "principalPoint": ["-26", "16"],
        "distortionLocked": "false", "distortionInitializationMode": "none", "distortionParams": "",
        "undistortionOffset": ["0", "0"], "undistortionParams": "", "distortionType": "none",
        "undistortionType": "none", "locked": "false", "fisheyeCircleCenterX": "0", "fisheyeCircleRadius": "1",
    }],
    "poses": [{"poseId": "0", "pose": {"transform": {"rotation": ["1"], "center": ["1"]}, "locked": "false",
                                       "rotationOnly": "false", "removable": "true"}}],
    "rigs": [{"rigId": "0", "subPoses": [{"status": "estimated", "pose": {}}]}],
    "structure": [{"landmarkId": "0", "descType": "sift", "color": ["1"], "X": ["1"], "observations": []}],
    "constraints2d": [{"ViewFirst": "0"}], "rotationpriors": [{"ViewFirst": "0"}], "landmarks": [{}],
}  # fmt: skip

OPENMVG = {
    "sfm_data_version": "0.3", "root_path": "/photographs",
    "views": [{"key": 0, "value": {"polymorphic_id": 1, "polymorphic_name": "view_priors", "ptr_wrapper": {
        "id": 2, "data": {"local_path": "", "filename": "a.jpg", "width": 6, "height": 4, "id_view": 0,
                          "id_intrinsic": 0, "id_pose": 0, "use_pose_center_prior": True, "center_weight": [1, 1, 1],
                          "center": [1, 2, 3], "use_pose_rotation_prior": True, "rotation_weight": 1.0,
                          "rotation": [[1]]}}}}],
    "intrinsics": [{"key": 0, "value": {"polymorphic_id": 1, "polymorphic_name": "pinhole_brown_t2", "ptr_wrapper": {
        "id": 3, "data": {"width": 6, "height": 4, "focal_length": 5, "principal_point": [3, 2], "disto_k1": [0],
                          "disto_k3": [0], "disto_t2": [0], "fisheye": [0], "value0": {
                              "width": 6, "height": 4, "focal_length": 5, "principal_point": [3, 2]}}}}}],
    "extrinsics": [{"key": 0, "value": {"rotation": [[1]], "center": [1, 2, 3]}}],
    "structure": [{"key": 0, "value": {"X": [1, 2, 3], "observations": []}}], "control_points": [],
}  # fmt: skip

#: transforms.json as NeRF, instant-ngp, nerfstudio, NeuS2, D-NeRF and Polycam write it.
TRANSFORMS = """camera_angle_x camera_angle_y
 fl_x fl_y k1 k2 k3 k4 p1 p2 is_fisheye cx cy w h aabb_scale frames file_path
 sharpness transform_matrix rotation time x_fov y_fov scale offset aabb render_aabb up n_extra_learnable_dims
 from_mitsuba rolling_shutter transform_matrix_start transform_matrix_end depth_path enable_depth_loading
 integer_depth_scale enable_ray_loading fix_premult white_transparent black_transparent mask_color ftheta_p0 ftheta_w
 latlong equirectangular orthographic camera_model orientation_override auto_scale_poses_override applied_transform
 applied_scale depth_file_path mask_path ply_file_path colmap_im_id train_filenames val_filenames test_filenames
 distortion_params depth_unit_scale_factor from_na intrinsic_matrix timestamp blur_score driver_parameters is_hdr
 fisheye_crop_radius normal_file_path n_frames"""

#: The variables that Bouguet's toolbox saves, and the files of an object.
BOUGUET = """fc cc kc alpha_c KK inv_KK Rc_1 omc_1 Tc_1 H_1 x_1 y_1 X_1 ex_1 ex dX dY dX_1 dY_1 dX_default dY_default
 wintx winty wintx_1 winty_1 n_sq_x_1 n_sq_y_1 nx ny n_ima active_images ind_active image_numbers calib_name
 format_image type_numbering first_num N_slots solution solution_error solution_init param param_list est_dist
 est_alpha est_fc est_aspect_ratio center_optim check_cond MaxIter recompute_extrinsic fc_error cc_error kc_error
 alpha_c_error omc_error_1 Tc_error_1 err_std map __header__ light_directions.txt light_intensities.txt mask.png
 mesh_Gt.ply filenames.txt"""


def of_xmp(fields: Fields) -> list[str]:
    columns = "name x y alt heading pitch roll f px py k1 k2 k3 k4 t1 t2"
    return [*(f"xcr:{name}" for name in xmp_fields(ElementTree.fromstring(XMP))), *columns.split()]


def of_colmap(fields: Fields) -> list[str]:
    """As the heads of the text files name them, which COLMAP writes."""
    columns = {
        "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", "points3D": "POINT3D_ID", "rigs": "RIG_ID",
        "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME POINTS2D[]", "frames": "FRAME_ID",
    }  # fmt: skip
    return [f"{file}/{name}" for file, names in columns.items() for name in names.split()]


#: Formats whose fields have plain names.
FLAT = {
    "bundler": "f k1 k2 R t points list.txt:focal",
    "visualsfm": "name focal qw qx qy qz cx cy cz radial FixedK points PLY",
    "opensfm": """cameras shots points biases rig_cameras rig_instances reference_lla cameras/projection_type
     cameras/width cameras/height cameras/focal cameras/focal_x cameras/focal_y cameras/c_x cameras/c_y cameras/k1
     cameras/k2 cameras/k3 cameras/k4 cameras/p1 cameras/p2 cameras/focal_prior cameras/k1_prior shots/rotation
     shots/translation shots/camera shots/orientation shots/capture_time shots/gps_dop shots/gps_position shots/compass
     shots/vertices shots/faces shots/scale shots/covariance shots/merge_cc""",
    "polycam": """t_00 t_13 t_23 fx fy cx cy width height timestamp blur_score neighbors manual_keyframe center_depth
     angular_velocity""",
    "record3d": "K perFrameIntrinsicCoeffs w h poses dw dh fps initPose frameTimestamps cameraType depthScale",
    "sdfstudio": """camera_model height width has_mono_prior has_sensor_depth has_foreground_mask pairs worldtogt
     scene_box frames frames/rgb_path frames/camtoworld frames/intrinsics frames/mono_depth_path
     frames/mono_normal_path frames/sensor_depth_path frames/foreground_mask frames/sfm_sparse_points_view""",
    "gltf": """nodes/name nodes/camera nodes/children nodes/matrix nodes/translation nodes/rotation nodes/scale
     cameras/name perspective/yfov perspective/aspectRatio perspective/znear perspective/zfar KHR_lights_punctual meshes
     materials""",
}
#: By format: the names of the fields in samples of it.
SAMPLES = {
    "metashape": lambda fields: xml_names(ElementTree.fromstring(METASHAPE)[0], fields.closed),
    "realitycapture": of_xmp, "colmap": of_colmap,
    "sfmdata": lambda fields: [*json_names(ALICEVISION, fields.closed), *json_names(OPENMVG, fields.closed)],
    "transforms": lambda fields: TRANSFORMS.split(), "diligent-mv": lambda fields: BOUGUET.split(),
    "neus": lambda fields: [f"{name}_{inv}0" for name in ("world_mat", "scale_mat", "camera_mat")
                            for inv in ("", "inv_")] + ["light_energy_0", "max_intensity"],
    "iron": lambda fields: ["K", "W2C", "img_size"],
    "llff": lambda fields: ["rotation", "translation", "height", "width", "focal", "near", "far"],
    **{name: lambda fields, name=name: FLAT[name].split() for name in FLAT},
    "middlebury": lambda fields: ["imgname", *(f"{m}{i}{j}" for m in "kr" for i in "123" for j in "123"), "t1", "t3"],
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_every_field_of_a_sample_is_declared(name):
    fields = FORMATS[name].fields
    assert not [own for own in SAMPLES[name](fields) if fields.kind_of(own)[0] == "unknown"]


@pytest.mark.parametrize("name", FORMATS)
def test_fields_are_of_one_kind(name):
    fields = FORMATS[name].fields
    names = fields.names()
    assert len(names) == len({*names}) and {kind for _, kind, _ in fields.rows()} <= {*KINDS}
    assert all(why for _, _, why in fields.rows())


def metashape(folder, more=""):
    path = photogrammetry_files.metashape(folder)
    path.write_text(path.read_text().replace("</sensor>", f"{more}</sensor>"))
    return "metashape", path


def sidecars(folder):
    return "realitycapture", photogrammetry_files.sidecars(folder, LensShift="0.1")


def sfmdata(folder):
    return "sfmdata", photogrammetry_files.alicevision(folder, own={"tilt": 3})


def neus(folder):
    return "neus", foreign_captures.neus(folder, distortion_0=[0.1])


def iron(folder):
    return "iron", foreign_captures.iron(folder, lambda cameras: cameras["1.png"].update(distortion=[0.1]))


def gltf(folder):
    folder.mkdir()
    moves = {"animations": [{"channels": [], "samplers": []}], "extensionsUsed": ["KHR_node_visibility", "KHR_mesh_x"]}
    return "gltf", structure_files.gltf(folder, edit=lambda content: content.update(moves))


def diligent(folder):
    folder = foreign_captures.diligent_folder(folder)
    file = folder / "Calib_Results.mat"
    known = {key: value for key, value in scipy.io.loadmat(file).items() if not key.startswith("__")}
    scipy.io.savemat(file, known | {"kc": [0.1, 0, 0, 0, 0], "alpha_c": 0.0, "lens_2": 3})
    return "diligent-mv", folder


@pytest.mark.parametrize(("make", "told"), [
    (lambda folder: metashape(folder, "<shift>3</shift>"), "sensor/shift (unknown)"),
    (lambda folder: metashape(folder, "<vignetting>3</vignetting>"),
     "sensor/vignetting (brightness of the corners; a fit may refine it)"),
    (sidecars, "xcr:LensShift (unknown)"), (sfmdata, "intrinsics/tilt (unknown)"),
    (neus, "distortion_0 (unknown)"), (iron, "distortion (unknown)"),
    (gltf, "KHR_node_visibility (unknown), animations (cameras are taken from where they are without it)"),
    (diligent, "kc (distortion and skew, where they are not 0), lens_2 (unknown)"),
])  # fmt: skip
def test_unknown_fields_are_named_once(make, told, tmp_path, capsys):
    name, source = make(tmp_path / "source")
    converted(name, source, tmp_path / "scene.xml")
    lines = [line for line in capsys.readouterr().out.splitlines() if "not used: " in line]
    assert [line.partition("not used: ")[2] for line in lines] == [told]


def test_nothing_is_told_of_what_is_known(tmp_path, capsys):
    converted("metashape", photogrammetry_files.metashape(tmp_path / "a"), tmp_path / "a.xml")
    converted("sfmdata", photogrammetry_files.openmvg(tmp_path / "b"), tmp_path / "b.xml")
    converted("realitycapture", photogrammetry_files.csv_table(tmp_path / "c"), tmp_path / "c.xml")
    assert "not used" not in capsys.readouterr().out


@pytest.mark.parametrize("name", " ".join(FORMATS["transforms"].fields.refused).replace("*", "2").split())
def test_fields_of_transforms_are_refused_unless_they_are_zero(name, tmp_path):
    for value in (0, [0, 0.0], False):
        top = {"fl_x": 70.0, "frames": [{"file_path": "0.png"}]} | {name: value}
        source = transforms(tmp_path / str(value), top, top["frames"], lambda k: noise(np.uint8))
        converted("transforms", source, tmp_path / f"{value}.xml")
    text = json.loads((source / "transforms.json").read_text())
    (source / "transforms.json").write_text(json.dumps(text | {name: [0, 0.2]}))
    with pytest.raises(InputError, match=rf"{name}: is \[0, 0.2\], which is not supported: "):
        converted("transforms", source, tmp_path / "refused.xml")


@pytest.mark.parametrize("value", ["true", "1", "regularized"])
def test_cameras_that_moved_during_the_exposure_are_refused_by_metashape(tmp_path, value):
    _, path = metashape(tmp_path, f'<property name="rolling_shutter" value="{value}"/>')
    with pytest.raises(InputError, match=f"sensor '4': rolling_shutter: is {value}, which is not supported"):
        converted("metashape", path, Path(tmp_path / "s.xml"))
    path.write_text(path.read_text().replace(f'value="{value}"', 'value="disabled"'))
    assert len(converted("metashape", path, tmp_path / "s.xml").shots) == 3
