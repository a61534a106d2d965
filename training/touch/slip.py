"""Detection of slip in a sequence of frames, trained on simulated drags: whether slip has begun, whether the whole contact slides, and how
far it is from that.

Friction depends on the past, so one frame does not show slip. A small recurrent network gets the model's modes of the pins in each frame
and their change since the frame before, and remembers. It learns from contacts that are pressed and then dragged. The finite elements give
the part of the skin that slides, and from it follow

- the beginning of slip: at least a tenth of the pressed skin slides under a drag;
- slip of the whole contact: nineteen twentieths of it slide;
- the sliding share: the share of the pressed skin that slides under the drag;
- the remaining drag: how far the object must still be dragged until the whole contact slides.

A press alone does not count as slip, although skin that spreads over a smooth object slides on it. In training the states of a contact are
traversed at random speeds with random stops, and every frame has its own noise of the pins, so that the network depends on no frame rate.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn.utils.rnn import pad_sequence

from scenes.layouts.rings import Rings
from scenes.sensor import SensorSpec
from training.data.dataset import Dataset, name_prefixes
from training.data.pins import PinTable
from training.errors import TrainingError
from training.runs.assemble import COVERAGE, conformal_quantile
from training.runs.run_files import AGAIN
from training.surrogate.symmetry import Symmetry, symmetries
from training.touch.contact_maps import HEADROOM
from twin.camera.projection import project_in_form
from twin.errors import ErrorsAs
from twin.frames.truth import arrays_of, image_name, open_truth
from twin.geometry.pins import rest_pins
from twin.mechanics.path import carry_points
from twin.mechanics.skin_map import skin_grid
from twin.store import ArrayFile

"""File of a run with its network for slip."""
FILE = ArrayFile("network for slip", "twin train", version=1, error=TrainingError, again=AGAIN)
BEGINS, WHOLE = 0.1, 0.95
"""Share of the pressed skin that slides when slip begins, and share above which the whole contact counts as sliding."""
FEWEST_DRAGS = 30
"""Least number of contacts that are dragged until they slide. With fewer, slip is not learnt."""
HELD_OUT = 6
"""One contact in this many is held out of training, to set thresholds and intervals."""
WAYS = 2400
"""Number of sequences for training. Each contact gives several, at different speeds."""
SLOWEST, FASTEST = 0.15, 1.0
"""Smallest and largest speed, in load steps (0.4 mm at most) per frame."""
STOP_SHARE, LONGEST_STOP = 0.04, 8
"""Probability that the object stops at a frame, and bound (exclusive) of the number of frames of a stop."""
NOISE_PX = 0.1
"""Standard deviation of a pin's noise in a frame, px."""
GAIN, CHANGE = 3.0, 5.0
"""Standard deviation of the largest mode at the network's input, and factor on the change of the modes."""
JITTER = 0.02
"""Standard deviation of the noise of the network's inputs in training."""
UNITS, EPOCHS, BATCH, RATE, DECAY = 64, 12, 24, 5e-3, 0.02
"""Training: units of both layers, epochs, sequences of a step, highest learning rate, weight decay."""
LEAST_LEFT_MM = 0.1
"""Distance, mm, that is added to the remaining drag before its logarithm is taken."""
LEFT_WEIGHT, SHARE_WEIGHT = 0.3, 0.1
"""Weights in the loss: of the remaining drag and of the direction, and of the sliding share."""
LEFT_SCALES, SHARE_SCALES = (-4.0, 2.0), (-3.5, 0.0)
"""Bounds of the logarithm of the errors that the network states: of the remaining drag, and of the sliding share (0.03 to 1)."""
SEEN_DRAG_MM = 0.3
"""Least drag, mm, for which its direction is learnt."""
FALSE_ALARMS = 0.01
"""Share of the held-out frames without slip that may raise the alarm. It determines the alarm's threshold."""
NAMES = ("slip_begins", "slip_whole", "slip_sliding", "slip_left", "slip_direction")
"""Additional labels of an estimate with history: probabilities of slip's beginning and of slip of the whole contact, sliding share,
remaining drag, direction."""
SLIP_UNITS = ("", "", "", "mm", "deg")


@dataclass(frozen=True)
class Drag:
    """A simulated contact that is pressed, and then dragged; S states.

    Attributes
    ----------
    caps_mm : (S, N, 3) float
        Places of the pins' caps.
    lost : (S, N) bool
        Pins that are hidden.
    share : (S,) float
        Share of the pressed skin that slides; 0 before the drag.
    drag_mm : (S,) float
        Distance by which the object was dragged.
    direction : (2,) float
        Unit vector of the drag in the image plane of the sensor frame; (0, 0) if there was none.
    """

    caps_mm: np.ndarray
    lost: np.ndarray
    share: np.ndarray
    drag_mm: np.ndarray
    direction: np.ndarray

    def turn(self, symmetry: Symmetry, rings: int) -> "Drag":
        """The same drag with the object turned or mirrored over a sensor whose pins form rings."""
        lost = np.empty_like(self.lost)
        lost[:, symmetry.places(rings)] = self.lost
        direction = symmetry.matrix[:2, :2] @ self.direction
        return replace(self, caps_mm=symmetry.move_vectors(self.caps_mm, rings), lost=lost, direction=direction)

    @property
    def whole_mm(self) -> float:
        """Drag at which the whole contact first slides; NaN if it never does."""
        sliding = np.flatnonzero(self.share >= WHOLE)
        if not len(sliding):
            return float("nan")
        around = [max(sliding[0] - 1, 0), sliding[0]]
        return float(np.interp(WHOLE, self.share[around], self.drag_mm[around]))


@dataclass(frozen=True)
class DragPath:
    """A drag as a sequence of T frames.

    Attributes
    ----------
    modes : (T, D) float
        The model's modes of the pins.
    begins, whole : (T,) bool
        Whether slip has begun, and whether the whole contact slides.
    share : (T,) float
        Share of the pressed skin that slides; 0 before the drag.
    left_mm : (T,) float
        Remaining drag until the whole contact slides; NaN if it never does.
    drag_mm : (T,) float
    direction : (2,) float
    """

    modes: np.ndarray
    begins: np.ndarray
    whole: np.ndarray
    share: np.ndarray
    left_mm: np.ndarray
    drag_mm: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class Slip:
    """Estimate of a contact's slip after a frame.

    Attributes
    ----------
    begins, whole : float
        Probability that slip has begun, and that the whole contact slides.
    share, share_low, share_high : float
        Share of the pressed skin that slides under a drag, and the ends of its 90 % interval.
    left_mm, left_low_mm, left_high_mm : float
        Remaining drag until the whole contact slides, and the ends of its 90 % interval.
    direction_deg : float
        Direction in which the object moves over the skin, in the sensor frame from x towards y.
    alarm : bool
        Whether ``begins`` exceeds the threshold that was set for few false alarms.
    """

    begins: float
    whole: float
    share: float
    share_low: float
    share_high: float
    left_mm: float
    left_low_mm: float
    left_high_mm: float
    direction_deg: float
    alarm: bool

    @property
    def values(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values, and low and high ends of the 90 % intervals (5,), of the labels ``NAMES``; probability and direction have no interval."""
        value = np.array([self.begins, self.whole, self.share, self.left_mm, self.direction_deg])
        low, high = value.copy(), value.copy()
        low[2:4], high[2:4] = (self.share_low, self.left_low_mm), (self.share_high, self.left_high_mm)
        return value, low, high


class SlipNetwork(nn.Module):
    """Network with eight output numbers for every frame of sequences (B, T, D).

    They are the logits of slip's beginning and of slip of the whole contact, the logarithms of the remaining drag and of its error, the
    direction (2), the logit of the sliding share and the logarithm of its error.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, UNITS)
        self.memory = nn.GRU(UNITS, UNITS, batch_first=True)
        self.head = nn.Linear(2 * UNITS, 8)

    def forward(self, x: torch.Tensor, before: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """The numbers (B, T, 8), and the memory (1, B, units) after the last frame."""
        h = nn.functional.silu(self.enter(x))
        remembered, after = self.memory(h, before)
        return self.head(torch.cat([h, remembered], dim=2)), after


@dataclass(frozen=True)
class SlipModel:
    """A trained network with the gain and bounds of its modes, the alarm's threshold, and factors on the errors that the network states.

    Attributes
    ----------
    network : SlipNetwork
    gain : float
    limit : (D,) float
        Size above which a mode is clipped.
    alarm_at : float
        Probability of slip's beginning above which the alarm is given.
    left_factor, share_factor : float
        Factors with which 90 % of the remaining drags, and of the sliding shares, lie within the stated errors.
    """

    network: SlipNetwork = field(repr=False)
    gain: float
    limit: np.ndarray
    alarm_at: float
    left_factor: float
    share_factor: float

    def inputs(self, modes: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Inputs of the network from modes (..., D) and those of the frame before."""
        now, last = (self.gain * np.clip(each, -self.limit, self.limit) for each in (modes, before))
        return np.concatenate([now, CHANGE * (now - last)], axis=-1).astype(np.float32)

    def estimate_from(self, out: np.ndarray) -> Slip:
        """The estimate from the network's numbers (8,)."""
        begins, whole, share = (1 / (1 + np.exp(-np.clip(out[[0, 1, 6]].astype(float), -50, 50)))).tolist()
        middle, wide = float(out[2]), self.left_factor * float(np.exp(np.clip(out[3], *LEFT_SCALES)))
        left, low, high = (max(float(np.exp(np.clip(at, -9, 5))) - LEAST_LEFT_MM, 0.0) for at in (middle, middle - wide, middle + wide))
        apart = self.share_factor * float(np.exp(np.clip(out[7], *SHARE_SCALES)))
        sliding = (share, max(share - apart, 0.0), min(share + apart, 1.0))
        return Slip(begins, whole, *sliding, left, low, high, float(np.degrees(np.arctan2(out[5], out[4]))), begins > self.alarm_at)


class SlipTracker:
    """Tracks the slip of one contact from frame to frame.

    Parameters
    ----------
    model : SlipModel
    """

    def __init__(self, model: SlipModel) -> None:
        self._model = model
        self.forget()

    def forget(self) -> None:
        """Forget the contact: the next frame is the first of another contact."""
        self._memory: torch.Tensor | None = None
        self._before: np.ndarray | None = None

    def __call__(self, modes: np.ndarray) -> Slip:
        """The estimate after a frame with these modes (D,)."""
        before = modes if self._before is None else self._before
        x = torch.from_numpy(self._model.inputs(modes, before))[None, None]
        with torch.no_grad():
            out, self._memory = self._model.network(x, self._memory)
        self._before = modes
        return self._model.estimate_from(out[0, 0].numpy())


def drags_of(data: Dataset) -> list[tuple[np.ndarray, Drag]]:
    """Drags of the contacts of a simulated data set with all their states, each with its rows (S,), including contacts without a drag."""
    truth, _, _ = open_truth(data.folder)
    names = ("caps_mm", "visible", "path_id", "move", "T_sensor_object", "map_force_n", "map_touched_mm2", "map_slipping_mm2")
    arrays = arrays_of(truth, names)
    nodes_mm = skin_grid(data.pins.sensor.geometry).nodes_mm
    order = {name: row for row, name in enumerate(data.pins.image_name.tolist())}
    found: list[tuple[np.ndarray, Drag]] = []
    for contact in np.unique(arrays["path_id"]).tolist():
        mine = np.flatnonzero(arrays["path_id"] == contact)
        rows = np.array([order.get(image_name(contact, state), -1) for state in range(len(mine))])
        if (rows >= 0).all() and len(rows) > 1:
            found.append((rows, _drag({key: array[mine] for key, array in arrays.items()}, nodes_mm)))
    return found


def name_drags(parts: Sequence[Dataset]) -> Iterator[tuple[Dataset, list[str], Drag]]:
    """The drags of several data sets, each with its data set and the names of its frames in the joined one."""
    for part, prefix in zip(parts, name_prefixes([part.folder for part in parts]), strict=True):
        for rows, drag in drags_of(part):
            yield part, [prefix + name for name in part.pins.image_name[rows].tolist()], drag


def _drag(arrays: dict[str, np.ndarray], nodes_mm: np.ndarray) -> Drag:
    """The drag of one contact, from its rows of the truth."""
    weight = np.linalg.norm(arrays["map_force_n"], axis=2)
    middle = weight @ nodes_mm / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    T = arrays["T_sensor_object"]
    dragged = np.abs(arrays["move"]).max(axis=1) > 0
    steps = np.zeros((len(T), 3))
    for k in range(1, len(T)):
        if dragged[k]:
            steps[k] = carry_points(middle[k - 1 : k], T[k - 1], T[k])[0]
    whole = steps.sum(axis=0)[:2]
    size = float(np.linalg.norm(whole))
    slides = arrays["map_slipping_mm2"].sum(axis=1) / np.maximum(arrays["map_touched_mm2"].sum(axis=1), 1e-6)
    share, drag_mm = np.where(dragged, np.minimum(slides, 1.0), 0.0), np.cumsum(np.linalg.norm(steps, axis=1))
    return Drag(arrays["caps_mm"].astype(float), ~arrays["visible"], share, drag_mm, whole / size if size > 0 else np.zeros(2))


class CapView:
    """The model's view of its sensor's caps: their projections in the frame with noise, and from these the model's modes.

    Parameters
    ----------
    modes_of : callable
        Modes (T, D) of a table of T frames (``PoseEstimator.modes_of``).
    pins : PinTable
        A table of the sensor and form, relative to the sensor's own pins at rest.
    """

    def __init__(self, modes_of: Callable[[PinTable], np.ndarray], pins: PinTable) -> None:
        self._modes_of, self._pins = modes_of, pins
        self._rest_px = project_in_form(pins.sensor, pins.form, rest_pins(pins.sensor.geometry).caps_mm)

    def __call__(self, caps_mm: np.ndarray, lost: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Modes (T, D) of caps (T, N, 3), of which some are ``lost`` (T, N)."""
        count, reference = len(caps_mm), self._pins.reference
        moved_px = project_in_form(self._pins.sensor, self._pins.form, caps_mm) - self._rest_px
        nodes_px = reference.pins_px + moved_px + NOISE_PX * rng.normal(size=moved_px.shape)
        columns = {"image_name": np.full(count, ""), "nodes_px": nodes_px, "area_px2": np.tile(reference.area_px2, (count, 1))}
        columns |= {"lost": lost, "valid": np.ones(count, bool), "light": np.zeros(lost.shape)}
        return self._modes_of(self._pins.with_columns(columns))


def resample_path(drag: Drag, at: np.ndarray, eyes: CapView, rng: np.random.Generator) -> DragPath:
    """A drag in frames at positions ``at`` (T,) in its sequence of states, 0 to S - 1, with linear interpolation between two states."""
    low = np.minimum(at.astype(int), len(drag.share) - 2)
    part = at - low

    def between(values: np.ndarray) -> np.ndarray:
        return (values[low].T * (1 - part) + values[low + 1].T * part).T

    drag_mm, share, limit = between(drag.drag_mm), between(drag.share), drag.whole_mm
    whole = drag_mm >= limit  # nowhere if the limit is NaN
    modes = eyes(between(drag.caps_mm), drag.lost[low], rng)
    return DragPath(modes, (share >= BEGINS) | whole, whole, share, np.maximum(limit - drag_mm, 0.0), drag_mm, drag.direction)


def random_places(states: int, rng: np.random.Generator) -> np.ndarray:
    """Positions (T,) from the first to the last of a contact's states, at a random speed with random stops."""
    stride, found = np.exp(rng.uniform(np.log(SLOWEST), np.log(FASTEST))), [0.0]
    while found[-1] < states - 1:
        if rng.random() < STOP_SHARE:
            found += [found[-1]] * int(rng.integers(1, LONGEST_STOP))
        found.append(min(found[-1] + stride * np.exp(0.3 * rng.normal()), states - 1.0))
    return np.array(found)


def learn_slip(drags: Sequence[Drag], eyes: CapView, sensor: SensorSpec, *, seed: int = 0) -> SlipModel:
    """Learn slip from drags. At least ``FEWEST_DRAGS`` must slide in the end. If pins form rings, each drag is also turned and mirrored."""
    rings = sensor.pins.shape.rings if isinstance(sensor.pins.shape, Rings) else None
    turns = [] if rings is None else symmetries(sensor.pins.phase_deg)
    rng = np.random.default_rng([seed, 5])
    held = set(rng.permutation(len(drags))[::HELD_OUT].tolist())
    paths: tuple[list[DragPath], list[DragPath]] = ([], [])
    versions = max(1, round(WAYS / len(drags)))
    for k, drag in enumerate(drags):
        for _ in range(1 if k in held else versions):
            seen = drag if rings is None else drag.turn(turns[rng.integers(len(turns))], rings)
            paths[k in held].append(resample_path(seen, random_places(len(drag.share), rng), eyes, rng))
    known = np.concatenate([path.modes for path in paths[0]])
    gain = GAIN / max(float(known.std(axis=0).max()), 1e-12)
    torch.manual_seed(seed)
    model = SlipModel(SlipNetwork(2 * known.shape[1]), gain, HEADROOM * np.abs(known).max(axis=0), 0.5, 1.0, 1.0)
    _fit_filter(model, paths[0], seed)
    return _calibrate(model, paths[1])


def _fit_filter(model: SlipModel, paths: list[DragPath], seed: int) -> None:
    """Train the network of a model. Each step uses sequences of similar lengths."""
    generator = torch.Generator().manual_seed(seed)
    paths = sorted(paths, key=lambda path: len(path.modes))
    groups = [_pad_sequences(model, paths[k : k + BATCH]) for k in range(0, len(paths), BATCH)]
    optimiser = torch.optim.AdamW(model.network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=EPOCHS * len(groups))
    for _ in range(EPOCHS):
        for k in torch.randperm(len(groups), generator=generator).tolist():
            x, there, wanted = groups[k]
            out, _ = model.network(x + JITTER * torch.randn(x.shape, generator=generator))
            loss = _loss(out[there], wanted[there])
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
    model.network.eval()


def _pad_sequences(model: SlipModel, paths: list[DragPath]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Inputs (B, T, 2 D), a mask of the existing frames (B, T), and targets (B, T, 8) of paths, padded to the longest one's T frames."""
    x, there, wanted = [], [], []
    for path in paths:
        x.append(torch.from_numpy(model.inputs(path.modes, np.concatenate([path.modes[:1], path.modes[:-1]]))))
        there.append(torch.ones(len(path.modes), dtype=torch.bool))
        known = np.isfinite(path.left_mm) & ~path.whole
        log_left = np.log(np.where(known, path.left_mm, 1.0) + LEAST_LEFT_MM)
        shown, direction = path.drag_mm > SEEN_DRAG_MM, np.tile(path.direction, (len(known), 1))
        columns = np.column_stack([path.begins, path.whole, known, log_left, shown, direction, path.share])
        wanted.append(torch.from_numpy(columns).float())
    return pad_sequence(x, True), pad_sequence(there, True), pad_sequence(wanted, True)


def _loss(out: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Mean loss of frames: numbers (M, 8) against targets (M, 8)."""
    loss = nn.functional.binary_cross_entropy_with_logits(out[:, :2], wanted[:, :2], reduction="none").sum(dim=1).mean()
    known, shown = wanted[:, 2] > 0, wanted[:, 4] > 0
    left = _likelihood(out[:, 2] - wanted[:, 3], out[:, 3].clamp(*LEFT_SCALES))
    apart = ((out[:, 4:6] - wanted[:, 5:7]) ** 2).sum(dim=1)
    loss = loss + SHARE_WEIGHT * _likelihood(out[:, 6].sigmoid() - wanted[:, 7], out[:, 7].clamp(*SHARE_SCALES)).mean()
    for part, chosen in ((left, known), (apart, shown)):
        if chosen.any():
            loss = loss + LEFT_WEIGHT * part[chosen].mean()
    return loss


def _likelihood(off: torch.Tensor, log_error: torch.Tensor) -> torch.Tensor:
    """Negative logarithm of the density of normally distributed errors (M,), without its constant."""
    return (off / log_error.exp()) ** 2 / 2 + log_error


def _calibrate(model: SlipModel, paths: list[DragPath]) -> SlipModel:
    """The model with threshold and intervals from held-out paths."""
    x, there, wanted = _pad_sequences(model, paths)
    with torch.no_grad():
        out, _ = model.network(x)
    said, true = out[there].numpy(), wanted[there].numpy()
    known, none = true[:, 2] > 0, true[:, 0] < 0.5
    left_factor, alarm_at = model.left_factor, model.alarm_at
    if known.any():
        left_factor = _factor(said[known, 2] - true[known, 3], said[known, 3], LEFT_SCALES)
    share_factor = _factor(1 / (1 + np.exp(-said[:, 6])) - true[:, 7], said[:, 7], SHARE_SCALES)
    if none.any():
        logits = np.quantile(said[none, 0].astype(float), 1 - FALSE_ALARMS)
        alarm_at = max(0.5, float(1 / (1 + np.exp(-np.clip(logits, -50, 50)))))
    return replace(model, alarm_at=min(alarm_at, 0.99), left_factor=left_factor, share_factor=share_factor)


def _factor(off: np.ndarray, log_error: np.ndarray, bounds: tuple[float, float]) -> float:
    """Factor on the stated errors with which 90 % of the errors (M,) lie within them."""
    scores = np.abs(off) / np.exp(np.clip(log_error, *bounds))
    return float(conformal_quantile(scores[:, None], COVERAGE)[0])


def write_slip(path: Path, model: SlipModel) -> None:
    """Write the model in the form that ``read_slip`` reads."""
    about = {key: getattr(model, key) for key in ("gain", "alarm_at", "left_factor", "share_factor")}
    weights = {key: value.numpy() for key, value in model.network.state_dict().items()}
    FILE.write(path, weights | {"limit": model.limit.astype(np.float32)}, about)


def read_slip(path: Path) -> SlipModel:
    """Read the model that ``write_slip`` wrote.

    Raises
    ------
    TrainingError
        The file can't be read, or is damaged.
    """
    with FILE.open_arrays(path) as (about, found):
        limit = found.pop("limit").astype(float)
        network = SlipNetwork(2 * len(limit))
        with ErrorsAs(RuntimeError, lambda error: ValueError("its arrays do not fit together")):
            network.load_state_dict({key: torch.from_numpy(value) for key, value in found.items()})
        return SlipModel(network.eval(), limit=limit, **about)


# Errors of slip that are means over frames or contacts, in the order of ``compare_slip``.
MEANS = ("whole_accuracy", "false_alarms", "lead_mm", "late", "share", "share_covered", "left_mm", "left_covered")


def compare_slip(model: SlipModel, paths: Sequence[DragPath]) -> dict[str, float]:
    """Compare the estimates for simulated drags with the true values.

    Returns
    -------
    dict
        contacts, frames : int
        whole_accuracy : float
            Share of the frames in which slip of the whole contact is classified correctly.
        false_alarms : float
            Share of the frames without slip that raise the alarm.
        lead_mm : float
            Mean drag between the first alarm during the drag and slip of the whole contact. A later alarm gives a negative value; a
            missing alarm counts as one at the drag's end.
        late : float
            Share of the contacts whose alarm came after the whole contact slid.
        share, share_covered : float
            Mean absolute error of the sliding share, and the part of the true shares inside the 90 % intervals.
        left_mm, left_covered : float
            Mean absolute error of the remaining drag, and the share of true values inside the 90 % intervals.
        direction_deg : float
            Median error of the direction.
    """
    found: dict[str, list[float]] = {name: [] for name in MEANS}
    turned: list[float] = []
    for path in paths:
        tracker = SlipTracker(model)
        slips = [tracker(modes) for modes in path.modes]
        found["whole_accuracy"] += [(slip.whole > 0.5) == whole for slip, whole in zip(slips, path.whole.tolist(), strict=True)]
        found["share"] += [abs(slip.share - share) for slip, share in zip(slips, path.share.tolist(), strict=True)]
        found["share_covered"] += [s.share_low <= share <= s.share_high for s, share in zip(slips, path.share.tolist(), strict=True)]
        found["false_alarms"] += [slip.alarm for slip, begins in zip(slips, path.begins.tolist(), strict=True) if not begins]
        if path.whole.any():
            at = next((k for k, slip in enumerate(slips) if slip.alarm and path.drag_mm[k] > 0), len(slips) - 1)
            slides_mm = float(path.drag_mm[0] + path.left_mm[0])
            found["lead_mm"].append(slides_mm - float(path.drag_mm[at]))
        for k in np.flatnonzero(np.isfinite(path.left_mm) & ~path.whole).tolist():
            found["left_mm"].append(abs(slips[k].left_mm - float(path.left_mm[k])))
            found["left_covered"].append(slips[k].left_low_mm <= path.left_mm[k] <= slips[k].left_high_mm)
        true_deg = float(np.degrees(np.arctan2(path.direction[1], path.direction[0])))
        turned += [abs((slips[k].direction_deg - true_deg + 180) % 360 - 180) for k in np.flatnonzero(path.drag_mm > SEEN_DRAG_MM).tolist()]
    found["late"] = [lead < 0 for lead in found["lead_mm"]]
    counts = {"contacts": len(paths), "frames": len(found["whole_accuracy"])}
    direction_deg = float(np.median(turned)) if turned else float("nan")
    means = {name: float(np.mean(values)) if values else float("nan") for name, values in found.items()}
    return counts | means | {"direction_deg": direction_deg}
