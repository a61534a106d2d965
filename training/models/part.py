"""The interface of a model for the rest of the code. Each model is an object of a class below, in its own package.

A run calls these methods in this order: ``prepare`` (makes inputs of frames, and fits to the training frames what the networks
need), ``build`` (makes a network with random weights), ``initialise`` (sets a network's constants from the training rows before the
first step), and ``modes`` if a Gaussian process is averaged with the networks (makes that process's inputs). A trained model estimates
by ``estimate_frame`` and ``estimate_rows``. ``pack`` and ``unpack`` make and read its small copy. Ensembles and intervals are the same
for all models (``training.runs.assemble``).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch import nn

from scenes.sensor import SensorSpec
from training.data.dataset import Dataset
from training.data.label_code import LabelCode
from training.data.pins import PinTable, cap_light
from training.errors import TrainingError
from twin.pins import Pipeline, Reference
from twin.types import Frame, Observation

LIKELY = 0.5  # least probability of a contact for which a frame gets an estimate
SEEN_DECIMALS = 3  # decimals of pins (px) and areas (px^2) that are compared: the last bits of a centroid may differ between machines
Learnt = Mapping[str, Mapping[str, np.ndarray]]  # groups of named arrays that a model learnt before its networks
Weights = dict[str, torch.Tensor]  # a network's state


@dataclass(frozen=True)
class Recipe:
    """Settings of a training run.

    Attributes
    ----------
    epochs, batch : int
    rate : float
        Adam's learning rate, before the schedule changes it.
    schedule : {"cosine", "plateau", "constant"}
        Cosine: after a short rise the rate falls to 0 over all epochs. Plateau: it is halved after three epochs in which the loss of
        the last training batch did not fall, as in the published code. Constant: it does not change.
    patience : int
        Number of epochs without a smaller error on the held-out fold after which training stops. With 0 it never stops early, and the
        result are the last, averaged weights.
    decay : float
        Weight decay (AdamW); 0 for Adam.
    average : float
        Decay of the exponential average of the weights over steps, in (0, 1); 0: no average.
    loss : {"l1", "l2"}
    scaling : {"standard", "unit", "none"}
        Scaling of the labels: to mean 0 and variance 1, to the range [-1, 1], or none (mm and deg).
    members : int
        Number of networks in the ensemble; each holds out another fold.
    kernel : bool
        Whether a Gaussian process is averaged with the networks; the model must have modes.
    """

    epochs: int = 100
    batch: int = 256
    rate: float = 2e-3
    schedule: str = "cosine"
    patience: int = 0
    decay: float = 1e-3
    average: float = 0.995
    loss: str = "l1"
    scaling: str = "standard"
    members: int = 2
    kernel: bool = False


class Inputs(Protocol):
    """The networks' inputs of M frames."""

    def __len__(self) -> int: ...

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The network's arguments for some rows (B,) int64."""
        ...


class ArrayInputs:
    """Inputs that are one array: ``batch`` gives some of its rows.

    Parameters
    ----------
    values : (M, ...) array
    """

    def __init__(self, values: np.ndarray) -> None:
        self.values = torch.from_numpy(values)

    def __len__(self) -> int:
        return len(self.values)

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See ``Inputs``."""
        return (self.values[rows],)


@dataclass(frozen=True)
class Prepared:
    """Inputs for training on M frames.

    Attributes
    ----------
    inputs : Inputs
        ``views`` times M rows: row v M + k is frame k in view v. View 0 is the unchanged frame.
    learnt : dict
        Arrays fitted to the training frames; they are stored with the weights.
    views : int
        Number of versions of each frame that the network is trained on.
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
        Estimated labels in mm and deg, and half of the 90 % interval for the kind of label that the model was trained on.
    half_width_raw : (B, K) float
        Half of the 90 % interval for raw labels, whose moves may not have been executed.
    executed : (B,) float
        Probability that the shear move was executed; NaN if the model does not estimate it.
    touched : float
        For a single frame, the probability that anything is touched; NaN without a frame without contact to compare with.
    seen : Observation or None
        For a single frame, the pins from which the labels were estimated; None if the model uses the picture itself.
    """

    mean: np.ndarray
    half_width: np.ndarray
    half_width_raw: np.ndarray
    executed: np.ndarray
    touched: float = float("nan")
    seen: Observation | None = None


@dataclass(frozen=True)
class OneFrame:
    """The pins of one frame: a table of one row, the probability ``touched`` of a contact as in ``Prediction``, the share of the pins in
    view that were not found, and the pipeline's observation of the frame, if it is known."""

    pins: PinTable
    touched: float = float("nan")
    lost_share: float = 0.0
    seen: Observation | None = None


@dataclass(frozen=True)
class Unseen:
    """A frame that shows too little for an estimate, with the reason; ``touched`` and ``inputs_seen`` as in ``Prediction``."""

    reason: str
    touched: float = float("nan")
    seen: Observation | None = None


@dataclass(frozen=True)
class Modes:
    """Inputs of a Gaussian process for B rows.

    Attributes
    ----------
    inputs : (B, D) float
    share : (B,) float
        Weight of view 1 (see ``Prepared``) for each row, 0 to 1; view 0 has the remaining weight.
    """

    inputs: np.ndarray
    share: np.ndarray


@dataclass(frozen=True)
class Trained:
    """Everything that a trained model needs for its estimates.

    Attributes
    ----------
    sensor : SensorSpec
    pipeline : Pipeline
        Pipeline of the sensor whose frames are estimated.
    reference : Reference
        The pins at rest in training.
    learnt : dict
        As in ``Prepared``.
    ensemble : callable
        ``ensemble(inputs, rows)`` gives the labels of rows (B,) of inputs.
    touched : callable, optional
        ``touched(nodes_px, lost)`` gives the probability that a frame's pins (N, 2) show a contact
        (``training.touch.contact_probability``). It is None unless the pins at rest were measured in a frame without contact.
    """

    sensor: SensorSpec
    pipeline: Pipeline
    reference: Reference
    learnt: Learnt
    ensemble: Callable[[Inputs, torch.Tensor], Prediction]
    touched: Callable[[np.ndarray, np.ndarray], float] | None = None


@dataclass(frozen=True)
class Variant:
    """A model without one of its ingredients, to measure what that ingredient contributes.

    Attributes
    ----------
    size : dict
        Sizes of the network that differ from the model's own.
    recipe : dict
        Settings of the recipe that differ from the model's own.
    """

    size: Mapping[str, int] = field(default_factory=dict)
    recipe: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Model(ABC):
    """One model, with everything that the rest of the code needs to know about it.

    Attributes
    ----------
    name : str
        Name by which a user chooses the model.
    description : str
        One line.
    recipe : Recipe
        Default settings of its training.
    variants : dict of str to Variant
        Variants by the name of the part that is left out. ``NAME-without-PART`` can be trained.
    published_mm_deg : (float, float), optional
        Mean absolute errors of depth (mm) and angle (deg) that its authors published.
    timed_batches : int, optional
        Number of batches that a speed measurement runs, for models whose epoch takes many minutes on a CPU. None: a whole epoch.
    counts_from_rest : bool
        Whether its inputs are displacements from the pins at rest, so that a frame without contact of the sensor in use improves them.
    has_modes : bool
        Whether it has ``modes``, so that a Gaussian process can be averaged with its networks.
    modes_scaled : bool
        Whether the scales of its modes show their importance, so that the process needs only one common length.
    derived : tuple of str, optional
        Weights that a small copy leaves out, because ``build`` makes them again. None: the model has no small copy.
    """

    name: str
    description: str
    recipe: Recipe
    variants: Mapping[str, Variant] = field(default_factory=dict)
    published_mm_deg: tuple[float, float] | None = None
    timed_batches: int | None = None

    counts_from_rest: ClassVar[bool] = False
    has_modes: ClassVar[bool] = False
    modes_scaled: ClassVar[bool] = False
    derived: ClassVar[tuple[str, ...] | None] = None

    @abstractmethod
    def prepare(self, data: Dataset, train: np.ndarray) -> Prepared:
        """Make the inputs of all M frames of a data set, and learn from its training rows (m,) what the networks need."""

    @abstractmethod
    def inputs_seen(self, data: Dataset) -> object:
        """All that the model uses of a data set's frames, as input of ``inputs_digest``. Frames with equal values are equal for it."""

    @abstractmethod
    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> nn.Module:
        """Make a network with random weights. Its output is a dict with ``mean`` (B, K).

        The output may also have ``log_scale`` (B, K), the logarithm of each label's expected error, and ``executed`` (B,), the logit
        of the probability that the shear move was executed.

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

    def initialise(  # noqa: B027  (most take nothing)
        self, network: nn.Module, inputs: Inputs, rows: torch.Tensor, numbers: torch.Tensor, code: LabelCode
    ) -> None:
        """Set the parts of a network that follow from the training rows (m,), before its first step. Most models have none.

        Parameters
        ----------
        numbers : (M, E) float
            Standardised numbers of all frames' labels.
        code : LabelCode
            Code of the labels.
        """

    def penalty(self, network: nn.Module) -> torch.Tensor | None:
        """The number that training adds to the loss of every batch; None if there is none."""
        return None

    def modes(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """Inputs of a Gaussian process for rows (B,).

        Raises
        ------
        TrainingError
            The model has none: see ``has_modes``.
        """
        raise TrainingError(f"{self.name} has no modes for a Gaussian process; train it with `kernel=False`")

    @abstractmethod
    def estimate_frame(self, trained: Trained, frame: Frame) -> Prediction | Unseen:
        """Estimate the labels of one frame.

        Raises
        ------
        FrameError
            The frame does not belong to the model's sensor: wrong size, type or form.
        """

    @abstractmethod
    def estimate_rows(self, trained: Trained, data: Dataset, rows: np.ndarray) -> Prediction:
        """Estimate the labels of some rows (B,) of a data set whose frames are all of one camera."""

    def pack(self, weights: Weights) -> Weights:
        """The weights of a network that its small copy stores.

        Raises
        ------
        TrainingError
            The model has no small copy.
        """
        if self.derived is None:
            raise TrainingError(f"{self.name} has no small copy: the effect of half precision on it was never measured")
        return {key: value for key, value in weights.items() if key not in self.derived}

    def unpack(self, packed: Weights, blank: Weights) -> Weights:
        """The weights of a network from its small copy ``packed``; ``blank`` are the weights of the network that ``build`` makes."""
        return packed | {key: blank[key] for key in self.derived or ()}


class PinModel(Model):
    """A model whose only inputs are the pins that the pipeline finds.

    Attributes
    ----------
    sees_light : bool
        Whether it also uses the gray level at each pin.
    unmeasured_widens : float
        Factor on the intervals if no frame without contact shows the camera's place.
    """

    sees_light: ClassVar[bool] = False
    unmeasured_widens: ClassVar[float] = 1.0

    @abstractmethod
    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> Inputs:
        """Inputs of a table's frames.

        Parameters
        ----------
        learnt : dict
            As in ``Prepared``.
        reference : Reference
            The pins at rest in training; ``pins`` has those of the present sensor.
        together : bool
            Whether all frames are of one camera that did not move between them, and no frame without contact shows its place.
        """

    def prepare_pins(self, pins: PinTable, train: np.ndarray) -> Prepared:
        """As ``Model.prepare``, from the pins alone."""
        return Prepared(self.inputs(pins, {}, pins.reference, together=False))

    def prepare(self, data: Dataset, train: np.ndarray) -> Prepared:
        """See ``Model``."""
        return self.prepare_pins(data.pins, train)

    def inputs_seen(self, data: Dataset) -> object:
        """See ``Model``: the pins, and their places at rest."""
        pins = data.pins
        places = [np.round(px, SEEN_DECIMALS) + 0.0 for px in (pins.nodes_px, pins.area_px2, pins.reference.pins_px)]
        return [*places, pins.lost, pins.measured]

    def estimate_frame(self, trained: Trained, frame: Frame) -> Prediction | Unseen:
        """See ``Model``."""
        seen = self.pins_in(trained, frame)
        return seen if isinstance(seen, Unseen) else self.estimate_one(trained, seen)

    def pins_in(self, trained: Trained, frame: Frame) -> OneFrame | Unseen:
        """The pins of one frame; raises as ``estimate_frame``."""
        seen = trained.pipeline(frame)
        if not seen.valid or seen.graph is None:
            return Unseen(seen.reason, seen=seen)
        lost = np.isnan(seen.pins_px[:, 0])
        touched = float("nan") if trained.touched is None else trained.touched(seen.graph.nodes_px, lost)
        if touched < LIKELY:
            return Unseen(f"no contact (its probability is {touched:.0%})", touched, seen)
        graph, reference = seen.graph, trained.pipeline.reference
        light = cap_light(frame, graph.nodes_px, reference) if self.sees_light else np.zeros(len(lost))
        columns = np.array([frame.name]), graph.nodes_px[None], graph.area_px2[None], lost[None], np.ones(1, bool)
        measured = reference is not trained.reference
        pins = PinTable(trained.sensor, trained.pipeline.form, reference, *columns, measured=measured, light=light[None])
        return OneFrame(pins, touched, 1 - seen.found / max(seen.expected, 1), seen)

    def estimate_one(self, trained: Trained, seen: OneFrame) -> Prediction:
        """Estimate the labels of one frame."""
        return replace(self.estimate_pins(trained, seen.pins), touched=seen.touched, seen=seen.seen)

    def estimate_rows(self, trained: Trained, data: Dataset, rows: np.ndarray) -> Prediction:
        """See ``Model``."""
        return self.estimate_pins(trained, data.pins.rows(rows))

    def estimate_pins(self, trained: Trained, pins: PinTable) -> Prediction:
        """Estimate the labels of the valid frames of one camera.

        If the camera sits at another place than in training, its displacement is measured in the table's own frame without contact. Without
        such a frame it is the median over the frames.
        """
        inputs = self.inputs(pins, trained.learnt, trained.reference, together=not pins.measured)
        return trained.ensemble(inputs, torch.arange(len(pins)))


def refuse_sizes(model: Model, size: Mapping[str, int], known: tuple[str, ...] = ()) -> None:
    """Refuse sizes that a model does not have.

    Raises
    ------
    TrainingError
    """
    if odd := sorted(set(size) - set(known)):
        there_are = f"there are {', '.join(known)}" if known else "it has no sizes to choose"
        raise TrainingError(f"{model.name} has no size {', '.join(odd)}; {there_are}")
