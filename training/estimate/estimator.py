"""A trained model with its sensor and pipeline: it estimates the pose in a frame. A live loop calls it."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from scenes.sensor import SensorSpec
from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.data.targets import limits_of
from training.errors import TrainingError
from training.estimate.displacements import MOST_CONTACTS, Displacements, other_rest, read_displacements
from training.estimate.domain import FEWEST, Domain, Verdict, read_domain
from training.estimate.rest_seeking import RestSeeker
from training.models import model_named
from training.models.part import Inputs, OneFrame, PinModel, Prediction, Trained, Unseen
from training.runs.assemble import Ensemble
from training.runs.packed import SHIPPED, WEIGHTS, shipped_names, unpack
from training.runs.run_files import (
    CHECKPOINT,
    CONFIG,
    DISPLACEMENTS,
    DOMAIN,
    MAPS,
    SLIP,
    TENSORS,
    damaged,
    read_config,
    read_tensors,
    require_together,
)
from training.touch.contact_maps import MapModel, read_maps
from training.touch.slip import NAMES as SLIP_NAMES
from training.touch.slip import SLIP_UNITS, Slip, SlipModel, SlipTracker, read_slip
from training.touch.touched import TouchAnswer
from twin.errors import FrameError
from twin.estimate import SensorModel
from twin.frames import spread
from twin.frames.forms import blob_spec, form_named
from twin.mechanics.skin_map import ContactMaps
from twin.pins import Pipeline, Reference, View, make_reference, measure_reference, view_of
from twin.pins.view import camera_modes
from twin.store import fingerprint
from twin.types import Form, Frame, Observation

LOST_USUAL = 0.02
"""Share of lost pins in usual frames."""
LOST_WIDENS = 2.0
"""Growth of the intervals with the share of lost pins. With a hidden patch of 15 or 30 % of the pins, errors of depth in the twin grow by a
factor of 1.2 or 1.6."""
USUAL_FRAME = Verdict("")
"""Verdict on a frame about which nothing strange is known."""
FEWEST_VIEWED = 8
ASSUMED_RADIUS, ASSUMED_MM, ASSUMED_DEG = 0.1, 0.015, 1.0
"""Half widths for what a specification only assumes: share of a length, because all lengths are proportional to the radius; share of the
radius; and angle. Simulated taps on a plate with a skin thinner by 0.3 or thicker by 0.4 mm, or a gel 2.5 times softer or stiffer, come out
0.11 to 0.21 mm and 0.1 to 0.35 deg off (radius 20 mm)."""
MOST_USUAL = 0.6
"""Least share of contacts that must be usual but for a motion of the camera, for this motion to be estimated from them."""
"""Least number of contacts whose median pins show the camera's view."""
SIMULATED_FORCES = ("force_x", "force_y", "force_z", "torque_z")
"""Labels that are proportional to the stiffness of the simulated sensor."""


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
        Marks of the frames from which the model learnt (``training.runs.identity.frame_marks``); None if the run does not hold them.
    maps : MapModel or None
        Model of contact maps; None unless the run learnt it.
    slip : SlipModel or None
        Model of slip in a sequence of frames; None unless the run learnt it.
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
        known = config.get("known_rest_px")  # pins at rest, measured on the unit from which the weights were learnt
        self._known_rest_px = None if known is None else np.array(known, float)
        learnt = {group: {key: value.numpy() for key, value in arrays.items()} for group, arrays in content["aside"].items()}
        self.learnt_from: np.ndarray | None = content["learnt_from"].numpy() if "learnt_from" in content else None
        self._trained = Trained(self.sensor, self.pipeline, reference, learnt, self.ensemble)
        self.maps: MapModel | None = None
        self.slip: SlipModel | None = None
        self.displacements: Displacements | None = None
        self.domain: Domain | None = None
        self._tracker: SlipTracker | None = None
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
        run = folder_of(run)
        packed = (run / WEIGHTS).is_file()
        if not packed and not (run / TENSORS).is_file():
            hint = "it was begun and not finished; continue it with 'twin train'" if (run / CHECKPOINT).is_file() else _instead_of(run)
            raise TrainingError(f"{run}: holds no trained model: {hint}")
        config = read_config(run)
        try:
            content = unpack(config, run / WEIGHTS) if packed else read_tensors(run / TENSORS)
            require_together(run, config, content)
            if "correction" in content:
                raise TrainingError(f"{run}: corrected by a regression, which this version does not know; train again")
            found = cls(config, content)
        except (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError, IndexError) as error:
            raise damaged(run / (WEIGHTS if packed else TENSORS), f"its weights do not fit {CONFIG}") from error
        if (run / MAPS).is_file():
            found.maps = read_maps(run / MAPS, found.sensor.geometry)
        if (run / SLIP).is_file():
            found.slip = read_slip(run / SLIP)
        if (run / DISPLACEMENTS).is_file():
            found.displacements = read_displacements(run / DISPLACEMENTS, found.sensor.pins.count)
        if (run / DOMAIN).is_file():
            found.domain = read_domain(run / DOMAIN, found.sensor.pins.count, len(found.names))
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
            (``twin.pins.view``); or the model does not count pins from rest.

        Notes
        -----
        The returned model gives no estimate for a frame that shows no contact.
        """
        if not self.counts_from_rest:
            raise FrameError(f"a no-contact frame serves only a model that counts pins from rest, {self.model} does not; leave it out")
        reference = measure_reference(self.sensor, self.form, frame, known=self._known_rest)
        view = self.require_view(reference.pins_px, frame.name or "frame")
        found = self.counted_from(reference)
        found._trained = replace(found._trained, touched=TouchAnswer(reference))
        return found.noting(view.undecided())

    @cached_property
    def _known_rest(self) -> Reference:
        """The pins at rest of the unit from which the weights were learnt."""
        known = self._known_rest_px
        return self._trained.reference if known is None else make_reference(known, self.sensor.pins)

    def require_view_of_contacts(self, nodes_px: np.ndarray, rest: Reference | None, name: str) -> str:
        """As ``require_view``, from the pins (M, N, 2) of contacts, and from the places at ``rest`` that were estimated from them.

        Returns
        -------
        str
            What these places do not decide about the view; "" if nothing.
        """
        if len(nodes_px) >= FEWEST_VIEWED:
            self.require_view(np.median(nodes_px, axis=0), name, contacts=True)
            motions, usual = self._common_camera(rest or self._known_rest, nodes_px)
            if usual < MOST_USUAL and (rest is not None or motions.any()):
                raise FrameError(
                    f"{name}: {1 - usual:.0%} of them are no contacts that the weights of {self.sensor.name} know, and the camera is "
                    "displaced: its picture may be turned, mirrored or stretched; give a frame without contact (init_0.png beside the "
                    "frames, --no-contact FRAME)"
                )
        view = None if rest is None else self.require_view(rest.pins_px, name)
        if view is not None and view.pressed:
            raise FrameError(
                f"{name}: no pins at rest of {self.sensor.name} explain them: the camera's picture may be turned or mirrored, or they are "
                "of a kind that the weights do not know; give a frame without contact (init_0.png beside the frames, --no-contact FRAME)"
            )
        return "" if view is None else view.undecided()

    def require_view(self, pins_px: np.ndarray, name: str, *, contacts: bool = False) -> View:
        """The camera's view of pins at rest (N, 2), or of the median of ``contacts``, against the unit of the weights.

        Raises
        ------
        FrameError
            The picture ``name`` is displaced so far that estimates would be wrong.
        """
        view = view_of(pins_px, self._known_rest, self.sensor.pins, camera_modes(self.sensor, self.form))
        view.require_small(name, f"the unit that the weights of {self.sensor.name} are for", contacts=contacts)
        return view

    def remembering(self) -> "PoseEstimator":
        """The model for consecutive frames, which remembers earlier frames; the model itself if the run did not learn slip.

        Its estimates also have the labels ``training.touch.slip.NAMES``: the probabilities that the contact has begun to slide and that
        all of it slides, the sliding share, the remaining drag until all of it slides (mm), and the direction in which the object moves
        over the skin (deg, sensor frame, from x towards y). A frame without an estimate ends the contact: the next frame belongs to a new
        contact.
        """
        if self.slip is None:
            return self
        found = copy(self)
        found._tracker = SlipTracker(self.slip)
        if self._tracker is None:
            found.names, found.units = (*self.names, *SLIP_NAMES), (*self.units, *SLIP_UNITS)
        return found

    @property
    def recorded_sensor(self) -> SensorSpec:
        """The sensor with the pins at rest of the unit from which the weights were learnt, if they were measured.

        Displacements in a recording without a no-contact frame are computed from these.
        """
        if self._known_rest_px is None:
            return self.sensor
        blob = blob_spec(self.sensor.pipeline, self.form).model_copy(update={"rest_px": tuple(map(tuple, self._known_rest_px.tolist()))})
        return self.sensor.model_copy(update={"pipeline": self.sensor.pipeline.model_copy(update={str(self.form): blob})})

    def at_known_rest(self) -> "PoseEstimator":
        """The same model for frames without a no-contact frame, taken by the unit from which its weights were learnt."""
        if self._known_rest_px is None:
            return self
        found = self.counted_from(self._known_rest)
        found._trained = replace(found._trained, touched=TouchAnswer(found.pipeline.reference))
        return found

    def other_rest(self, start: Reference, nodes_px: np.ndarray) -> Reference | None:
        """The rest layout estimated from contacts with pins (M, N, 2), if it differs from ``start``, the assumed one.

        None if the difference is not significant, if there are fewer contacts than ``training.estimate.displacements.FEWEST_CONTACTS`` (8
        for the place of the camera alone), or if the run did not learn how contacts displace the pins.
        """
        if not self.counts_from_rest:
            return None
        found = other_rest(self.displacements, start, nodes_px)
        if found is None and self.domain is not None:
            motions, usual = self._common_camera(start, nodes_px)
            if motions.any() and usual >= MOST_USUAL:
                found = start.pins_px + start.spacing_px.mean() * (motions @ self.domain.motions).reshape(-1, 2)
        return None if found is None else make_reference(found, self.sensor.pins)

    def _common_camera(self, start: Reference, nodes_px: np.ndarray) -> tuple[np.ndarray, float]:
        """``Domain.common_camera`` of contacts (M, N, 2), px, with the pins at rest ``start``; no motion for few contacts or no domain."""
        whole = nodes_px[np.isfinite(nodes_px).all(axis=(1, 2))]
        if self.domain is None or len(whole) < FEWEST_VIEWED:
            return np.zeros(4), 1.0
        whole = whole[spread(len(whole), MOST_CONTACTS)]
        return self.domain.common_camera((whole - start.pins_px) / start.spacing_px.mean())

    def at_rest_of(self, frames: Iterable[Frame]) -> tuple["PoseEstimator", bool]:
        """The model for the sensor that took ``frames`` of contacts, none of them without contact, and whether the sensor is another unit.

        The rest places are those measured on the unit of the weights, unless the contacts show others: see ``other_rest``.

        Raises
        ------
        FrameError
            The camera's picture is displaced so far that estimates would be wrong.
        """
        nodes_px = self.at_known_rest().nodes_in(frames)
        found, other = self.told_rest(nodes_px)
        undecided = self.require_view_of_contacts(nodes_px, found.pipeline.reference if other else None, "these contacts")
        return found.noting(undecided), other

    def nodes_in(self, frames: Iterable[Frame]) -> np.ndarray:
        """The pins (M, N, 2), px, in the valid ones of some frames."""
        graphs = [seen.graph for frame in frames if (seen := self.pipeline(frame)).valid]
        return np.array([graph.nodes_px for graph in graphs if graph is not None]).reshape(-1, self.sensor.pins.count, 2)

    def usual_share(self, nodes_px: np.ndarray) -> float:
        """Share of contacts with pins (M, N, 2), px, that the model knows, wherever the camera sits; 0 if the run holds no domain."""
        return 0.0 if self.domain is None else self._common_camera(self._known_rest, nodes_px)[1]

    def told_rest(self, nodes_px: np.ndarray) -> tuple["PoseEstimator", bool]:
        """As ``at_rest_of``, from the pins (M, N, 2), px, of contacts."""
        estimator = self.at_known_rest()
        other = estimator.other_rest(estimator.pipeline.reference, nodes_px)
        return (estimator, False) if other is None else (estimator.counted_from(other), True)

    def seeking_rest(self) -> SensorModel:
        """The model for a camera's frames if no frame shows its sensor without contact. It works as ``at_rest_of``, while frames arrive.

        The result is the model itself if its inputs are not displacements from rest.
        """
        return RestSeeker(self) if self.counts_from_rest else self

    def with_intervals(self, intervals: Mapping[str, np.ndarray]) -> "PoseEstimator":
        """The same model with other interval quantiles, as ``training.studies.judging.intervals_on`` finds them for one kind of its
        frames."""
        found = copy(self)
        found.ensemble = copy(self.ensemble)
        for name, values in intervals.items():
            setattr(found.ensemble, name, np.asarray(values, float))
        found._trained = replace(self._trained, ensemble=found.ensemble)
        return found

    def counted_from(self, reference: Reference) -> "PoseEstimator":
        """The same model; it measures the pins' displacements from other pins at rest."""
        found = copy(self)
        found.pipeline = Pipeline(self.sensor, self.form, reference, graph=self.pipeline.graph)
        found._trained = replace(self._trained, pipeline=found.pipeline)
        return found if self._tracker is None else found.remembering()

    def noting(self, undecided: str) -> "PoseEstimator":
        """The same model; its ``caveats`` say what is ``undecided`` about the camera's view."""
        found = copy(self)
        found._undecided = undecided
        return found

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
            return self._as_estimate(self.part.estimate_frame(self._trained, frame), started, verdict=self._verdict_of(frame))
        seen = self.pins_in(frame)
        return self.unseen(seen, started) if isinstance(seen, Unseen) else self.estimate_one(seen, started, "")

    @property
    def caveats(self) -> list[str]:
        """Reasons why the intervals of all frames are wider than the model's own, one line each."""
        found = [self._undecided] if self._undecided else []
        if self.domain is None:
            found.append(
                "the run does not hold the patterns of pins that it learnt from (an earlier version, or fewer frames than "
                f"{FEWEST}): a strange frame gets an estimate like any other; train it again"
            )
        if self._unmeasured > 1:
            found.append(
                f"no frame without contact shows where the camera sits: all intervals are {self._unmeasured:g} times wider; give one "
                "(--no-contact, --at-rest)"
            )
        if self._assumes:
            mm = ASSUMED_MM * self.sensor.skin.outer_radius_mm
            found.append(
                "the model was trained on simulated contacts of a sensor whose contacts were never calibrated: radius, skin and gel are "
                f"assumed; for that the intervals hold {ASSUMED_RADIUS:.0%} of each length, {mm:.2g} mm and {ASSUMED_DEG:g} deg; "
                "'twin calibrate contact' with labelled contacts knows it better"
            )
        if self._force.any() and self._stiffness > 1:
            skin, gel = self.sensor.skin.young_modulus_mpa, self.sensor.gel.young_modulus_mpa
            found.append(
                f"forces and torques assume a skin of {skin:.3g} MPa and a gel of {gel:.3g} MPa, and may be {self._stiffness:.3g} times "
                "larger or smaller; their intervals hold that; 'twin calibrate contact' with 3 weighed presses or more knows it better"
            )
        return found

    @property
    def label_range(self) -> np.ndarray:
        """Extent (K,) of the labels that the model was trained on; infinite if the run holds no domain."""
        return np.full(len(self.units), np.inf) if self.domain is None else self.domain.high - self.domain.low

    @property
    def _assumes(self) -> bool:
        """Whether the model was trained on simulated contacts of a sensor whose contacts were never calibrated."""
        return self.domain is not None and self.domain.simulated and self.sensor.rig is None

    def _assumed(self, value: np.ndarray) -> np.ndarray:
        """Half widths (K,) that are due to what is only assumed of the sensor, for estimates (K,)."""
        length = np.array([unit == "mm" for unit in self.units[: len(value)]])
        lengths = ASSUMED_MM * self.sensor.skin.outer_radius_mm + ASSUMED_RADIUS * np.abs(value)
        return float(self._assumes) * np.where(length, lengths, np.where(self._force, 0.0, ASSUMED_DEG))

    @property
    def _unmeasured(self) -> float:
        """Factor on all intervals for a camera that may have moved."""
        alone = self.pipeline.reference is self._trained.reference
        return self.part.unmeasured_widens if isinstance(self.part, PinModel) and alone else 1.0

    @property
    def _stiffness(self) -> float:
        """Factor by which the true forces may be larger or smaller than the simulated ones."""
        return self.sensor.skin.stiffness_factor

    @property
    def _force(self) -> np.ndarray:
        """(K,) bool: labels that are forces or torques of simulated contacts. They are proportional to the sensor's stiffness."""
        return np.array([name in SIMULATED_FORCES for name in self.config["columns"]])

    def _widened(
        self, value: np.ndarray, half: np.ndarray, lost_share: float, verdict: Verdict, excess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """Low and high ends (K,) of the intervals with all unknown effects, and notes on this frame."""
        lost = 1.0 + LOST_WIDENS * lost_share if lost_share > LOST_USUAL else 1.0
        if verdict.notes and self.domain is not None:
            half = np.maximum(half, self.domain.least) * verdict.factor + verdict.added
        half = half * lost * self._unmeasured + excess + self._assumed(value)
        more, less = value * (self._stiffness - 1), value * (1 / self._stiffness - 1)
        low = value - half + np.where(self._force, np.minimum(more, less), 0.0)
        high = value + half + np.where(self._force, np.maximum(more, less), 0.0)
        notes = (f"{lost_share:.0%} of the pins were not found: intervals are {lost:.1f} times wider",) if lost > 1 else ()
        return low, high, (*verdict.notes, *notes)

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
            return self.unseen(seen, started), None
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
                f"the model of '{self.sensor.name}' makes no contact maps; train touch on simulated contacts, which tell "
                "what acts on the skin ('twin dataset', 'twin train --model touch --target contact')"
            )
        return self.maps

    def modes_of(self, pins: PinTable) -> np.ndarray:
        """Modes (M, D) that the model sees in a table's frames; raises as ``inputs_of``."""
        inputs, rows = self.inputs_of(pins, together=not pins.measured)
        return self.ensemble.modes(inputs, rows).inputs

    def _as_estimate(
        self,
        made: Prediction | Unseen,
        started: float,
        contact: str = "",
        slip: Slip | None = None,
        lost: float = 0.0,
        verdict: Verdict = USUAL_FRAME,
    ) -> PoseEstimate:
        excess: np.ndarray = np.zeros(len(self._bounds[0]))
        if isinstance(made, Prediction) and self.domain is not None:
            reason = verdict.reason
            if not reason:
                reason, excess = self.domain.outside_range(made.mean[0], self.config["columns"], self.config["units"])
            made = Unseen(reason, made.touched, made.seen) if reason else made
        if isinstance(made, Unseen):
            if self._tracker is not None:
                self._tracker.forget()
            none = np.full(len(self.names), np.nan)
            return PoseEstimate(
                self.names, self.units, none, none, none, np.nan, False, made.reason, _ms(started), contact, made.touched, seen=made.seen
            )
        value, half, executed = made.mean[0], made.half_width[0], float(made.executed[0])
        low, high, notes = self._widened(value, half, lost, verdict, excess)
        value, low, high = (np.clip(each, *self._bounds) for each in (value, low, high))
        if slip is not None:
            value, low, high = (np.concatenate(pair) for pair in zip((value, low, high), slip.values, strict=True))
        return PoseEstimate(
            self.names, self.units, value, low, high, executed, True, "", _ms(started), contact, made.touched, notes, made.seen
        )

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
        seen = replace(seen, pins=seen.pins.seen_from(known)) if seen.pins.measured else seen
        verdict = self._verdict(seen.pins.nodes_px[0], seen.pins.lost[0])
        if verdict.reason:
            return self.unseen(Unseen(verdict.reason, seen.touched, seen.seen), started)
        if self.domain is not None and verdict.camera.any():
            pins = seen.pins
            places = self.domain.without_camera(pins.nodes_px[0], pins.area_px2[0], verdict.camera, known.spacing_px.mean())
            seen = replace(seen, pins=replace(pins, nodes_px=places[0][None], area_px2=places[1][None]))
        slip = None if self._tracker is None else self._tracker(self.modes_of(seen.pins)[0])
        return self._as_estimate(self._of_pins.estimate_one(self._trained, seen), started, contact, slip, seen.lost_share, verdict)

    def knows(self, pins: PinTable) -> np.ndarray:
        """(M,) bool: whether the pins of each row of a table are a pattern that the model was trained on."""
        seen = pins.seen_from(self._trained.reference)
        return np.array([not self._verdict(*each).reason for each in zip(seen.nodes_px, seen.lost, strict=True)], bool)

    def _verdict(self, nodes_px: np.ndarray, lost: np.ndarray) -> Verdict:
        """Whether pins (N, 2), as seen by the camera of the training, some of them ``lost`` (N,), are a pattern that was trained on."""
        if self.domain is None:
            return USUAL_FRAME
        reference = self._trained.reference
        moved = (nodes_px - reference.pins_px) / reference.spacing_px.mean()
        return self.domain.judge(moved, lost, reference, corrects=isinstance(self.part, PinModel))

    def _verdict_of(self, frame: Frame) -> Verdict:
        """The verdict on a frame for a model that does not look for pins itself."""
        if self.domain is None:
            return USUAL_FRAME
        seen = self.pipeline(frame)
        if not seen.valid or seen.graph is None:
            return Verdict(seen.reason)
        return self._verdict(seen.graph.nodes_px, np.isnan(seen.pins_px[:, 0]))

    def unseen(self, seen: Unseen, started: float) -> PoseEstimate:
        """The estimate of a frame that shows no known pose."""
        return self._as_estimate(seen, started)

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


def _instead_of(run: Path) -> str:
    """Suggestion for a folder that holds no model: the shipped or neighbouring model with the most similar name, if there is one."""
    shipped = shipped_names()
    beside = [folder.name for folder in run.parent.iterdir() if (folder / "config.json").is_file()] if run.parent.is_dir() else []
    near = get_close_matches(run.name, [*(shipped if run.name == str(run) else []), *beside], n=1)
    if near:
        return f"did you mean '{near[0] if near[0] in shipped and near[0] not in beside else run.with_name(near[0])}'?"
    return f"'twin train' writes one; weights for {', '.join(shipped)} go with the package: give the name instead"


def folder_of(run: str | Path) -> Path:
    """The folder of a run: the given one, or that of the shipped weights if there is no such folder and ``run`` is a sensor's name."""
    return SHIPPED / run if not Path(run).exists() and str(run) in shipped_names() else Path(run)


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
        return PoseEstimator.load(sensor) if sensor in shipped_names() else None

    return model_of


def digest_of(run: str | Path) -> str:
    """Digest of everything that affects a model's estimates: its weights, its configuration, and the code that runs it."""
    folder, digest = folder_of(run), hashlib.sha256(fingerprint(PoseEstimator).encode())
    for name in (CONFIG, WEIGHTS, TENSORS, DOMAIN):
        if (folder / name).is_file():
            digest.update(name.encode() + hashlib.sha256((folder / name).read_bytes()).digest())
    return digest.hexdigest()


def load_remembering(run: str | Path) -> PoseEstimator:
    """A trained model for consecutive frames: ``PoseEstimator.load`` and ``PoseEstimator.remembering``.

    Raises
    ------
    TrainingError
        The folder holds no run.
    """
    return PoseEstimator.load(run).remembering()


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


def _ms(started: float) -> float:
    return 1e3 * (perf_counter() - started)
