"""How far a sensor may degrade, ours beside the paper's pipeline."""

import json
from pathlib import Path

from figures.jobs import Measured, Value, job, run_twin


@job(
    "robustness.mg400-331",
    "twin robustness --sensor mg400-331 --jobs 2 --out OUT",
    sensors=("mg400-331",),
    code=("training.studies.degradation",),
    minutes=4,
)
def robustness(work: Path) -> Measured:
    """Conditions in which our pipeline tolerates as much as the paper's, and twice as much."""
    run_twin(work, "robustness", "--sensor", "mg400-331", "--jobs", 2, "--out", work / "sweep")
    content = json.loads((work / "sweep" / "envelope.json").read_text())
    beside = next(comparison for comparison in content["comparisons"] if comparison["theirs"] == "legacy")
    found = {name: Value(beside[name]) for name in ("cases", "as_wide", "twice")}
    return found | {"narrower": Value(len(beside["narrower"]))}
