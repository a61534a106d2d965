"""``python tests/weights/domains.py FOLDER [NAME...]``: learn the domains of the shipped weights again, after a change of the domain.

They come from the training fifths of the recordings (``TACTIP_REAL``) and from simulated contacts with sixteen objects, which are generated
into FOLDER, or taken up from it (about two hours on two cores). Names: mg400-331, mg400-127, ur5-331, ur5-tacpad,
edge, plate.

``python tests/weights/domains.py --starts [NAME...]``: only measure again from where on the intervals grow, on the other fifths.
"""

import os
import sys
from pathlib import Path

import numpy as np

from scenes import ObjectSpec, SensorSpec, load_experiment, load_object, load_randomisation, load_sensor
from scenes.experiment import ExperimentSpec
from training.data.dataset import Dataset, load_dataset, split_rows
from training.data.simulated import config_of
from training.estimate.contact_estimator import ContactEstimator, contacts_folder
from training.estimate.domain import Domain, learn_domain, read_domain, write_domain
from training.estimate.estimator import PoseEstimator
from training.generation import GenerationConfig, generate
from training.models.part import LIKELY
from training.runs.run_files import DOMAIN, SHIPPED
from training.touch.contact_probability import TouchAnswer
from twin.rig.kinematics import rig_of

REAL = Path(os.environ.get("TACTIP_REAL", "../shared/real"))
LEARNT = ["plane", "sphere", "ball-10", "ball-40", "ball-80", "round-bar", "square-rod", "triangle-rod", "hexagon-rod"]
MORE = ["cylinder", "edge", "can", "mesh-can", "square", "prism", "tin-box"]
ACROSS, NOISE_PX = 12, 0.1
AROUND = {"prism": 24.0, "square": 41.0}
"""Largest distance, mm, of contacts from the middle of a face of these objects: past its edges."""
CONTACTS = ((LEARNT, 24, 71), (MORE, 5, 1071), (AROUND, 40, 2071))
"""Objects, contacts with each of them, and the seed."""
RECORDINGS = {
    "mg400-331": ("tac-vgnn-331",),
    "mg400-127": ("tac-vgnn-127",),
    "ur5-331": ("ur5-331-surface-3d-tap",),
    "ur5-tacpad": ("tacpad-force",),
    "edge": ("ur5-331-edge-2d-tap", "ur5-331-edge-2d-shear"),
    "plate": ("ur5-331-surface-3d-tap", "ur5-331-surface-3d-shear"),
}


def simulate(
    out: Path, sensor: SensorSpec, obj: ObjectSpec, experiment: ExperimentSpec, randomisation: str, *, count: int, seed: int, across: int
) -> Path:
    """Simulated contacts of pins alone, made if they are missing."""
    if not (out / "targets.csv").is_file():
        out.mkdir(parents=True, exist_ok=True)
        config = GenerationConfig(
            sensor=sensor,
            object=obj,
            experiment=experiment,
            randomisation=load_randomisation(randomisation),
            friction=rig_of(sensor).friction,
            seed=seed,
            images="none",
            states="all",
            across=across,
        )
        generate(out, config, count)
    return out


def simulated(sensor: str, folder: Path, *, raw: bool) -> list[Path]:
    """Folders of the simulated contacts of a sensor, made if they are missing; of frames of the camera if ``raw``."""
    spec, found = load_sensor(sensor), []
    if raw:
        spec = spec.model_copy(update={"recording": None, "pipeline": spec.pipeline.model_copy(update={"processed": None})})
    for objects, count, seed in ((["plane"], 24, 71),) if raw else CONTACTS:
        for name in objects:
            experiment = load_experiment("surface-3d" if raw else "objects-2d")
            if objects is AROUND:
                pose = experiment.pose.model_copy(update={"pose_1": (-AROUND[name], AROUND[name])})
                experiment = experiment.model_copy(update={"pose": pose})
            out = folder / f"{sensor}-{name}-{seed}{'-raw' if raw else ''}"
            found.append(simulate(out, spec, load_object(name), experiment, "contact", count=count, seed=seed, across=ACROSS))
    return found


def moved(data: Dataset, rows: np.ndarray) -> np.ndarray:
    """Displacements (M, N, 2) of the pins in rows, in mean spacings."""
    return (data.pins.nodes_px[rows] - data.pins.reference.pins_px) / data.pins.reference.spacing_px.mean()


def weights_of(name: str) -> tuple[PoseEstimator, Path]:
    """Some weights, and the path of their domain."""
    kinds = name in ("edge", "plate")
    place = contacts_folder("ur5-331") if kinds else SHIPPED / name
    return ContactEstimator.load(place).parts[name] if kinds else PoseEstimator.load(name), (place / name if kinds else place) / DOMAIN


def recordings_of(name: str, estimator: PoseEstimator) -> list[Dataset]:
    return [load_dataset(REAL / each, estimator.sensor, estimator.names).in_order() for each in RECORDINGS[name]]


def started(domain: Domain, estimator: PoseEstimator, recorded: list[Dataset]) -> Domain:
    """The domain whose intervals grow from where the held-out frames of the recordings end, from which the intervals come."""
    held = [(data, split_rows(len(data), 0)[1]) for data in recorded if data.pins.form == estimator.form]
    if not held:
        return domain
    return domain.starting_at(
        np.concatenate([moved(data, rows) for data, rows in held]), np.concatenate([data.pins.lost[rows] for data, rows in held])
    )


def start_again(name: str) -> None:
    """Measure for the domain of some weights from where on the intervals grow."""
    estimator, path = weights_of(name)
    known = read_domain(path, estimator.sensor.pins.count, len(estimator.names))
    domain = started(known, estimator, recordings_of(name, estimator))
    path.unlink()
    write_domain(path, domain)
    print(f"{name}: intervals grow from {np.round(domain.starts, 2)} limits", flush=True)


def make(name: str, folder: Path) -> Path:
    """Learn the domain of some weights and write it; its path."""
    estimator, path = weights_of(name)
    recorded = recordings_of(name, estimator)
    least_of = [
        estimator.predict_rows(data, np.arange(0, len(data), 7)).half_width for data in recorded if data.pins.form == estimator.form
    ]
    whole = name == "ur5-tacpad"
    rows = [np.arange(len(data)) if whole else split_rows(len(data), 0)[0] for data in recorded]
    pins = [moved(data, chosen) for data, chosen in zip(recorded, rows, strict=True)]
    labels = [data.targets.corrected[chosen] for data, chosen in zip(recorded, rows, strict=True)]
    group = [np.arange(sum(map(len, rows)))]
    rng = np.random.default_rng(0)
    for place_ in simulated(name, folder, raw=name == "ur5-331") if name in ("mg400-331", "mg400-127", "ur5-331") else []:
        data = load_dataset(place_, config_of(place_).sensor, estimator.names, form=estimator.form)
        touched = TouchAnswer(data.pins.reference)
        apart = [touched(nodes_px, lost) < LIKELY for nodes_px, lost in zip(data.pins.nodes_px, data.pins.lost, strict=True)]
        found = moved(data, np.arange(len(data)))
        pins.append(found + rng.normal(0, NOISE_PX / estimator.trained_reference.spacing_px.mean(), found.shape))
        labels.append(np.where(np.array(apart)[:, None], np.nan, data.targets.corrected))
        group.append(group[-1].max() + 1 + np.unique(data.group, return_inverse=True)[1].ravel())
        if not least_of:
            least_of.append(estimator.predict_table(data.pins).half_width)
    domain = learn_domain(
        np.concatenate(pins),
        np.concatenate(labels),
        estimator.trained_reference,
        recorded[0].targets.units,
        least=np.median(np.concatenate(least_of), axis=0),
        lost=recorded[0].pins.lost if whole else None,
        group=np.concatenate(group),
    )
    domain = domain if whole else started(domain, estimator, recorded)
    write_domain(path, domain)
    print(f"{name}: {sum(map(len, pins))} frames, limits {np.round(domain.limits, 4)}, {path.stat().st_size} bytes", flush=True)
    return path


if __name__ == "__main__":
    if sys.argv[1] == "--starts":
        for chosen in sys.argv[2:] or ("mg400-331", "mg400-127"):
            start_again(chosen)
        sys.exit()
    for old in SHIPPED.rglob(DOMAIN):  # those of an earlier version can't be read
        if old.parent.name in (sys.argv[2:] or RECORDINGS):
            old.unlink()
    for chosen in sys.argv[2:] or RECORDINGS:
        make(chosen, Path(sys.argv[1]))
