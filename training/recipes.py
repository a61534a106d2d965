"""The settings of a training run; each model has its own (``training.models``)."""

from dataclasses import asdict, dataclass

from twin.errors import TwinError


class TrainingError(TwinError):
    """A training run can't be started, continued or used as asked."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a training run.

    Attributes
    ----------
    epochs, batch : int
    rate : float
        Adam's learning rate at the start.
    schedule : {"cosine", "plateau", "constant"}
        Cosine to 0 over all epochs after a short rise; halved after three epochs in which the last training batch's loss
        (which the published code watches) did not fall; or kept.
    patience : int
        Epochs without gain on the held-out fold until training stops; 0 never stops early and keeps the last, averaged weights.
    decay : float
        Weight decay (AdamW), 0 for Adam.
    average : float
        Of the weights over steps, in (0, 1); 0 without.
    loss : {"l1", "l2"}
    scaling : {"standard", "unit", "none"}
        Of the labels: mean 0 and variance 1, range [-1, 1], or mm and deg as they are.
    members : int
        Networks of the ensemble; each holds out another fold.
    kernel : bool
        Whether a Gaussian process is averaged in, which needs a model that has modes.
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


def as_dict(recipe: Recipe) -> dict[str, object]:
    """The settings as JSON holds them."""
    return asdict(recipe)
