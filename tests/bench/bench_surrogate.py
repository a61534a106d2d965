"""Surrogate and finite elements beside each other, on the labelled contacts of a recording: pins against the frames', and poses told.

python tests/bench/bench_surrogate.py --sensor mg400-331 --data FOLDER
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes import load_object, load_sensor
from scenes.sensor import SensorSpec
from training.data.pins import PinTable
from training.environments.observe import Eye
from training.estimate.estimator import PoseEstimator
from training.surrogate.contacts import SurrogateContacts
from training.surrogate.model import surrogate_of
from training.surrogate.reading import EpisodeContact
from twin.camera.projection import project_in_form
from twin.errors import ContactError
from twin.frames import open_recording
from twin.geometry.pins import rest_pins
from twin.mechanics.solver import SkinSolver
from twin.pins import make_graph
from twin.pins.batch import recording_reference
from twin.pins.pipeline import Pipeline
from twin.rig.contact import RigContact
from twin.rig.labels import read_arm_labels
from twin.studio.contact import experiment_of
from twin.types import Form

FRAMES = 60
"""Frames that are sampled from the recording."""
STEPS = 20
"""Steps of the surrogate on each part of the path."""


@dataclass(frozen=True)
class Beside:
    """Errors of both on the same frames.

    Attributes
    ----------
    frames : int
        Frames whose contact both computed.
    fem_px, surrogate_px : float
        Mean distance of their pins from the frames', in pixels.
    names : tuple of str
        The estimator's labels, in mm and degrees.
    fem_mae, surrogate_mae : numpy.ndarray
        (L,) mean absolute errors of the labels that the shipped estimator tells from their pins.
    """

    frames: int
    fem_px: float
    surrogate_px: float
    names: tuple[str, ...]
    fem_mae: np.ndarray
    surrogate_mae: np.ndarray


def measured(sensor: str, data: Path, frames: int = FRAMES) -> Beside:
    """Both on frames sampled from a recording; frames without a contact that both can compute are left out."""
    spec, estimator = load_sensor(sensor), PoseEstimator.load(sensor)
    recording, experiment = open_recording(data, spec), experiment_of(estimator)
    reference, _ = recording_reference(spec, recording, [])
    pipeline, labels, touched = Pipeline(spec, recording.form, reference), read_arm_labels(recording), load_object(experiment.object)
    rig = RigContact(SkinSolver(spec), experiment, touched)
    surrogate = SurrogateContacts(surrogate_of(spec), spec, 1)
    real, fem, fast, truth = [], [], [], []
    for row in np.random.default_rng(0).permutation(len(recording))[:frames]:
        label, seen = labels[row], pipeline(recording.read(int(row)))
        if not (label.executed and seen.valid):
            continue
        try:
            way, end = rig.commanded_path(label), rig.end(label)
            surrogate.begin(0, EpisodeContact(spec, touched, rig.law))
            parts = len(way.path.poses) - 1
            for along in np.linspace(0, parts, STEPS * parts + 1):
                surrogate.move(np.array([0]), way.path.at(along)[None], np.zeros(1))
        except ContactError:
            continue
        if surrogate.felt.lost[0]:
            continue
        real.append(seen.pins_px - reference.pins_px)
        fem.append(end.caps_mm)
        fast.append(surrogate.felt.caps_mm[0].copy())
        columns = [(label.pose if name.startswith("pose") else label.move, int(name.rsplit("_", 1)[1]) - 1) for name in estimator.names]
        truth.append([values[at] for values, at in columns])
    moved = [np.array([moved_px(spec, recording.form, caps) for caps in kind]) for kind in (fem, fast)]
    off = [float(np.linalg.norm(kind - np.array(real), axis=2).mean()) for kind in moved]
    errors = [np.abs(told(estimator, spec, kind) - np.array(truth)).mean(axis=0) for kind in (fem, fast)]
    return Beside(len(truth), off[0], off[1], tuple(estimator.names), errors[0], errors[1])


def moved_px(spec: SensorSpec, form: Form, caps_mm: np.ndarray) -> np.ndarray:
    """Displacements (P, 2) of caps (P, 3) from rest, in pixels of a form of frames."""
    return project_in_form(spec, form, caps_mm) - project_in_form(spec, form, rest_pins(spec.geometry).caps_mm)


def told(estimator: PoseEstimator, spec: SensorSpec, caps_mm: list[np.ndarray]) -> np.ndarray:
    """Labels (N, L) that the estimator tells from caps, in the form of frames for which it was trained."""
    eye = Eye(spec, 1, "pose", pictures="none", pin_noise_px=0.0)
    places = eye.reference.pins_px + np.array([moved_px(spec, eye.form, caps) for caps in caps_mm])
    areas = np.stack([make_graph("voronoi", place, outmost=eye.reference.outmost).area_px2 for place in places])
    count, found = len(places), np.zeros(places.shape[:2], bool)
    names, valid = np.full(count, ""), np.ones(count, bool)
    return estimator.predict_table(PinTable(spec, eye.form, eye.reference, names, places, areas, found, valid, measured=True)).mean


def main() -> None:
    """Print the errors of both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=FRAMES)
    given = parser.parse_args()
    found = measured(given.sensor, given.data, given.frames)
    print(f"{found.frames} frames: pins {found.fem_px:.3f} px off by finite elements, {found.surrogate_px:.3f} px by the surrogate")
    for name, fem, fast in zip(found.names, found.fem_mae, found.surrogate_mae, strict=True):
        print(f"  {name}: {fem:.3f} and {fast:.3f} off")


if __name__ == "__main__":
    main()
