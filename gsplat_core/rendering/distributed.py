"""Rendering with Gaussians shared out over processes (Grendel, Zhao et al. 2024), as gsplat's `distributed=True`.

Each process holds some of the Gaussians and some of the cameras. It projects and colours its Gaussians for the cameras
of all processes, sends the visible splats to the processes of these cameras, and blends those that it receives. The
pictures are those of one process that holds everything, with the Gaussians in the order of the processes. In the backward pass
gradients of splats go back the same way, so each process gets the gradient of its Gaussians with respect to the sum of
all losses.

All processes must call `rasterization` and the backward pass together, with the same number of cameras, options and
channels. `viewmats` and `Ks` must require gradients in all processes or in none. The backend of the process group
decides on the transport: NCCL between GPUs, gloo between CPUs.

`cli` starts the processes.
"""

from __future__ import annotations

import logging
import math
import os
import socket
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.multiprocessing.spawn import spawn

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import PackedProjection
from gsplat_core.rendering.pipeline import ColoredSplats
from gsplat_core.rendering.settings import Arguments, RenderSettings

_LOG = logging.getLogger(__name__)


def check_distributed(arguments: Arguments, settings: RenderSettings) -> None:
    """Check arguments of `rasterization(distributed=True)`.

    Raises:
        InvalidInput: without a process group, and for batch dimensions, colours of each camera, or absgrad.
        NotImplementedError: for distances along rays and normals.
    """
    if not (dist.is_available() and dist.is_initialized()):
        raise InvalidInput(
            "distributed=True needs a process group; call torch.distributed.init_process_group, or start the program with"
            " gsplat_core.rendering.distributed.cli"
        )
    if arguments.means.dim() > 2:
        raise InvalidInput(
            f"distributed=True takes tensors without batch dimensions, got means {list(arguments.means.shape)}"
        )
    for name, values, degree in (
        ("colors", arguments.colors, settings.sh_degree),
        ("extra_signals", arguments.extra_signals, settings.extra_degree),
    ):
        if values is not None and values.dim() != (2 if degree is None else 3):
            raise InvalidInput(
                f"distributed=True takes {name} that are the same for all cameras, got {list(values.shape)}"
            )
    if settings.absgrad:
        raise InvalidInput("absgrad is not available with distributed=True; use the gradient of meta['means2d']")
    if settings.has_distance or settings.normals:
        raise NotImplementedError(
            "distance along the rays and normals are not supported with distributed=True; use the render modes D and ED"
        )


def all_cameras(viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, Tensor]:
    """Return world-to-camera matrices [C, 4, 4] and intrinsics [C, 3, 3] of all processes, in their order; differentiable.

    Raises:
        InvalidInput: if the processes have different numbers of cameras.
    """
    counts = all_gather_int32(dist.get_world_size(), len(viewmats), device=viewmats.device)
    if len(set(counts)) > 1:
        raise InvalidInput(
            f"all processes must have the same number of cameras, got {', '.join(map(str, counts))} by rank"
        )
    views, intrinsics = all_gather_tensor_list(dist.get_world_size(), [viewmats, Ks])
    return views, intrinsics


def exchanged(splats: ColoredSplats, cameras: int) -> ColoredSplats:
    """Send each splat to the process that renders its camera, and return the splats of this process's cameras;
    differentiable.

    Args:
        splats: splats of this process's Gaussians for the cameras of all processes.
        cameras: number of cameras of each process.

    Returns:
        Packed splats, by camera, then in the order of the processes and their Gaussians. Gaussian ids are 0.
    """
    rows, channels, opacities, nearness = splats
    if isinstance(rows, PackedProjection):
        camera_ids = rows.camera_ids
        values = [rows.means2d, rows.depths[:, None], rows.conics, opacities[:, None], channels]
        radii = rows.radii
    else:
        visible = (rows.radii[..., 0] > 0).reshape(-1).nonzero()[:, 0]
        camera_ids = visible // max(rows.radii.shape[-2], 1)
        flat = (rows.means2d, rows.depths[..., None], rows.conics, opacities[..., None], channels)
        values = [each.reshape(-1, each.shape[-1])[visible] for each in flat]
        radii, nearness = rows.radii.reshape(-1, 2)[visible], nearness.reshape(-1)[visible]
    world = dist.get_world_size()
    floats = torch.cat([*values, nearness.detach()[:, None]], -1)
    integers = torch.cat([radii, (camera_ids % max(cameras, 1))[:, None].to(radii.dtype)], -1)
    sent = torch.bincount(camera_ids // max(cameras, 1), minlength=world).tolist()
    received = all_to_all_int32(world, sent, device=floats.device)
    integers = _exchange(integers, sent, received)
    floats = _Exchange.apply(floats, sent, received)
    order = integers[:, 2].argsort(stable=True)
    radii, camera = integers[order, :2], integers[order, 2].long()
    means2d, depths, conics, opacity, colors, near = floats[order].split([2, 1, 3, 1, channels.shape[-1], 1], -1)
    zeros = torch.zeros_like(camera)
    packed = PackedProjection(
        zeros,
        camera,
        zeros,
        radii.contiguous(),
        means2d.contiguous(),
        depths[:, 0].contiguous(),
        conics.contiguous(),
        None,
    )
    return ColoredSplats(packed, colors.contiguous(), opacity[:, 0].contiguous(), near[:, 0].detach().contiguous())


def _exchange(rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
    out = rows.new_empty(sum(received), *rows.shape[1:])
    dist.all_to_all_single(out, rows.contiguous(), received, sent)
    return out


class _Exchange(torch.autograd.Function):
    """Autograd function that sends tensor rows to each process and returns the received rows. Gradients are sent back."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
        ctx.counts = received, sent
        return _exchange(rows, sent, received)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        return _exchange(v[0], *ctx.counts), None, None


class _Gather(torch.autograd.Function):
    """Autograd function that concatenates the rows of all processes. The gradient is the sum over all processes."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor) -> Tensor:
        ctx.count = len(rows)
        parts = [torch.empty_like(rows) for _ in range(dist.get_world_size())]
        dist.all_gather(parts, rows.contiguous())
        return torch.cat(parts)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        total = v[0].clone(memory_format=torch.contiguous_format)
        dist.all_reduce(total)
        first = dist.get_rank() * ctx.count
        return (total[first : first + ctx.count],)


def all_gather_int32(world_size: int, value: int | Tensor, device: torch.device | None = None) -> list[Any]:
    """Gather one integer from each process, in the order of their ranks.

    Args:
        world_size: number of processes.
        value: number, or tensor with one.
        device: device for the transport of a number; the CPU if None.

    Returns:
        Numbers, or tensors if `value` is one.
    """
    if world_size == 1:
        return [value]
    number = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.int32, device=device)
    parts = [torch.empty_like(number) for _ in range(world_size)]
    dist.all_gather(parts, number)
    return parts if isinstance(value, Tensor) else [int(part) for part in parts]


def all_to_all_int32(world_size: int, values: Sequence[int | Tensor], device: torch.device | None = None) -> list[Any]:
    """Send the i-th number to the process of rank i, and return the numbers received, by rank.

    Args:
        world_size: number of processes.
        values: one number, or tensor with one, for each process.
        device: device for the transport of numbers; the CPU if None.

    Returns:
        Numbers; tensors where `values` has one.

    Raises:
        InvalidInput: unless there is one value for each process.
    """
    if world_size == 1:
        return list(values)
    _check_count("values", values, world_size)
    devices = [value.device for value in values if isinstance(value, Tensor)]
    if devices:
        device = devices[0]
    numbers = torch.tensor([int(value) for value in values], dtype=torch.int32, device=device)
    out = torch.empty_like(numbers)
    dist.all_to_all_single(out, numbers)
    parts = out.tolist()
    return [
        value.new_tensor(part) if isinstance(value, Tensor) else part for value, part in zip(values, parts, strict=True)
    ]


def all_gather_tensor_list(world_size: int, tensor_list: Sequence[Tensor]) -> list[Tensor]:
    """Concatenate each tensor of all processes along the first dimension, in one collective call; differentiable.

    Args:
        world_size: number of processes.
        tensor_list: tensors [N, ...] with the same N, and the same shapes in all processes.

    Returns:
        Tensors [N * world_size, ...].

    Raises:
        InvalidInput: if the first dimensions differ.
    """
    if world_size == 1:
        return list(tensor_list)
    rows, widths = _joined(tensor_list)
    gathered = _Gather.apply(rows)
    return _parted(gathered, widths, tensor_list)


def all_to_all_tensor_list(
    world_size: int,
    tensor_list: Sequence[Tensor],
    splits: Sequence[int | Tensor],
    output_splits: Sequence[int | Tensor] | None = None,
) -> list[Tensor]:
    """Send rows of the tensors to all processes in one collective call, and return those received; differentiable.

    Args:
        world_size: number of processes.
        tensor_list: tensors [N, ...] with the same N.
        splits: number of rows for each process, in order; their sum is N.
        output_splits: number of rows from each process; None to ask for them.

    Returns:
        Tensors [M, ...] with the rows received, by rank.

    Raises:
        InvalidInput: if the first dimensions differ, or the number of splits is not that of processes.
    """
    if world_size == 1:
        return list(tensor_list)
    _check_count("splits", splits, world_size)
    rows, widths = _joined(tensor_list)
    sent = [int(split) for split in splits]
    received = all_to_all_int32(world_size, sent, rows.device) if output_splits is None else output_splits
    exchanged_rows = _Exchange.apply(rows, sent, [int(count) for count in received])
    return _parted(exchanged_rows, widths, tensor_list)


def _check_count(name: str, values: Sequence[Any], world_size: int) -> None:
    if len(values) != world_size:
        raise InvalidInput(f"{name} must have one value for each of {world_size} processes, got {len(values)}")


def _joined(tensor_list: Sequence[Tensor]) -> tuple[Tensor, list[int]]:
    counts = {len(tensor) for tensor in tensor_list}
    if len(counts) != 1:
        raise InvalidInput(f"all tensors must have the same first dimension, got {sorted(counts)}")
    flat = [tensor.reshape(len(tensor), math.prod(tensor.shape[1:])) for tensor in tensor_list]
    return torch.cat(flat, -1), [part.shape[1] for part in flat]


def _parted(rows: Tensor, widths: list[int], like: Sequence[Tensor]) -> list[Tensor]:
    parts = rows.split(widths, -1)
    return [part.reshape(len(rows), *tensor.shape[1:]) for part, tensor in zip(parts, like, strict=True)]


def cli(fn: Callable[..., None], args: Any, verbose: bool = False, *, processes: int | None = None) -> bool:
    """Call `fn(local_rank, world_rank, world_size, args)` in each of several processes with a process group.

    On GPUs the group's backend is NCCL and each process uses the GPU of its local rank. Under `mpirun` on several
    machines the processes exist already, and `MASTER_ADDR` and `MASTER_PORT` name the first one. Otherwise the
    processes are started here; `fn` and `args` must then be picklable.

    Args:
        fn: function to call.
        args: passed on to `fn`.
        verbose: log when processes start and end.
        processes: number of processes on the CPU, with the backend gloo. None: one for each GPU; one without a GPU.

    Returns:
        True.
    """
    if "OMPI_COMM_WORLD_SIZE" in os.environ:
        rank, size, local = (int(os.environ[f"OMPI_COMM_WORLD_{name}"]) for name in ("RANK", "SIZE", "LOCAL_RANK"))
        _process(rank, size, fn, args, local, verbose, processes is None)
        return True
    on_gpus = processes is None and torch.cuda.is_available()
    size = torch.cuda.device_count() if on_gpus else processes or 1
    if size == 1 and processes is None:
        fn(0, 0, 1, args)
        return True
    os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"] = "localhost", str(_free_port())
    context = spawn(_process, args=(size, fn, args, None, verbose, on_gpus), nprocs=size, join=False)
    assert context is not None
    try:
        while not context.join():
            pass
    finally:
        for process in context.processes:
            if process.is_alive():
                process.terminate()
            process.join()
    return True


def _process(
    rank: int, size: int, fn: Callable[..., None], args: Any, local_rank: int | None, verbose: bool, on_gpus: bool
) -> None:
    local = rank if local_rank is None else local_rank
    if verbose:
        _LOG.info("process %d of %d starts", rank + 1, size)
    if on_gpus:
        torch.cuda.set_device(local)
    dist.init_process_group(backend="nccl" if on_gpus else "gloo", world_size=size, rank=rank)
    try:
        fn(local, rank, size, args)
        dist.barrier()
    finally:
        dist.destroy_process_group()
    if verbose:
        _LOG.info("process %d of %d has ended", rank + 1, size)


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return int(listener.getsockname()[1])
