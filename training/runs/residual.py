"""Teaches the small network that adds to rendered frames what models leave out (`twin.camera.residual`), and evaluates it apart.

The network is taught against classifiers, networks that learn at the same time to distinguish real patches from rendered ones (Goodfellow
et al. 2014). Two classifiers are built like the two-sample test's network and begin again in turn, so that no weakness of a single one is
learnt; a third one sees finer texture. Squared errors hold the network near the render: of the luma against the real frame, and of averages
over 5 x 5 px against the render's own, so that levels and the pins' centroids stay.

Frames to which the light was fitted are left out: their renders are more like them than those of other frames. Each evaluated frame is
rendered with a network that was taught on the other half of the frames. The network that is written was taught on all of them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from scenes.sensor import ResidualSpec, SensorSpec
from training.data.two_sample import LEVEL_SCALE, PATCH_PX, TwoSample, evaluate_classifiers, evaluate_halves, patch_corners, patch_network
from twin.calibration.sensor_file import write_sensor
from twin.camera.capture import CHROMA_RANGE, LUMA_RANGE, before_stream, expose, luma_weights
from twin.camera.projection import Disc, lens_disc
from twin.camera.residual import LEAK, LEVELS, MIDDLE, MOST_LEVELS, STEEPNESS, differences, with_residual
from twin.errors import FrameError, format_count
from twin.evaluation.pictures.aligned import read_real, with_changes
from twin.evaluation.pictures.compare import compare_images
from twin.frames.recording import BadFrame
from twin.mechanics.skin_fit import SkinFit
from twin.optics.render import Renderer
from twin.pins.pipeline import Pipeline
from twin.progress import Progress, Step, silent, stage, unheard
from twin.store import writes_file
from twin.types import FloatArray, Form, Frame, ImageArray

CHANNELS, NOISES = 16, 2
"""Size of the network: channels within, random numbers at each pixel."""
STEPS, ALONE = 700, 30
"""Steps of teaching, and how many of them the classifiers learn alone first."""
BATCH, TURNED = 24, 6
"""Patches of each kind in a step, and how many of them are turned alike for the classifiers."""
RATE, LAST_SHARE = 1e-3, 0.4
"""Learning rate of Adam, and the share of it that the last step has."""
MOMENTS, WEIGHT_DECAY = (0.5, 0.99), 1e-2
"""Decay of Adam's moments, and the weight decay of the classifiers."""
ANEW, NOISE_ANEW = 150, 100
"""Steps after which a classifier begins again, and after which the camera's noise is sampled again."""
LOW_WEIGHT, LUMA_WEIGHT = 0.05, 0.002
"""Weights of the squared errors (gray levels): of averages over 5 x 5 px, and of the luma."""
AVERAGED_PX, AVERAGED_STRIDE = 5, 3
"""Side of the squares whose averages stay, px, and their distance."""
KEPT_SHARE = 0.01
"""Share of each step's weights in the moving average that is the result."""
START_SD = 1e-3
"""Standard deviation of the last kernel at the start, so that the network begins by changing nothing."""
NUMBERS = (LUMA_RANGE / 255, CHROMA_RANGE / 255, CHROMA_RANGE / 255)
"""Whole numbers of the stream's studio range for a gray level of luma, blue and red difference."""
DIGITS = 5
"""Significant digits of a written weight."""
LEAST_TAUGHT = 4
"""Fewest frames that the network is taught on and evaluated by."""


@dataclass(frozen=True)
class TaughtResidual:
    """A sensor with a residual network, and how its frames are evaluated without it and with it.

    Attributes
    ----------
    spec : SensorSpec
        With ``response.residual``, not switched on.
    frames : int
        Number of frames that were evaluated.
    before, after : dict of str to TwoSample
        What each classifier of the two-sample test (`JUDGES`) result for real frames and renders.
    real : dict of str to TwoSample
        Its result for two halves of the real frames, where there is no difference.
    psnr_db : (float, float)
        Over the disc, before and after.
    shift_px : (float, float)
        By how far the network moves found pins: median and 95th percentile.
    refused : list of BadFrame
    written : list of Path
    """

    spec: SensorSpec
    frames: int
    before: dict[str, TwoSample]
    after: dict[str, TwoSample]
    real: dict[str, TwoSample]
    psnr_db: tuple[float, float]
    shift_px: tuple[float, float]
    refused: list[BadFrame]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = [f"refused {each['image_name']}: {each['reason']}" for each in self.refused]
        lines.append(f"{format_count(self.frames, 'frames')}, each with a network that did not see it")
        for name, before in self.before.items():
            halves = f"of two halves of the real frames {self.real[name].text()}"
            lines.append(f"two-sample accuracy, {name} evaluate: {before.text()} -> {self.after[name].text()}; {halves}")
        moved = f"pins moved by {self.shift_px[0]:.3f} px (median), {self.shift_px[1]:.3f} px (95 %)"
        lines.append(f"PSNR over the disc {self.psnr_db[0]:.2f} -> {self.psnr_db[1]:.2f} dB; {moved}")
        return [*lines, "the network is off: 'twin realism --residual' and 'twin dataset --residual' switch it on"]


@writes_file(".*.csv", ".*.uri")
def calibrate_residual(
    frames: Path, sensor: SensorSpec, out: Path, *, fitted: int = 6, steps: int = STEPS, progress: Progress = silent
) -> TaughtResidual:
    """Teach a residual network to a folder of raw colour frames, evaluate it on frames that it did not see, and write the specification.

    Parameters
    ----------
    sensor : SensorSpec
        A specification that ``calibrate_optics`` made for this sensor.
    out : Path
        The ``.toml`` file to write.
    fitted : int
        Leave out the frames to which ``calibrate_optics`` with this limit fitted the specification.

    Raises
    ------
    FrameError
        The camera is mono, or fewer than ``LEAST_TAUGHT`` frames are valid.
    """
    if sensor.camera.channels == "mono":
        raise FrameError(f"sensor {sensor.name}: a residual network needs colour frames, this camera is mono")
    sensor = with_changes(sensor, response={"residual": None})
    disc = lens_disc(sensor.view, sensor.housing)
    with stage(progress, "read the frames, find their pins") as step:
        read, refused = read_real(frames, sensor, disc, fitted=fitted, progress=step)
    if len(read) < LEAST_TAUGHT:
        raise FrameError(f"{frames}: valid frames beside the {fitted} fitted ones: {len(read)}; give {LEAST_TAUGHT} or more")
    fit, renderer, light = SkinFit(sensor), Renderer(sensor), []
    with stage(progress, "fit the skin to the pins, render") as step:
        for done, each in enumerate(read):
            light.append(renderer.render(fit(each.pins_px), seed=done))
            step(done + 1, len(read))
    real = [each.frame.image for each in read]
    plain = [expose(each, sensor.capture, np.random.default_rng(k)) for k, each in enumerate(light)]
    found = list(plain)
    halves = [np.arange(len(real))[k::2] for k in (0, 1)]
    for taught, unseen in (halves, halves[::-1]):
        with stage(progress, "train a network on half of the frames") as step:
            residual = teach([real[k] for k in taught], [light[k] for k in taught], sensor, disc, steps=steps, progress=step)
        own = with_residual(with_changes(sensor, response={"residual": residual.model_dump()}))
        for k in unseen:
            found[k] = expose(light[k], own.capture, np.random.default_rng(k))
    with stage(progress, "train the network on all frames") as step:
        residual = teach(real, light, sensor, disc, steps=steps, progress=step)
    with stage(progress, "train the two-sample test") as step:
        before, after = (evaluate_classifiers(real, shown, disc.inside, progress=step) for shown in (plain, found))
    with stage(progress, "the same for halves of the real frames") as step:
        real_told = evaluate_halves(real, disc.inside, progress=step)
    pairs = (zip(real, shown, strict=True) for shown in (plain, found))
    psnr_db = [float(np.mean([compare_images(*pair, disc.inside).psnr_db for pair in each])) for each in pairs]
    shift_px = _shift_px(sensor, plain, found)
    spec = with_changes(sensor, response={"residual": residual.model_dump()})
    write_sensor(out, spec, f"With a residual network that was trained on {format_count(len(real), 'frames')} of {frames.name}.")
    return TaughtResidual(spec, len(real), before, after, real_told, (psnr_db[0], psnr_db[1]), shift_px, refused, [out])


def _shift_px(sensor: SensorSpec, first: list[ImageArray], second: list[ImageArray]) -> tuple[float, float]:
    """Median and 95th percentile of the distances of pins that are found in both of two sets of frames."""
    pipeline = Pipeline(sensor, Form.RAW)
    pins = [[pipeline(Frame(image, Form.RAW, str(k))).pins_px for k, image in enumerate(images)] for images in (first, second)]
    apart = np.linalg.norm(np.array(pins[1]) - np.array(pins[0]), axis=-1)
    median, most = np.nanquantile(apart, [0.5, 0.95])
    return float(median), float(most)


class ResidualNetwork(nn.Module):
    """The network of `twin.camera.residual` for teaching: the same four convolutions."""

    def __init__(self, channels: int = CHANNELS, noises: int = NOISES) -> None:
        super().__init__()
        self.noises = noises
        sizes = ((3 + noises, channels, 5), (channels, channels, 3), (channels, channels, 3), (channels, 3, 3))
        self.layers = nn.ModuleList(nn.Conv2d(given, made, side, padding=side // 2) for given, made, side in sizes)
        last = list(self.layers[-1].parameters())
        nn.init.normal_(last[0], std=START_SD)
        nn.init.zeros_(last[1])

    def forward(self, signal: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """What is added (n, 3, H, W) to luma and colour differences (n, 3, H, W), given noise (n, noises, H, W)."""
        first, second, third, last = self.layers
        hidden = functional.leaky_relu(first(torch.cat([signal / LEVELS - torch.tensor(MIDDLE).view(1, 3, 1, 1), noise], 1)), LEAK)
        hidden = hidden + functional.leaky_relu(second(hidden), LEAK)
        hidden = hidden + functional.leaky_relu(third(hidden), LEAK)
        return MOST_LEVELS * torch.tanh(STEEPNESS * last(hidden))


def teach(
    real: list[ImageArray], light: list[FloatArray], sensor: SensorSpec, disc: Disc, *, steps: int = STEPS, progress: Step = unheard
) -> ResidualSpec:
    """A residual network that was taught on real frames (H, W, 3) uint8 and the rendered light (H, W, 3) of the same states.

    The same frames give the same network.

    Parameters
    ----------
    sensor : SensorSpec
        Without a residual network; its response makes gray levels of the light.
    disc : Disc
        The lens disc, within which patches lie and the network acts.
    steps : int
    """
    rng, corners = np.random.default_rng(0), patch_corners(disc.inside)
    corners = corners[corners[:, 1] % 2 == 0]  # neighbouring columns share colour differences
    matrix = torch.from_numpy(differences(luma_weights(sensor.response.stream)))
    shown = torch.from_numpy(np.stack(real).astype(np.float32)).permute(0, 3, 1, 2)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = ResidualNetwork()
        judges = [patch_network(), patch_network(), _fine_classifier()]
        their = [_optimizer(judge) for judge in judges]
        mine = torch.optim.Adam(network.parameters(), RATE, betas=MOMENTS)
        kept = [weights.detach().clone() for weights in network.parameters()]
        for done in range(steps):
            if done % NOISE_ANEW == 0:
                gray = np.stack([before_stream(x, sensor.capture, rng) for x in light])
                signal = _colours(torch.from_numpy(gray).permute(0, 3, 1, 2), matrix)
            if done and done % ANEW == 0:
                turn = done // ANEW % 2
                judges[turn] = patch_network()
                their[turn] = _optimizer(judges[turn])
            mine.param_groups[0]["lr"] = RATE * (1 - (1 - LAST_SHARE) * done / steps)
            given, wanted = _pairs(signal, shown, corners, rng)
            made = _add_noise(network, given, sensor.response.chroma_columns)
            frames = _through_stream(made, matrix, sensor.response.stream)
            for judge, optimizer in zip(judges, their, strict=True):
                _train_classifier(judge, optimizer, wanted, frames.detach(), rng)
            if done >= ALONE:
                fooled = torch.stack([_deception_loss(judge, wanted, frames) for judge in judges]).mean()
                low = (_averages(made) - _averages(given)).square().mean()
                luma = (made[:, 0] - _colours(wanted, matrix)[:, 0]).square().mean()
                mine.zero_grad()
                (fooled + LOW_WEIGHT * low + LUMA_WEIGHT * luma).backward()
                mine.step()
                for mean, weights in zip(kept, network.parameters(), strict=True):
                    mean.lerp_(weights.detach(), KEPT_SHARE if done > ALONE else 1.0)
            progress(done + 1, steps)
    return spec_of(kept, disc)


def spec_of(weights: list[torch.Tensor], disc: Disc) -> ResidualSpec:
    """The section of a specification that holds a network's kernels and biases, in the order of its layers."""
    numbers = tuple(float(f"{value:.{DIGITS}g}") for part in weights for value in part.flatten().tolist())
    x, y = (round(float(value), 2) for value in disc.center_px)
    return ResidualSpec(weights=numbers, channels=CHANNELS, noises=NOISES, center_px=(x, y), radius_px=round(float(disc.radius_px), 2))


def _colours(gray: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """(n, 3, H, W) of colours (n, 3, H, W) times a matrix (3, 3)."""
    return torch.einsum("ij,njhw->nihw", matrix, gray)


def _pairs(signal: torch.Tensor, shown: torch.Tensor, corners: np.ndarray, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Patches (n, 3, p, p) of the renders' luma and colour differences, and of the real frames, at the same places."""
    frames, at, p = rng.integers(len(shown), size=BATCH), corners[rng.integers(len(corners), size=BATCH)], PATCH_PX
    cut = [(k, slice(None), slice(row, row + p), slice(column, column + p)) for k, (row, column) in zip(frames, at, strict=True)]
    return torch.stack([signal[c] for c in cut]), torch.stack([shown[c] for c in cut])


def _add_noise(network: ResidualNetwork, signal: torch.Tensor, columns: int) -> torch.Tensor:
    """Luma and colour differences after the network; ``columns`` neighbouring columns have their mean colour differences."""
    noise = torch.randn(len(signal), network.noises, *signal.shape[2:])
    made = signal + network(signal, noise)
    if columns == 1:
        return made
    shared = functional.avg_pool2d(made[:, 1:], (1, columns)).repeat_interleave(columns, 3)
    return torch.cat([made[:, :1], shared], 1)


def _through_stream(signal: torch.Tensor, matrix: torch.Tensor, stream: str) -> torch.Tensor:
    """Colours (n, 3, H, W) of luma and colour differences, rounded as the stream rounds them; the slope is that without rounding."""
    numbers = torch.tensor(NUMBERS).view(1, 3, 1, 1)
    rounded = signal if stream == "rgb" else signal + ((signal * numbers).round() / numbers - signal).detach()
    return _colours(rounded, torch.linalg.inv(matrix)).clamp(0, 255)


def _averages(signal: torch.Tensor) -> torch.Tensor:
    return functional.avg_pool2d(signal, AVERAGED_PX, AVERAGED_STRIDE)


def _fine_classifier() -> nn.Module:
    """A classifier whose first convolution sees every pixel, with bounded slopes (Miyato et al. 2018)."""
    layers: list[nn.Module] = []
    for given, made, stride in ((3, 24, 1), (24, 48, 2), (48, 64, 2)):
        layers += [nn.utils.parametrizations.spectral_norm(nn.Conv2d(given, made, 3, stride=stride, padding=1)), nn.LeakyReLU(LEAK)]
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(64, 1), nn.Flatten(0))


def _optimizer(judge: nn.Module) -> torch.optim.Optimizer:
    return torch.optim.AdamW(judge.parameters(), RATE, betas=MOMENTS, weight_decay=WEIGHT_DECAY)


def _train_classifier(
    judge: nn.Module, optimizer: torch.optim.Optimizer, real: torch.Tensor, made: torch.Tensor, rng: np.random.Generator
) -> None:
    """One step of a classifier on real (n, 3, p, p) and made patches, turned and mirrored."""
    seen = torch.cat([_turn_patches(part, rng) for patches in (real, made) for part in patches.split(TURNED)])
    truth = torch.cat([torch.ones(len(real)), torch.zeros(len(made))])
    optimizer.zero_grad()
    functional.binary_cross_entropy_with_logits(judge(seen / LEVEL_SCALE - 1), truth).backward()
    optimizer.step()


def _turn_patches(patches: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    turned = torch.rot90(patches, int(rng.integers(4)), (2, 3))
    return turned.flip(3) if rng.random() < 0.5 else turned


def _deception_loss(judge: nn.Module, real: torch.Tensor, made: torch.Tensor) -> torch.Tensor:
    """Loss of made patches that a classifier, which sees them among real ones, takes for made."""
    judge.requires_grad_(False)
    loss = functional.softplus(-judge(torch.cat([real, made]) / LEVEL_SCALE - 1)[len(real) :]).mean()
    judge.requires_grad_(True)
    return loss
