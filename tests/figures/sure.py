"""Changed real frames given to the shipped weights: which are estimated right, refused, and estimated confidently wrong."""

from pathlib import Path

from changed_views import CASES, Counts, count_changes

from figures.jobs import NO_PICTURES, Measured, Value, job, real_folder


def key_of(change: str) -> str:
    """A change's name as part of a figure's."""
    return change.replace(" ", "_").replace("%", "percent").replace(".", "_")


@job(
    "sure.changes",
    "make figures ONLY=sure.changes",
    sensors=("mg400-331", "mg400-127", "ur5-331"),
    beside=NO_PICTURES,
    code=(
        "training.estimate.estimator",
        "training.estimate.rest",
        "training.estimate.widening",
        "training.estimate.contact_estimator",
        "training.estimate.domain",
        "changed_views",
    ),
    shipped=("training/weights",),
    recordings=tuple(dict.fromkeys(recording for _, recording, _, _ in CASES.values())),
    minutes=20,
)
def changed_views(work: Path) -> Measured:
    """Shares over all recordings, and the most confidently wrong frames of one of them."""
    counts: dict[str, list[Counts]] = {}
    for case in CASES:
        for name, _, found in count_changes(case, real_folder()):
            counts.setdefault(key_of(name), []).append(found)
    measured = {}
    for name, each in counts.items():
        total = sum(found.valid + found.refused for found in each)
        for key in ("right", "refused", "wrong"):
            measured[f"{name}_{key}"] = Value(sum(getattr(found, key) for found in each) / total)
        measured[f"{name}_most"] = Value(max(found.wrong for found in each))
    return measured
