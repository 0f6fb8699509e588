"""How the flow's differential equation ẋ = V(x) is solved: steps of fixed length, and an adaptive solver."""

from collections.abc import Callable

import torch
from torch import Tensor

from mi_ring.errors import InputError

TOLERANCE = 1e-5  #: of the adaptive solver, absolute (in the normalised frame) and relative

Velocity = Callable[[Tensor], Tensor]


def euler(velocity: Velocity, x: Tensor, time: float) -> Tensor:
    """From points x (V, 3) by one step of length `time`; its error is of first order in the length of the steps."""
    return x + time * velocity(x)


def midpoint(velocity: Velocity, x: Tensor, time: float) -> Tensor:
    """The same with two velocities, of second order."""
    return x + time * velocity(x + time / 2 * velocity(x))


def rk4(velocity: Velocity, x: Tensor, time: float) -> Tensor:
    """The same with four velocities, of fourth order: the classical method of Runge and Kutta."""
    a = velocity(x)
    b = velocity(x + time / 2 * a)
    c = velocity(x + time / 2 * b)
    d = velocity(x + time * c)
    return x + time / 6 * (a + 2 * b + 2 * c + d)


def dopri5(velocity: Velocity, x: Tensor, time: float) -> Tensor:
    """The same by as many steps as `TOLERANCE` asks for: Dormand and Prince (1980), by the package torchdiffeq.

    Step lengths are chosen for all points together. It computes in float32 at least: by the rounding of bfloat16 no
    step would be short enough.
    """
    if time == 0:
        return x
    with torch.autocast(x.device.type, enabled=False):
        times = x.new_tensor([0.0, time])
        return odeint()(lambda _, y: velocity(y), x, times, rtol=TOLERANCE, atol=TOLERANCE, method="dopri5")[-1]


def odeint() -> Callable:
    """Of torchdiffeq. Raises InputError if that is not installed."""
    try:
        from torchdiffeq import odeint
    except ModuleNotFoundError as error:
        if error.name != "torchdiffeq":
            raise
        raise InputError("the adaptive solver, dopri5: needs the package torchdiffeq, which is not installed; try "
                         "`pip install torchdiffeq`") from error  # fmt: skip
    return odeint


#: By name.
SOLVERS: dict[str, Callable[[Velocity, Tensor, float], Tensor]] = {
    "euler": euler, "midpoint": midpoint, "rk4": rk4, "dopri5": dopri5,
}  # fmt: skip
