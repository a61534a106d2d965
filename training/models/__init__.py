"""Register of all models by name. To add a model, add a package beside this file and its name below."""

from dataclasses import asdict, fields

from scenes.files import quote
from scenes.plugins import others
from training.errors import TrainingError
from training.models.cnn.model import CNN_V1, CNN_V2
from training.models.graphs.model import GNN, TAC_VGNN, TAC_VGNN_RELEASE
from training.models.part import Model, Recipe, Variant
from training.models.steered.model import STEERED
from training.models.touch.model import TOUCH
from training.models.vgnn.model import VGNN

MODELS: dict[str, Model] = {}
# Text between a model's name and the name of the ingredient that is left out.
WITHOUT = "-without-"


def register(model: Model) -> None:
    """Make a model known by its name.

    Raises
    ------
    ValueError
        Another model has this name, or the name contains ``WITHOUT``.
    """
    if model.name in MODELS or WITHOUT in model.name:
        raise ValueError(f"a model can't be registered as '{model.name}': another one has this name, or it contains '{WITHOUT}'")
    MODELS[model.name] = model


for _model in (VGNN, STEERED, TOUCH, GNN, TAC_VGNN, TAC_VGNN_RELEASE, CNN_V1, CNN_V2):
    register(_model)


def model_named(name: str) -> Model:
    """The model with this name.

    Raises
    ------
    TrainingError
        There is no such model.
    """
    if name not in MODELS:
        given = others("models", MODELS, is_one=lambda part: isinstance(part, Model))
        MODELS.update({model.name: model for model in given.values()})
    if name not in MODELS:
        raise TrainingError(f"no model '{quote(name)}'; choose one of {', '.join(MODELS)}")
    return MODELS[name]


def variant_named(name: str) -> tuple[Model, Variant]:
    """The model with this name, and its variant: for ``MODEL-without-PART`` the one that leaves PART out, else an empty one.

    Raises
    ------
    TrainingError
        There is no such model or part.
    """
    of_model, _, part = name.partition(WITHOUT)
    model = model_named(of_model)
    if not part:
        return model, Variant()
    if part not in model.variants:
        can_be = f"can be trained without {', '.join(model.variants)}" if model.variants else "has no part that can be left out"
        raise TrainingError(f"no model '{quote(name)}'; {model.name} {can_be}")
    return model, model.variants[part]


def recipe_of(model: str, **changes: object) -> Recipe:
    """The recipe of a model with some settings changed; None leaves a setting as it is.

    Raises
    ------
    TrainingError
        The model or the setting does not exist.
    """
    chosen = model_named(model)
    known = {field.name for field in fields(Recipe)}
    if odd := set(changes) - known:
        raise TrainingError(f"no setting {', '.join(sorted(odd))}; there are {', '.join(sorted(known))}")
    recipe = Recipe(**asdict(chosen.recipe) | {key: value for key, value in changes.items() if value is not None})
    for key in ("epochs", "batch", "members"):
        if getattr(recipe, key) < 1:
            raise TrainingError(f"{key} must be at least 1, got {getattr(recipe, key)}")
    if recipe.kernel and not chosen.has_modes:
        raise TrainingError(f"{model} has no modes for a Gaussian process; train it with `kernel=False`")
    return recipe
