"""What the user chooses: one frozen dataclass is the command line, its docstrings the help text."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from tyro.conf import Positional, arg

from mi_ring.command import name_of
from mi_ring.errors import InputError

HEAD_START = 2 / 3  #: share of the first stage's iterations that a start near the object makes unnecessary
EXCHANGE = 0.4  #: iterations of the second stage that it gets for each; by the presets they take about as long


class Stage(NamedTuple):
    """One stage of coarse to fine."""

    level: int  #: of the icosphere
    width: int  #: of the photographs, at most [px]
    first: int  #: iteration
    last: int  #: iteration after the last


@dataclass(frozen=True)
class Config:
    """Reconstruct an object: photographs in, a watertight mesh with a spatially varying material out."""

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs."""
    out: Path | None = None
    """Folder of the results. Default: out/<name>, the name of the scene file, or of its folder if it is scene.xml."""
    resume: bool = False
    """Go on from the folder's checkpoint.pt. Give the same settings as before."""
    preset: Literal["fast", "default", "fine", "paper"] = "default"
    """Settings that go together; each can be overridden. paper: the paper's own, seven hours on two cores."""
    domain: Literal["auto", "sphere", "hull"] | tuple[Literal["mesh"], Path] = "auto"
    """The surface that is deformed. hull: the visual hull of the masks; mesh FILE: a closed mesh, in scene units; auto:
    the scene's own if it names one, else the hull where it has handles, which a sphere can never get."""
    masks: Literal["auto", "given", "none"] = "auto"
    """given: those of the scene, if any; auto: the same, but if it has none the object is what is brighter than a dark
    room; none: as if it had none, which finds them in a dark room, too; --weights.mask 0 does without any."""
    seed: int = 0
    """Of every random choice."""
    iterations: int = 360
    """In all, shared out among the stages. From a hull or a mesh it is fewer, see --shares."""
    levels: tuple[int, ...] = (4, 5, 6)
    """Icosphere level of each stage: 10 · 4^level + 2 vertices."""
    widths: tuple[int, ...] = (128, 256, 512)
    """Width of the photographs in each stage, at most [px]."""
    shares: tuple[float, ...] = (0.45, 0.46, 0.09)
    """Share of the iterations of each stage. A hull or a mesh is near the object already: from there two thirds of the
    first stage are exchanged for 40 % as many iterations of the second, which take about as long."""
    batch: int = 8
    """Photographs per iteration."""
    steps: int = 5
    """Euler steps of the flow, the paper's T."""
    spp: int = 1
    """Samples per pixel."""
    loss: Literal["l2", "l1", "log", "l1+log"] = "l1+log"
    """How predicted and observed radiance are compared. l2: squared differences, the paper's; l1: absolute ones, which
    few pixels that no surface explains do not rule; log: of logarithms, for what is dark; l1+log: the mean of both."""
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Parameters of the scene's BSDF to predict, each with its lowest and highest value (inf: none), for instance
    base_color 0 1 roughness 0.05 1. Default: the five numbers of cooktorrance."""
    shadows: bool = True
    """Is a point lit only if it sees the light, while fitting? Pictures of the result follow the scene's integrator."""
    indirect: bool = True
    """Add interreflection to the predictions. The lights' intensities must be true, else it is wrong or left out."""
    weights: dict[str, float] = field(default_factory=lambda: {"rgb": 1.0, "mask": 5.0, "velocity": 0.01})
    """Weight of each term of the loss; 0 switches a term off. rgb: colours; mask: silhouettes; velocity: how smooth the
    flow is, the paper's lambda."""
    velocity_decay: float = 0.03
    """The weight of the regulariser falls exponentially to this share: strong at first, which keeps the surface smooth
    while it finds its place, weak at the end, for details."""
    laplacian_scale: float = 0.01
    """The paper's alpha: how much the regulariser smoothes the velocity field."""
    blur: float = 0.06
    """Blur of the mask loss at the start, as a share of the photograph's width; it shrinks to a pixel."""
    optimizer: Literal["muon", "adam"] = "muon"
    """muon: Muon for the hidden weights, Adam for the rest. adam: Adam for all."""
    learning_rate: float = 3e-3
    """Of Adam."""
    muon_rate: float = 3e-2
    """Learning rate of Muon."""
    decay: float = 0.1
    """The learning rates fall exponentially to this share."""
    precision: Literal["auto", "bfloat16", "float32"] = "auto"
    """Of the networks' matrix products. auto: bfloat16 where that is faster (processors with AMX, newer GPUs)."""
    subdivisions: int = 6
    """Level of the mesh that is written."""
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = "llvm_ad_rgb"
    """Of Mitsuba, and with it of torch: llvm_ad_rgb computes on the processor, cuda_ad_rgb on a GPU if there is one."""
    threads: int = 0
    """Processor threads of the fit; 0: all."""
    deterministic: bool = False
    """The same result bit for bit on the same machine, on one thread."""

    def __post_init__(self):
        def require(condition: bool, name: str, what: str) -> None:
            if not condition:
                raise InputError(f"--{name.replace('_', '-')}: is {getattr(self, name)}, must be {what}")

        for name in ("iterations", "steps", "batch", "spp"):
            require(getattr(self, name) >= 1, name, "at least 1")
        if self.deterministic and self.variant != "llvm_ad_rgb":
            raise InputError("--deterministic: needs --variant llvm_ad_rgb; a GPU adds numbers in an order of its own")
        require(0 <= self.seed < 2**63, "seed", "0 or more and below 2^63")
        for name in ("threads", "blur", "laplacian_scale"):
            require(0 <= getattr(self, name) < math.inf, name, "0 or more")
        for name in ("learning_rate", "muon_rate", "decay", "velocity_decay"):
            require(0 < getattr(self, name) < math.inf, name, "above 0")
        require(0 <= self.subdivisions <= 8, "subdivisions", "0 to 8")
        require(bool(self.levels) and all(0 <= level <= 8 for level in self.levels), "levels", "one or more of 0 to 8")
        for name in ("widths", "shares"):
            value = getattr(self, name)
            require(len(value) == len(self.levels), name, f"as many values as --levels ({len(self.levels)})")
            require(all(0 < v < math.inf for v in value), name, "above 0")
        unknown = set(self.weights) - {"rgb", "mask", "velocity"}
        require(not unknown, "weights", "of rgb, mask and velocity")
        require(all(0 <= w < math.inf for w in self.weights.values()), "weights", "0 or more")

    @property
    def name(self) -> str:
        """Of the scene."""
        return name_of(self.scene)

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self.out or Path("out") / self.name

    def stages(self, near: bool = False) -> list[Stage]:
        """Those stages that get at least one iteration, in order, from a start that is `near` the object or far."""
        shares = list(self.shares)
        if near and len(shares) > 1:
            shares[1] += EXCHANGE * HEAD_START * shares[0]
            shares[0] -= HEAD_START * shares[0]
        total, done, first, stages = sum(self.shares), 0.0, 0, []
        for level, width, share in zip(self.levels, self.widths, shares):
            done += share
            last = round(self.iterations * done / total)
            stages.append(Stage(level, width, first, last))
            first = last
        return [stage for stage in stages if stage.last > stage.first]

    def weights_at(self, progress: float) -> dict[str, float]:
        """Weight of each term of the loss when this share of the iterations is done."""
        relax = {"velocity": self.velocity_decay**progress}
        return {term: weight * relax.get(term, 1.0) for term, weight in self.weights.items()}

    def settings(self) -> dict:
        """What defines the result, as plain data: all but where it goes and what computes it."""
        plain = json.loads(self.to_json())
        elsewhere = ("scene", "out", "resume", "variant", "threads")
        return {key: value for key, value in plain.items() if key not in elsewhere}

    def to_json(self) -> str:
        """Every option as used."""
        return json.dumps(dataclasses.asdict(self), indent=2, default=str)


PRESETS = {
    "fast": {
        "iterations": 120, "levels": (4, 5), "widths": (128, 256), "shares": (0.85, 0.15), "subdivisions": 5,
        "velocity_decay": 1.0,  # in so few iterations limbs are not yet in their places when it is weak
    },
    "default": {},
    "fine": {"iterations": 1000, "shares": (0.3, 0.4, 0.3)},
    "paper": {
        "iterations": 6000, "steps": 20, "levels": (5, 6), "widths": (512, 512), "shares": (1 / 3, 2 / 3), "spp": 4,
        "weights": {"rgb": 1.0, "mask": 0.0, "velocity": 0.01},
        "loss": "l2", "optimizer": "adam", "learning_rate": 1e-4, "decay": 1.0, "velocity_decay": 1.0,
        "precision": "float32", "domain": "sphere", "masks": "given", "shadows": False, "indirect": False,
    },
}  # fmt: skip
