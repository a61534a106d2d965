"""The settings of a training run. Each model has its own values (``training.models``)."""

from dataclasses import dataclass


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
