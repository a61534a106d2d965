"""The paper's figure of training efficiency: time and memory of training against batch size."""

import ctypes
import gc
import threading
import time
from pathlib import Path

import torch

from training.dataset import PinTable
from training.loop import Loop, Rows
from training.models import model_named, recipe_of
from training.models.part import Inputs
from training.networks import parameter_count

INITIAL_ROWS = 500  # from which a network takes what it needs before its first step: speed does not depend on it
MIB = 2.0**20


class PeakMemory:
    """The largest memory while it is watched, MiB above the start: of the GPU, or the process's resident set."""

    def __init__(self, device: str = "cpu") -> None:
        self.device, self.peak = device, 0.0

    def __enter__(self) -> "PeakMemory":
        gc.collect()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # else what was freed before and not given back would hide what is taken
        if trim:
            trim(0)
        if self.device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        self.start, self.watching = self._now(), True
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.watching = False
        self.thread.join()
        if self.device == "cuda":
            self.peak = torch.cuda.max_memory_allocated() / MIB - self.start

    def _watch(self) -> None:
        while self.watching and self.device != "cuda":
            self.peak = max(self.peak, self._now() - self.start)
            time.sleep(0.01)

    def _now(self) -> float:
        if self.device == "cuda":
            return torch.cuda.memory_allocated() / MIB
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / MIB


def measure_training(model: str, pins: PinTable, inputs: Inputs, batch: int, *, device: str = "cpu") -> dict:
    """Train on a frame's inputs for a while and see what it costs.

    Parameters
    ----------
    pins : PinTable
        M frames.
    inputs : Inputs
        Rows of an epoch: of the same frames, once or more often.

    Returns
    -------
    dict
        ``model``, ``parameters``, ``batch``, ``rows_timed``, ``ms_per_frame`` (in an epoch, all its rows together),
        ``s_per_epoch`` (None where only some batches were timed) and ``memory_mib``. A first pass, not timed, warms up.
    """
    torch.manual_seed(0)
    part, count = model_named(model), len(inputs)
    network = part.build(pins.reference, 2, {})
    part.initialise(network, inputs, torch.arange(min(INITIAL_ROWS, count)))
    timed = count if part.timed_batches is None else min(part.timed_batches * batch, count)
    labels, executed, none = torch.randn(count, 2), torch.full((count,), torch.nan), torch.zeros(0, dtype=torch.long)
    rows = Rows(inputs, labels, torch.ones(2), executed, torch.arange(timed), none)
    loop = Loop(network.to(device), recipe_of(model, batch=batch), rows, 0, part.penalty)
    with PeakMemory(device) as memory:
        loop.epoch()
        seconds = loop.epoch()["seconds"]
    return {
        "model": model,
        "parameters": parameter_count(network),
        "batch": batch,
        "rows_timed": timed,
        "ms_per_frame": 1e3 * seconds / timed * count / len(pins),
        "s_per_epoch": seconds if timed == count else None,
        "memory_mib": memory.peak,
    }
