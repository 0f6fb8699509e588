"""The experiments: each is a list of runs, and what columns and figure are made of them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_ring.errors import InputError
from mi_ring.experiments import measures, plots, published
from mi_ring.experiments.experiment import Asked, Column, Experiment, Run
from mi_ring.experiments.recipes import DiligentObject, Part, Perturbed, own
from mi_ring.experiments.single_view import SingleView
from mi_ring.experiments.sources import captures, one_mesh, require_no_materials, short, traced

DILIGENT = "https://sites.google.com/site/photometricstereodata"  #: where its photographs are to be had
WRONG = 0.5  #: of cameras in table 3: [deg], and [% of the distance]
VIEWS = 5, 10, 15, 25, 35, 50
BANDS = 6  #: of the stripes
#: Of rising gloss, and those of the stripes, where no others are given.
GLOSSY = tuple(f"principled base_color=0.5,0.25,0.12 roughness={r} specular=0.6" for r in (0.7, 0.5, 0.3))
STRIPED = ("principled base_color=0.55,0.1,0.08 roughness=0.3 specular=0.6", "diffuse reflectance=0.2,0.35,0.5")

NORMALS = {"normal_mean": Column("normals, mean °"), "normal_median": Column("median °")}
DEPTHS = {"depth_mean": Column("depth, mean %", 3), "depth_median": Column("median %", 3)}
PHOTOGRAPHS = {"psnr_input": Column("PSNR, input dB", 1), "psnr_novel": Column("novel dB", 1)}
FLAWS = {"inside_out": Column("inside out %", 3), "crossing": Column("crossing %", 3)}
TIME = {"seconds": Column("fit s", 0)}
USUAL = {**NORMALS, **DEPTHS, **PHOTOGRAPHS, **TIME}
SHAPE = {**NORMALS, "depth_mean": DEPTHS["depth_mean"], **FLAWS, **TIME}
CAPTURES = "folders of captures with scene.xml and truth/mesh.ply"


def seeded(runs: Sequence[Run], asked: Asked) -> list[Run]:
    """Each run once for each seed. Its name is the same whatever others there are."""
    many = len(asked.seeds) > 1

    def own_seed(run: Run, seed: int) -> Run:
        labels = {**run.labels, **({"seed": seed} if many else {})}
        name = f"{run.name}-{seed}" if seed else run.name
        return replace(run, name=name, labels=labels, changes={**run.changes, "seed": seed})

    return [own_seed(run, seed) for run in runs for seed in asked.seeds]


def require_one_seed(asked: Asked, name: str) -> None:
    """Raise InputError for several seeds, where no row could be the mean."""
    if len(asked.seeds) > 1:
        raise InputError(f"--seeds: are several; {name} takes one; give one")


def varied(asked: Asked, label: str, settings: dict[Any, dict[str, Any]], quick: Sequence[Any] = ()) -> list[Run]:
    """Each capture by each of some settings, of which --quick takes some."""
    chosen = quick if asked.quick and quick else settings
    return seeded([
        Run(f"{recipe.name}-{key}".replace(", ", "-").replace(" ", ""), recipe,
            {"capture": recipe.name, label: key}, settings[key])
        for recipe in captures(asked) for key in chosen
    ], asked)  # fmt: skip


def table1(asked: Asked) -> list[Run]:
    """Each capture."""
    return seeded([Run(r.name, r, {"capture": r.name}) for r in captures(asked)], asked)


def table2(asked: Asked) -> list[Run]:
    """Each object of DiLiGenT-MV; those that are not there fail."""
    require_no_materials(asked)
    if len(asked.data) != 1:
        raise InputError("DATA: table2 needs one folder, that of DiLiGenT-MV with mvpmsData/bearPNG and others; get it "
                         f"from its authors: {DILIGENT}/mv")  # fmt: skip
    root = asked.data[0] / "mvpmsData" if (asked.data[0] / "mvpmsData").is_dir() else asked.data[0]
    folders = {folder.name.removesuffix("PNG"): folder for folder in sorted(root.glob("*PNG"))}
    if not any((folder / "Calib_Results.mat").is_file() for folder in folders.values()):
        raise InputError(f"{asked.data[0]}: has no mvpmsData/bearPNG/Calib_Results.mat or the like; give the folder of "
                         "DiLiGenT-MV as it is unpacked")  # fmt: skip
    names = [str(row["object"]) for row in published.TABLE2]
    return seeded([
        Run(name, DiligentObject(f"diligent-{name}", folders.get(name, root / f"{name}PNG"), name == "bear"),
            {"object": name}, measure=measures.in_millimetres)
        for name in sorted({*names, *folders})
    ], asked)  # fmt: skip


def table3(asked: Asked) -> list[Run]:
    """Each capture with poses that are exact, wrong, and wrong but refined."""
    runs = []
    for recipe in captures(asked):
        for seed in asked.seeds:
            wrong = Perturbed(f"{recipe.name}-wrong-{seed}", recipe, WRONG, seed)
            for cameras, source, refine in (
                ("exact", recipe, "none"), ("wrong", wrong, "none"), ("refined", wrong, "cameras"),
            ):  # fmt: skip
                seeds = {"seed": seed} if len(asked.seeds) > 1 else {}
                runs.append(Run(f"{recipe.name}-{cameras}-{seed}", source,
                                {"capture": recipe.name, "cameras": cameras, **seeds},
                                {"refine": (refine,), "seed": seed}, measures.aligned))  # fmt: skip
    return runs


def specularity(asked: Asked) -> list[Run]:
    """One mesh of each material."""
    mesh = one_mesh(asked)
    materials = asked.materials or (GLOSSY[::2] if asked.quick else GLOSSY)
    names = [short(material) for material in materials]
    if len({*names}) < len(names):  # what differs is among the parameters that are left out
        names = list(materials)
    recipes = [traced(asked, mesh, m, f"gloss-{mesh.stem if mesh else 'pot'}-{short(m)}") for m in materials]
    return seeded([Run(recipe.folder_in(Path()).name, recipe, {"material": called}, measure=measures.with_slices)
                   for recipe, called in zip(recipes, names)], asked)  # fmt: skip


def stripes(asked: Asked) -> list[Run]:
    """One mesh of two materials."""
    mesh, materials = one_mesh(asked), asked.materials or STRIPED
    if len(materials) != 2:
        raise InputError(f"--materials: are {len(materials)}, stripes need two")
    first, second = materials
    name = f"stripes-{mesh.stem if mesh else 'pot'}-{short(first)}-{short(second)}"
    recipe = traced(asked, mesh, first, name, second=second, bands=BANDS)
    labels = {"materials": f"{short(first)} and {short(second)}"}
    return seeded([Run(recipe.folder_in(Path()).name, recipe, labels, measure=measures.with_slices)], asked)


def views(asked: Asked) -> list[Run]:
    """Each capture by so many of its photographs."""
    return seeded([
        Run(f"{recipe.name}-{count}", Part(f"{recipe.name}-part-{count}", recipe, count),
            {"capture": recipe.name, "views": count})
        for recipe in captures(asked) for count in counts(asked, recipe.photographs)
    ], asked)  # fmt: skip


def counts(asked: Asked, most: int) -> list[int]:
    """Of photographs to take from so many."""
    return sorted({count for count in (VIEWS[:1] if asked.quick else VIEWS) if count < most} | {most})


def genus(asked: Asked) -> list[Run]:
    """Each capture from a sphere and from a hull."""
    starts = {"sphere": {"domain": "sphere"}, "hull": {"domain": "hull"}}
    return varied(asked, "start", starts)


def ablation(asked: Asked) -> list[Run]:
    """The ring and ResNets from a sphere, and the ring from a hull, as fits usually begin."""
    sphere = {"domain": "sphere", "steps": 3}
    networks: dict[Any, dict[str, Any]] = {
        "ring, T = 3": sphere,
        "resnet, T = 3": {**sphere, "shape_net": "resnet"},
        "wide-resnet, T = 3": {**sphere, "shape_net": "wide-resnet"},
        "resnet, T = 20": {**sphere, "shape_net": "resnet", "steps": 20},
        "ring, hull": {"domain": "hull"},
    }
    return varied(asked, "network", networks, list(networks)[:2])


def encoding(asked: Asked) -> list[Run]:
    """Each capture by each encoding."""
    encodings: dict[Any, dict[str, Any]] = {
        "linear, 16": {},
        "linear, 5": {"frequencies": 5},
        "octaves, 5": {"encoding": "octaves", "frequencies": 5},
        "octaves, 10": {"encoding": "octaves", "frequencies": 10},
        "none": {"encoding": "none"},
    }
    return varied(asked, "encoding", encodings, ("linear, 16", "octaves, 5", "none"))


def steps(asked: Asked) -> list[Run]:
    """Each capture by so many Euler steps."""
    return varied(asked, "T", {t: {"steps": t} for t in (1, 2, 3, 5, 10, 20, 40)}, (1, 3, 10))


def swap(asked: Asked) -> list[Run]:
    """Two captures or more from a sphere."""
    if not asked.data:
        require_no_materials(asked)
    require_one_seed(asked, "swap")
    recipes = captures(asked) if asked.data else [own(), traced(asked, None, GLOSSY[-1])]
    if len(recipes) < 2:
        raise InputError("DATA: is one capture; swap exchanges the materials of two or more")
    return [Run(r.name, r, {"capture": r.name}, {"domain": "sphere", "seed": asked.seeds[0]}) for r in recipes]


def resolution(asked: Asked) -> list[Run]:
    """Each capture, sampled at several levels."""
    require_one_seed(asked, "resolution")
    return seeded([Run(r.name, r, {"capture": r.name}, measure=measures.by_level) for r in captures(asked)], asked)


def timing(asked: Asked) -> list[Run]:
    """Each capture, looked at in the course of its fit."""
    require_one_seed(asked, "timing")
    return seeded([Run(r.name, r, {"capture": r.name}, measure=measures.course, watched=True)
                   for r in captures(asked)], asked)  # fmt: skip


def single(asked: Asked) -> list[Run]:
    """Each object that is seen from one side."""
    require_no_materials(asked)
    if not asked.data:
        raise InputError("DATA: single needs .npz files of DiLiGenT's views from one side, as docs/paper.md says; "
                         f"get them from its authors: {DILIGENT}/single")  # fmt: skip
    recipes = [SingleView(f"single-{file.stem}", file) for file in asked.data]
    for recipe in recipes:
        recipe.read()
    return seeded([Run(r.file.stem, r, {"object": r.file.stem}, measure=measures.normals_from_one_side)
                   for r in recipes], asked)  # fmt: skip


_ERROR = "normal_mean", "error of normals, mean [°]"
_MATERIAL = {"slice_error": Column("BRDF slices, relative error %", 1)}

EXPERIMENTS = {
    "table1": Experiment(
        "The paper's table 1: accuracy on captures with measured materials.", table1, USUAL,
        plots.bars(_ERROR, ("depth_mean", "error of depth, mean [% of the diagonal]"), ("psnr_novel", "novel [dB]")),
        published=published.TABLE1, data=f"{CAPTURES}, or meshes",
    ),
    "table2": Experiment(
        "DiLiGenT-MV: normals and depths of pixels that see both surfaces; Chamfer distance of what any photograph "
        "shows, the mean of both directions, to the other surface and not to points of it.",
        table2,
        {**NORMALS, "depth_mm": Column("depth, mean mm"), "chamfer_mm": Column("Chamfer mm"), **TIME},
        plots.bars(_ERROR, ("depth_mm", "error of depth, mean [mm]")), published=published.TABLE2,
        mean_over="object", data="the folder of DiLiGenT-MV",
    ),
    "table3": Experiment(
        "The paper's table 3: poses wrong by 0.5° and 0.5 % of the distance, and refined; after rigid alignment.",
        table3,
        {**NORMALS, "depth_mean": DEPTHS["depth_mean"], **PHOTOGRAPHS, "turned": Column("cameras turned °", 3), **TIME},
        plots.bars(_ERROR, ("turned", "what is left of cameras' turns [°]")), published=published.TABLE3,
        data=f"{CAPTURES}, or meshes",
    ),
    "specularity": Experiment(
        "Materials of rising gloss on one shape: normals, and slices of the BRDF with light and camera at one place.",
        specularity, {**USUAL, **_MATERIAL}, plots.slices, data="one mesh",
    ),
    "stripes": Experiment(
        "Two materials in stripes: normals, and whether each place has the right one.", stripes,
        {**USUAL, **_MATERIAL, "right_material": Column("right material %", 1)}, plots.pictures, data="one mesh",
    ),
    "views": Experiment(
        "Accuracy by the number of photographs.", views, USUAL,
        plots.curves(("views", "photographs"), _ERROR), data=f"{CAPTURES}, or meshes",
    ),
    "ablation": Experiment(
        "The ring against plain ResNets: triangles turned inside out, and crossing others, in % of all.", ablation,
        SHAPE, plots.bars(("inside_out", "inside out [%]"), ("crossing", "crossing [%]"), _ERROR),
        data=f"{CAPTURES}, or meshes",
    ),
    "encoding": Experiment(
        "Positional encodings: linear frequencies, powers of two, none.", encoding, {**USUAL, **FLAWS},
        plots.bars(_ERROR, ("psnr_novel", "novel [dB]")), data=f"{CAPTURES}, or meshes",
    ),
    "steps": Experiment(
        "Steps of the flow, the paper's T.", steps, {**USUAL, **FLAWS},
        plots.curves(("T", "T"), _ERROR, logarithmic=True), data=f"{CAPTURES}, or meshes",
    ),
    "genus": Experiment(
        "An object with a handle, from a sphere and from the masks' visual hull.", genus,
        {**SHAPE, "genus": Column("genus"), "genus_true": Column("true genus")}, plots.pictures,
        data=f"{CAPTURES}, or meshes",
    ),
    "swap": Experiment(
        "Materials exchanged between fits from one domain, the sphere.", swap, USUAL, plots.swapped,
        data=f"two or more {CAPTURES}, or meshes",
    ),
    "resolution": Experiment(
        "One fit, sampled at several levels: the networks are functions.", resolution,
        {"level": Column("level", 0), "vertices": Column("vertices", 0), **NORMALS, **DEPTHS, **FLAWS},
        plots.curves(("vertices", "vertices"), _ERROR, logarithmic=True), data=f"{CAPTURES}, or meshes",
    ),
    "timing": Experiment(
        "The error of normals in the course of a fit.", timing,
        {"iteration": Column("iteration", 0), **TIME, **NORMALS, "depth_mean": DEPTHS["depth_mean"]},
        plots.curves(("seconds", "fit [s]"), _ERROR), data=f"{CAPTURES}, or meshes",
    ),
    "single": Experiment(
        "DiLiGenT's photographs from one side: errors of normals, 90° where the camera misses the surface.", single,
        {**NORMALS, "missed": Column("missed %"), **TIME}, plots.pictures,
        data=".npz files of DiLiGenT's photographs from one side",
    ),
}  # fmt: skip
