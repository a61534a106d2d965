"""The file of a sweep: its conditions, their ranges, the steps, and pairs of conditions."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scenes.base import Section, SpecError
from scenes.load import read_section
from twin.errors import ErrorsAs, TwinError
from twin.evaluation.degradation.condition import Condition, DegradedCase
from twin.evaluation.degradation.conditions import CONDITIONS, condition
from twin.evaluation.degradation.sweep import SEVERITIES


class ConditionPlan(Section):
    """One condition of a sweep.

    Attributes
    ----------
    name : str
        Name of a condition; ``twin robustness --list`` lists all of them.
    severe : float, optional
        Value at severity 1, in the unit of the condition's parameter. The default is the condition's own value, which is the most severe
        one.
    """

    name: str
    severe: float | None = None

    def condition(self) -> Condition:
        """The condition with its range.

        Raises
        ------
        TwinError
            The condition is unknown, or the range is not within its own range.
        """
        known = condition(self.name)
        if self.severe is None:
            return known
        if not 0 < (self.severe - known.nominal) / (known.severe - known.nominal) <= 1:
            raise TwinError(
                f"{self.name}: severe = {self.severe:g} is not between {known.nominal:g} (where nothing is degraded) and"
                f" {known.severe:g} {known.unit}".rstrip()
            )
        return replace(known, severe=self.severe)


class SweepPlan(Section):
    """A user's sweep.

    Attributes
    ----------
    steps : tuple of float
        Increasing severities between 0 and 1 (0 is always included). The defaults have smaller steps at small severities.
    condition : tuple of ConditionPlan
        The conditions to sweep; if empty, all of them.
    pairs : tuple of (str, str)
        Pairs of names. Both conditions of a pair act together, with the same severity.
    """

    steps: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = SEVERITIES[1:]
    condition: tuple[ConditionPlan, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()

    def severities(self) -> tuple[float, ...]:
        """All severities, from 0 upwards."""
        return (0.0, *sorted(set(self.steps)))

    def cases(self) -> tuple[DegradedCase, ...]:
        """Single conditions, then pairs.

        Raises
        ------
        TwinError
            A condition is unknown, has an impossible range, or is named twice.
        """
        asked = self.condition or (() if self.pairs else tuple(ConditionPlan(name=name) for name in CONDITIONS))
        named = {each.name: each.condition() for each in asked}
        singles = tuple(DegradedCase((named[each.name],)) for each in asked)
        pairs = tuple(DegradedCase(tuple(named.get(name) or condition(name) for name in pair)) for pair in self.pairs)
        cases = Counter("+".join(sorted(c.name for c in case.conditions)) for case in singles + pairs)
        if twice := [name for name, count in cases.items() if count > 1]:
            raise TwinError(f"named twice: {', '.join(twice)}; name each condition and each pair once")
        if alone := [a for a, b in self.pairs if a == b]:
            raise TwinError(f"a pair needs two conditions, got {alone[0]} with itself")
        return singles + pairs


def load_plan(path: Path) -> SweepPlan:
    """Read a sweep's file.

    Raises
    ------
    TwinError
        The file can't be read, or a key or name is unknown.
    """
    with ErrorsAs(SpecError, lambda error: TwinError(f"{error}; 'twin robustness --help' shows such a file")):
        return read_section(path, SweepPlan)
