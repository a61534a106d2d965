"""The configuration of a simulated data set, and the random draw of each of its contacts."""

import json
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError

from scenes.base import NonNegative, Section
from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.randomisation import FrictionSpread, RandomisationSpec, number_type
from scenes.sensor import SensorSpec
from twin.errors import ContactError, DatasetError
from twin.frames.folders import pictures_folder
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel
from twin.types import FINE, Form, Quality, present_value

Images = Literal["raw", "gray", "processed", "none"]
States = Literal["end", "all"]

MOST_CONTACTS = 1_000_000
"""Most contacts of a data set. At one second each, a core needs twelve days for them."""


def require_count(count: int, option: str = "`count`") -> None:
    """Raise ``DatasetError`` if a data set can't have this number of contacts; ``option`` names the source of the number."""
    if not 1 <= count <= MOST_CONTACTS:
        raise DatasetError(f"{option} {count}: a data set has 1 to {MOST_CONTACTS} contacts")


class GenerationConfig(Section):
    """Everything that determines the frames of a data set, except their number.

    Attributes
    ----------
    friction : float
        Coefficient of friction of every contact, unless the randomisation draws it.
    images : {"raw", "gray", "processed", "none"}
        Which pictures are rendered: the camera's frame, its luminance, the processed (thresholded) frame, or none (pins alone).
    states : {"end", "all"}
        Which states of a contact are kept: the last one, or every converged state on the path to it.
    across : int
        Elements along each side of the skin's grid.
    """

    sensor: SensorSpec
    object: ObjectSpec
    experiment: ExperimentSpec
    randomisation: RandomisationSpec | None = None
    friction: NonNegative
    seed: Annotated[int, Field(ge=0)] = 0
    images: Annotated[Images, BeforeValidator(present_value)] = "raw"
    states: States = "end"
    quality: Annotated[Quality, BeforeValidator(present_value)] = "standard"
    across: Annotated[int, Field(ge=6, le=64, multiple_of=2)] = FINE

    @property
    def form(self) -> Form:
        """Form of frame in whose pixels the pins are given. Without pictures it is the recordings' form if the sensor has one, else raw."""
        if self.images == "none":
            return Form.PROCESSED if self.sensor.recording else Form.RAW
        return Form.PROCESSED if self.images == "processed" else Form.RAW

    @property
    def image_folder(self) -> str:
        """Name of the subfolder of a recording that holds pictures of this kind."""
        return pictures_folder(self.images)

    def text(self) -> str:
        """The configuration as JSON. Equal configurations give equal texts."""
        return json.dumps(self.model_dump(mode="json"), indent=1, sort_keys=True) + "\n"


@dataclass(frozen=True)
class Draw:
    """One randomly sampled contact.

    Attributes
    ----------
    label : ArmLabel
    sensor : SensorSpec
        The sensor with the values sampled for this contact.
    friction : float
        Coefficient of friction.
    values : dict of str to float
        The sampled values, by key of the randomisation.
    image_seed : int
        Seed of the picture's noise.
    noise : numpy.random.Generator
        Generator of the noise of the stored pins.
    """

    label: ArmLabel
    sensor: SensorSpec
    friction: float
    values: dict
    image_seed: int
    noise: np.random.Generator


def draw_label(experiment: ExperimentSpec, rng: np.random.Generator, executed_share: float = 1.0) -> ArmLabel:
    """Draw pose and move, each number uniformly over its range."""
    low, high = np.array(list(experiment.ranges().values())).T
    numbers = rng.uniform(low, high)
    return ArmLabel(numbers[:6], numbers[6:], bool(rng.random() < executed_share))


def draw_contact(config: GenerationConfig, index: int, attempt: int) -> Draw:
    """The ``attempt``-th draw of contact ``index``. It depends on these two numbers and the configuration alone.

    Raises
    ------
    ContactError
        The sampled values do not make a valid sensor.
    """
    streams = [np.random.default_rng([config.seed, index, attempt, part]) for part in range(5)]
    how = config.randomisation
    label = draw_label(config.experiment, streams[0], how.executed_share if how else 1.0)
    friction = draw_friction(how.friction, streams[1]) if how and how.friction else config.friction
    sensor, values = draw_sensor(config.sensor, how, streams[2]) if how and how.sensor else (config.sensor, {})
    return Draw(label, sensor, friction, values, int(streams[3].integers(2**31)), streams[4])


def draw_friction(spread: FrictionSpread, rng: np.random.Generator) -> float:
    """Draw a coefficient of friction."""
    kind, value = rng.random(), float(np.exp(rng.uniform(np.log(spread.low), np.log(spread.high))))
    if kind < spread.free_share:
        return 0.0
    return spread.stick if kind > 1 - spread.stick_share else value


def draw_sensor(nominal: SensorSpec, how: RandomisationSpec, rng: np.random.Generator) -> tuple[SensorSpec, dict]:
    """A copy of a sensor with randomly sampled values, and these values by key. They are sampled in the alphabetical order of the keys."""
    plain = nominal.model_dump(mode="json") | {"rig": rig_of(nominal).model_dump(mode="json")}
    values = {}
    for key, spread in sorted(how.sensor.items()):
        section, name = key.split(".")
        share, (low, high) = rng.random(), spread.ends
        if plain[section] is None:
            raise DatasetError(f"randomisation {how.name}: {nominal.name} has no [{section}], so '{key}' can't be sampled; leave it out")
        if spread.scale:
            value = plain[section][name] * (low ** (1 - share) * high**share)
        else:
            value = low + share * (high - low) + (plain[section][name] if spread.add else 0)
        values[key] = plain[section][name] = int(round(value)) if number_type(key) is int else value
    try:
        return SensorSpec.model_validate(plain), values
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"])) or "sensor"
        raise ContactError(f"the sampled numbers make no sensor: {where}: {problem['msg']}; narrow the randomisation") from error
