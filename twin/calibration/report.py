"""The calibration's page: before, after, what is left, what changed."""

from pathlib import Path

from scenes.sensor import SensorSpec
from twin.calibration.run import Calibration
from twin.realism.images import difference_picture
from twin.recordings.images import write_image
from twin.report.page import render_page

LONGEST = 12  # numbers of a list that the page shows


def write_page(out: Path, start: SensorSpec, found: Calibration, source: str) -> Path:
    """Write ``index.html`` and its pictures into ``out``; the page's path."""
    pictures = out / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    rows = []
    for frame, before, after in zip(found.frames, found.first, found.last, strict=True):
        images = {"real": frame.image, "before": before, "after": after, "residual": difference_picture(frame.image, after)}
        row = {"name": frame.name}
        for kind, image in images.items():
            path = pictures / f"{Path(frame.name).stem}-{kind}.png"
            write_image(path, image)
            row[kind] = f"{pictures.name}/{path.name}"
        rows.append(row)
    path = out / "index.html"
    path.write_text(
        render_page(
            "twin.calibration",
            spec=found.spec,
            frames=len(rows),
            source=source,
            before=found.before,
            after=found.after,
            notes=found.notes,
            rows=rows,
            changes=changes(start, found.spec),
        )
    )
    return path


def changes(before: SensorSpec, after: SensorSpec) -> list[dict]:
    """Every value that differs: ``name`` as section.key, ``before`` and ``after`` as text."""
    old, new = before.model_dump(), after.model_dump()
    found = []
    for section, values in new.items():
        if isinstance(values, dict):
            found += [
                {"name": f"{section}.{key}", "before": _shown(old[section][key]), "after": _shown(value)}
                for key, value in values.items()
                if old[section] is not None and old[section][key] != value
            ]
    return found


def _shown(value) -> str:
    if isinstance(value, tuple | list):
        return (
            f"{len(value)} entries"
            if len(value) > LONGEST or (value and not isinstance(value[0], float))
            else ", ".join(_shown(v) for v in value)
        )
    return f"{value:.5g}" if isinstance(value, float) else str(value)
