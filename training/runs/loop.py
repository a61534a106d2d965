"""Training of one network, epoch by epoch. Its state can be stored on disk, and the training continued from it.

Functions for all networks follow: their size, their device, their outputs for many rows.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import torch
from torch import nn

from training.errors import TrainingError
from training.models.part import Inputs, Recipe
from twin.errors import OptionError

# Steps at the start in which the cosine schedule's learning rate rises from 0 to its full value.
RISE_STEPS = 100
# Epochs without a smaller loss after which the plateau schedule halves the learning rate. The published code uses the same number.
PLATEAU_PATIENCE = 3
# Weight of the error scales' loss in the total loss. The labels' loss has the weight 1.
SCALE_LOSS = 0.05
# Weight in the total loss of the loss of the prediction that the move was executed. The labels' loss has the weight 1.
EXECUTED_LOSS = 0.05
# Parts of a training that have a state of their own.
STATEFUL = ("network", "optimiser", "plateau")
# Attributes of a training that are its state, too.
STATE = ("averaged", "best_weights", "steps", "epochs_done", "best", "since_best", "curves")


@dataclass(frozen=True)
class TrainingRows:
    """The rows with which a network is trained and monitored.

    Attributes
    ----------
    inputs : Inputs
    labels : (M, K) float32
        Scaled labels.
    weight : (K,) float32
        Weight of each label in the loss.
    executed : (M,) float32
        Whether the move was executed: 1, 0, or NaN if that is not known.
    train, held : (m,) int64
        Rows to train on, and rows on which the error is monitored.
    """

    inputs: Inputs
    labels: torch.Tensor
    weight: torch.Tensor
    executed: torch.Tensor
    train: torch.Tensor
    held: torch.Tensor


@dataclass
class Loop:
    """A network in training. ``epoch()`` runs one epoch; ``state()`` and ``load()`` store and restore the whole state of the training.

    Parameters
    ----------
    network : nn.Module
    recipe : Recipe
    rows : Rows
    seed : int
        Seed of the order of the rows.
    penalty : callable
        ``penalty(network)`` is added to the loss of every batch.
    """

    network: nn.Module
    recipe: Recipe
    rows: TrainingRows
    seed: int
    penalty: Callable[[nn.Module], torch.Tensor | None]
    epochs_done: int = 0
    best: float = math.inf
    since_best: int = 0
    curves: list[dict] = field(default_factory=list)

    def __post_init__(self) -> None:
        recipe = self.recipe
        parameters = list(self.network.parameters())
        self.device = device_of(self.network)
        self.optimiser = torch.optim.AdamW(parameters, lr=recipe.rate, weight_decay=recipe.decay)
        self.plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(self.optimiser, factor=0.5, patience=PLATEAU_PATIENCE)
        self.generator = torch.Generator().manual_seed(self.seed)
        self.averaged = [p.detach().clone() for p in parameters]
        self.best_weights = {key: value.clone() for key, value in self.network.state_dict().items()}
        self.steps_of_epoch = max(1, math.ceil(len(self.rows.train) / recipe.batch))
        self.steps = 0

    @property
    def finished(self) -> bool:
        """Whether all epochs are done, or the held-out error has not fallen for as many epochs as the recipe's patience."""
        return self.epochs_done >= self.recipe.epochs or bool(self.recipe.patience and self.since_best >= self.recipe.patience)

    def epoch(self) -> dict:
        """Train once on all training rows, and return the new point of the learning curve."""
        started = perf_counter()
        self.network.train()
        total, loss = 0.0, math.nan
        shuffled = self.rows.train[torch.randperm(len(self.rows.train), generator=self.generator)]
        for chosen in shuffled.split(self.recipe.batch):
            loss = self._step(chosen)
            total += loss * len(chosen)
        seconds = perf_counter() - started
        self.epochs_done += 1
        held = self._watch()
        rate = self.optimiser.param_groups[0]["lr"]
        if held < self.best:
            self.best, self.since_best = held, 0
            self.best_weights = {key: value.clone() for key, value in self.network.state_dict().items()}
        else:
            self.since_best += 1
        if self.recipe.schedule == "plateau":
            self.plateau.step(loss)  # the last batch's loss, as in the published code
        point = {"epoch": self.epochs_done, "loss": total / len(shuffled), "held_out_error": held, "rate": rate, "seconds": seconds}
        self.curves.append(point)
        return point

    def result(self) -> nn.Module:
        """The trained network. Its weights are the best on the held-out rows if the recipe has patience, else the averaged ones."""
        if self.recipe.patience:
            self.network.load_state_dict(self.best_weights)
        elif self.recipe.average:
            with torch.no_grad():
                torch._foreach_copy_(list(self.network.parameters()), self.averaged)
        return self.network.eval()

    def state(self) -> dict:
        """Everything that is needed to continue the training."""
        parts = {key: getattr(self, key).state_dict() for key in STATEFUL}
        parts |= {"generator": self.generator.get_state(), "torch": torch.get_rng_state()}
        return {key: getattr(self, key) for key in STATE} | parts

    def load(self, state: dict) -> None:
        """Continue from a state."""
        for key in STATEFUL:
            getattr(self, key).load_state_dict(state[key])
        self.generator.set_state(state["generator"])
        torch.set_rng_state(state["torch"])
        for key in STATE:
            setattr(self, key, state[key])
        self.averaged = [value.to(self.device) for value in self.averaged]

    def _step(self, chosen: torch.Tensor) -> float:
        if self.recipe.schedule == "cosine":
            along = self.steps / (self.recipe.epochs * self.steps_of_epoch)
            for group in self.optimiser.param_groups:
                group["lr"] = self.recipe.rate * min(1.0, (self.steps + 1) / RISE_STEPS) * 0.5 * (1 + math.cos(math.pi * along))
        rows = self.rows
        out = self.network(*(part.to(self.device) for part in rows.inputs.batch(chosen)))
        labels, executed, weight = (part.to(self.device) for part in (rows.labels[chosen], rows.executed[chosen], rows.weight))
        loss = row_loss(out, labels, executed, weight, self.recipe.loss)
        if (penalty := self.penalty(self.network)) is not None:
            loss = loss + penalty
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        self.steps += 1
        if self.recipe.average:
            share = min(1 - self.recipe.average, 1.0) if self.steps > RISE_STEPS else 1.0
            with torch.no_grad():
                torch._foreach_lerp_(self.averaged, [p.detach() for p in self.network.parameters()], share)
        return float(loss.detach())

    def _watch(self) -> float:
        """Mean absolute error of the scaled labels on the held-out rows."""
        if not len(self.rows.held):
            return math.nan
        out = predict_rows(self.network, self.rows.inputs, self.rows.held, self.recipe.batch)
        return float((out["mean"] - self.rows.labels[self.rows.held]).abs().mean())


def row_loss(out: dict, labels: torch.Tensor, executed: torch.Tensor, weight: torch.Tensor, kind: str) -> torch.Tensor:
    """Mean over rows of the labels' weighted error, plus the losses of error scale and executed move if the network gives these.

    The error scale is that of a Laplace distribution around the mean. Its loss has no gradient with respect to the mean.
    """
    error = out["mean"] - labels
    loss = ((error.abs() if kind == "l1" else error.square()) * weight).mean()
    if "first" in out:  # the first guess of a network that refines it later
        loss = loss + ((out["first"] - labels).abs() * weight).mean()
    if "log_scale" in out:
        scale = out["log_scale"]
        loss = loss + SCALE_LOSS * (error.detach().abs() * torch.exp(-scale) + scale).mean()
    if "executed" in out and bool((known := torch.isfinite(executed)).any()):
        cross = nn.functional.binary_cross_entropy_with_logits(out["executed"][known], executed[known])
        loss = loss + EXECUTED_LOSS * cross
    return loss


def parameter_count(network: nn.Module) -> int:
    """Number of trainable parameters."""
    return sum(p.numel() for p in network.parameters())


def device_of(network: nn.Module) -> torch.device:
    """The device that holds a network's parameters."""
    return next(network.parameters()).device


def choose_device(name: str) -> str:
    """``cpu`` or ``cuda`` for ``auto`` (a GPU where there is one), ``cpu`` or ``cuda``.

    Raises
    ------
    OptionError
        The name is another one.
    TrainingError
        It is ``cuda``, and PyTorch finds no GPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise OptionError(f"`device` must be auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("`device` cuda: PyTorch finds no GPU here; give `device` cpu, or install a PyTorch built for your GPU")
    return "cuda" if name != "cpu" and torch.cuda.is_available() else "cpu"


def predict_rows(network: nn.Module, inputs: Inputs, rows: torch.Tensor, batch: int = 256) -> dict[str, torch.Tensor]:
    """The network's outputs for some rows, in evaluation mode, on the CPU."""
    if network.training:
        network.eval()
    parts: list[dict[str, torch.Tensor]] = []
    with torch.no_grad():
        for chosen in rows.split(batch):
            out = network(*(part.to(device_of(network)) for part in inputs.batch(chosen)))
            parts.append({key: value.cpu() for key, value in out.items()})
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
