"""Data parallelism: the processes that `torchrun` starts share the work of each iteration.

All processes draw the same random numbers, hold the same networks and make the same steps. Each process evaluates the
networks at some of the points and renders some of the photographs. Losses and gradients are summed over all processes
(synchronous data parallelism, "Accurate, Large Minibatch SGD", Goyal et al. 2017). Only the first process writes and
prints. No other module uses torch.distributed.
"""

import atexit
import contextlib
import functools
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from mi_ring.errors import InputError
from mi_ring.system.gpus import OWN
from mi_ring.system.machine import cores, device

Value = TypeVar("Value")


class ProcessLost(InputError):
    """Error: another process of the fit has ended or cannot be reached. No results are written then."""


class Processes:
    """Communication between the processes of a fit. This class is for a fit with one process: it sends nothing."""

    count, rank = 1, 0  #: number of processes, and the number of this one
    on_this_machine = 1  #: processes on this machine
    exchanged, exchanges = 0, 0  #: bytes that this process has sent to sums so far, and the number of sums

    @property
    def threads(self) -> int:
        """Number of processor threads for this process."""
        return max(1, cores() // self.on_this_machine)

    def sum(self, tensor: Tensor) -> Tensor:
        """Sum a tensor over all processes. Returns the sum in each process. All tensors must have the same shape."""
        return tensor

    def broadcast(self, value: Value) -> Value:
        """Return the first process's `value` in all processes. The value must be picklable."""
        return value

    def agreed(self, work: Callable[[], Value]) -> Value:
        """Call `work` in each process. Returns this process's result.

        If `work` raises InputError in one process, all processes raise it.
        """
        return work()

    def on_first(self, work: Callable[[], Value]) -> Value:
        """Call `work` in the first process only. Returns its result in all processes.

        An InputError or SystemExit of `work` is raised in all processes.
        """
        return work()

    def maximum(self, number: int) -> int:
        """Return the largest `number` of all processes."""
        return number

    def barrier(self) -> None:
        """Wait until all processes have called this method."""

    def share(self, total: int) -> "Share":
        """Return this process's share of `total` photographs or points, which are divided among all processes."""
        return Share(self, total)

    def sum_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Replace the gradient of each parameter, in place, by its sum over all processes.

        The gradient stays None if no process has one.
        """


class Team(Processes):
    """Communication between several processes, by torch.distributed."""

    def __init__(self) -> None:
        import torch.distributed as distributed

        self.distributed = distributed
        self.rank, self.count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        self.on_this_machine = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        # NCCL needs a GPU of its own for each process. Objects that are no tensors go through the processor.
        own = self.on_this_machine == 1 or os.environ.get(OWN) == "1"
        self.nccl = own and torch.cuda.is_available() and distributed.is_nccl_available()
        distributed.init_process_group("cpu:gloo,cuda:nccl" if self.nccl else "gloo")
        atexit.register(self.leave)

    def leave(self) -> None:
        """Leave the group of processes, when this process ends. A process cannot join a group twice."""
        with contextlib.suppress(RuntimeError):
            self.distributed.destroy_process_group()

    def attempt(self, exchange: Callable[[], None]) -> None:
        """Call `exchange`, which communicates with other processes. Raises ProcessLost if another process is gone."""
        try:
            exchange()
        except RuntimeError as error:
            raise ProcessLost("another process of this fit has ended or is out of reach; go on from the last "
                              "checkpoint with the same command and --resume") from error  # fmt: skip

    def sum(self, tensor: Tensor) -> Tensor:
        """Sum a tensor over all processes. Returns the sum in each process, without gradients.

        All tensors have the same shape.
        """
        place = device() if self.nccl else torch.device("cpu")
        total = tensor.detach().to(place, copy=True).contiguous()
        self.exchanged, self.exchanges = self.exchanged + total.numel() * total.element_size(), self.exchanges + 1
        self.attempt(lambda: self.distributed.all_reduce(total))
        return total.to(tensor.device)

    def broadcast(self, value: Value) -> Value:
        """Return the first process's `value` in all processes. The value must be picklable."""
        box = [pickle.dumps(value) if self.rank == 0 else None]
        self.attempt(lambda: self.distributed.broadcast_object_list(box))
        return value if self.rank == 0 else pickle.loads(box[0])  # type: ignore[arg-type]

    def agreed(self, work: Callable[[], Value]) -> Value:
        """Call `work` in each process. Returns this process's result.

        If `work` raises InputError in one process, all processes raise it. If several fail, all raise the first one's
        error.
        """
        result: Any = None
        error: InputError | None = None
        try:
            result = work()
        except InputError as found:
            error = found
        messages: list[Any] = [None] * self.count
        self.attempt(lambda: self.distributed.all_gather_object(messages, str(error) if error else None))
        failed = [k for k, message in enumerate(messages) if message is not None]
        if failed:
            where = f"process {failed[0] + 1} of {self.count}: " * (failed[0] > 0)
            raise InputError(f"{where}{messages[failed[0]]}") from error
        return result

    def on_first(self, work: Callable[[], Value]) -> Value:
        """Call `work` in the first process only. Returns its result in all processes.

        An InputError or SystemExit of `work` is raised in all processes.
        """
        outcome: Any = None
        try:
            outcome = ("value", work()) if self.rank == 0 else None
        except InputError as error:
            outcome = ("error", str(error))
        except SystemExit as stop:
            outcome = ("exit", stop.code)
        kind, value = self.broadcast(outcome)
        if kind == "error":
            raise InputError(value)
        if kind == "exit":
            raise SystemExit(value)
        return value

    def maximum(self, number: int) -> int:
        """Return the largest `number` of all processes."""
        numbers = torch.tensor([number])
        self.attempt(lambda: self.distributed.all_reduce(numbers, self.distributed.ReduceOp.MAX))
        return int(numbers)

    def barrier(self) -> None:
        """Wait until all processes have called this method."""
        self.maximum(0)

    def sum_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Replace the gradient of each parameter, in place, by its sum over all processes.

        All gradients are sent together. The gradient stays None if no process has one.
        """
        place = device()
        has = torch.tensor([float(p.grad is not None) for p in parameters])
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        total = self.sum(torch.cat([part.flatten().to(place) for part in (has, *grads)]))
        has, *grads = total.split([len(has), *(p.numel() for p in parameters)])
        for parameter, somewhere, grad in zip(parameters, has.tolist(), grads):
            parameter.grad = grad.view_as(parameter).to(parameter.device) if somewhere else None


class Rows(torch.autograd.Function):
    """Autograd function that joins the rows of all processes to one tensor (N, C).

    The backward pass sums the gradients over all processes.
    """

    @staticmethod
    def forward(ctx: Any, own: Tensor, share: "Share") -> Tensor:
        """Return the rows (N, C) of all processes. `own` (n, C): this process's rows.

        `share`: which of the N rows they are.
        """
        ctx.share = share
        return share.gathered(own)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """Return the gradient of the summed loss of all processes with respect to this process's rows (n, C).

        `grad` (N, C): gradient of this process's loss with respect to all rows.
        """
        return ctx.share.processes.sum(grad)[ctx.share.part], None


class Share:
    """This process's share of N photographs or points. The slice `part` selects it.

    If there are more processes than photographs, some processes have the `weight` 0. They repeat a photograph of
    another process, and their result does not count.
    """

    def __init__(self, processes: Processes, total: int) -> None:
        self.processes, self.total_count = processes, total
        first, last = (total * k // processes.count for k in (processes.rank, processes.rank + 1))
        self.weight = (last - first) / total  #: weight of this process's mean in the mean over all photographs
        self.part = slice(first, last) if last > first else slice(min(first, total - 1), min(first, total - 1) + 1)

    def sum(self, tensor: Tensor) -> Tensor:
        """Sum a tensor over all processes. Returns the sum in each process, without gradients.

        `tensor`: this process's sum over its own photographs. It does not count if the process has the weight 0.
        """
        return self.processes.sum(tensor if self.weight else torch.zeros_like(tensor))

    def gathered(self, tensor: Tensor) -> Tensor:
        """Join the rows of all processes. Returns (N, …) in the order of the N photographs, without gradients.

        `tensor` (n, …): the rows of this process's photographs.
        """
        if self.processes.count == 1:
            return tensor
        whole = tensor.new_zeros(self.total_count, *tensor.shape[1:])
        if self.weight:
            whole[self.part] = tensor
        return self.processes.sum(whole)

    def concatenated(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Join the rows of all processes, for several tensors. Returns tensors (N, …) for all points, with gradients.

        `tensors`: each (n, …), for this process's points.
        """
        if self.processes.count == 1:
            return list(tensors)
        columns = [tensor.flatten(1) if tensor.ndim > 1 else tensor[:, None] for tensor in tensors]
        whole = Rows.apply(torch.cat(columns, 1), self).split([c.shape[1] for c in columns], 1)
        return [part.reshape(-1, *tensor.shape[1:]) for part, tensor in zip(whole, tensors)]


ALONE = Processes()
_current: Processes = ALONE


def current() -> Processes:
    """Return the processes that work on the current fit: several inside a block of `joined`, a single one elsewhere."""
    return _current


@functools.cache
def team_of_this_process() -> Team:
    """Return the group of processes to which this process belongs. The first call connects them."""
    return Team()


@contextlib.contextmanager
def joined() -> Iterator[Processes]:
    """Context manager in which the processes that `torchrun` has started work on one fit.

    Yields the communication between them. A process that `torchrun` has not started works alone. Only the first process
    prints. If an InputError ends the fit, only the first process reports it.
    """
    global _current
    if int(os.environ.get("WORLD_SIZE", 1)) == 1 or "TORCHELASTIC_RUN_ID" not in os.environ:
        yield ALONE
        return
    team = _current = team_of_this_process()
    try:
        with silent() if team.rank else contextlib.nullcontext():
            yield team
    except InputError:
        if team.rank:
            raise SystemExit(2) from None
        raise
    finally:
        _current = ALONE


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Context manager that discards all text printed in its block, also to standard error."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield
