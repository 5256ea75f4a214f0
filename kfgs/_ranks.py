"""One job by several processes: each works on its own views, and the parts are put together in the order of the views.

`torchrun` starts the processes and numbers them (RANK, WORLD_SIZE). Inside `together()` they work on one job. Outside, and with
one process, every function here does what its name says in this process alone, and nothing is imported.

Every exchange begins with a short note from each process: what it is about to do, or the error that ended its work. So a
process that fails joins the next exchange with its error, and all of them end.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")
NOTE, LONGEST = 4096, 600  # bytes of a note, characters of the error in it
ALIGNED = 16  # bytes: where a tensor may begin, whatever its dtype
TIMEOUT = 3600.0
"""Seconds that a process waits for the others. A process that ends is noticed at once, whatever this is. It is long because all
wait for the slowest view, and for the first process when it alone writes a report."""


class PeerError(RuntimeError):
    """Another process of the job failed; the message says which, and why."""


class LostError(ConnectionError):
    """Another process of the job ended without a word, or does not answer."""


@dataclass(frozen=True)
class _Group:
    rank: int
    size: int
    handle: Any


_group: _Group | None = None


def place() -> tuple[int, int]:
    """(rank, number of processes) as torchrun numbered them; (0, 1) without torchrun."""
    numbers = []
    for name, usual in (("RANK", "0"), ("WORLD_SIZE", "1")):
        word = os.environ.get(name) or usual
        if not word.isdecimal():
            raise ValueError(f"{name}: expected a whole number, as torchrun sets it, got {word!r:.40}; unset it")
        numbers.append(int(word))
    rank, size = numbers
    return (rank, size) if size > 1 and os.environ.get("RANK") else (0, 1)


def first() -> bool:
    """Whether this is the process that writes files and prints: the only one, or rank 0."""
    return _group is None or _group.rank == 0


@contextmanager
def together(timeout: float = TIMEOUT) -> Iterator[None]:
    """Let all processes that torchrun started work on one field; without torchrun this does nothing.

    Inside, `fit_scene`, `fit_color`, `fit_field`, `uplift`, `uplift_maps`, `fit_codebook`, `quantize_maps` and `fused_answers`
    share their views among the processes. Every process must make the same calls with the same arguments, and see the same
    folders; the first one alone writes and reports. On CPUs with equal numbers of threads, the results are bit for bit those
    of one process.

    Args:
        timeout: seconds to wait for a process that lives, but does not answer.

    Raises:
        PeerError: if another process raised an error; the message names the process and has its words.
        LostError: if another process ended or does not answer.

    Example:
        >>> with together():
        ...     print("one process, or each of several")
        one process, or each of several
    """
    global _group
    rank, size = place()
    if size == 1 or _group is not None:
        yield
        return
    _group = _Group(rank, size, _meet(rank, size, timeout))
    try:
        yield
        meet()
    except (PeerError, LostError):  # all know
        raise
    except Exception as error:
        _notes({"error": f"{type(error).__name__}: {error}"[:LONGEST]})
        raise
    finally:
        _group = None


def in_order(items: Iterable[T], part: Callable[[T], dict[str, Tensor]]) -> Iterator[dict[str, Tensor]]:
    """`part(item)` for each item, in order; each process computes only those of its own items.

    What is added up in this order does not depend on the number of processes. At any time, memory holds the parts of as many
    items as there are processes.

    Args:
        items: the same ones in every process.
        part: named tensors of one item. Those of other processes come to this one's GPU if they were on a GPU.
    """
    if _group is None:
        yield from map(part, items)
        return
    remaining = iter(items)
    while batch := list(islice(remaining, _group.size)):
        mine = part(batch[_group.rank]) if _group.rank < len(batch) else {}
        yield from _exchange("a part of a sum", mine)[: len(batch)]


def once(function: Callable[[], Any]) -> Any:
    """What the function returns (JSON) in the first process, which alone calls it; the others wait for it."""
    global _group
    if _group is None:
        return function()
    import torch

    mine, group = {}, _group
    if group.rank == 0:
        _group = None  # what it calls must not wait for the others
        try:
            value = json.dumps(function()).encode()
        finally:
            _group = group
        mine = {"json": torch.frombuffer(bytearray(value), dtype=torch.uint8)}
    return json.loads(_exchange("work of the first process", mine)[0]["json"].numpy().tobytes())


def meet() -> None:
    """Wait until every process is here."""
    if _group is not None:
        _exchange("a meeting", {})


def agree(what: str, value: Callable[[], str]) -> None:
    """Check that all processes have the same value, or raise a ValueError in each; with one process it is not computed."""
    if _group is None:
        return
    import torch

    mine = torch.frombuffer(bytearray(value().encode()), dtype=torch.uint8)
    found = _exchange("a comparison", {"value": mine})
    if any(not torch.equal(one["value"], found[0]["value"]) for one in found):
        raise ValueError(
            f"{what}: expected the same in all {len(found)} processes, got others in some; give all the same inputs, folders "
            "that all see, and the same kind of processor and number of threads"
        )


def _meet(rank: int, size: int, timeout: float) -> Any:
    """The group of all processes: gloo for tensors of CPUs, nccl for those of GPUs if each process has one of its own."""
    from datetime import timedelta

    import torch
    import torch.distributed as dist

    local, beside = (
        int(os.environ.get(name, value)) for name, value in (("LOCAL_RANK", rank), ("LOCAL_WORLD_SIZE", size))
    )
    own = torch.cuda.is_available() and beside <= torch.cuda.device_count()
    if torch.cuda.is_available():
        torch.cuda.set_device(local % torch.cuda.device_count())
    options: dict[str, Any] = {
        "backend": "cpu:gloo,cuda:nccl" if own else "gloo",
        "timeout": timedelta(seconds=timeout),
    }
    try:
        if dist.is_initialized():
            return dist.new_group(**options)
        store, _, _ = next(iter(dist.rendezvous("env://", rank, size, timeout=options["timeout"])))
        # torchrun keeps its store when it starts all again after a kill, with the addresses of those that ended
        store = dist.PrefixStore(f"kfgs {os.environ.get('TORCHELASTIC_RESTART_COUNT', 0)}", store)
        dist.init_process_group(store=store, rank=rank, world_size=size, **options)
    except (RuntimeError, ValueError) as error:
        raise LostError(
            f"processes: expected {size} of them to meet (torchrun sets MASTER_ADDR and MASTER_PORT), got: {_line(error)}"
        ) from error
    return dist.group.WORLD


def _exchange(what: str, mine: dict[str, Tensor]) -> list[dict[str, Tensor]]:
    """The tensors of every process, by rank; names, shapes and dtypes may differ."""
    import torch
    import torch.distributed as dist

    assert _group is not None
    tensors = {name: value.detach().contiguous() for name, value in mine.items()}
    kinds = {
        name: [str(value.dtype).removeprefix("torch."), list(value.shape), value.device.type]
        for name, value in tensors.items()
    }
    notes = _notes({"what": what, "tensors": kinds})
    if len({note["what"] for note in notes}) > 1:
        doing = ", ".join(f"{note['what']} (process {rank})" for rank, note in enumerate(notes))
        raise LostError(f"processes: expected all to do the same, got {doing}; make the same calls in each of them")
    nccl = "nccl" in str(dist.get_backend_config(_group.handle))
    bytes_ = []
    for note in notes:
        fast = nccl and any(device == "cuda" for *_, device in note["tensors"].values())
        bytes_.append(torch.empty(sum(_spans(note["tensors"])), dtype=torch.uint8, device="cuda" if fast else "cpu"))
    for name, place in _unpack(kinds, bytes_[_group.rank]).items():
        place.copy_(tensors[name])
    with _watching():  # a broadcast each: gloo's all_gather takes twice as long, and would need equal sizes
        sending = [
            dist.broadcast(one, rank, group=_group.handle, async_op=True) for rank, one in enumerate(bytes_) if len(one)
        ]
        for one in sending:
            one.wait()
    parts = []
    for note, one in zip(notes, bytes_, strict=True):
        found = _unpack(note["tensors"], one)
        parts.append({name: value.to(note["tensors"][name][2]) for name, value in found.items()})
    return [*parts[: _group.rank], tensors, *parts[_group.rank + 1 :]]


def _unpack(kinds: dict[str, Any], sent: Tensor) -> dict[str, Tensor]:
    """The tensors that lie in some bytes; they share the memory."""
    import torch

    found, start = {}, 0
    for (name, (dtype, shape, _)), span in zip(kinds.items(), _spans(kinds), strict=True):
        kind = getattr(torch, dtype)
        found[name] = sent[start : start + math.prod(shape) * kind.itemsize].view(kind).view(shape)
        start += span
    return found


def _spans(kinds: dict[str, Any]) -> list[int]:
    """The bytes of each tensor, with those to the next place where one may begin."""
    import torch

    sizes = (math.prod(shape) * getattr(torch, dtype).itemsize for dtype, shape, _ in kinds.values())
    return [-(-size // ALIGNED) * ALIGNED for size in sizes]


def _notes(mine: dict[str, Any]) -> list[dict[str, Any]]:
    """The note of every process; a PeerError if another one has failed."""
    import torch
    import torch.distributed as dist

    assert _group is not None
    text = json.dumps(mine, ensure_ascii=False).encode()
    sent = torch.frombuffer(bytearray(text.ljust(NOTE)), dtype=torch.uint8)
    received = [torch.empty_like(sent) for _ in range(_group.size)]
    with _watching():
        dist.all_gather(received, sent, group=_group.handle)
    notes = [json.loads(one.numpy().tobytes()) for one in received]
    failed = [(rank, note["error"]) for rank, note in enumerate(notes) if "error" in note]
    if failed and "error" not in mine:
        raise PeerError("; ".join(f"process {rank} of {_group.size} failed: {error}" for rank, error in failed))
    return notes


@contextmanager
def _watching() -> Iterator[None]:
    """Errors of torch's collectives as a `LostError`."""
    try:
        yield
    except RuntimeError as error:
        raise LostError(
            f"processes: expected all of them to go on, lost one ({_line(error)}); its own message says why. The same "
            "command goes on from the last checkpoint"
        ) from error


def _line(error: Exception) -> str:
    """The first sentence of an error of torch, without the place in its source."""
    return re.sub(r"\[\S*\.cc:\d+\] ", "", " ".join(str(error).split())).split(". ")[0][:200]
