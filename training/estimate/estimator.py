"""A trained model with its sensor and pipeline: it estimates the pose in a frame. A live loop calls it.

The functions at the end load trained models: by run, by sensor, several at once.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from scenes.sensor import SensorSpec
from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.data.targets import limits_of
from training.errors import TrainingError
from training.estimate.domain import Domain, DomainVerdict, read_domain
from training.estimate.rest import DisplacementModel, RestPlaces, RestSeeker, read_displacements
from training.estimate.widening import Widening
from training.models import model_named
from training.models.part import Inputs, OneFrame, PinModel, Prediction, Trained, Unseen
from training.runs import run_files
from training.runs.assemble import Ensemble
from training.touch.contact_maps import MapModel, read_maps
from training.touch.contact_probability import TouchAnswer
from training.touch.slip import NAMES as SLIP_NAMES
from training.touch.slip import SLIP_UNITS, Slip, SlipModel, SlipTracker, read_slip
from twin.errors import FrameError
from twin.estimate import SensorModel
from twin.frames.forms import blob_spec, form_named
from twin.mechanics.skin_map import ContactMaps
from twin.pins import Pipeline, Reference, make_reference
from twin.store import fingerprint
from twin.types import Form, Frame, Observation

USUAL_FRAME = DomainVerdict("")
"""Verdict on a frame about which nothing strange is known."""


@dataclass(frozen=True)
class PoseEstimate:
    """A model's estimate of one frame.

    Attributes
    ----------
    names, units : tuple of str
        Name and unit of each of the K labels.
    value : (K,) float
        Estimates in mm and deg; NaN if ``valid`` is false.
    low, high : (K,) float
        Ends of the 90 % intervals.
    executed : float
        Probability that the shear move was executed; NaN if the model does not estimate it.
    valid : bool
    reason : str
        Why the estimate is not valid; empty if it is.
    ms : float
        Time from the frame to the estimate.
    contact : str
        The kind of the frame's contact; empty if the model does not classify kinds, or if the contact is of no known kind.
    touched : float
        Probability that anything is touched; NaN if no frame without contact was given (``PoseEstimator.at_rest``).
    notes : tuple of str
        Reasons why the intervals of this frame are wider than those of others.
    seen : Observation or None
        The pins that the estimate was made from; None if the model uses the picture itself.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    executed: float
    valid: bool
    reason: str
    ms: float
    contact: str = ""
    touched: float = float("nan")
    notes: tuple[str, ...] = ()
    seen: Observation | None = None


class PoseEstimator:
    """Estimates the pose in frames of one sensor.

    Parameters
    ----------
    config, content : dict
        Content of a run's ``config.json`` and ``weights.pt``.

    Attributes
    ----------
    learnt_from : (m, 2) int64 or None
        Marks of the model's training frames (``training.runs.config.frame_marks``); None if the run does not hold them.
    maps : MapModel or None
        Model of contact maps; None if the run did not train it.
    slip : SlipModel or None
        Model of slip in a sequence of frames; None if the run did not train it.
    displacements : Displacements or None
        Model of the pins' possible displacements, which gives the rest places of a unit without a no-contact frame; None unless the run
        learnt it.

    Raises
    ------
    TrainingError
        This version of the program does not have the run's model.
    """

    def __init__(self, config: dict, content: dict) -> None:
        self.config = config
        self.model: str = config["model"]
        self.part = model_named(self.model)
        self.sensor = SensorSpec.model_validate(config["sensor"])
        self.form = Form(config["pipeline"]["form"])
        self.names, self.units = tuple(config["columns"]), tuple(config["units"])
        self._bounds = limits_of(self.names)
        reference = make_reference(content["reference_px"].numpy(), self.sensor.pins)
        self.pipeline = Pipeline(self.sensor, self.form, reference, graph=config["pipeline"]["graph"])
        self.ensemble = Ensemble(self.part, reference, content, config["size"])
        known = config.get("known_rest_px")  # pins at rest, measured on the unit from which the weights were trained
        self._known_rest_px = None if known is None else np.array(known, float)
        learnt = {group: {key: value.numpy() for key, value in arrays.items()} for group, arrays in content["aside"].items()}
        self.learnt_from: np.ndarray | None = content["learnt_from"].numpy() if "learnt_from" in content else None
        self._trained = Trained(self.sensor, self.pipeline, reference, learnt, self.ensemble)
        self.maps: MapModel | None = None
        self.slip: SlipModel | None = None
        self.displacements: DisplacementModel | None = None
        self.domain: Domain | None = None
        self._tracker: SlipTracker | None = None
        self._consecutive = False
        self._wider: tuple[float, ...] = ()  # factors of the intervals on another unit, if this is one
        self._undecided = ""

    @classmethod
    def load(cls, run: str | Path) -> "PoseEstimator":
        """Load the folder of a finished run, or of its small copy.

        Parameters
        ----------
        run : path
            A folder, or the name of a sensor whose weights are shipped with the package.

        Raises
        ------
        TrainingError
            The folder holds no trained model, or one that this version can't read.
        """
        run = run_files.folder_of(run)
        packed, begun = (run / run_files.WEIGHTS).is_file(), (run / run_files.CHECKPOINT).is_file()
        weights = run / (run_files.WEIGHTS if packed else run_files.TENSORS)
        if not weights.is_file():
            hint = "it was begun and not finished; continue it with 'twin train'" if begun else run_files.instead_of(run)
            raise TrainingError(f"{run}: holds no trained model: {hint}")
        config = run_files.read_config(run)
        try:
            content = run_files.unpack(config, weights) if packed else run_files.read_tensors(weights)
            run_files.require_together(run, config, content)
            if "correction" in content:
                raise TrainingError(f"{run}: corrected by a regression, which this version does not know; train again")
            found = cls(config, content)
        except (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError, IndexError) as error:
            raise run_files.damage_error(weights, f"its weights do not fit {run_files.CONFIG}") from error
        if (run / run_files.MAPS).is_file():
            found.maps = read_maps(run / run_files.MAPS, found.sensor.geometry)
        if (run / run_files.SLIP).is_file():
            found.slip = read_slip(run / run_files.SLIP)
        if (run / run_files.DISPLACEMENTS).is_file():
            found.displacements = read_displacements(run / run_files.DISPLACEMENTS, found.sensor.pins.count)
        if (run / run_files.DOMAIN).is_file():
            found.domain = read_domain(run / run_files.DOMAIN, found.sensor.pins.count, len(found.names))
        return found

    @property
    def counts_from_rest(self) -> bool:
        """Whether the model can use a frame without contact of the sensor in use."""
        return self.part.counts_from_rest

    def at_rest(self, frame: Frame) -> "PoseEstimator":
        """The model for the sensor that took ``frame`` without contact. Displacements are then computed from the pins in this frame.

        Raises
        ------
        FrameError
            The frame shows a contact, or not this sensor, or the camera's picture is displaced so far that estimates would be wrong
            (``twin.pins.labelling.reference``); or the model does not count pins from rest.

        Notes
        -----
        The returned model gives no estimate for a frame that shows no contact.
        """
        if not self.counts_from_rest:
            raise FrameError(f"{self.model} does not measure displacements from rest, so it needs no no-contact frame; leave it out")
        reference, undecided = self.rest.measured(frame)
        return self.counted_from(reference, measured=True).noting(undecided)

    @property
    def rest(self) -> RestPlaces:
        """The pins at rest, and how they are found."""
        return RestPlaces(self.sensor, self.form, self._known_rest, self.displacements, self.domain, self.counts_from_rest)

    @cached_property
    def _known_rest(self) -> Reference:
        """The pins at rest of the unit from which the weights were trained."""
        known = self._known_rest_px
        return self._trained.reference if known is None else make_reference(known, self.sensor.pins)

    def with_history(self) -> "PoseEstimator":
        """The model for consecutive frames: it names pins as in the frame before, and uses earlier frames if the run learnt slip.

        Then its estimates also have the labels ``training.touch.slip.NAMES``: the probabilities that the contact has begun to slide and
        that all of it slides, the sliding share, the remaining drag until all of it slides (mm), and the direction in which the object
        moves over the skin (deg, sensor frame, from x towards y). A frame without an estimate ends the contact: the next frame belongs to
        a new contact.
        """
        found = self.keep_names()
        if self.slip is not None:
            found._tracker = SlipTracker(self.slip)
            if self._tracker is None:
                found.names, found.units = (*self.names, *SLIP_NAMES), (*self.units, *SLIP_UNITS)
        return found

    def keep_names(self) -> "PoseEstimator":
        """The model for consecutive frames, which names pins as in the frame before, without any other use of earlier frames."""
        return self._with(pipeline=self.pipeline.with_history(), _consecutive=True)

    def _with(self, **changes: Any) -> "PoseEstimator":
        """A copy with other attributes."""
        found = copy(self)
        vars(found).update(changes)
        found._trained = replace(found._trained, pipeline=found.pipeline, ensemble=found.ensemble)
        return found

    @property
    def recorded_sensor(self) -> SensorSpec:
        """The sensor with the pins at rest of the unit from which the weights were trained, if they were measured.

        Displacements in a recording without a no-contact frame are computed from these.
        """
        if self._known_rest_px is None:
            return self.sensor
        blob = blob_spec(self.sensor.pipeline, self.form).model_copy(update={"rest_px": tuple(map(tuple, self._known_rest_px.tolist()))})
        return self.sensor.model_copy(update={"pipeline": self.sensor.pipeline.model_copy(update={str(self.form): blob})})

    def at_known_rest(self) -> "PoseEstimator":
        """The same model for frames without a no-contact frame, taken by the unit from which its weights were trained."""
        return self if self._known_rest_px is None else self.counted_from(self._known_rest, measured=True)

    def at_rest_of(self, frames: Iterable[Frame]) -> tuple["PoseEstimator", bool]:
        """The model for the sensor that took ``frames`` of contacts, none of them without contact, and whether the sensor is another unit.

        The rest places are those measured on the unit of the weights, unless the contacts show others: see ``RestPlaces.other``.

        Raises
        ------
        FrameError
            The camera's picture is displaced so far that estimates would be wrong.
        """
        return self.rest_from_contacts(self.at_known_rest().nodes_in(frames), "these contacts")

    def rest_from_contacts(self, nodes_px: np.ndarray, name: str) -> tuple["PoseEstimator", bool]:
        """As ``at_rest_of``, from the pins (M, N, 2), px, of contacts; errors call them ``name``."""
        rest, undecided = self.rest.of_contacts(nodes_px, name)
        return self.with_rest_pins(rest).noting(undecided), rest is not None

    def with_rest_pins(self, rest: Reference | None) -> "PoseEstimator":
        """The same model with the pins at rest that were estimated from contacts, or with the known ones."""
        return self.at_known_rest() if rest is None else self.counted_from(rest)

    def nodes_in(self, frames: Iterable[Frame]) -> np.ndarray:
        """The pins (M, N, 2), px, in the valid ones of some frames."""
        graphs = [seen.graph for frame in frames if (seen := self.pipeline(frame)).valid]
        return np.array([graph.nodes_px for graph in graphs if graph is not None]).reshape(-1, self.sensor.pins.count, 2)

    def seeking_rest(self) -> SensorModel:
        """The model for a camera's frames if no frame shows its sensor without contact. It works as ``at_rest_of``, while frames arrive.

        The result is the model itself if its inputs are not displacements from rest.
        """
        return RestSeeker(self) if self.counts_from_rest else self

    def with_intervals(self, intervals: Mapping[str, np.ndarray]) -> "PoseEstimator":
        """The same model with other interval quantiles: those of one kind of its frames."""
        ensemble = copy(self.ensemble)
        vars(ensemble).update({name: np.asarray(values, float) for name, values in intervals.items()})
        return self._with(ensemble=ensemble)

    def counted_from(self, reference: Reference, *, measured: bool = False) -> "PoseEstimator":
        """The same model; it measures the pins' displacements from other pins at rest.

        If these were ``measured`` without contact, it also estimates whether anything is touched.
        """
        trained = replace(self._trained, touched=TouchAnswer(reference)) if measured else self._trained
        wider = tuple(self.config.get("other_unit_widens", ()))
        if wider and self.rest.same_unit(reference):
            wider = ()
        pipeline = Pipeline(self.sensor, self.form, reference, graph=self.pipeline.graph)
        found = self._with(pipeline=pipeline, _trained=trained, _wider=wider)
        if not self._consecutive:
            return found
        return found.keep_names() if self._tracker is None else found.with_history()

    def noting(self, undecided: str) -> "PoseEstimator":
        """The same model; its ``caveats`` say what is ``undecided`` about the camera's view."""
        return self._with(_undecided=undecided)

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """Refuse another sensor or form than the model was trained for.

        Raises
        ------
        FrameError
        """
        form = form_named(form)
        if sensor.name != self.sensor.name or sensor.pins.count != self.sensor.pins.count or form != self.form:
            raise FrameError(
                f"the model was trained on {self.form} frames of '{self.sensor.name}' ({self.sensor.pins.count} pins), "
                f"these are {form} frames of '{sensor.name}' ({sensor.pins.count} pins); give a model trained for them"
            )

    def __call__(self, frame: Frame) -> PoseEstimate:
        """Estimate the pose in one frame. If too few pins are found, the estimate is not valid and states the reason.

        Raises
        ------
        FrameError
            The frame does not belong to the model's sensor: wrong size, type or form.
        """
        started = perf_counter()
        if not isinstance(self.part, PinModel):
            return self._as_estimate(self.part.estimate_frame(self._trained, frame), started, self._verdict_of(frame), "", None, 0.0)
        seen = self.pins_in(frame)
        return self.estimate_without_pose(seen, started) if isinstance(seen, Unseen) else self.estimate_one(seen, started, "")

    @property
    def caveats(self) -> list[str]:
        """Reasons why the intervals of all frames are wider than the model's own, one line each."""
        return [*([self._undecided] if self._undecided else []), *self._widening.caveats]

    @property
    def label_range(self) -> np.ndarray:
        """Extent (K,) of the labels that the model was trained on; infinite if the run holds no domain."""
        return np.full(len(self.units), np.inf) if self.domain is None else self.domain.high - self.domain.low

    @property
    def _widening(self) -> Widening:
        alone = self.pipeline.reference is self._trained.reference
        unmeasured = self.part.unmeasured_widens if isinstance(self.part, PinModel) and alone else 1.0
        return Widening(self.sensor, self.domain, self.config["columns"], self.config["units"], unmeasured, self._wider)

    def contact_maps(self, frame: Frame) -> tuple[PoseEstimate, ContactMaps | None]:
        """The estimate of one frame, with the pressure and shear over the skin; no maps if the estimate is not valid.

        Raises
        ------
        FrameError
            The frame does not belong to the model's sensor: wrong size, type or form.
        TrainingError
            The run has no maps.
        """
        started, seen = perf_counter(), self.pins_in(frame)
        if isinstance(seen, Unseen):
            return self.estimate_without_pose(seen, started), None
        made = self.estimate_one(seen, started, "")
        return made, self.maps_of(seen.pins, made.value[None])[0] if made.valid else None

    def maps_of(self, pins: PinTable, values: np.ndarray) -> list[ContactMaps]:
        """Contact maps of many frames, from their pins and the model's estimates for them (M, K).

        Raises
        ------
        TrainingError
            The run has no maps.
        """
        model = self.require_maps()
        return [model(modes, dict(zip(self.names, said, strict=True))) for modes, said in zip(self.modes_of(pins), values, strict=True)]

    def require_maps(self) -> MapModel:
        """The model of contact maps; raises ``TrainingError`` if the run has none."""
        if self.maps is None:
            raise TrainingError(
                f"the model of '{self.sensor.name}' makes no contact maps; train touch on simulated contacts, which contain the forces on "
                "the skin ('twin dataset', 'twin train --model touch --target contact')"
            )
        return self.maps

    def modes_of(self, pins: PinTable) -> np.ndarray:
        """Modes (M, D) that the model sees in a table's frames; raises as ``inputs_of``."""
        inputs, rows = self.inputs_of(pins, together=not pins.measured)
        return self.ensemble.modes(inputs, rows).inputs

    def _as_estimate(
        self, made: Prediction | Unseen, started: float, verdict: DomainVerdict, contact: str, slip: Slip | None, lost: float
    ) -> PoseEstimate:
        if isinstance(made, Unseen):
            return self.estimate_without_pose(made, started)
        reason = verdict.reason
        excess: np.ndarray = np.zeros(len(self._bounds[0]))
        if self.domain is not None and not reason:
            reason, excess = self.domain.outside_range(made.mean[0], self.config["columns"], self.config["units"])
        if reason:
            return self.estimate_without_pose(Unseen(reason, made.touched, made.seen), started, contact)
        value, half, executed = made.mean[0], made.half_width[0], float(made.executed[0])
        low, high, notes = self._widening(value, half, lost, verdict, excess)
        value, low, high = (np.clip(each, *self._bounds) for each in (value, low, high))
        if slip is not None:
            value, low, high = (np.concatenate(pair) for pair in zip((value, low, high), slip.values, strict=True))
        head = self.names, self.units, value, low, high, executed
        return PoseEstimate(*head, True, "", 1e3 * (perf_counter() - started), contact, made.touched, notes, made.seen)

    def pins_in(self, frame: Frame) -> OneFrame | Unseen:
        """The pins of one frame, or the reason why they can't be used; raises as a call does."""
        return self._of_pins.pins_in(self._trained, frame)

    def estimate_one(self, seen: OneFrame, started: float, contact: str) -> PoseEstimate:
        """Estimate the pose from the pins of one frame.

        Parameters
        ----------
        started : float
            Time at which the frame arrived, by ``perf_counter``.
        contact : str
            Kind of the frame's contact.
        """
        known = self._trained.reference
        seen = replace(seen, pins=seen.pins.relative_to(known)) if seen.pins.measured else seen
        verdict = self._verdict(seen.pins.nodes_px[0], seen.pins.lost[0])
        if verdict.reason:
            return self.estimate_without_pose(Unseen(verdict.reason, seen.touched, seen.seen), started)
        if self.domain is not None and verdict.camera.any():
            pins = seen.pins
            places = self.domain.without_camera(pins.nodes_px[0], pins.area_px2[0], verdict.camera, known.spacing_px.mean())
            seen = replace(seen, pins=replace(pins, nodes_px=places[0][None], area_px2=places[1][None]))
        slip = None if self._tracker is None else self._tracker(self.modes_of(seen.pins)[0])
        return self._as_estimate(self._of_pins.estimate_one(self._trained, seen), started, verdict, contact, slip, seen.lost_share)

    @property
    def trained_reference(self) -> Reference:
        """The pins at rest from which the training measured displacements."""
        return self._trained.reference

    def knows(self, pins: PinTable) -> np.ndarray:
        """(M,) bool: whether the pins of each row of a table are a pattern that the model was trained on."""
        seen = pins.relative_to(self._trained.reference)
        return np.array([not self._verdict(*each).reason for each in zip(seen.nodes_px, seen.lost, strict=True)], bool)

    def _verdict(self, nodes_px: np.ndarray, lost: np.ndarray) -> DomainVerdict:
        """Whether pins (N, 2), as seen by the camera of the training, some of them ``lost`` (N,), are a pattern that was trained on."""
        if self.domain is None:
            return USUAL_FRAME
        reference = self._trained.reference
        moved = (nodes_px - reference.pins_px) / reference.spacing_px.mean()
        return self.domain.assess(moved, lost, reference, corrects=isinstance(self.part, PinModel))

    def _verdict_of(self, frame: Frame) -> DomainVerdict:
        """The verdict on a frame for a model that does not look for pins itself."""
        if self.domain is None:
            return USUAL_FRAME
        seen = self.pipeline(frame)
        if not seen.valid or seen.graph is None:
            return DomainVerdict(seen.reason)
        return self._verdict(seen.graph.nodes_px, np.isnan(seen.pins_px[:, 0]))

    def estimate_without_pose(self, seen: Unseen, started: float, contact: str = "") -> PoseEstimate:
        """The estimate of a frame that shows no known pose."""
        if self._tracker is not None:
            self._tracker.forget()
        none = np.full(len(self.names), np.nan)
        head = self.names, self.units, none, none, none, np.nan
        return PoseEstimate(*head, False, seen.reason, 1e3 * (perf_counter() - started), contact, seen.touched, seen=seen.seen)

    def predict_rows(self, data: Dataset, rows: np.ndarray) -> Prediction:
        """Estimate the labels of some rows (B,) of a data set whose frames are all of one camera.

        Raises
        ------
        FrameError
            The frames belong to another sensor or form.
        """
        self.check(data.pins.sensor, data.pins.form)
        return self.part.estimate_rows(self._trained, data, rows)

    def predict_table(self, pins: PinTable) -> Prediction:
        """Estimate the labels of many valid frames of one camera at once.

        The camera may sit at another place than in training. Its displacement is measured in the table's own frame without contact. Without
        such a frame it is the median over the frames.

        Raises
        ------
        FrameError
            The frames belong to another sensor or form.
        TrainingError
            The model does not estimate from pins.
        """
        self.check(pins.sensor, pins.form)
        return self._of_pins.estimate_pins(self._trained, pins)

    def inputs_of(self, pins: PinTable, *, together: bool) -> tuple[Inputs, torch.Tensor]:
        """The networks' inputs for a table's frames, and the indices of all rows.

        Raises
        ------
        TrainingError
            The model does not estimate from pins.
        """
        return self._of_pins.inputs(pins, self._trained.learnt, self._trained.reference, together=together), torch.arange(len(pins))

    @property
    def _of_pins(self) -> PinModel:
        if not isinstance(self.part, PinModel):
            raise TrainingError(f"{self.model} estimates from pictures, not from pins; give the frames themselves")
        return self.part


def models_by_sensor(run: str | Path | None = None, first: str = "") -> Callable[[str], PoseEstimator | None]:
    """A function from a sensor's name to a trained model of it: that of a run, else the shipped one, else None.

    After the first model is loaded, the networks of this process run in one thread: for networks of this size, more threads cost more time
    than they save.

    Parameters
    ----------
    run : path, optional
    first : str
        Name of the sensor to which the run must belong; "" for any.

    Raises
    ------
    TrainingError
        The run holds no trained model, or one of another sensor than ``first``.
    """
    given = None if run is None else PoseEstimator.load(run)
    if given is not None and first not in ("", given.sensor.name):
        raise TrainingError(f"{run}: a model of '{given.sensor.name}', not of '{first}'; give its --sensor, or another --model")

    def model_of(sensor: str) -> PoseEstimator | None:
        torch.set_num_threads(1)
        if given is not None and given.sensor.name == sensor:
            return given
        return PoseEstimator.load(sensor) if sensor in run_files.shipped_names() else None

    return model_of


def digest_of(run: str | Path) -> str:
    """Digest of everything that affects a model's estimates: its weights, its configuration, and the code that runs it."""
    folder, digest = run_files.folder_of(run), hashlib.sha256(fingerprint(PoseEstimator).encode())
    for name in (run_files.CONFIG, run_files.WEIGHTS, run_files.TENSORS, run_files.DOMAIN):
        if (folder / name).is_file():
            digest.update(name.encode() + hashlib.sha256((folder / name).read_bytes()).digest())
    return digest.hexdigest()


def load_with_history(run: str | Path) -> PoseEstimator:
    """A trained model for consecutive frames: ``PoseEstimator.load`` and ``PoseEstimator.with_history``.

    Raises
    ------
    TrainingError
        The folder holds no run.
    """
    return PoseEstimator.load(run).with_history()


def load_by_name(runs: Sequence[Path]) -> dict[str, PoseEstimator]:
    """Load several trained models. The keys are the names of their folders, or their whole paths if two folders have the same name.

    Raises
    ------
    TrainingError
        A folder holds no run.
    """
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        names = [str(run) for run in runs]
    return {name: PoseEstimator.load(run) for name, run in zip(names, runs, strict=True)}
