"""Processes that share out the points and the photographs of each iteration of a fit, as `torchrun` starts them.

All draw the same random numbers, hold the same networks and make the same steps; each evaluates the networks at some of
the points and renders some of the photographs, and what these say is summed over all (synchronous data parallelism,
"Accurate, Large Minibatch SGD", Goyal et al. 2017). The first alone writes and prints. This module alone knows of
torch.distributed, which one process does without.
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


class Lost(InputError):
    """Another process of the fit has ended, or cannot be reached: the results stay as they were."""


class Processes:
    """All processes of a fit, seen from one of them. This is one that is alone: its sums are those of all."""

    count, rank = 1, 0  #: how many, and which of them this is
    here = 1  #: how many of them are on this machine
    exchanged, exchanges = 0, 0  #: bytes that this process has given to sums so far, and how many these were

    @property
    def threads(self) -> int:
        """Of the processor, those that are this process's."""
        return max(1, cores() // self.here)

    def sum(self, tensor: Tensor) -> Tensor:
        """The sum of what each process has, the same in all; tensors are of one shape."""
        return tensor

    def told(self, value: Value) -> Value:
        """What the first process has; it is pickled."""
        return value

    def together(self, work: Callable[[], Value]) -> Value:
        """What `work` returns here. If it fails with an InputError in one process, it does in all."""
        return work()

    def by_first(self, work: Callable[[], Value]) -> Value:
        """What `work` returns in the first process, which alone does it; so do its InputError and its exit."""
        return work()

    def most(self, number: int) -> int:
        """The largest of the numbers that processes have."""
        return number

    def wait(self) -> None:
        """Wait for all others."""

    def share(self, total: int) -> "Share":
        """This process's share of so many photographs."""
        return Share(self, total)

    def sum_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Have each parameter have the sum of its gradients; those without one in any process go without."""


class Team(Processes):
    """One of several processes, which torch.distributed has brought together."""

    def __init__(self) -> None:
        import torch.distributed as distributed

        self.distributed = distributed
        self.rank, self.count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        self.here = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        # NCCL wants a GPU of its own for each process; what is no tensor goes through the processor.
        own = self.here == 1 or os.environ.get(OWN) == "1"
        self.nccl = own and torch.cuda.is_available() and distributed.is_nccl_available()
        distributed.init_process_group("cpu:gloo,cuda:nccl" if self.nccl else "gloo")
        atexit.register(self.part)

    def part(self) -> None:
        """Take leave of the others, at the end of the process: a second time it could not join them."""
        with contextlib.suppress(RuntimeError):
            self.distributed.destroy_process_group()

    def attempt(self, exchange: Callable[[], None]) -> None:
        """Raises Lost where torch's own error is that another process has gone."""
        try:
            exchange()
        except RuntimeError as error:
            raise Lost("another process of this fit has ended or is out of reach; go on from the last checkpoint with "
                       "the same command and --resume") from error  # fmt: skip

    def sum(self, tensor: Tensor) -> Tensor:
        """As of one process."""
        place = device() if self.nccl else torch.device("cpu")
        total = tensor.detach().to(place, copy=True).contiguous()
        self.exchanged, self.exchanges = self.exchanged + total.numel() * total.element_size(), self.exchanges + 1
        self.attempt(lambda: self.distributed.all_reduce(total))
        return total.to(tensor.device)

    def told(self, value: Value) -> Value:
        """As of one process."""
        box = [pickle.dumps(value) if self.rank == 0 else None]
        self.attempt(lambda: self.distributed.broadcast_object_list(box))
        return value if self.rank == 0 else pickle.loads(box[0])  # type: ignore[arg-type]

    def together(self, work: Callable[[], Value]) -> Value:
        """As of one process; of several messages that of the first of them that has one is told."""
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

    def by_first(self, work: Callable[[], Value]) -> Value:
        """As of one process."""
        outcome: tuple[str, Any] | None = None
        try:
            outcome = ("value", work()) if self.rank == 0 else None
        except InputError as error:
            outcome = ("error", str(error))
        except SystemExit as stop:
            outcome = ("exit", stop.code)
        told: Any = self.told(outcome)
        kind, value = told
        if kind == "error":
            raise InputError(value)
        if kind == "exit":
            raise SystemExit(value)
        return value

    def most(self, number: int) -> int:
        """As of one process."""
        numbers = torch.tensor([number])
        self.attempt(lambda: self.distributed.all_reduce(numbers, self.distributed.ReduceOp.MAX))
        return int(numbers)

    def wait(self) -> None:
        """As of one process."""
        self.most(0)

    def sum_gradients(self, parameters: Sequence[Tensor]) -> None:
        """As of one process, all in one exchange."""
        place = device()
        has = torch.tensor([float(p.grad is not None) for p in parameters])
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        total = self.sum(torch.cat([part.flatten().to(place) for part in (has, *grads)]))
        has, *grads = total.split([len(has), *(p.numel() for p in parameters)])
        for parameter, somewhere, grad in zip(parameters, has.tolist(), grads):
            parameter.grad = grad.view_as(parameter).to(parameter.device) if somewhere else None


class Rows(torch.autograd.Function):
    """Rows of a tensor (N, C) of which each process has its own, attached; their backward pass is that of all."""

    @staticmethod
    def forward(ctx: Any, own: Tensor, share: "Share") -> Tensor:
        """As of `Share.gathered`."""
        ctx.share = share
        return share.gathered(own)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """What all processes together make of the loss."""
        return ctx.share.processes.sum(grad)[ctx.share.part], None


class Share:
    """What one process has of the photographs of an iteration: those of `part`; none of its own if `weight` is 0.

    Then it renders one that another process has, too, and that counts there: some are more than the photographs.
    """

    def __init__(self, processes: Processes, total: int) -> None:
        self.processes, self.total_count = processes, total
        first, last = (total * k // processes.count for k in (processes.rank, processes.rank + 1))
        self.weight = (last - first) / total  #: of a mean over its photographs in the mean over all of them
        self.part = slice(first, last) if last > first else slice(min(first, total - 1), min(first, total - 1) + 1)

    def sum(self, tensor: Tensor) -> Tensor:
        """The sum over all photographs of what is the sum over those of this process; without gradients."""
        return self.processes.sum(tensor if self.weight else torch.zeros_like(tensor))

    def gathered(self, tensor: Tensor) -> Tensor:
        """Of all photographs (N, …), in their order, what this process has of its own (n, …); without gradients."""
        if self.processes.count == 1:
            return tensor
        whole = tensor.new_zeros(self.total_count, *tensor.shape[1:])
        if self.weight:
            whole[self.part] = tensor
        return self.processes.sum(whole)

    def joined(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """The same of tensors (n, …) together, attached, of all points (N, …): every process has some of its own."""
        if self.processes.count == 1:
            return list(tensors)
        columns = [tensor.flatten(1) if tensor.ndim > 1 else tensor[:, None] for tensor in tensors]
        whole = Rows.apply(torch.cat(columns, 1), self).split([c.shape[1] for c in columns], 1)
        return [part.reshape(-1, *tensor.shape[1:]) for part, tensor in zip(whole, tensors)]


ALONE = Processes()
_current: Processes = ALONE


def current() -> Processes:
    """Those that `joined` has brought together; outside of it one process, alone."""
    return _current


@functools.cache
def team_of_this_process() -> Team:
    """The one that it belongs to."""
    return Team()


@contextlib.contextmanager
def joined() -> Iterator[Processes]:
    """Within it the processes that `torchrun` has started are one fit; others are alone.

    All but the first print nothing, and what the user can mend, which the first says, ends them silently.
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
    """Within it nothing that is printed is seen."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield
