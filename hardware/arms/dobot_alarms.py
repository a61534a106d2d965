"""Meanings and remedies of the Dobots' alarms. The MG400 and the Magician use the same numbers."""

_JOINT_ENDS = [f"J{joint} is {side} its range" for joint in (1, 2, 3, 4) for side in ("above", "below")]

ALARMS = {
    -2: "collision",
    1: "a command was not understood",
    16: "the target is at a singularity",
    17: "no joint angles reach the target",
    18: "the target is beyond a joint's range",
    20: "the places of an arc lie on one line",
    23: "the line to the target leaves the workspace",
    **dict(enumerate(_JOINT_ENDS, start=64)),
    72: "the parallelogram is at its end (J3 - J2 too large)",
    73: "the parallelogram is at its end (J3 - J2 too small)",
    **{79 + joint: f"J{joint} lost steps" for joint in (1, 2, 3, 4)},
    85: "the emergency stop is or was pressed",
    112: "collision",
}
_REMEDIES = {
    **dict.fromkeys(range(80, 84), "free the arm and home it"),
    -2: "free the arm by hand",
    85: "release the emergency stop",
    112: "free the arm by hand",
}


def explain(alarms: list[int]) -> str:
    """One line on the given alarms, with the remedy."""
    if not alarms:
        return "alarm (the arm does not report which); call clear_error(), then enable()"
    said = "; ".join(dict.fromkeys(f"alarm {alarm}: {ALARMS.get(alarm, 'see the vendor manual')}" for alarm in alarms))
    first = next((_REMEDIES[alarm] for alarm in alarms if alarm in _REMEDIES), "move away from the limit")
    return f"{said}; {first}, then call clear_error() and enable()"
