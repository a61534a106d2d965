"""Specification of the quantities that are sampled at random for each simulated contact."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from scenes.base import Fraction, Name, NonNegative, Positive, Section
from scenes.sensor import SensorSpec

Ends = tuple[float, float]


class SpreadSpec(Section):
    """Distribution of a number of a specification. Exactly one of the three keys is given.

    Attributes
    ----------
    scale : (lowest, highest)
        The specification's number is multiplied by a factor between the two ends, whose logarithm is uniformly distributed.
    add : (lowest, highest)
        A number that is uniformly distributed between the ends is added to the specification's number.
    value : (lowest, highest)
        A number that is uniformly distributed between the ends replaces the specification's number. It is rounded if the specification
        needs an integer.
    """

    scale: tuple[Positive, Positive] | None = None
    add: Ends | None = None
    value: Ends | None = None

    @property
    def ends(self) -> Ends:
        """The two ends of the key that is given."""
        return next(ends for ends in (self.scale, self.add, self.value) if ends is not None)

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [ends for ends in (self.scale, self.add, self.value) if ends is not None]
        if len(given) != 1:
            raise ValueError("give exactly one of scale, add and value")
        if given[0][0] > given[0][1]:
            raise ValueError(f"give the lower end first, got {list(given[0])}")
        return self


class FrictionSpread(Section):
    """Friction of a contact, sampled for each contact.

    Attributes
    ----------
    low, high : float
        Smallest and largest coefficient of friction. Its logarithm is uniformly distributed between them.
    free_share : float
        Fraction of the contacts without friction.
    stick_share : float
        Fraction of the contacts with the coefficient ``stick``.
    stick : float
        Coefficient of friction of these contacts. The default is so large that nothing slips.
    """

    low: Positive
    high: Positive
    free_share: Fraction = 0.0
    stick_share: Fraction = 0.0
    stick: Positive = 3.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.low > self.high:
            raise ValueError("low must not be larger than high")
        if self.free_share + self.stick_share > 1:
            raise ValueError("free_share and stick_share must not sum to more than 1")
        return self


class RandomisationSpec(Section):
    """Quantities that are sampled at random for each contact.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        One line for ``twin randomisations``.
    executed_share : float
        Fraction of the contacts in which the move is executed before the frame is taken.
    pin_noise_px : float
        Standard deviation of the noise that is added to the stored pins. Pictures have the camera's noise instead.
    friction : FrictionSpread, optional
        Distribution of the friction. Without it every contact has the friction of the rig or of the object.
    sensor : dict of str to Spread
        Distributions of numbers of the sensor's specification, by dotted key: material, geometry, camera, light, rig.
    """

    name: Name
    description: str
    executed_share: Fraction = 1.0
    pin_noise_px: NonNegative = 0.0
    friction: FrictionSpread | None = None
    sensor: Annotated[dict[str, SpreadSpec], Field(default_factory=dict)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key in self.sensor:
            if number_type(key) is None:
                raise ValueError(f"sensor.'{key}' names no number of a sensor's specification; expected e.g. 'skin.young_modulus_mpa'")
        return self


def number_type(key: str) -> type | None:
    """``int`` or ``float`` for the dotted key of a number in ``SensorSpec``, else None."""
    section, _, name = key.partition(".")
    field = SensorSpec.model_fields.get(section)
    models = [m for m in (field.annotation, *getattr(field.annotation, "__args__", ())) if hasattr(m, "file_keys")] if field else []
    found = models[0].file_keys().get(name) if models else None
    kind = found.annotation if found else None
    kind = getattr(kind, "__origin__", kind)
    return kind if kind in (int, float) else None
