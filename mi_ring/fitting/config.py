"""What the user chooses of a fit: one frozen dataclass, whose docstrings are the command's help."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from mi_ring.errors import InputError

#: Weights of the default terms of the loss; what is not given of `Config.weights` is one of these.
WEIGHTS = {
    "rgb": 1.0, "mask": 5.0, "velocity": 0.01, "calibration": 1e-3, "settling": 0.03,
    "normal_variation": 0.0, "material_rank": 0.0,
}  # fmt: skip


#: What `Config.refine` may have.
Unknown = Literal[
    "auto", "none", "cameras", "focal", "principal", "distortion", "light", "power", "gain", "falloff", "vignetting",
    "curve", "contrast", "scale", "ambient", "lamps", "masks",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Config:
    """The settings of a fit: all that defines its result but the photographs.

    Raises InputError for what is out of range. `Config.preset` gives settings that go together.
    """

    domain: Literal["auto", "sphere", "hull"] | tuple[Literal["mesh"], Path] = "auto"
    """The surface that is deformed. hull: the visual hull of the masks; mesh FILE: a closed mesh, in scene units; auto:
    the scene's own if it names one, else the hull, or the sphere where there are no masks to make one of."""
    masks: Literal["auto", "given", "none"] = "auto"
    """Which masks the command reads photographs with, as `load_capture` does from Python. given: those of the scene,
    if any; auto: the same, but if it has none the object is what is brighter than a dark room; none: as if it had none,
    which finds them in a dark room, too; --weights.mask 0 does without any."""
    light: Literal["capture", "environment", "turntable", "lamps", "auto"] = "capture"
    """What lights the object. capture: the lights that the scene says. Else they are unknown: environment: light from
    everywhere, fixed in the world; turntable: the same, fixed in the camera; lamps: one to three, fixed in the world,
    as coarse fits find them; auto: what explains the photographs best in coarse fits."""
    seed: int = 0
    """Random seed."""
    iterations: int = 460
    """Number of iterations, shared out among the stages. From a hull or a mesh it is fewer, see --shares; under an
    unknown environment 15 % more, while the surface stands still."""
    levels: tuple[int, ...] = (4, 5, 6)
    """Icosphere level of each stage: 10 · 4^level + 2 vertices."""
    widths: tuple[int, ...] = (128, 256, 512)
    """Width of the photographs in each stage, at most [px]."""
    shares: tuple[float, ...] = (0.45, 0.46, 0.09)
    """Share of the iterations of each stage. A hull or a mesh is near the object already: from there two thirds of the
    first stage are exchanged for 40 % as many iterations of the second, which take about as long."""
    batch: int = 8
    """Photographs per iteration."""
    steps: int = 3
    """Euler steps of the flow, the paper's T."""
    shape_net: Literal["ring", "resnet", "wide-resnet"] = "ring"
    """ring: the paper's flow, one velocity field for all steps. To compare, as many blocks with weights of their own,
    which is no flow: resnet: narrow ones, of as many parameters together; wide-resnet: of the ring's width."""
    encoding: Literal["linear", "octaves", "none"] = "linear"
    """Positional encoding of both networks. linear: frequencies 1, 2, 3, …; octaves: 1, 2, 4, 8, …; none: none."""
    frequencies: int = 16
    """How many frequencies the encoding has."""
    resample: bool = True
    """Have the vertices at other points of the start surface in each iteration? The sphere is randomly rotated."""
    spp: int = 1
    """Samples per pixel."""
    loss: Literal["l2", "l1", "log", "l1+log"] = "l1+log"
    """How predicted and observed radiance are compared. l2: squared differences, the paper's; l1: absolute ones, which
    few pixels that no surface explains do not rule; log: of logarithms, for what is dark; l1+log: the mean of both."""
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Parameters of the scene's BSDF to predict, each with its lowest and highest value (inf: none), for instance
    base_color 0 1 roughness 0.05 1. Default: the five numbers of cooktorrance."""
    shadows: bool = True
    """Is a point lit only if it sees its photograph's light, while fitting? The scene's own lamps cast shadows in any
    case, and pictures of the result follow the scene's integrator."""
    indirect: bool = True
    """Add interreflection to the predictions. The lights' intensities must be true, else it is wrong or left out."""
    weights: dict[str, float] = field(default_factory=lambda: dict(WEIGHTS))
    """Weight of each term of the loss; 0 switches a term off. rgb: colours; mask: silhouettes; velocity: how smooth the
    flow is, the paper's lambda; calibration: how far what is refined is from what the scene says; settling: how
    much the material varies, at the end under an unknown environment. Priors, off by default: normal_variation: edges
    rather than curves; material_rank: mixtures of few basis materials."""
    velocity_decay: float = 0.03
    """The weight of the regulariser falls exponentially to this share: strong at first, which keeps the surface smooth
    while it finds its place, weak at the end, for details. It is held back while the surface crosses itself, and while
    much of the light is unexplained."""
    laplacian_scale: float = 0.01
    """The paper's alpha: how much the regulariser smoothes the velocity field."""
    optimizer: Literal["muon", "adam"] = "muon"
    """muon: Muon for the hidden weights, Adam for the rest. adam: Adam for all."""
    learning_rate: float = 3e-3
    """Learning rate of Adam."""
    muon_rate: float = 3e-2
    """Learning rate of Muon."""
    decay: float = 0.1
    """The learning rates fall exponentially to this share; those of cameras to a half."""
    precision: Literal["auto", "bfloat16", "float32"] = "auto"
    """Precision of matrix products, of networks and of Muon. auto: bfloat16 where that is faster (processors with AMX,
    AMD's from Zen 4 on with PyTorch 2.10 or newer, newer GPUs). Muon's are never in one that is slower."""
    subdivisions: int = 6
    """Level of the mesh that is written."""
    refine: tuple[Unknown, ...] = ("auto",)
    """What else is unknown. cameras: their places and directions; focal, principal: focal length and principal point of
    each lens; distortion: how much each lens bends lines, its first radial one; light: where a flash is that moves with
    the camera, else the place or direction of each light; power: strength and colour of the light, photograph by
    photograph; gain: how much each photograph records of it, by exposure and white balance; falloff: how much less a
    flash shines to the sides; vignetting: how much darker the lens is toward the borders; curve: one exponent of the
    camera's, for all; contrast: how steep the S of a curve as of film is; scale: the power of all lights together, by
    interreflection; ambient: the light of the room, which is the same for all, fixed in the world, or in the camera if
    the scene has a `room` in its axes, as that of a turntable has; lamps: places and strengths of the scene's point and
    directional emitters, which light all photographs; masks: the object's outlines in the photographs,
    found anew about the surface at half and at three quarters of the fit. auto: light (of a flash that moves with the
    camera what is beside the lens, not how far ahead), power (unless gain is given) and ambient (unless it is
    subtracted), and scale where lights cannot be as strong as the scene says; under an unknown light, or where
    photographs have none of their own, gain, and ambient unless lamps light them; nothing if the scene says that it is
    calibrated. none: nothing."""
    holdout: int = 0
    """Keep one photograph of so many out of the fit, from the middle of the first so many on: by 8 the fifth, the
    thirteenth, and so on. What is refined for all must explain them better than before, else it is put back.
    0: none."""
    deterministic: bool = False
    """The same result bit for bit on the same machine, on one thread."""

    def __post_init__(self) -> None:
        def require(condition: bool, name: str, what: str) -> None:
            if not condition:
                raise InputError(f"--{name.replace('_', '-')}: is {as_typed(getattr(self, name))}, must be {what}")

        require(not isinstance(self.refine, str), "refine", "a tuple of names")
        known = get_args(Unknown)
        require(bool(self.refine) and set(self.refine) <= set(known), "refine", f"some of {', '.join(known)}")
        object.__setattr__(self, "refine", tuple(name for name in known if name in self.refine))  # in one order
        require("none" not in self.refine or len(self.refine) == 1, "refine", "none alone, or the names of unknowns")
        both = {"power", "gain"} <= set(self.refine)
        require(not both, "refine", "without power or without gain, for they look alike")

        for f in dataclasses.fields(Config):  # from Python nobody else has checked them
            if get_origin(f.type) is Literal:
                allowed = get_args(f.type)
                require(getattr(self, f.name) in allowed, f.name, f"one of {', '.join(allowed)}")
        if isinstance(self.domain, tuple | list) and len(self.domain) == 2 and self.domain[0] == "mesh":
            object.__setattr__(self, "domain", ("mesh", Path(self.domain[1])))
        else:
            require(self.domain in ("auto", "sphere", "hull"), "domain", "auto, sphere, hull or (mesh, FILE)")
        for name in ("iterations", "steps", "batch", "spp"):
            require(getattr(self, name) >= 1, name, "at least 1")
        require(1 <= self.frequencies <= 64, "frequencies", "1 to 64")
        require(self.encoding != "octaves" or self.frequencies <= 16, "frequencies", "1 to 16 for octaves")
        require(0 <= self.seed < 2**63, "seed", "0 or more and below 2^63")
        require(0 <= self.laplacian_scale < math.inf, "laplacian_scale", "0 or more")
        for name in ("learning_rate", "muon_rate", "decay", "velocity_decay"):
            require(0 < getattr(self, name) < math.inf, name, "above 0")
        require(self.holdout == 0 or self.holdout >= 2, "holdout", "0, or 2 or more")
        require(0 <= self.subdivisions <= 8, "subdivisions", "0 to 8")
        require(bool(self.levels) and all(0 <= level <= 8 for level in self.levels), "levels", "one or more of 0 to 8")
        for name in ("widths", "shares"):
            value = getattr(self, name)
            require(len(value) == len(self.levels), name, f"as many values as --levels ({len(self.levels)})")
            require(all(0 < v < math.inf for v in value), name, "above 0")
        object.__setattr__(self, "weights", WEIGHTS | self.weights)
        for name, weight in self.weights.items():
            if not 0 <= weight < math.inf:
                raise InputError(f"--weights.{name}: is {weight}, must be 0 or more")

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "Config":
        """The settings of a preset, `fast`, `default`, `fine` or `paper`, but for these changes.

        Of `weights` only those that are given change. Raises InputError for another name.
        """
        if name not in PRESETS:
            raise InputError(f"preset: is {name}, must be one of {', '.join(PRESETS)}")
        settings = PRESETS[name] | changes
        if "weights" in changes:
            settings["weights"] = PRESETS[name].get("weights", {}) | changes["weights"]
        return cls(**settings)

    def settings(self) -> dict:
        """All settings as plain data."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(Config)}
        return json.loads(json.dumps(values, default=str))


def as_typed(value: Any) -> str:
    """A setting's value as the command line has it, more or less."""
    if isinstance(value, dict):
        value = [word for item in value.items() for word in item]
    if isinstance(value, (tuple, list)):
        return " ".join(map(as_typed, value)) or "empty"
    return str(value)


#: Settings that go together, by name.
PRESETS: dict[str, dict] = {
    "fast": {
        "iterations": 140, "levels": (4, 5), "widths": (128, 256), "shares": (0.8, 0.2), "subdivisions": 5,
        "velocity_decay": 1.0,  # in so few iterations limbs are not yet in their places when it is weak
    },
    "default": {},
    "fine": {"iterations": 1400, "shares": (0.3, 0.4, 0.3)},
    "paper": {
        "iterations": 6000, "steps": 20, "levels": (5, 6), "widths": (512, 512), "shares": (1 / 3, 2 / 3), "spp": 4,
        "weights": {"rgb": 1.0, "mask": 0.0, "velocity": 0.01},
        "loss": "l2", "optimizer": "adam", "learning_rate": 1e-4, "decay": 1.0, "velocity_decay": 1.0,
        "precision": "float32", "domain": "sphere", "masks": "given", "shadows": False, "indirect": False,
        "refine": ("none",),
    },
}  # fmt: skip
