"""A sweep as a file: which conditions, how far, in which steps, which pairs."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from scenes.base import Section
from twin.errors import TwinError
from twin.robustness.condition import Case
from twin.robustness.conditions import CONDITIONS, condition
from twin.robustness.sweep import SEVERITIES


class ConditionPlan(Section):
    """``severe``: the parameter's value at severity 1, in the condition's unit; its own one where not given."""

    name: str
    severe: float | None = None


class SweepPlan(Section):
    """A user's sweep.

    ``steps``: severities between 0 and 1, rising (0 is always looked at). ``condition``: those to sweep (none: all).
    ``pairs``: two names each, both growing together.
    """

    steps: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = SEVERITIES[1:]
    condition: tuple[ConditionPlan, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()

    def severities(self) -> tuple[float, ...]:
        """All of them, from 0 up."""
        return (0.0, *sorted(set(self.steps)))

    def cases(self) -> tuple[Case, ...]:
        """Single conditions, then pairs.

        Raises
        ------
        TwinError
            A condition is unknown.
        """
        asked = self.condition or (() if self.pairs else tuple(ConditionPlan(name=name) for name in CONDITIONS))
        known = dict(CONDITIONS)
        for each in asked:
            known[each.name] = condition(each.name) if each.severe is None else replace(condition(each.name), severe=each.severe)
        singles = tuple(Case((known[each.name],)) for each in asked)
        pairs = tuple(Case(tuple(known.get(name) or condition(name) for name in pair)) for pair in self.pairs)
        return singles + pairs


def load_plan(path: Path) -> SweepPlan:
    """Read a sweep's file.

    Raises
    ------
    TwinError
        It can't be read, or a key or name is unknown.
    """
    try:
        return SweepPlan.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TwinError(f"{path}: not readable as TOML: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise TwinError(f"{path}: {key}: {first['msg']}; known: steps, pairs, and [[condition]] with name and severe") from error
