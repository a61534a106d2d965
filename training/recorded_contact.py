"""The contacts of a labelled recording: its table's rows as the arm's labels."""

from pathlib import Path

import numpy as np

from training.targets import read_executed
from twin.errors import FrameError
from twin.kinematics import ArmLabel
from twin.recordings import Recording


def read_arm_labels(recording: Recording) -> list[ArmLabel]:
    """Label of each of the recording's frames, in its order; what no file says was not executed counts as executed.

    A column that is missing counts as zero: recordings leave out what they never move.

    Raises
    ------
    FrameError
        If there is no table, it has no pose, or a cell of a pose or move holds no number.
    """
    columns = {
        kind: [(axis, recording.labels[f"{kind}_{axis}"]) for axis in range(1, 7) if f"{kind}_{axis}" in recording.labels]
        for kind in ("pose", "move")
    }
    if not columns["pose"]:
        found = ", ".join(recording.labels) or "no table"
        raise FrameError(f"{recording.path}: no labels pose_1..6 (found {found}); targets.csv with them is expected beside the frames")
    values = {kind: np.zeros((len(recording), 6)) for kind in columns}
    for kind, named in columns.items():
        for axis, cells in named:
            values[kind][:, axis - 1] = cells if cells.dtype.kind == "f" else np.nan
    odd = ~np.isfinite(np.hstack([values["pose"], values["move"]])).all(axis=1)
    if odd.any():
        names = [recording.names[k] for k in np.flatnonzero(odd)[:3]]
        raise FrameError(f"{recording.path}: {odd.sum()} rows hold no number in a pose or move ({', '.join(names)}); mend or remove them")
    executed = read_executed(Path(recording.path), recording.problems)
    done = [executed.get(name, 1.0) > 0.5 for name in recording.names]
    return [ArmLabel(*row) for row in zip(values["pose"], values["move"], done, strict=True)]
