"""How each model is trained unless told otherwise."""

from dataclasses import asdict, dataclass, fields, replace

from twin.errors import TwinError


class TrainingError(TwinError):
    """A training run can't be started, continued or used as asked."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a training run.

    Attributes
    ----------
    inputs : {"pins", "graphs", "images"}
        What the network sees of a frame.
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
        Whether a Gaussian process on the network's modes is averaged in.
    """

    inputs: str = "pins"
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
    kernel: bool = True


# the release's settings; the same with more and smaller steps that end at a rate of 0, where the paper says nothing;
# PoseNet's (Lepora 2020)
_RELEASE = Recipe("graphs", 200, 512, 1.5e-3, "plateau", 30, 0.0, 0.0, "l1", "none", 1, False)
_GRAPHS = Recipe("graphs", 150, 128, 2e-3, "cosine", 0, 0.0, 0.0, "l1", "none", 1, False)
_POSENET = Recipe("images", 100, 16, 1e-4, "constant", 10, 0.0, 0.0, "l2", "unit", 1, False)

RECIPES = {
    "vgnn": Recipe(),
    "gnn": _GRAPHS,
    "tac-vgnn": _GRAPHS,
    "tac-vgnn-release": _RELEASE,
    "cnn-v1": _POSENET,
    "cnn-v2": _POSENET,
}


def recipe_of(model: str, **changes) -> Recipe:
    """The recipe of a model with some settings changed; None leaves a setting as it is.

    Raises
    ------
    TrainingError
        For a model or setting that does not exist.
    """
    if model not in RECIPES:
        raise TrainingError(f"no model '{model}'; choose one of {', '.join(RECIPES)}")
    known = {field.name for field in fields(Recipe)}
    if odd := set(changes) - known:
        raise TrainingError(f"no setting {', '.join(sorted(odd))}; there are {', '.join(sorted(known))}")
    recipe = replace(RECIPES[model], **{key: value for key, value in changes.items() if value is not None})
    for key in ("epochs", "batch", "members"):
        if getattr(recipe, key) < 1:
            raise TrainingError(f"{key} must be at least 1, got {getattr(recipe, key)}")
    return recipe


def as_dict(recipe: Recipe) -> dict:
    """The settings as JSON holds them."""
    return asdict(recipe)
