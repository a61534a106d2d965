"""A trained model, its sensor and its pipeline in one: frame in, pose out. The one thing a live loop calls."""

import json
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from time import perf_counter

import numpy as np
import torch

from scenes.sensor import SensorSpec
from training.assemble import Ensemble, Prediction, filled, pin_inputs
from training.dataset import PinTable
from training.inputs import ImageInputs, graph_inputs, small_image
from training.recipes import TrainingError
from training.registration import Registration
from twin.errors import FrameError
from twin.preprocess import Pipeline, make_reference
from twin.types import Form, Frame


@dataclass(frozen=True)
class PoseEstimate:
    """What a model makes of one frame.

    Attributes
    ----------
    names, units : tuple of str
        Of the K labels.
    value : (K,) float
        mm and deg; NaN where ``valid`` is false.
    low, high : (K,) float
        The 90 % interval.
    executed : float
        Probability that the shear move was executed (NaN where the model doesn't tell).
    valid : bool
    reason : str
        Why it is not valid ("" if it is).
    ms : float
        Frame to pose.
    """

    names: tuple
    units: tuple
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    executed: float
    valid: bool
    reason: str
    ms: float


class PoseEstimator:
    """Estimates the pose in frames of one sensor.

    Parameters
    ----------
    config, content : dict
        What a run's ``config.json`` and ``weights.pt`` hold.
    """

    def __init__(self, config: dict, content: dict) -> None:
        self.config = config
        self.model: str = config["model"]
        self.sensor = SensorSpec.model_validate(config["sensor"])
        self.form = Form(config["pipeline"]["form"])
        self.names, self.units = tuple(config["columns"]), tuple(config["units"])
        reference = make_reference(content["reference_px"].numpy(), self.sensor.pins.rings)
        self.pipeline = Pipeline(self.sensor, self.form, reference, graph=config["pipeline"]["graph"])
        self.ensemble = Ensemble(self.model, reference, content, config["size"])
        aside = content["aside"]
        self.registration = Registration(**{key: value.numpy() for key, value in aside["registration"].items()}) if aside else None

    @classmethod
    def load(cls, run: str | Path) -> "PoseEstimator":
        """Load the folder of a finished run.

        Raises
        ------
        TrainingError
            If it holds none.
        """
        run = Path(run)
        if not (run / "weights.pt").is_file():
            hint = (
                "it was begun and not finished; continue it with 'twin train'"
                if (run / "checkpoint.pt").is_file()
                else "'twin train' writes one"
            )
            raise TrainingError(f"{run}: holds no trained model: {hint}")
        try:
            config = json.loads((run / "config.json").read_text())
            content = torch.load(run / "weights.pt", weights_only=True)
            return cls(config, content)
        except (OSError, ValueError, KeyError, RuntimeError, UnpicklingError) as error:
            raise TrainingError(f"{run}: not a run of this version, or a damaged one ({error}); train again") from error

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """Refuse another sensor or form than the model was trained for.

        Raises
        ------
        FrameError
        """
        if sensor.name != self.sensor.name or sensor.pins.count != self.sensor.pins.count or Form(form) != self.form:
            raise FrameError(
                f"the model was trained on {self.form} frames of '{self.sensor.name}' ({self.sensor.pins.count} pins), "
                f"these are {Form(form)} frames of '{sensor.name}' ({sensor.pins.count} pins); give a model trained for them"
            )

    def __call__(self, frame: Frame) -> PoseEstimate:
        """Estimate the pose in one frame; without (enough) pins the result is not valid and says why.

        Raises
        ------
        FrameError
            The frame is not one of the model's sensor: wrong size, type or form.
        """
        started = perf_counter()
        if self.model in ("cnn-v1", "cnn-v2"):
            self.pipeline.check(frame)
            made = self.ensemble(ImageInputs(small_image(frame.image)[None]), torch.zeros(1, dtype=torch.long))
            return self._estimate(made, started)
        seen = self.pipeline(frame)
        if not seen.valid:
            none = np.full(len(self.names), np.nan)
            return PoseEstimate(self.names, self.units, none, none, none, np.nan, False, seen.reason, _ms(started))
        lost = np.isnan(seen.pins_px[None, :, 0])
        return self._estimate(self._of_pins(seen.graph.nodes_px[None], seen.graph.area_px2[None], lost, frame.name), started)

    def predict_table(self, pins: PinTable) -> Prediction:
        """Labels of many valid frames of one camera at once; where it sits otherwise than in training, their median tells.

        Raises
        ------
        FrameError
            The frames are of another sensor or form.
        """
        self.check(pins.sensor, pins.form)
        return self._of_pins(pins.nodes_px, pins.area_px2, pins.lost, "", together=True)

    def _of_pins(self, nodes_px: np.ndarray, area_px2: np.ndarray, lost: np.ndarray, name: str, *, together: bool = False) -> Prediction:
        reference = self.pipeline.reference
        if self.model == "vgnn":
            nodes_px, area_px2 = filled(self.registration, nodes_px, area_px2, lost, reference)
            inputs = pin_inputs(self.registration, nodes_px, area_px2, lost, reference, together=together)
        else:
            count = len(nodes_px)
            table = PinTable(self.sensor, self.form, reference, np.full(count, name), nodes_px, area_px2, lost, np.ones(count, bool))
            inputs = graph_inputs(self.model, table, self.pipeline.size_px[0])
        return self.ensemble(inputs, torch.arange(len(nodes_px)))

    def _estimate(self, made: Prediction, started: float) -> PoseEstimate:
        value, half = made.mean[0], made.half_width[0]
        return PoseEstimate(self.names, self.units, value, value - half, value + half, float(made.executed[0]), True, "", _ms(started))


def _ms(started: float) -> float:
    return 1e3 * (perf_counter() - started)
