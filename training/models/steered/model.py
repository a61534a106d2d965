"""``steered``: our model of an edge's direction, a label that goes round the whole circle.

Its network makes a first guess of the direction from the whole field, and takes a second look at the field turned by this guess. Both looks
are multi-layer perceptrons on the principal components of the field's coefficients. In training, the first look gets every
frame turned by a random angle, and its answer is turned back. Therefore it need not learn the same contact again for each direction. The
second look gets the field turned back by the first guess and an error of some degrees. It estimates the rest of the direction and the other
labels. In this view all contacts are similar, so that few principal components show small differences. Both looks also get the angle of the
turn as an input, because no sensor is exactly the same all around.

The field is the displacement of the pins in a form that can be turned exactly, for any layout. With the complex displacement
u = u_x + i u_y at the place r (cos p, sin p) about the layout's middle, it is a sum of waves,

    u = sum_mn  c_mn R_mn(r) exp(i m p)

with the radial polynomials R_mn of Zernike (1934). A contact that is turned by an angle t in the picture has the displacement
exp(i t) u(r, p - t), and therefore the coefficients c_mn exp(i t (1 - m)).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import cast

import numpy as np
import torch
from scipy.special import eval_jacobi
from torch import nn

from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.errors import TrainingError
from training.models.part import ArrayInputs, Inputs, Learnt, Modes, PinModel, Recipe, refuse_sizes
from twin.pins.labelling.reference import Reference

# Number of pins for each coefficient: with fewer pins the fit follows the noise of single pins.
PINS_A_WAVE = 2.5
# Highest degree of the waves: finer ones are below the noise of a pin in every recording.
MOST_DEGREE = 14
# Number of turns of a frame over which the first look's answers are averaged in use.
TURNS = 6
# Number of second looks in use. The first one uses the first look's direction, each further one that of the one before.
LOOKS = 2
# Standard deviation of the error that is added to the first guess in training, rad: 4 deg, some times the usual error.
GUESS_ERROR_RAD = 0.07
# Copies of each training frame, turned at random, from which the principal components are computed.
COPIES = 3
# Number of inputs that describe a turn: sine and cosine of the turn and of twice the turn.
KNOWN_OF_TURN = 4
# Components of the turned field that are inputs of a Gaussian process. Finer ones are noise to it.
PROCESS_MODES = 20


@dataclass(frozen=True)
class Waves:
    """The waves of a layout with N pins.

    Attributes
    ----------
    fit : (C, N) complex
        From the complex displacements of the pins to the C coefficients, by least squares.
    order : (C,) int
        1 - m of each coefficient: how many times a coefficient turns when the contact turns once.
    """

    fit: np.ndarray
    order: np.ndarray


def waves_of(rest_px: np.ndarray) -> Waves:
    """The waves of a layout at rest (N, 2). Waves of the same m are orthogonal over the pins."""
    place = (rest_px - rest_px.mean(axis=0)) @ [1, 1j]
    place = place / np.abs(place).max()
    degree = 0
    while degree < MOST_DEGREE and PINS_A_WAVE * (degree + 2) * (degree + 3) / 2 <= len(rest_px):
        degree += 1
    parts, order = [], []
    for m in range(-degree, degree + 1):
        count = (degree - abs(m)) // 2 + 1  # R_mn is r^m times a polynomial of Jacobi
        radial = np.abs(place) ** abs(m) * [eval_jacobi(k, abs(m), 0, 1 - 2 * np.abs(place) ** 2) * (-1) ** k for k in range(count)]
        smooth, _ = np.linalg.qr((radial * np.exp(1j * m * np.angle(place))).T)
        parts.append(smooth)
        order += [1 - m] * smooth.shape[1]
    return Waves(np.linalg.pinv(np.concatenate(parts, axis=1)), np.array(order))


@dataclass(frozen=True)
class SteeredSize:
    """Sizes: principal components of each look, width and depth of each perceptron."""

    modes: int = 80
    width: int = 192
    depth: int = 3


class ComponentsPerceptron(nn.Module):
    """Principal components of coefficients, and a perceptron on them.

    Parameters
    ----------
    coefficients : int
        Number C of complex coefficients.
    outputs : int
    """

    mean: torch.Tensor  # (2 C,)
    components: torch.Tensor  # (2 C, modes)

    def __init__(self, coefficients: int, outputs: int, size: SteeredSize) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(2 * coefficients))
        self.register_buffer("components", torch.zeros(2 * coefficients, min(size.modes, 2 * coefficients)))
        entered = self.components.shape[1]
        self.linear = nn.Linear(entered, outputs)
        nn.init.zeros_(self.linear.weight)
        self.enter = nn.Linear(entered + KNOWN_OF_TURN, size.width)
        self.trunk = nn.ModuleList([nn.Linear(size.width, size.width) for _ in range(size.depth - 1)])
        self.head = nn.Linear(size.width, outputs)

    def prepare(self, seen: torch.Tensor) -> None:
        """Set the principal components from complex coefficients (M, C); each is scaled as in ``vgnn``."""
        flat = _flat(seen).double()
        self.mean.copy_(flat.mean(dim=0))
        size, direction = torch.linalg.eigh((flat - flat.mean(dim=0)).T @ (flat - flat.mean(dim=0)) / len(flat))
        keep = self.components.shape[1]
        deviation = size.flip(0)[:keep].clamp(min=1e-12 * float(size.max())).sqrt()
        self.components.copy_(direction.flip(1)[:, :keep] * (3 * (deviation / deviation[0]).sqrt() / deviation))

    def amplitudes(self, seen: torch.Tensor) -> torch.Tensor:
        """Principal components (B, modes) of coefficients (B, C)."""
        return (_flat(seen) - self.mean) @ self.components

    def forward(self, seen: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        """Numbers (B, outputs) from coefficients (B, C) that were turned by ``turn`` (B,) rad."""
        z = self.amplitudes(seen)
        h = torch.cat([z, turn.sin()[:, None], turn.cos()[:, None], (2 * turn).sin()[:, None], (2 * turn).cos()[:, None]], dim=1)
        h = torch.nn.functional.silu(self.enter(h))
        for layer in self.trunk:
            h = torch.nn.functional.silu(layer(h))
        return self.linear(z) + self.head(h)


class Steered(nn.Module):
    """See the module.

    Parameters
    ----------
    waves : Waves
    outputs : int
        Number E of the labels' numbers (``LabelCode``); two of them are sine and cosine of the direction.
    """

    fit: torch.Tensor  # (2, C, N) real and imaginary part
    order: torch.Tensor  # (C,)
    sine: torch.Tensor  # () int64: place of the direction's sine among the numbers; its cosine follows
    sense: torch.Tensor  # () 1 if the label grows when the contact turns from x to y in the picture, else -1

    def __init__(self, waves: Waves, outputs: int, size: SteeredSize) -> None:
        super().__init__()
        self.outputs = outputs
        self.register_buffer("fit", torch.from_numpy(np.stack([waves.fit.real, waves.fit.imag]).astype(np.float32)))
        self.register_buffer("order", torch.from_numpy(waves.order.astype(np.float32)))
        self.register_buffer("sine", torch.tensor(0))
        self.register_buffer("sense", torch.tensor(1.0))
        self.first = ComponentsPerceptron(len(waves.order), outputs, size)
        self.second = ComponentsPerceptron(len(waves.order), 2 * outputs, size)

    def coefficients(self, moved: torch.Tensor) -> torch.Tensor:
        """Complex coefficients (B, C) of displacements (B, N, 2)."""
        real, imaginary = self.fit
        x, y = moved[..., 0], moved[..., 1]
        return torch.complex(x @ real.T - y @ imaginary.T, x @ imaginary.T + y @ real.T)

    def turn_coefficients(self, seen: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        """Coefficients (B, C) of the same contacts turned by ``turn`` (B,) rad in the picture, from x to y."""
        return seen * torch.exp(1j * turn[:, None] * self.order)

    def prepare(self, moved: torch.Tensor, numbers: torch.Tensor, code: LabelCode) -> None:
        """Set sense and principal components from training frames (M, N, 2) and their numbers (M, E)."""
        sine = int(np.flatnonzero(np.repeat(code.circular, np.where(code.circular, 2, 1)))[0])
        self.sine.fill_(sine)
        seen, direction = self.coefficients(moved), torch.atan2(numbers[:, sine], numbers[:, sine + 1])
        turned = [self.turn_coefficients(seen, -sense * direction)[:, self.order != 0] for sense in (1, -1)]
        alike = [float(each.mean(dim=0).abs().square().sum()) for each in turned]
        self.sense.fill_(1.0 if alike[0] >= alike[1] else -1.0)
        copies = seen.repeat(COPIES, 1)
        self.first.prepare(self.turn_coefficients(copies, 2 * torch.pi * torch.rand(len(copies))))
        guess = (self.sense * direction).repeat(COPIES) + GUESS_ERROR_RAD * torch.randn(len(copies))
        self.second.prepare(self.turn_coefficients(copies, -guess))

    def forward(self, moved: torch.Tensor) -> dict[str, torch.Tensor]:
        """Numbers of the labels from displacements (B, N, 2).

        Returns
        -------
        dict
            ``mean`` and ``log_scale`` (B, E), standardised, and ``first`` (B, E), the first guess.
        """
        seen = self.coefficients(moved)
        if self.training:
            turn = 2 * torch.pi * torch.rand(len(seen), device=seen.device)
            first = self._first(seen, turn)
            guess = self._direction(first.detach()) + GUESS_ERROR_RAD * torch.randn(len(seen), device=seen.device)
            mean, scale = self._second(seen, guess)
            return {"mean": mean, "log_scale": scale, "first": first}
        turns = 2 * torch.pi * torch.arange(TURNS, device=seen.device) / TURNS
        first = torch.stack([self._first(seen, turn.expand(len(seen))) for turn in turns]).mean(dim=0)
        guess = self._direction(first)
        for _ in range(LOOKS):
            mean, scale = self._second(seen, guess)
            guess = self._direction(mean)
        return {"mean": mean, "log_scale": scale, "first": first}

    def view(self, moved: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The estimated numbers (B, E) of displacements (B, N, 2), and the components (B, modes) of the field turned by the estimate."""
        mean = self(moved)["mean"]
        return mean, self.second.amplitudes(self.turn_coefficients(self.coefficients(moved), -self._direction(mean)))

    def _direction(self, numbers: torch.Tensor) -> torch.Tensor:
        """(B,) direction in the picture, rad."""
        return self.sense * torch.atan2(self._pair(numbers)[0], self._pair(numbers)[1])

    def _pair(self, numbers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return numbers[:, int(self.sine)], numbers[:, int(self.sine) + 1]

    def _first(self, seen: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        said = self.first(self.turn_coefficients(seen, turn), turn)
        return self._with_direction(said, *_spun(*self._pair(said), -self.sense * turn))

    def _second(self, seen: torch.Tensor, guess: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        said = self.second(self.turn_coefficients(seen, -guess), -guess)
        mean, scale = said[:, : self.outputs], said[:, self.outputs :]
        rest = self._pair(mean)[0]  # rad: what is left of the direction
        label = self.sense * guess + rest
        length = torch.full_like(label, 2**0.5)  # standardised numbers of a direction are root 2 long
        return self._with_direction(mean, length * label.sin(), length * label.cos()), scale

    def _with_direction(self, numbers: torch.Tensor, sine: torch.Tensor, cosine: torch.Tensor) -> torch.Tensor:
        """The numbers (B, E) with another direction."""
        columns = list(numbers.unbind(dim=1))
        columns[int(self.sine)], columns[int(self.sine) + 1] = sine, cosine
        return torch.stack(columns, dim=1)


def _spun(sine: torch.Tensor, cosine: torch.Tensor, angle: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The pair (sin a, cos a) for the direction a + angle."""
    return sine * angle.cos() + cosine * angle.sin(), cosine * angle.cos() - sine * angle.sin()


def _flat(seen: torch.Tensor) -> torch.Tensor:
    return torch.cat([seen.real, seen.imag], dim=1)


class SteeredModel(PinModel):
    """See the module. Unlike ``vgnn``, it does not detect that the camera sits at another place than in training."""

    counts_from_rest = True
    has_modes = True
    derived = ("fit", "order")  # they follow from the pins at rest

    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> Steered:
        """See ``Model``; sizes are the fields of ``SteeredSize``."""
        refuse_sizes(self, size, tuple(field.name for field in fields(SteeredSize)))
        return Steered(waves_of(reference.pins_px), outputs, SteeredSize(**size))

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> ArrayInputs:
        """See ``PinModel``: displacements from rest (M, N, 2) in mean rest spacings. A lost pin is where its neighbours predict it."""
        return ArrayInputs(((pins.nodes_px - pins.reference.pins_px) / reference.spacing_px.mean()).astype(np.float32))

    def initialise(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor, numbers: torch.Tensor, code: LabelCode) -> None:
        """See ``Model``. Sets the principal components, and the turning sense in which the direction's label grows.

        Raises
        ------
        TrainingError
            Not exactly one label goes round the whole circle.
        """
        if (many := sum(code.circular)) != 1:
            raise TrainingError(f"{self.name} is for labels of which one is a direction on the whole circle, these have {many}; train vgnn")
        cast(Steered, network).prepare(inputs.batch(rows)[0], numbers[rows], code)

    def modes(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """See ``Model``. The inputs are the network's estimates, and the first components of the field after it is turned by them."""
        with torch.no_grad():
            numbers, seen = cast(Steered, network).view(*inputs.batch(rows))
        found = torch.cat([numbers, seen[:, :PROCESS_MODES]], dim=1).double().numpy()
        return Modes(found, np.zeros(len(found)))


STEERED = SteeredModel(
    name="steered",
    description="ours for an edge's direction: the displacements, turned to the estimated direction and evaluated again",
    recipe=Recipe(epochs=80, batch=128, members=2),
)
