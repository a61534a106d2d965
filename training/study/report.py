"""The study's tables, plots and page."""

from pathlib import Path

from training.studies.tac_vgnn.contacts import AreaChange, contacts_figure
from training.studies.tac_vgnn.models import PlannedRun, error_columns, ordering, read_curves
from twin.views.page import render_page
from twin.views.plots import new_figure

DPI = 110


def draw_efficiency(path: Path, rows: list[dict]) -> Path:
    """Time of training against batch size; the marker's area is the memory."""
    figure, (ax,) = new_figure(1, panel_inch=6)
    for model in dict.fromkeys(row["model"] for row in rows):
        mine = [row for row in rows if row["model"] == model]
        batches, times = [row["batch"] for row in mine], [row["ms_per_frame"] for row in mine]
        (line,) = ax.plot(batches, times, linewidth=1)
        ax.scatter(batches, times, s=[max(row["memory_mib"] / 4, 4) for row in mine], color=line.get_color(), alpha=0.6, label=model)
    ax.set(xscale="log", yscale="log", xlabel="batch", ylabel="ms per frame in training", title="marker's area: memory")
    ax.legend(markerscale=0.5)
    figure.savefig(path, dpi=DPI)
    return path


def draw_curves(path: Path, plans: list[PlannedRun], folder: Path) -> Path:
    """Error on the watched tenth of the training rows against epochs and against time, of every run that has begun."""
    figure, axes = new_figure(2, panel_inch=5)
    for plan in plans:
        if not (folder / plan.folder / "curves.csv").is_file():
            continue
        curve = [point for point in read_curves(folder / plan.folder) if point["network"] == 0]
        error, minutes, total = [point["held_out_error"] for point in curve], [], 0.0
        for point in curve:
            total += point["seconds"] / 60
            minutes.append(total)
        scaling = {"none": "mm and deg", "standard": "standard deviations", "unit": "half ranges"}[plan.config.recipe.scaling]
        marker = "." if len(curve) < 5 else None
        axes[0].plot(range(1, len(curve) + 1), error, marker=marker, linewidth=1, label=f"{plan.folder} ({scaling})")
        axes[1].plot(minutes, error, marker=marker, linewidth=1)
    for ax, label in zip(axes, ("epoch", "minutes of training"), strict=True):
        ax.set(xlabel=label, ylabel="mean error of the scaled labels", xscale="log", yscale="log")
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=DPI)
    return path


def draw_contacts(path: Path, contacts: list[AreaChange]) -> Path:
    """The interpretability figure."""
    contacts_figure(contacts).savefig(path, dpi=DPI)
    return path


def write_page(
    out: Path, *, data, models: list[dict], graphs: list[dict], efficiency: list[dict], contacts: list[dict], notes: dict
) -> Path:
    """``index.html`` over all that was written beside it."""
    names = data.targets.names
    orders = {key: ordering(models, key) for key in error_columns(data)}
    ranges = [
        {"name": name, "unit": unit, "low": float(data.targets.raw[:, k].min()), "high": float(data.targets.raw[:, k].max())}
        for k, (name, unit) in enumerate(zip(names, data.targets.units, strict=True))
    ]
    page = render_page(
        "training.study",
        sensor=data.pins.sensor.name,
        frames=len(data),
        problems=data.problems,
        names=names,
        ranges=ranges,
        models=models,
        orders=orders,
        graphs=graphs,
        efficiency=efficiency,
        contacts=contacts,
        notes=notes,
    )
    (out / "index.html").write_text(page)
    return out / "index.html"
