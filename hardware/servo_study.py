"""Surface following of several objects with several models."""

import csv
import re
from dataclasses import asdict
from pathlib import Path

from hardware.servo_plots import comparison_figure, save_figure
from scenes import load_object, load_servo
from twin.cli.progress import count_bar
from twin.cli.servo_run import Followed, ServoRun, follow
from twin.errors import TwinError

COLUMNS = ("smoothness", "local_smoothness", "path_error_mm", "depth_error_mm", "angle_error_deg", "completed", "lost_contacts")
HEADS = ("S", "local S", "path mm", "depth mm", "angle deg", "way", "lost")


def run_study(
    estimators: dict, objects: list[str], out: Path, *, parameters: str, steps: int | None, seed: int, plain_light: bool
) -> list[str]:
    """Follow each object with each estimator; lines of the comparison, which is also written to ``out``."""
    stimuli = {name: load_object(name) for name in objects}
    servo = load_servo(parameters)
    found: dict[tuple[str, str], Followed | str] = {}
    with count_bar("objects followed") as progress:
        for label, estimator in estimators.items():
            for name, stimulus in stimuli.items():
                run = ServoRun(estimator.sensor, estimator.form, stimulus, servo, steps=steps, seed=seed, plain_light=plain_light)
                folder = out / re.sub(r"[^\w.-]+", "_", label) / name
                folder.mkdir(parents=True, exist_ok=True)
                try:
                    found[label, name] = follow(run, estimator, folder, about={"model": label})
                except TwinError as error:  # not one step: a result of the study, too
                    found[label, name] = str(error)
                progress(len(found), len(estimators) * len(stimuli))
    followed = {key: value for key, value in found.items() if isinstance(value, Followed)}
    with (out / "study.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        rows = [(*key, asdict(value.measures), value.failure) for key, value in followed.items()]
        names = list(rows[0][2]) if rows else []
        writer.writerow(["model", "object", *names, "failure"])
        writer.writerows([model, name, *measures.values(), failure] for model, name, measures, failure in rows)
    if followed:
        pictures = [(model, name, value.path, value.outline_mm) for (model, name), value in followed.items()]
        save_figure(out / "study.png", comparison_figure(pictures))
    return _lines(found) + [f"wrote {out / 'study.csv'}", *([f"wrote {out / 'study.png'}"] if followed else [])]


def _lines(found: dict) -> list[str]:
    wide = max(len(model) for model, _ in found)
    lines = [f"{'model':{wide}} {'object':10}" + "".join(f"{head:>11}" for head in HEADS)]
    for (model, name), value in found.items():
        if isinstance(value, str):
            lines.append(f"{model:{wide}} {name:10}  failed: {value}")
            continue
        measures = asdict(value.measures)
        cells = "".join(f"{measures[column]:>11.0%}" if column == "completed" else f"{measures[column]:>11.4g}" for column in COLUMNS)
        lines.append(f"{model:{wide}} {name:10}{cells}" + (f"  ended early: {value.failure}" if value.failure else ""))
    return lines
