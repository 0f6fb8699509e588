"""The bridge between torch and Dr.Jit: arrays that share memory, and Dr.Jit programs that torch differentiates."""

import threading
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mi_ring.scene.alignment import ALIGNMENT


def to_drjit(tensor: Tensor) -> mi.Float:
    """Convert a tensor to a flat Dr.Jit Float that shares the tensor's memory (DLPack). Drops gradients.

    Nobody may write to this memory later. A tensor that does not begin at a multiple of `ALIGNMENT` is copied.
    """
    flat = tensor.detach().contiguous().ravel()
    return mi.Float(flat if flat.data_ptr() % ALIGNMENT == 0 else flat.clone())


def to_torch(array: mi.Float) -> Tensor:
    """Convert a Dr.Jit Float to a tensor (n,) that shares the array's memory (DLPack). Drops gradients.

    Nobody may write to this memory later.
    """
    return dr.detach(array).torch()


def evaluated(arrays: Sequence[mi.Float]) -> list[Tensor]:
    """Evaluate Dr.Jit Floats together, in one kernel. Returns each as a tensor (n,) that shares its memory.

    The tensors have no gradients.
    """
    dr.eval(arrays)
    return [to_torch(array) for array in arrays]


def differentiable(program: Callable, tensors: Sequence[Tensor], target) -> tuple[Tensor, ...]:
    """Run a Dr.Jit program. Returns its outputs as tensors (n,); torch can compute their gradients by `tensors`.

    `program`: function from a list of flat Floats, the values of `tensors`, to a list of Floats. An input carries
    gradients if its tensor requires them. `target`: object whose attribute `written` counts how often `program` has
    written its inputs to the scene. The backward pass raises RuntimeError if it runs twice, or if that count has grown
    since.
    """
    return _Differentiable.apply(program, target, *tensors)


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx, program, target, *tensors):
        arrays = [to_drjit(tensor) for tensor in tensors]
        dr.enable_grad([array for array, needed in zip(arrays, ctx.needs_input_grad[2:]) if needed])
        outputs = program(arrays)
        results = evaluated(outputs)
        ctx.save = target, target.written, arrays, outputs, [tensor.shape for tensor in tensors]
        ctx.thread = threading.get_ident()
        return tuple(results)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        if ctx.save is None:
            raise RuntimeError("the backward pass of a picture was taken a second time; render it again instead")
        target, written, arrays, outputs, shapes = ctx.save
        if target.written != written:
            raise RuntimeError("the surface was written again since this picture: call backward before the next one")
        ctx.save = None  # the backward pass consumes Dr.Jit's graph
        if ctx.thread != threading.get_ident():  # torch runs the backward pass on a GPU in a thread of its own
            dr.detail.new_scope(dr.backend_v(mi.Float))
        for output, gradient in zip(outputs, gradients):
            if dr.grad_enabled(output):
                dr.set_grad(output, to_drjit(gradient))
                dr.enqueue(dr.ADMode.Backward, output)
        dr.traverse(dr.ADMode.Backward)
        # Each gradient is a copy: torch may add to a gradient in place.
        return (
            None,
            None,
            *(
                to_torch(dr.grad(array)).clone().reshape(shape) if dr.grad_enabled(array) else None
                for array, shape in zip(arrays, shapes)
            ),
        )
