"""The one error a specification can raise.

What every specification section shares: frozen, strict, no unknown key, no NaN."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class SpecError(ValueError):
    """A specification file is missing, unreadable or impossible.

    The message names the file, the key and the remedy, on one line.
    """


Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Index = Annotated[float, Field(ge=1, le=3)]
NearOne = Annotated[float, Field(ge=0.9, le=1.1)]
Rgb = tuple[Fraction, Fraction, Fraction]


class Section(BaseModel):
    """A frozen section of a specification file; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
