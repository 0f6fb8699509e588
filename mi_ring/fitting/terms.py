"""The terms of the loss, each a function of an `Iteration`, and their weighted sum."""

import math
from collections.abc import Callable, Mapping
from numbers import Real
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from mi_ring.errors import InputError
from mi_ring.fitting import priors
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.losses import mask_loss, rgb_loss, velocity_loss
from mi_ring.nets.shape_net import Flow

DOUBT, SETTLED = 0.5, 0.5  #: masks of a lit room are doubted above this difference, from this progress on
PATTERNED = 0.1  #: factor of the weight `settling` if the object is probably not of one material
REGULARISED_POINTS = 512  #: points on the flow's paths, drawn anew in each iteration


class Term(NamedTuple):
    """A term of the loss: a function of an iteration, and a weight.

    `schedule`: a factor of the weight, which changes during the fit; None: 1.
    """

    function: Callable[[Iteration], Tensor | None]  #: its value, a scalar; None: it does not apply this time
    weight: float = 1.0  #: used if `Config.weights` has none of its name; 0 switches the term off
    schedule: Callable[[Iteration], float] | None = None  #: a factor of the weight, which changes during the fit


TermLike: TypeAlias = Term | Callable[[Iteration], Tensor | None]


def rgb(it: Iteration) -> Tensor:
    """Compute the term `rgb`: the difference between predicted and observed colours."""
    seen, context = it.observation, it.context
    return rgb_loss(it.prediction.rgb, seen.rgb, seen.clipped, context.exposure, context.config.loss, it.counted())


def mask(it: Iteration) -> Tensor | None:
    """Compute the term `mask`: the difference between predicted silhouettes and masks.

    Returns None if no photograph of the batch has a mask.
    """
    seen = it.observation
    masked = float(it.batch.share.sum(seen.masked.sum()))
    if not masked:
        return None
    valid = None if seen.valid is None else seen.valid[seen.masked]
    if not seen.masked.any():  # only photographs of other processes have one
        return 0 * it.prediction.coverage.sum()
    coverage = torch.where(shows(it), it.prediction.coverage, 0)[seen.masked]
    loss = mask_loss(coverage, seen.mask[seen.masked], it.outline_blur(), valid, doubt(it))
    return loss * (int(seen.masked.sum()) / masked / it.batch.share.weight) if it.batch.share.weight else loss


def shows(it: Iteration) -> Tensor:
    """Return a boolean mask (n, H, W): where the masks of an iteration's photographs would show the object.

    Masks by a threshold show only the bright part of the object, all others all of it.
    """
    seen, threshold = it.observation, it.context.capture.threshold
    if threshold is None:
        return torch.ones_like(seen.mask, dtype=torch.bool)
    return torch.maximum(seen.rgb, it.prediction.rgb.detach()).amax(-1) > threshold


def doubt(it: Iteration) -> float:
    """Return the difference between silhouette and mask above which a mask is probably wrong, see `mask_loss`.

    In a lit room a mask may, for example, contain a shadow. So large differences count less there in the second half of
    the fit.
    """
    return DOUBT if it.context.capture.lit_room and it.progress > SETTLED else math.inf


def velocity(it: Iteration) -> Tensor | None:
    """Compute the term `velocity`, the paper's L_reg, at random points on the paths of domain points through the flow.

    Returns None once the networks no longer shape the surface.
    """
    if it.stage.settles or it.stage.detail:
        return None
    net = it.context.model.ring.shape_net
    random = torch.Generator().manual_seed(it.batch.seeds["regulariser"])
    chosen = torch.randperm(len(it.batch.points), generator=random)[:REGULARISED_POINTS]
    steps = int(torch.randint(net.steps, (), generator=random))
    with torch.no_grad(), it.context.autocast():
        x = net.flow(it.batch.points[chosen], steps)
    field = net.velocity_of(steps) if isinstance(net, Flow) else net.velocity
    # Always in float32: bfloat16 is too coarse for second differences.
    return velocity_loss(field, x, it.context.config.laplacian_scale)


def calibration(it: Iteration) -> Tensor | None:
    """Compute the term `calibration`: the prior of the unknowns of calibration; None if nothing is refined."""
    calibration = it.context.model.calibration
    return calibration.prior() if calibration else None


def settling(it: Iteration) -> Tensor | None:
    """Compute the term `settling`: the variation of the material along the surface.

    It reduces slow variation, which is probably an effect of the light. Returns None except in the stage in which the
    surface is fixed.
    """
    return priors.albedo_variation(it) if it.stage.settles else None


#: What a fit minimises by default, with the weights of `Config.weights`.
default_terms: dict[str, Term] = {
    "rgb": Term(rgb),
    "mask": Term(mask),
    "velocity": Term(velocity, schedule=lambda it: it.context.regulariser),
    "calibration": Term(calibration),
    "settling": Term(settling, schedule=lambda it: 1.0 if it.context.one_material else PATTERNED),
    "normal_variation": Term(priors.normal_variation),
    "material_rank": Term(priors.material_rank),
}
WITHOUT_PHOTOGRAPHS = set(default_terms) - {"rgb", "mask"}  #: terms that do not compare with photographs
#: Names of the log's other entries.
RESERVED = {"iteration", "seconds", "loss", "weights", "learning_rate", "stage", "vertices", "crossing", "unexplained",
            "second_lobe"}  # fmt: skip


class Loss:
    """The loss: the weighted sum of its terms. Call it with an `Iteration`. It returns a scalar tensor."""

    def __init__(self, terms: Mapping[str, TermLike] | None, weights: Mapping[str, float]) -> None:
        """Make a loss. `terms`: by name; None: `default_terms`. `weights`: by name of the term.

        Raises InputError for something that is no term, for a reserved name, for a weight whose term does not exist,
        and if no term with a weight above 0 compares the surface with photographs.
        """
        given = default_terms if terms is None else terms
        if not isinstance(given, Mapping):
            raise InputError(f"terms: is {type(given).__name__}, must be a dict of terms by their names")
        self.terms = {name: term if isinstance(term, Term) else Term(term) for name, term in given.items()}
        self.weights = weights
        for name, (function, own, schedule) in self.terms.items():
            usable = isinstance(name, str) and isinstance(own, Real) and math.isfinite(own)
            if not (usable and callable(function) and (schedule is None or callable(schedule))):
                raise InputError(f"terms: {name}: must be a function, or a Term of a function, a finite weight and a "
                                 "function that gives its factor")  # fmt: skip
        if reserved := self.terms.keys() & RESERVED:
            raise InputError(f"terms: {min(reserved)}: the log has an entry of that name; give the term another")
        if not any(self.weight(name) for name in self.terms.keys() - WITHOUT_PHOTOGRAPHS):
            raise InputError("weights: no term compares the surface with the photographs; give rgb or mask one above 0")
        if unknown := set(weights) - set(default_terms) - set(self.terms):
            raise InputError(f"weights: {min(unknown)}: there is no such term; there are {', '.join(self.terms)}")

    @property
    def usual(self) -> bool:
        """Return True if the terms `rgb` and `mask` are the default ones, or left out."""
        return all(self.terms.get(name, default_terms[name]) is default_terms[name] for name in ("rgb", "mask"))

    def weight(self, name: str) -> float:
        """Return the weight of the term `name`; 0 if there is no such term.

        The factor that changes during the fit is not included.
        """
        return self.weights.get(name, self.terms[name].weight) if name in self.terms else 0.0

    def require_velocity(self, shape_net: Flow) -> None:
        """Raise InputError if the term `velocity` is used but the network `shape_net` has no method `velocity`."""
        needed = self.terms.get("velocity") is default_terms["velocity"] and self.weight("velocity") > 0
        if needed and not hasattr(shape_net, "velocity"):
            raise InputError(f"networks: {type(shape_net).__name__}: has no velocity, which the term of that name "
                             "needs; give it one, or the term the weight 0")  # fmt: skip

    def __call__(self, it: Iteration) -> Tensor:
        """Compute this process's part of the loss. Returns a scalar; the parts of all processes add up to the loss.

        Writes the loss of all processes, its terms and their weights into `it`. Raises InputError if a term returns
        anything but a scalar tensor or None.
        """
        loss, values = torch.zeros((), device=it.batch.points.device), dict.fromkeys(self.terms, (0.0, 0.0))
        for name, term in self.terms.items():
            weight = self.weight(name)
            value = term.function(it) if weight else None
            if value is None:
                continue
            if not isinstance(value, Tensor) or value.ndim:
                raise InputError(f"terms: {name}: must give a scalar tensor or None, not {type(value).__name__} "
                                 f"{tuple(getattr(value, 'shape', ()))}")  # fmt: skip
            it.weights[name] = weight * (term.schedule(it) if term.schedule else 1.0)
            values[name] = float(value.detach()), 1.0
            loss = loss + it.weights[name] * value
        loss = loss * it.batch.share.weight
        found = torch.tensor([*values.values(), (float(loss.detach()), 1.0)], dtype=torch.double)
        found[:-1, 0] *= it.batch.share.weight
        *sums, (it.loss, _) = it.batch.share.sum(found).tolist()
        it.terms = {name: value for name, (value, times) in zip(values, sums) if times}
        return loss
