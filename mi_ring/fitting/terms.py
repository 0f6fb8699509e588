"""The terms of the loss. All are means, so that their weights do not depend on sizes.

Small pure functions of tensors, and what a fit makes of them: `default_terms`, functions of an `Iteration`.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from mi_ring.fitting import priors
from mi_ring.fitting.iteration import Iteration
from mi_ring.images import blur
from mi_ring.nets.shape_net import Flow

DOUBT, SETTLED = 0.5, 0.5  #: of masks in a lit room: the difference that is too large, and from which progress on
PATTERNED = 0.1  #: weight of the variation of a material that varies, by that of one that hardly does
REGULARISED_POINTS = 512  #: of the flow's paths, drawn anew in each iteration


def perceived(photographs: Tensor, exposure: float, kind: str) -> Tensor:
    """Radiance as `kind` of the losses of colours compares it, in units of `exposure`."""
    linear = photographs / exposure
    if kind in ("l2", "l1"):
        return linear
    log = (4 * linear).clamp(min=-0.5).log1p()
    return log if kind == "log" else (linear + log) / 2  # both rise, so this is the mean of two losses


def colour_error(
    predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str, telling: Tensor | None = None
) -> Tensor:
    """By how much predicted photographs (n, H, W, 3) are brighter than observed ones, `perceived`.

    Where `clipped` (n, H, W, 3) the scene was at least as bright as observed: a brighter prediction is no error. Where
    not `telling` (n, H, W) nothing is.
    """
    error = perceived(predicted, exposure, kind) - perceived(observed, exposure, kind)
    error = torch.where(clipped, error.clamp(max=0), error)
    return error if telling is None else error * telling[..., None]


def rgb_loss(
    predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str, telling: Tensor | None = None
) -> Tensor:
    """L_rgb: how far predicted photographs (n, H, W, 3) are from observed ones, in units of `exposure`.

    Arguments as of `colour_error`. `kind`: `l2` squares (the paper), `l1` is robust, `log` is robust and compares
    ratios rather than differences, so that dim surfaces seen at a slant count as much as bright ones, `l1+log` is the
    mean of both.
    """
    error = colour_error(predicted, observed, clipped, exposure, kind, telling)
    return error.square().mean() if kind == "l2" else error.abs().mean()


def mask_loss(
    coverage: Tensor, mask: Tensor, sigma: float, valid: Tensor | None = None, doubt: float = math.inf
) -> Tensor:
    """Squared difference of coverage and mask (n, H, W), blurred by a Gaussian of `sigma` [px].

    The blur lets an outline feel a mask that it does not touch yet. Where not `valid` (n, H, W) there is no difference.
    Differences beyond `doubt` count less and less ("Statistical Methods for Tomographic Image Reconstruction", Geman
    and McClure 1987): a mask is wrong there.
    """
    difference = coverage - mask if valid is None else (coverage - mask) * valid
    square = blur(difference, sigma).square()
    return (square / (1 + square / doubt**2)).mean()


def velocity_loss(
    velocity: Callable[[Tensor], Tensor], x: Tensor, laplacian_scale: float, step: float = 0.02
) -> Tensor:
    """L_reg = mean ‖(I − αΔ) V(x)‖² at points x (n, 3) of the flow's paths, α = `laplacian_scale`.

    The Laplacian over ℝ³ is the seven-point stencil of width `step`, small against the period of the highest frequency.
    """
    offsets = step * torch.cat([torch.eye(3), -torch.eye(3)]).to(x)
    v = velocity(torch.cat([x[None], x + offsets[:, None]]))
    laplacian = (v[1:] - v[0]).sum(0) / step**2
    return (v[0] - laplacian_scale * laplacian).square().sum(-1).mean()


class Term(NamedTuple):
    """A term of the loss."""

    function: Callable[[Iteration], Tensor | None]  #: its value, a scalar; None: it has nothing to say this time
    weight: float = 1.0  #: where `Config.weights` has none of its name; 0 switches it off
    schedule: Callable[[Iteration], float] | None = None  #: a factor of the weight in the course of the fit


def telling(it: Iteration) -> Tensor | None:
    """(n, H, W) bool: where colours count; None: everywhere.

    In a room that was not black, what is not wholly object by its mask and by its prediction could be anything.
    """
    return it.surely() if it.fit.capture.lit_room else None


def rgb(it: Iteration) -> Tensor:
    """Colours: predicted photographs against observed ones."""
    return rgb_loss(it.predicted, it.observed, it.clipped, it.fit.exposure, it.fit.config.loss, telling(it))


def outline_blur(it: Iteration) -> float:
    """Standard deviation [px] of the blur of silhouettes: it shrinks, to a pixel for the last fifth of the fit."""
    width = it.fit.capture.shots[it.index[0]].size[0] / it.scale
    return max(1.0, it.fit.config.blur * (1 - it.progress / 0.8) * width)


def mask(it: Iteration) -> Tensor | None:
    """Silhouettes, of the photographs that have a mask.

    In a room that was not black masks are guesses: once the shape has settled, what most of them say outweighs one that
    fills a handle with its shadow.
    """
    masked = float(it.share.sum(it.masked.sum()))
    if not masked:
        return None
    coverage, threshold = it.coverage, it.fit.capture.threshold
    if threshold is not None:  # of the object, such masks show what is bright
        lit = torch.maximum(it.observed, it.predicted.detach()).amax(-1) > threshold
        coverage = torch.where(lit, coverage, 0)
    valid = None if it.valid is None else it.valid[it.masked]
    doubt = DOUBT if it.fit.capture.lit_room and it.progress > SETTLED else math.inf
    if not it.masked.any():  # only photographs of other processes have one
        return 0 * it.coverage.sum()
    loss = mask_loss(coverage[it.masked], it.mask[it.masked], outline_blur(it), valid, doubt)
    return loss * (int(it.masked.sum()) / masked / it.share.weight) if it.share.weight else loss


def velocity(it: Iteration) -> Tensor | None:
    """L_reg at random points of the paths of the domain points, random in time, as long as they move."""
    if it.stage.settles:
        return None
    fit, net = it.fit, it.fit.ring.shape_net
    chosen = torch.randperm(len(it.s), generator=fit.random)[:REGULARISED_POINTS]
    steps = int(torch.randint(net.steps, (), generator=fit.random))
    with torch.no_grad(), fit.autocast():
        x = net.flow(it.s[chosen], steps)
    field = net.velocity_of(steps) if isinstance(net, Flow) else net.velocity
    # The velocity in float32 always: its second differences would drown in bfloat16.
    return velocity_loss(field, x, fit.config.laplacian_scale)


def calibration(it: Iteration) -> Tensor | None:
    """The prior of what is refined besides surface and material."""
    return it.fit.calibration.prior() if it.fit.calibration else None


def settling(it: Iteration) -> Tensor | None:
    """Variation of the material once the surface stands still: what varies slowly is more likely light."""
    return priors.albedo_variation(it) if it.stage.settles else None


def plainness(it: Iteration) -> float:
    """How much is to be said for one material: less where a coarse fit was better off with many."""
    return 1.0 if it.fit.lighting.plain else PATTERNED


def strength(it: Iteration) -> float:
    """Of the regulariser, as `mi_ring.fitting.restraint` has it."""
    return it.fit.restraint.strength(it.fit.config.velocity_decay)


#: What a fit minimises unless told otherwise. Their weights are those of `Config.weights`.
default_terms: dict[str, Term] = {
    "rgb": Term(rgb),
    "mask": Term(mask),
    "velocity": Term(velocity, schedule=strength),
    "calibration": Term(calibration),
    "settling": Term(settling, schedule=plainness),
    "normal_variation": Term(priors.normal_variation),
    "material_variation": Term(priors.material_variation),
    "material_rank": Term(priors.material_rank),
}
