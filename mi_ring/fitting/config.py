"""The settings of a fit. `Config` joins three frozen dataclasses: `Common`, `Tuning` and `Ablation`.

The docstrings of the fields are the help texts of `mi-ring fit`. The help keeps their line breaks.
"""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from mi_ring.errors import InputError
from mi_ring.fitting.setting_types import as_typed, of_type
from mi_ring.scene.lobes import MOST_LOBES
from mi_ring.version import __version__

#: Weights of the default terms of the loss. `Config.weights` has these where nothing else is given.
WEIGHTS = {
    "rgb": 1.0, "mask": 5.0, "velocity": 0.01, "calibration": 1e-3, "settling": 0.03,
    "normal_variation": 0.0, "material_rank": 0.0,
}  # fmt: skip

#: Largest values of settings. Far below them, memory or patience ends.
MOST = {"iterations": 10**6, "steps": 10**4, "batch": 10**6, "spp": 10**4}

#: What `Config.refine` may have.
Unknown = Literal[
    "auto", "none", "cameras", "focal", "principal", "distortion", "light", "power", "gain", "falloff", "vignetting",
    "curve", "contrast", "scale", "ambient", "lamps", "masks",
]  # fmt: skip

#: Entries of config.json that are no settings of a fit: input, output and computing resources.
TASK = {"scene", "out", "resume", "preset", "minutes", "variant", "threads"}


@dataclass(frozen=True, kw_only=True)
class Common:
    """Settings for every user."""

    light: Literal["capture", "environment", "turntable", "lamps", "auto"] = "capture"
    """The kind of light in the photographs. Set another kind than capture if the lights are not in the scene file.
    capture: the lights of the scene file.
    environment: unknown light from all sides. It does not move, while the camera moves around the object.
    turntable: unknown light from all sides. It stands still relative to the camera, while the object turns.
    lamps: one to three unknown lamps. They do not move, while the camera moves around the object.
    auto: one of these four. The background of the photographs and coarse fits tell which. This takes longer."""
    refine: tuple[Unknown, ...] = ("auto",)
    """Calibration that the fit corrects, in addition to surface and material. Initial values come from the scene file.
    auto: light, power, ambient. Also scale, if with these lights the object would reflect more light than it gets.
    From ten photographs on also cameras, if they differ; falloff, if the lights are a flash beside the lens, whose cone
    the scene file does not give, but not with vignetting; contrast, if the photographs' curve is not given, as in most
    sRGB files.
    With another --light than capture, auto is gain and ambient; for lamps also light and lamps.
    none: nothing, for exact calibration. If predicted photographs look shifted, give --refine auto principal.
    cameras: position and direction of each camera.
    focal, principal: focal length and principal point of each lens.
    distortion: first radial distortion coefficient of each lens.
    light: position or direction of the lights inside the <sensor> elements: each lights one photograph, as a flash.
    lamps: position and intensity of the point and directional emitters outside <sensor>: they light all photographs.
    power: intensity and colour of the light of each photograph. Give it if the flash varied.
    gain: exposure and white balance of each photograph. Give it instead of power if the camera's exposure varied.
    falloff: the cone of a flash that moves with the camera: how fast its light decreases to the sides, and where it
    points.
    vignetting: how much darker the lens makes the corners of the image.
    contrast: steepness of the S shape of the camera's response curve.
    curve: exponent of the response curve, and how much longer the dark end of its S shape is than the bright end.
    scale: one factor for the intensities of all lights. The fit finds it from interreflection.
    ambient: light of the room, from all sides.
    masks: outlines of the object. The fit finds new masks after one half and three quarters of its iterations."""
    masks: Literal["auto", "given", "none"] = "auto"
    """The masks that the fit uses. Set none if the masks of the scene file are wrong and the room is dark.
    given: the masks of the scene file.
    none: the fit ignores these masks. In a dark room the bright pixels of each photograph become its mask.
    In a lit room the fit then uses no mask. The fit measures in the photographs whether the room is dark.
    auto: given if the scene file has masks, otherwise none. To use no mask in any case, set --weights.mask 0."""
    domain: Literal["auto", "sphere", "hull"] | tuple[Literal["mesh"], Path] = "auto"
    """The start surface that the fit deforms. The fitted surface has the same number of handles (genus).
    hull: the visual hull of the masks. mesh FILE: a closed mesh in scene units. sphere: a sphere around the object.
    auto: the mesh that the scene file names as `domain`. If it names none: hull. If there are no masks: sphere.
    A start surface near the object saves time. Give a mesh if the object has a handle that the masks do not show."""
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Parameters of the BSDF that the fit finds, each with its lowest and highest value (inf: no limit).
    Only needed if the BSDF of the scene is not cooktorrance. Example: --parameters base_color 0 1 roughness 0.05 1"""
    detail: Literal["none", "texture", "shape", "both"] = "both"
    """What the fit refines at the end, as fine as the pixels of the photographs. The networks alone are smooth.
    texture: colour and gloss, and at the end a texture from the photographs at their own size.
    shape: displacement of the surface. both: texture and shape. At least four photographs are needed.
    none: neither, which takes less time; so do the presets fast and paper."""
    holdout: int = 0
    """Leave every n-th photograph out of the fit and test the result on these photographs. 0: use all photographs.
    For example, 8 leaves out the fifth, the thirteenth, and so on. The fit then has fewer photographs.
    At the end the fit undoes each correction of --refine that does not improve this test, except the corrections of
    single photographs: cameras, power and gain."""
    iterations: int = 460
    """Number of iterations of all stages together, for example 1400. More iterations give finer detail and take longer.
    That is for a start from a sphere. A fit from a hull or a mesh leaves out two thirds of those of the first stage.
    A fit under an unknown environment makes 15 % more."""
    seed: int = 0
    """Random seed. Fits with different seeds show how much results vary by chance."""
    deterministic: bool = False
    """Make repeated fits on one machine equal bit for bit. The fit then uses one processor thread and takes longer.
    Set it to see the effect of another option without chance."""


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """How fine and how fast the fit is. Presets set most of these options."""

    levels: tuple[int, ...] = (4, 5, 6)
    """Level of the mesh in each stage, 0 to 8. A mesh of level n has about 10 · 4^n vertices.
    Higher levels give finer detail. One level more takes up to four times the time and memory."""
    widths: tuple[int, ...] = (128, 256, 512)
    """Largest width of the photographs in each stage [px]: one number for each of --levels.
    The fit reduces wider photographs to this width. Larger widths give finer detail and take longer."""
    shares: tuple[float, ...] = (0.45, 0.46, 0.09)
    """Iterations of each stage, from coarse to fine, as a share of all: one number above 0 for each of --levels.
    Only the ratios count. A larger last number gives finer detail and takes longer. A fit that starts from a hull or a
    mesh skips two thirds of the iterations of the first stage. It adds 40 % of the skipped iterations to the second."""
    small_lights: int = 8
    """Most small lights, such as windows, lamps and the sun, that the fit finds in an unknown room: 0 to 32.
    0: none are sought. Beside a flash or other lights none are sought either."""
    subdivisions: int = 6
    """Level of the mesh in the results, 0 to 8: about 10 · 4^level vertices. This option does not change the fit.
    A fit with --detail chooses the level itself, 7 or 8 for most captures.
    mi-ring export can write other levels later."""
    detail_share: float = 0.13
    """Number of iterations that --detail adds at the end, as a share of --iterations. 0.13 of 1000: 130 more.
    Raise it if fine texture or relief is still blurred. With fewer than 10 such iterations there are no details."""
    detail_rate: float = 0.1
    """Learning rate of --detail: the longest displacement in an iteration, in widths of a cell of its grid. Values of
    textures change by up to three times as much. Lower it if the surface becomes rough."""
    batch: int = 8
    """Photographs in each iteration. More photographs make an iteration slower and its gradient less noisy."""
    steps: int = 3
    """Number of steps in which the network moves the start surface to the object (Euler steps; the paper's T).
    More steps take more time and memory. Give more steps if the surface folds over; they make folds less likely."""
    spp: int = 1
    """Samples per pixel of predicted photographs. More samples make an iteration slower and its gradient less noisy."""
    weights: dict[str, float] = field(default_factory=lambda: dict(WEIGHTS))
    """Weight of each term of the loss, 0 or more; 0 switches the term off.
    rgb: the colours agree with the photographs.
    mask: the silhouettes agree with the masks.
    velocity: the deformation is smooth (the paper's lambda). Raise it for noisy photographs, lower it for fine detail.
    calibration: the corrected calibration stays near the calibration of the scene file.
    settling: the material varies little over the surface. Only in the last stage under an unknown environment.
    normal_variation: the surface has flat faces and sharp edges. Try 0.01 if the object has them.
    material_rank: the material is a mixture of few materials. Try 0.01 if the object has few materials."""
    velocity_decay: float = 0.03
    """During the fit, the weight of velocity falls to this share of --weights.velocity, above 0. 1: it stays constant.
    A small share gives finer detail. In a short fit a small share may let the surface fold over."""
    laplacian_scale: float = 0.01
    """How much the term velocity penalises high frequencies of the deformation, 0 or more (the paper's alpha).
    A larger value gives a smoother surface with less detail."""
    learning_rate: float = 3e-3
    """Learning rate of Adam at the start. Raise it for faster progress. Lower it if the loss does not fall steadily."""
    muon_rate: float = 3e-2
    """Learning rate of Muon at the start. Muon trains the hidden layers of the networks. --optimizer adam has no Muon.
    Raise it for faster progress. Lower it if the loss does not fall steadily."""
    decay: float = 0.1
    """Learning rates at the end of the fit, as a share of those at its start. With 1 they stay constant.
    With a smaller share the surface changes less at the end. The learning rates of cameras always fall to one half."""
    precision: Literal["auto", "bfloat16", "float32"] = "auto"
    """Number format of matrix products. auto: bfloat16 if it is faster than float32 on this machine.
    Set float32 to compare results of different machines. A fit in float32 may take longer."""


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """Parts of the method to replace or leave out, to measure their effect."""

    shadows: bool = True
    """Trace the shadows that flash and lamps cast on the object.
    --no-shadows makes a fit faster. The surface then becomes wrong if a light is not at its camera."""
    indirect: bool = True
    """Predict light that the object reflects onto itself (interreflection). It makes concave parts brighter.
    Give --no-indirect if the light intensities in the scene file are wrong."""
    pairs: Literal["subtract", "both"] = "subtract"
    """What the fit does with photographs that name an image `ambient`: the same view without the photograph's light.
    subtract: it only subtracts this image. both: it also fits it, as a photograph that the room alone lights, and finds
    this light. It then sees each photograph half as often: give more --iterations."""
    loss: Literal["l2", "l1", "log", "l1+log"] = "l1+log"
    """How the difference of predicted and observed colours is measured.
    l2: squared difference, as in the paper. l1: absolute difference, less sensitive to outliers.
    log: difference of logarithms, for dark surfaces. l1+log: the mean of l1 and log."""
    diffuse: Literal["rough", "lambert"] = "rough"
    """How matte surfaces reflect light. lambert: equally in all directions, as in the paper.
    rough: more toward the light, as wood, cloth and stone do. The fit finds how much, everywhere on the surface."""
    lobes: Literal["auto", "1", "2"] = "auto"
    """Number of lobes of the highlights, unless the BSDF of the scene says. 1: one at each point, as in the paper.
    2: a second lobe, the coat. Varnish, glaze and polished metal have a sharp highlight in a wide one.
    auto: 1, and 2 from the middle of the fit on if the photographs show a second lobe."""
    optimizer: Literal["muon", "adam"] = "muon"
    """The optimisers that train the networks. Set adam to train them as in the paper.
    muon: Muon for the hidden layers, Adam for the other weights. adam: Adam for all weights, as in the paper."""
    shape_net: Literal["ring", "resnet", "wide-resnet"] = "ring"
    """The network that deforms the start surface, in several steps. Set resnet or wide-resnet only to compare.
    ring: as in the paper "One Ring to Rule Them All". The same network makes all steps.
    resnet: each step has its own, narrower network. All together have about as many weights as the network of ring.
    wide-resnet: each step has its own network, as wide as the network of ring.
    With resnet and wide-resnet the surface may fold over."""
    encoding: Literal["linear", "octaves", "none"] = "linear"
    """Positional encoding of points in the networks of shape and material.
    linear: frequencies 1, 2, 3, … octaves: frequencies 1, 2, 4, 8, … none: no encoding, which gives little detail."""
    frequencies: int = 16
    """Number of frequencies of the positional encoding, 1 to 64 (1 to 16 for octaves).
    With more frequencies the fit can represent finer detail, and also more noise."""
    resample: bool = True
    """Sample new points of the start surface in each iteration, so that the networks learn the whole surface.
    With --no-resample all iterations use the same points."""


@dataclass(frozen=True, kw_only=True)
class Config(Ablation, Tuning, Common):
    """The settings of a fit. Settings and photographs together define the result.

    The fields are those of `mi_ring.fitting.config.Common`, `mi_ring.fitting.config.Tuning` and
    `mi_ring.fitting.config.Ablation`. `Config.preset` returns the settings of a preset. Raises InputError if a value is
    out of range.
    """

    def __post_init__(self) -> None:
        def require(condition: bool, name: str, what: str) -> None:
            if not condition:
                raise InputError(f"--{name.replace('_', '-')}: is {as_typed(getattr(self, name))[:60]}, must be {what}")

        known = get_args(Unknown)
        wanted = {"refine": f"a list of names: {', '.join(known)}", "domain": "auto, sphere, hull or (mesh, FILE)"}
        for f in dataclasses.fields(Config):  # for JSON and for calls from Python: the command line has checked them
            if get_origin(f.type) is Literal:
                wanted[f.name] = f"one of {', '.join(get_args(f.type))}"
            try:
                object.__setattr__(self, f.name, of_type(f.type, getattr(self, f.name)))
            except (ValueError, OverflowError):  # OverflowError: an integer beyond the range of floats
                require(False, f.name, wanted.get(f.name, "as mi-ring fit --help-all says"))
        require(bool(self.refine), "refine", wanted["refine"])
        object.__setattr__(self, "refine", tuple(name for name in known if name in self.refine))  # in one order
        require("none" not in self.refine or len(self.refine) == 1, "refine", "none alone, or the names of unknowns")
        both = {"power", "gain"} <= set(self.refine)
        require(not both, "refine", "without power or without gain, for they look alike")
        for name, most in MOST.items():
            require(1 <= getattr(self, name) <= most, name, f"1 to {most:,}")
        require(1 <= self.frequencies <= 64, "frequencies", "1 to 64")
        require(self.encoding != "octaves" or self.frequencies <= 16, "frequencies", "1 to 16 for octaves")
        require(0 <= self.seed < 2**63, "seed", "0 or more and below 2^63")
        require(0 <= self.laplacian_scale < math.inf, "laplacian_scale", "0 or more")
        for name in ("learning_rate", "muon_rate", "decay", "velocity_decay", "detail_rate"):
            require(0 < getattr(self, name) < math.inf, name, "above 0")
        require(0 <= self.detail_share < math.inf, "detail_share", "0 or more")
        require(0 <= self.small_lights <= MOST_LOBES, "small_lights", f"0 to {MOST_LOBES}")
        require(self.holdout == 0 or self.holdout >= 2, "holdout", "0, or 2 or more")
        require(0 <= self.subdivisions <= 8, "subdivisions", "0 to 8")
        require(bool(self.levels) and all(0 <= level <= 8 for level in self.levels), "levels", "one or more of 0 to 8")
        for name in ("widths", "shares"):
            value = getattr(self, name)
            require(len(value) == len(self.levels), name, f"as many values as --levels ({len(self.levels)})")
            require(all(v > 0 for v in value) and sum(value) < math.inf, name, "above 0")
        object.__setattr__(self, "weights", WEIGHTS | self.weights)
        for name, weight in self.weights.items():
            if not 0 <= weight < math.inf:
                raise InputError(f"--weights.{name}: is {weight}, must be 0 or more")

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "Config":
        """Return the settings of the preset `name`: `fast`, `default`, `fine` or `paper`.

        `changes`: other values for single settings. `weights` replaces only the weights that it contains. Raises
        InputError for an unknown preset and for a value that is out of range.
        """
        if name not in PRESETS:
            raise InputError(f"preset: is {name}, must be one of {', '.join(PRESETS)}")
        settings = PRESETS[name] | changes
        if "weights" in changes:
            settings["weights"] = PRESETS[name].get("weights", {}) | changes["weights"]
        return cls(**settings)

    @staticmethod
    def load(path: str | Path) -> "Config":
        """Read the settings of an earlier fit. `path`: its results folder, or the config.json in this folder.

        A setting that the file does not contain gets its default. Raises InputError, which names file and setting, for
        an unknown setting or a wrong value.
        """
        path = Path(path)
        path = path / "config.json" if path.is_dir() else path
        advice = "give the results folder of a fit, or its config.json"
        try:
            entries = json.loads(path.read_bytes())
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); {advice}") from error
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: is not JSON; {advice}") from error
        if not isinstance(entries, dict):
            raise InputError(f"{path}: holds no settings; {advice}")
        settings = {name: value for name, value in entries.items() if name not in TASK}
        if unknown := settings.keys() - {f.name for f in dataclasses.fields(Config)}:
            raise InputError(f"{path}: {min(unknown)}: is no setting of mi_ring {__version__}; remove it")
        try:
            return Config(**settings)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except RecursionError as error:  # in the message about a value of many nested lists
            raise InputError(f"{path}: holds no settings; {advice}") from error

    def settings(self) -> dict:
        """Return all settings as a dictionary that can be written as JSON."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(Config)}
        return json.loads(json.dumps(values, default=str))


#: Settings that go together, by name.
PRESETS: dict[str, dict] = {
    "fast": {
        "iterations": 140, "levels": (4, 5), "widths": (128, 256), "shares": (0.8, 0.2), "subdivisions": 5,
        "velocity_decay": 1.0,  # in so few iterations limbs are not yet in their places when it is weak
        "detail": "none",
    },
    "default": {},
    "fine": {"iterations": 1400, "shares": (0.3, 0.4, 0.3)},
    "paper": {
        "iterations": 6000, "steps": 20, "levels": (5, 6), "widths": (512, 512), "shares": (1 / 3, 2 / 3), "spp": 4,
        "weights": {"rgb": 1.0, "mask": 0.0, "velocity": 0.01},
        "loss": "l2", "optimizer": "adam", "learning_rate": 1e-4, "decay": 1.0, "velocity_decay": 1.0,
        "precision": "float32", "domain": "sphere", "masks": "given", "shadows": False, "indirect": False,
        "refine": ("none",), "detail": "none", "diffuse": "lambert", "lobes": "1", "small_lights": 0,
    },
}  # fmt: skip
