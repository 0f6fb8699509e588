"""Evaluates networks in chunks of points on all cores of the processor. Each thread computes one chunk at a time."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import torch
from torch import Tensor

CHUNK = 8192  #: most points that a thread computes at once
MAX_STORED = 20_000  #: most points with stored activations; for more, the backward pass computes them again

_pool: tuple[int, int, ThreadPoolExecutor] | None = None  # of the process: (its id, threads, executor)
_lock = threading.Lock()


def forward_in_chunks(ctx: Any, forward: Callable, x: Tensor, keep: bool) -> Tensor:
    """Compute the values of a network at points `x` (n, 3), in chunks of equal size. Returns a tensor (n, …).

    `ctx`: context of the autograd function; data for the backward pass are stored in it. `forward(chunk, keep)` returns
    (values of the chunk, data for its backward pass). `keep`: True if a backward pass will follow. For more than
    `MAX_STORED` points the backward pass computes these data again, to save memory. On a GPU there is a single chunk.
    """
    chunks = 1
    ctx.recompute = forward if keep and len(x) > MAX_STORED and x.device.type == "cpu" else None
    if x.device.type == "cpu":
        threads = torch.get_num_threads()
        size = max(1, min(CHUNK, MAX_STORED // threads)) if ctx.recompute else CHUNK  # all threads store one at a time
        chunks = threads * -(-len(x) // (threads * size))
    parts = x.detach().tensor_split(max(1, min(chunks, len(x))))
    ctx.sizes = [len(part) for part in parts]
    values, stored = zip(*in_parallel(torch.no_grad()(partial(forward, keep=keep and not ctx.recompute)), parts))
    ctx.stored = parts if ctx.recompute else stored
    return torch.cat(values)


def backward_in_chunks(ctx: Any, backward: Callable, gradient: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Compute the gradients with respect to the points and to the parameters of `ctx.layers`, in the same chunks.

    `ctx`: context in which the forward pass has stored its data. `gradient` (n, …): gradient of the values.
    `backward(gradient, stored, sums)` returns the gradient of the points of one chunk and adds the gradients of the
    parameters to `sums`. Returns (gradient (n, 3) of the points, list of the gradients of the parameters). Raises
    RuntimeError for a second call, and if a parameter has changed since the forward pass.
    """
    _ = ctx.saved_tensors  # lets torch check for changes: the layers may share memory with the parameters
    if ctx.stored is None:
        raise RuntimeError("a second backward pass through a network is not supported, not even with retain_graph; "
                           "use mi_ring.nets.mlp.plain_autograd()")  # fmt: skip

    @torch.no_grad()
    def run(gradient: Tensor, stored: Any) -> tuple[Tensor, list[Tensor]]:
        sums = ctx.layers.zeros()
        if ctx.recompute:
            _, stored = ctx.recompute(stored, keep=True)
        return backward(gradient, stored, sums), sums

    gradients, sums = zip(*in_parallel(run, gradient.split(ctx.sizes), ctx.stored))
    ctx.stored = None
    return torch.cat(gradients), [sum(parts) for parts in zip(*sums)]


def in_parallel(function: Callable, *arguments: Sequence) -> list:
    """Call `function` once for each index i, with the items i of all `arguments`, in several threads.

    Returns all results. The results are a list in the order of the items. In each thread, torch uses one core.
    """
    threads = min(torch.get_num_threads(), len(arguments[0]))
    if threads == 1:
        return list(map(function, *arguments))
    return list(pool(threads).map(function, *arguments))


def pool(threads: int) -> ThreadPoolExecutor:
    """Return the pool of worker threads of this process. If it has fewer than `threads` threads, a new pool is made."""
    global _pool
    with _lock:
        if _pool is None or _pool[0] != os.getpid() or _pool[1] < threads:  # a fork does not copy threads
            before = torch.get_num_threads()
            executor = ThreadPoolExecutor(threads, "mi_ring", initializer=use_one_thread)
            started = threading.Barrier(threads + 1)
            try:
                for _ in range(threads):
                    executor.submit(started.wait)
            except BaseException:
                started.abort()  # otherwise the threads that have started would wait forever
                raise
            started.wait()
            torch.set_num_threads(before)  # for all later threads, torch uses the number that a thread set last
            _pool = os.getpid(), threads, executor
        return _pool[2]


def use_one_thread() -> None:
    """Make torch use a single thread for all computations that the current thread starts."""
    torch.get_num_threads()  # the first call copies the number of the process, which would undo the next line
    torch.set_num_threads(1)
