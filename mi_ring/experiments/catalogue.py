"""The experiments: which fits they run, and the columns and figures of their results."""

from collections.abc import Callable, Sequence
from typing import Any

from mi_ring.errors import InputError
from mi_ring.experiments import measures, plots, published
from mi_ring.experiments.datasets import DiligentObject, PerturbedCameras, Subset
from mi_ring.experiments.experiment import Column, Experiment, ExperimentOptions, Run
from mi_ring.experiments.selection import datasets, one_mesh, path_traced, require_no_materials, short_name
from mi_ring.experiments.single_view import SingleView

DILIGENT = "https://sites.google.com/site/photometricstereodata"  #: site of the two data sets
POSE_ERROR = 0.5  #: of cameras in table 3: rotation [deg] and position [% of the distance]
VIEWS = 5, 10, 15, 25, 35, 50
BANDS = 6  #: number of stripes
#: Default materials of `specularity`, by rising gloss, and of `stripes`.
GLOSSY = tuple(f"principled base_color=0.5,0.25,0.12 roughness={r} specular=0.6" for r in (0.7, 0.5, 0.3))
STRIPED = ("principled base_color=0.55,0.1,0.08 roughness=0.3 specular=0.6", "diffuse reflectance=0.2,0.35,0.5")

NORMALS = {"normal_mean": Column("normals, mean °"), "normal_median": Column("median °")}
DEPTH = {"depth_mean": Column("depth, mean %", 3)}
DEPTHS = {**DEPTH, "depth_median": Column("median %", 3)}
PHOTOGRAPHS = {"psnr_input": Column("PSNR, input dB", 1), "psnr_novel": Column("novel dB", 1)}
FLAWS = {"inside_out": Column("inside out %", 3), "crossing": Column("crossing %", 3)}
TIME = {"seconds": Column("fit s", 0)}
ACCURACY = {**NORMALS, **DEPTHS, **PHOTOGRAPHS, **TIME}
SHAPE = {**NORMALS, **DEPTH, **FLAWS, **TIME}
MATERIAL = {"slice_error": Column("BRDF slices, relative error %", 1)}
NORMAL_ERROR = "normal_mean", "error of normals, mean [°]"

ListRuns = Callable[[ExperimentOptions], list[Run]]


def each_dataset(**fields: Any) -> ListRuns:
    """Return a function that lists one run for each dataset.

    `fields`: fields of the class `Run` that all these runs get.
    """
    return lambda options: [Run(d.name, d, {"capture": d.name}, **fields) for d in datasets(options)]


def each_setting(label: str, settings: dict[Any, dict[str, Any]], quick: Sequence[Any] = ()) -> ListRuns:
    """Return a function that lists one run for each dataset and each setting.

    `label`: name of the table's column that says which setting a run has. `settings`: a dict from the values in this
    column to changed fields of `Config`. `quick`: the values to use with --quick; empty: all.
    """

    def list_runs(options: ExperimentOptions) -> list[Run]:
        values = [*settings] if not (options.quick and quick) else quick
        return [Run(f"{d.name}-{value}".replace(", ", "-").replace(" ", ""), d, {"capture": d.name, label: value},
                    settings[value]) for d in datasets(options) for value in values]  # fmt: skip

    return list_runs


def table2(options: ExperimentOptions) -> list[Run]:
    """List one run for each object of DiLiGenT-MV that is in the paper or in DATA.

    If an object is not in DATA, its run will fail. Raises InputError if DATA is not the folder of DiLiGenT-MV.
    """
    require_no_materials(options)
    if len(options.data) != 1:
        raise InputError("DATA: table2 needs one folder, that of DiLiGenT-MV with mvpmsData/bearPNG and others; get it "
                         f"from its authors: {DILIGENT}/mv")  # fmt: skip
    root = options.data[0] / "mvpmsData" if (options.data[0] / "mvpmsData").is_dir() else options.data[0]
    folders = {folder.name.removesuffix("PNG"): folder for folder in sorted(root.glob("*PNG"))}
    if not any((folder / "Calib_Results.mat").is_file() for folder in folders.values()):
        raise InputError(f"{options.data[0]}: has no file like mvpmsData/bearPNG/Calib_Results.mat; give the folder of "
                         "DiLiGenT-MV as it was unpacked")  # fmt: skip
    runs = []
    for name in sorted({*(str(row["object"]) for row in published.TABLE2), *folders}):
        source = folders.get(name, root / f"{name}PNG")
        dataset = DiligentObject.of(options.captures / f"diligent-{name}", source, name == "bear")
        runs.append(Run(name, dataset, {"object": name}, measure=measures.in_millimetres))
    return runs


def table3(options: ExperimentOptions) -> list[Run]:
    """List three runs for each dataset and seed: exact cameras, wrong cameras, and wrong ones that the fit refines."""
    runs = []
    for exact in datasets(options):
        for seed in options.seeds:
            wrong = PerturbedCameras.of(options.captures / f"{exact.name}-wrong-{seed}", exact, POSE_ERROR, seed)
            label = {"seed": seed} if len(options.seeds) > 1 else {}
            for cameras, dataset, refine in (
                ("exact", exact, "none"), ("wrong", wrong, "none"), ("refined", wrong, "cameras"),
            ):  # fmt: skip
                labels = {"capture": exact.name, "cameras": cameras, **label}
                changes = {"refine": (refine,), "seed": seed}
                runs.append(Run(f"{exact.name}-{cameras}-{seed}", dataset, labels, changes, measures.aligned))
    return runs


def specularity(options: ExperimentOptions) -> list[Run]:
    """List one run for each material in `options`, or for three materials from matt to glossy.

    All have the same mesh.
    """
    mesh = one_mesh(options)
    materials = options.materials or (GLOSSY[::2] if options.quick else GLOSSY)
    names = [short_name(material) for material in materials]
    if len({*names}) < len(names):  # they differ in parameters that are not in short names
        names = list(materials)
    traced = [path_traced(options, mesh, m, f"gloss-{mesh.stem if mesh else 'pot'}-{short_name(m)}")
              for m in materials]  # fmt: skip
    return [Run(dataset.scene.parent.name, dataset, {"material": name}, measure=measures.with_slices)
            for dataset, name in zip(traced, names)]  # fmt: skip


def stripes(options: ExperimentOptions) -> list[Run]:
    """List one run: a mesh with stripes of two materials. Raises InputError if other than two materials are given.

    Without materials in `options`, two default materials are used.
    """
    mesh, materials = one_mesh(options), options.materials or STRIPED
    if len(materials) != 2:
        raise InputError(f"--materials: are {len(materials)}, stripes need two")
    first, second = map(short_name, materials)
    name = f"stripes-{mesh.stem if mesh else 'pot'}-{first}-{second}"
    dataset = path_traced(options, mesh, materials[0], name, second=materials[1], bands=BANDS)
    labels = {"materials": f"{first} and {second}"}
    return [Run(dataset.scene.parent.name, dataset, labels, measure=measures.with_slices)]


def views(options: ExperimentOptions) -> list[Run]:
    """List several runs for each dataset, with increasing numbers of photographs, up to all of them."""
    runs = []
    for source in datasets(options):
        fewer = {count for count in (VIEWS[:1] if options.quick else VIEWS) if count < source.photographs}
        for count in sorted(fewer | {source.photographs}):
            dataset = Subset.of(options.captures / f"{source.name}-part-{count}", source, count)
            runs.append(Run(f"{source.name}-{count}", dataset, {"capture": source.name, "views": count}))
    return runs


def swap(options: ExperimentOptions) -> list[Run]:
    """List one run for each dataset. All fits start from a sphere, so that their materials can be exchanged.

    Raises InputError for fewer than two datasets.
    """
    if not options.data:
        require_no_materials(options)
    found = datasets(options)
    if not options.data:
        found.append(path_traced(options, None, GLOSSY[-1]))
    if len(found) < 2:
        raise InputError("DATA: is one capture; swap exchanges the materials of two or more")
    return [Run(d.name, d, {"capture": d.name}, {"domain": "sphere", "seed": options.seeds[0]}) for d in found]


def single(options: ExperimentOptions) -> list[Run]:
    """List one run for each .npz file in DATA: an object of DiLiGenT, photographed by one camera under many lights.

    Raises InputError if DATA is empty or a file is wrong.
    """
    require_no_materials(options)
    if not options.data:
        raise InputError("DATA: single needs .npz files of DiLiGenT's views from one side, as docs/how-to/paper.md "
                         f"says; get them from its authors: {DILIGENT}/single")  # fmt: skip
    runs = []
    for file in options.data:
        dataset = SingleView.of(options.captures / f"single-{file.stem}", file)
        dataset.read()
        runs.append(Run(file.stem, dataset, {"object": file.stem}, measure=measures.single_view_normals))
    return runs


SPHERE = {"domain": "sphere", "steps": 3}
NETWORKS: dict[Any, dict[str, Any]] = {
    "ring, T = 3": SPHERE,
    "resnet, T = 3": {**SPHERE, "shape_net": "resnet"},
    "wide-resnet, T = 3": {**SPHERE, "shape_net": "wide-resnet"},
    "resnet, T = 20": {**SPHERE, "shape_net": "resnet", "steps": 20},
    "ring, hull": {"domain": "hull"},
}
ENCODINGS: dict[Any, dict[str, Any]] = {
    "linear, 16": {}, "linear, 5": {"frequencies": 5}, "octaves, 5": {"encoding": "octaves", "frequencies": 5},
    "octaves, 10": {"encoding": "octaves", "frequencies": 10}, "none": {"encoding": "none"},
}  # fmt: skip
STEPS: dict[Any, dict[str, Any]] = {t: {"steps": t} for t in (1, 2, 3, 5, 10, 20, 40)}

EXPERIMENTS = {
    "table1": Experiment(
        "The paper's table 1: accuracy on captures with measured materials.", each_dataset(), ACCURACY,
        plots.bars(NORMAL_ERROR, ("depth_mean", "error of depth, mean [% of the diagonal]"),
                   ("psnr_novel", "novel [dB]")),
        published=published.TABLE1),
    "table2": Experiment(
        "DiLiGenT-MV. Errors of normals and depth where a pixel sees both surfaces. Chamfer distance: mean distance of "
        "points of one surface from the other surface, mean of both directions, only of parts that a photograph shows.",
        table2, {**NORMALS, "depth_mm": Column("depth, mean mm"), "chamfer_mm": Column("Chamfer mm"), **TIME},
        plots.bars(NORMAL_ERROR, ("depth_mm", "error of depth, mean [mm]")), "the folder of DiLiGenT-MV",
        published.TABLE2, mean_over="object"),
    "table3": Experiment(
        "The paper's table 3: poses wrong by 0.5° and 0.5 % of the distance, and refined; after rigid alignment.",
        table3, {**NORMALS, **DEPTH, **PHOTOGRAPHS, "turned": Column("cameras turned °", 3), **TIME},
        plots.bars(NORMAL_ERROR, ("turned", "rotation error of the cameras [°]")), published=published.TABLE3),
    "specularity": Experiment(
        "Materials of increasing gloss on one shape: normals, and BRDF slices with light and camera at one place.",
        specularity, {**ACCURACY, **MATERIAL}, plots.slices, "one mesh"),
    "stripes": Experiment(
        "Two materials in stripes: normals, and whether each place has the right one.", stripes,
        {**ACCURACY, **MATERIAL, "right_material": Column("right material %", 1)}, plots.pictures, "one mesh"),
    "views": Experiment(
        "Accuracy by number of photographs.", views, ACCURACY, plots.curves(("views", "photographs"), NORMAL_ERROR)),
    "ablation": Experiment(
        "The ring and plain ResNets: triangles that are inside out or cross others, in % of all.",
        each_setting("network", NETWORKS, quick=list(NETWORKS)[:2]), SHAPE,
        plots.bars(("inside_out", "inside out [%]"), ("crossing", "crossing [%]"), NORMAL_ERROR)),
    "encoding": Experiment(
        "Positional encodings: linear frequencies, powers of two, none.",
        each_setting("encoding", ENCODINGS, quick=("linear, 16", "octaves, 5", "none")), {**ACCURACY, **FLAWS},
        plots.bars(NORMAL_ERROR, ("psnr_novel", "novel [dB]"))),
    "steps": Experiment(
        "Steps of the flow, the paper's T.", each_setting("T", STEPS, quick=(1, 3, 10)), {**ACCURACY, **FLAWS},
        plots.curves(("T", "T"), NORMAL_ERROR, logarithmic=True)),
    "genus": Experiment(
        "An object with a handle, from a sphere and from the masks' visual hull.",
        each_setting("start", {name: {"domain": name} for name in ("sphere", "hull")}),
        {**SHAPE, "genus": Column("genus"), "genus_true": Column("true genus")}, plots.pictures),
    "swap": Experiment(
        "Materials exchanged between fits that start from the sphere.", swap, ACCURACY, plots.swapped,
        f"two or more {Experiment.data}", one_seed=True),
    "resolution": Experiment(
        "One fit, sampled at several levels of the mesh.", each_dataset(measure=measures.by_level),
        {"level": Column("level", 0), "vertices": Column("vertices", 0), **NORMALS, **DEPTHS, **FLAWS},
        plots.curves(("vertices", "vertices"), NORMAL_ERROR, logarithmic=True), one_seed=True),
    "timing": Experiment(
        "The error of normals during a fit.", each_dataset(measure=measures.course, watched=True),
        {"iteration": Column("iteration", 0), **TIME, **NORMALS, **DEPTH},
        plots.curves(("seconds", "fit [s]"), NORMAL_ERROR), one_seed=True),
    "single": Experiment(
        "DiLiGenT's photographs from one side: errors of normals, 90° where the camera misses the surface.", single,
        {**NORMALS, "missed": Column("missed %"), **TIME}, plots.pictures,
        ".npz files of DiLiGenT's photographs from one side"),
}  # fmt: skip
