"""What the rest of the code asks of a model. A model is one object of a class below, in a package of its own.

A run asks a model, in this order: ``prepare`` (frames to inputs, and what is learnt from the training frames before any
network learns), ``build`` (a network with random weights), ``initialise`` (what the network takes from its training rows
before the first step), and, where a Gaussian process is averaged in, ``modes`` (what that process sees). A trained model is
asked to ``estimate_frame`` and ``estimate_rows``; a small copy of it is made and read by ``pack`` and ``unpack``. Ensembles
and intervals are the same for all models (``training.assemble``).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch import nn

from scenes.sensor import SensorSpec
from training.dataset import Dataset
from training.pins import PinTable
from training.recipes import Recipe, TrainingError
from twin.pins import Pipeline
from twin.pins.reference import Reference
from twin.types import Frame

SEEN_DECIMALS = 3  # of pins (px) and areas (px^2) that tell frames apart: the last bits of a centroid may differ between machines
Learnt = Mapping[str, Mapping[str, np.ndarray]]  # groups of named arrays that a model learnt before its networks did
Weights = dict[str, torch.Tensor]  # a network's state


class Inputs(Protocol):
    """What networks see of M frames."""

    def __len__(self) -> int: ...

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The network's arguments for some rows (B,) int64."""
        ...


@dataclass(frozen=True)
class Prepared:
    """What training on M frames starts from.

    Attributes
    ----------
    inputs : Inputs
        ``views`` times M rows: row v M + k is frame k in view v, and view 0 is the frame as it is.
    learnt : dict
        What was learnt from the training frames; it is kept with the weights.
    views : int
        Ways in which the network sees each frame.
    """

    inputs: Inputs
    learnt: Learnt = field(default_factory=dict)
    views: int = 1


@dataclass(frozen=True)
class Prediction:
    """Labels of B frames.

    Attributes
    ----------
    mean, half_width : (B, K) float
        mm and deg; half of the 90 % interval, of the labels that were learnt.
    half_width_raw : (B, K) float
        The same for the labels as published, whose moves may not have been executed.
    executed : (B,) float
        Probability that the shear move was executed; NaN where the model does not tell.
    """

    mean: np.ndarray
    half_width: np.ndarray
    half_width_raw: np.ndarray
    executed: np.ndarray


@dataclass(frozen=True)
class Unseen:
    """A frame in which a model sees too little to estimate anything, and why."""

    reason: str


@dataclass(frozen=True)
class Modes:
    """What a Gaussian process sees of B rows.

    Attributes
    ----------
    inputs : (B, D) float
    share : (B,) float
        Part of each row, 0 to 1, that is seen in view 1 (see ``Prepared``); the rest is seen in view 0.
    """

    inputs: np.ndarray
    share: np.ndarray


@dataclass(frozen=True)
class Trained:
    """A trained model as it estimates.

    Attributes
    ----------
    sensor : SensorSpec
    pipeline : Pipeline
        Of the sensor in hand.
    reference : Reference
        The pins at rest in training.
    learnt : dict
        As in ``Prepared``.
    ensemble : callable
        Labels of some rows (B,) of inputs.
    """

    sensor: SensorSpec
    pipeline: Pipeline
    reference: Reference
    learnt: Learnt
    ensemble: Callable[[Inputs, torch.Tensor], Prediction]


@dataclass(frozen=True)
class Variant:
    """A model with one of its ingredients left out, to see what that ingredient is worth.

    Attributes
    ----------
    size : dict
        Sizes of the network that differ.
    recipe : dict
        Settings of the recipe that differ.
    """

    size: Mapping[str, int] = field(default_factory=dict)
    recipe: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Model(ABC):
    """One model, by all that others need to know of it.

    Attributes
    ----------
    name : str
        As the user gives it.
    description : str
        One line.
    recipe : Recipe
        How it is trained unless told otherwise.
    variants : dict of str to Variant
        By the name of what is left out: ``NAME-without-PART`` can be trained.
    published_mm_deg : (float, float), optional
        Mean absolute errors of depth (mm) and angle (deg) that its authors state.
    timed_batches : int, optional
        Batches after which a measurement of its speed stops, where a whole epoch takes many minutes on a CPU; None times an epoch.
    counts_from_rest : bool
        Whether it counts pins from rest, so that a no-contact frame of the sensor in hand serves it.
    has_modes : bool
        Whether it has ``modes``, so that a Gaussian process can be averaged in.
    """

    name: str
    description: str
    recipe: Recipe
    variants: Mapping[str, Variant] = field(default_factory=dict)
    published_mm_deg: tuple[float, float] | None = None
    timed_batches: int | None = None

    counts_from_rest: ClassVar[bool] = False
    has_modes: ClassVar[bool] = False

    @abstractmethod
    def prepare(self, data: Dataset, train: np.ndarray) -> Prepared:
        """Inputs of all M frames of a data set, and what is learnt beforehand from its training rows (m,)."""

    @abstractmethod
    def seen(self, data: Dataset) -> object:
        """All that the model sees of a data set's frames, as ``inputs_digest`` takes it: frames with the same are the same to it."""

    @abstractmethod
    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> nn.Module:
        """A network with random weights, whose outputs are a dict with ``mean`` (B, K).

        It may also give ``log_scale`` (B, K), the logarithm of each label's expected error, and ``executed`` (B,), the logit
        that the shear move was executed.

        Parameters
        ----------
        reference : Reference
            The pins at rest.
        outputs : int
            Number of labels K.
        size : dict
            Sizes that differ from the model's own.

        Raises
        ------
        TrainingError
            The model has no such size.
        """

    def initialise(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor) -> None:  # noqa: B027  (most take nothing)
        """Let a network take from the training rows (m,) what it needs before its first step: nothing, unless a model says otherwise."""

    def penalty(self, network: nn.Module) -> torch.Tensor | None:
        """A number that training adds to the loss of every batch; None for none."""
        return None

    def modes(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """What a Gaussian process sees of rows (B,).

        Raises
        ------
        TrainingError
            The model has none: see ``has_modes``.
        """
        raise TrainingError(f"{self.name} has no modes that a Gaussian process could see; train it with --no-kernel")

    @abstractmethod
    def estimate_frame(self, trained: Trained, frame: Frame) -> Prediction | Unseen:
        """Labels of one frame.

        Raises
        ------
        FrameError
            The frame is not one of the model's sensor: wrong size, type or form.
        """

    @abstractmethod
    def estimate_rows(self, trained: Trained, data: Dataset, rows: np.ndarray) -> Prediction:
        """Labels of some rows (B,) of a data set, whose frames are of one camera."""

    def pack(self, weights: Weights) -> Weights:
        """What a small copy keeps of a network's weights.

        Raises
        ------
        TrainingError
            The model has no small copy.
        """
        raise TrainingError(f"a small copy of {self.name} is not provided for: what half precision does to it was never measured")

    def unpack(self, packed: Weights, blank: Weights) -> Weights:
        """The weights whose small copy is ``packed``; ``blank`` are those of the same network as ``build`` gives it."""
        raise TrainingError(f"a small copy of {self.name} is not provided for")


class PinModel(Model):
    """A model that sees the pins which the pipeline finds, and nothing else of a frame."""

    @abstractmethod
    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> Inputs:
        """Inputs of a table's frames.

        Parameters
        ----------
        learnt : dict
            As in ``Prepared``.
        reference : Reference
            The pins at rest in training; ``pins`` has those of the sensor in hand.
        together : bool
            Whether the frames are of one camera that did not move between them and that no no-contact frame tells of.
        """

    def prepare_pins(self, pins: PinTable, train: np.ndarray) -> Prepared:
        """``prepare`` from the pins alone."""
        return Prepared(self.inputs(pins, {}, pins.reference, together=False))

    def prepare(self, data: Dataset, train: np.ndarray) -> Prepared:
        """See ``Model``."""
        return self.prepare_pins(data.pins, train)

    def seen(self, data: Dataset) -> object:
        """See ``Model``: the pins, and where they are at rest."""
        pins = data.pins
        places = [np.round(px, SEEN_DECIMALS) + 0.0 for px in (pins.nodes_px, pins.area_px2, pins.reference.pins_px)]
        return [*places, pins.lost, pins.measured]

    def estimate_frame(self, trained: Trained, frame: Frame) -> Prediction | Unseen:
        """See ``Model``."""
        seen = trained.pipeline(frame)
        if not seen.valid or seen.graph is None:
            return Unseen(seen.reason)
        pins = PinTable(
            trained.sensor,
            trained.pipeline.form,
            trained.pipeline.reference,
            np.array([frame.name]),
            seen.graph.nodes_px[None],
            seen.graph.area_px2[None],
            np.isnan(seen.pins_px[None, :, 0]),
            np.ones(1, bool),
            measured=trained.pipeline.reference is not trained.reference,
        )
        return self._estimated(trained, pins, together=False)

    def estimate_rows(self, trained: Trained, data: Dataset, rows: np.ndarray) -> Prediction:
        """See ``Model``."""
        return self.estimate_pins(trained, data.pins.rows(rows))

    def estimate_pins(self, trained: Trained, pins: PinTable) -> Prediction:
        """Labels of the valid frames of one camera.

        Where the camera sits otherwise than in training, the table's own no-contact frame tells, or without one the median
        of the frames.
        """
        return self._estimated(trained, pins, together=not pins.measured)

    def _estimated(self, trained: Trained, pins: PinTable, *, together: bool) -> Prediction:
        inputs = self.inputs(pins, trained.learnt, trained.reference, together=together)
        return trained.ensemble(inputs, torch.arange(len(pins)))


def refuse_sizes(model: Model, size: Mapping[str, int], known: tuple[str, ...] = ()) -> None:
    """Refuse sizes that a model does not have.

    Raises
    ------
    TrainingError
    """
    if odd := sorted(set(size) - set(known)):
        there_are = f"there are {', '.join(known)}" if known else "it has none that can be chosen"
        raise TrainingError(f"{model.name} has no size {', '.join(odd)}; {there_are}")
