"""Points in chunks, one per thread: how the networks share the processor's cores."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import torch
from torch import Tensor

CHUNK = 8192  #: points that a thread computes at once, at most
KEPT = 20_000  #: points of which the activations are kept; of more they are computed again on the way back

_pool: tuple[int, ThreadPoolExecutor] | None = None  # one for the whole process: (threads, executor)
_lock = threading.Lock()


def forward_in_chunks(ctx: Any, forward: Callable, x: Tensor, keep: bool) -> Tensor:
    """Values at points (n, 3) by `forward(chunk, keep)`: of a chunk, and what the way back needs of it, if wanted.

    Chunks are computed one per thread, and are as many for each; a GPU computes all points at once. What the way back
    needs of very many points would be most of a fit's memory: it is computed anew, chunk by chunk.
    """
    chunks = 1
    ctx.again = forward if keep and len(x) > KEPT and x.device.type == "cpu" else None
    if x.device.type == "cpu":
        threads = torch.get_num_threads()
        most = max(1, min(CHUNK, KEPT // threads)) if ctx.again else CHUNK  # all threads are at work at once
        chunks = threads * -(-len(x) // (threads * most))
    parts = x.detach().tensor_split(max(1, min(chunks, len(x))))
    ctx.sizes = [len(part) for part in parts]
    own = torch.no_grad()(partial(forward, keep=keep and not ctx.again))
    values, kept = zip(*in_parallel(own, parts))
    ctx.kept = parts if ctx.again else kept
    return torch.cat(values)


def backward_in_chunks(ctx: Any, backward: Callable, gradient: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Gradients of the points and of the parameters of `ctx.layers`, by `backward(gradient, kept, sums)` of each chunk.

    Raises RuntimeError if the parameters were changed since, and the second time.
    """
    _ = ctx.saved_tensors  # torch's own checks: the layers may share the parameters' memory
    if ctx.kept is None:
        raise RuntimeError("the backward pass of a network was taken a second time; retain_graph does not keep it, "
                           "but mi_ring.nets.mlp.plain_autograd() does")  # fmt: skip

    @torch.no_grad()
    def run(gradient: Tensor, kept: Any) -> tuple[Tensor, list[Tensor]]:
        sums = ctx.layers.zeros()
        if ctx.again:
            _, kept = ctx.again(kept, keep=True)
        return backward(gradient, kept, sums), sums

    gradients, sums = zip(*in_parallel(run, gradient.split(ctx.sizes), ctx.kept))
    ctx.kept = None
    return torch.cat(gradients), [sum(parts) for parts in zip(*sums)]


def in_parallel(function: Callable, *arguments: Sequence) -> list:
    """`map` over threads that compute alone, as many as torch was ever set to use."""
    threads = min(torch.get_num_threads(), len(arguments[0]))
    if threads == 1:
        return list(map(function, *arguments))
    return list(pool(threads).map(function, *arguments))


def pool(threads: int) -> ThreadPoolExecutor:
    """The process's workers, at least so many, for which torch uses one thread each."""
    global _pool
    with _lock:
        if _pool is None or _pool[0] < threads:
            before = torch.get_num_threads()
            executor = ThreadPoolExecutor(threads, "mi_ring", initializer=compute_alone)
            started = threading.Barrier(threads + 1)
            try:
                for _ in range(threads):
                    executor.submit(started.wait)
            except BaseException:
                started.abort()  # those that are there already would wait forever
                raise
            started.wait()
            torch.set_num_threads(before)  # torch takes what the last thread set for the number of all later ones
            _pool = threads, executor
        return _pool[1]


def compute_alone() -> None:
    """Have torch use one thread for what the current thread computes."""
    torch.get_num_threads()  # the first time torch takes over the number of the process, which would undo the next line
    torch.set_num_threads(1)


def forget_pool() -> None:
    """A forked process has no threads but one."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=forget_pool)
