"""What a fit that goes on elsewhere needs of one that stopped."""

import copy
from typing import TYPE_CHECKING

from mi_ring.objects.ring_file import ring_state

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit


def state_of(fit: "Fit") -> dict:
    """All of it, for `torch.save`: the ring, which `ring_of` makes anew, and what `restore` takes up."""
    state = {
        "ring": ring_state(fit.ring, fit.config.settings()),
        "optimizers": [optimizer.state_dict() for optimizer in fit.optimizers],
        "random": fit.random.get_state(),
        "iteration": fit.iteration,
        "seconds": fit.seconds,
        "log": fit.log,
        "restraint": vars(fit.restraint),
        "caution": fit.caution.state(),
        "calibration": fit.calibration and fit.calibration.state_dict(),
        "averages": fit.averages.pictures,
        "confirmed": fit.confirmed,
        "outlines": fit.outlines,
        "waiting": fit.rounds.waiting,
        "lighting": tuple(fit.lighting),
    }
    return copy.deepcopy(state)  # which the next iteration would change


def restore(fit: "Fit", state: dict) -> None:
    """Have a fit that was made of the state's ring and lighting take up the rest."""
    state = copy.deepcopy(state)  # which the next iteration would change
    for optimizer, saved in zip(fit.optimizers, state["optimizers"], strict=True):
        optimizer.load_state_dict(saved)
    fit.random.set_state(state["random"])
    fit.iteration, fit.seconds, fit.log = state["iteration"], state["seconds"], state["log"]
    vars(fit.restraint).update(state["restraint"])
    fit.averages.pictures = state["averages"]
    fit.confirmed = state["confirmed"]
    fit.rounds.restore(state.get("waiting", {}))
    fit.take_outlines(state["outlines"])
    if fit.calibration:
        fit.calibration.load_state_dict(state["calibration"])
