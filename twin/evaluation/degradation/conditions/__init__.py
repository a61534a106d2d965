"""All known conditions, by name."""

import difflib

from scenes.files import quote
from scenes.plugins import others
from twin.errors import TwinError
from twin.evaluation.degradation.condition import Condition
from twin.evaluation.degradation.conditions import body, electronics, optics, placement

FAMILIES = (optics, body, placement, electronics)
CONDITIONS: dict[str, Condition] = {c.name: c for family in FAMILIES for c in family.CONDITIONS}
CONDITIONS |= {c.name: c for c in others("conditions", CONDITIONS, is_one=lambda part: isinstance(part, Condition)).values()}


def condition(name: str) -> Condition:
    """The condition with this name.

    Raises
    ------
    TwinError
        There is no such condition; the message names the nearest one.
    """
    if name in CONDITIONS:
        return CONDITIONS[name]
    near = difflib.get_close_matches(name, CONDITIONS, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(CONDITIONS)}"
    raise TwinError(f"no condition named '{quote(name)}': {hint}")


def condition_lines() -> list[str]:
    """All conditions as lines of text, with their parameters and the most severe value."""
    return [f"{c.name:18} {c.family:12} {c.title}: {c.parameter}, up to {c.severe:g} {c.unit}".rstrip() for c in CONDITIONS.values()]
