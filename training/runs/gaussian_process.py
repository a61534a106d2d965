"""Gaussian process regression. This implementation has three uses:

- the process whose prediction is averaged with that of the networks (``fit_processes``),
- labels from simulated and real data together (``fit_two_fidelities``),
- the difference between a twin's pins and real ones (``training.studies.sim_to_real.discrepancy``).

Each input has a length. With inputs a, b divided by these lengths, the covariance of two rows is a sum of terms,

    smooth    s^2 exp(-|a - b|^2 / 2 r^2)     with r = 1 where the term has no reach of its own
    linear    s^2 a.b
    constant  s^2

A row is of the first kind (simulated) or of the second kind (real). A term with ``second`` is 0 unless both rows are of the second
kind: it describes the difference between two fidelities (Kennedy and O'Hagan 2000, eq. 1 with rho = 1). Each kind has its own noise.

Lengths, sizes and noises maximise the log marginal likelihood (Rasmussen and Williams 2006, eq. 5.8), along PyTorch's gradient of it.
The prediction of a row from all other rows (leave-one-out) is eq. 5.12.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

# Variance added to every row, so that rounding does not make the Cholesky factorisation fail. Labels have a variance of about 1.
JITTER = 1e-6
# Most rows of each kind on which the likelihood is maximised. The cost grows with the third power of their number, and more rows change
# no result.
FIT_ROWS = 1000
# Steps of Adam. The likelihood of some hundred rows no longer changes after this many.
CLIMB_STEPS = 60
# Step size of Adam in the logarithms of the parameters: one step changes a parameter by a factor of 1.1 at most.
CLIMB_RATE = 0.1
# Common length of ``fit_smooth_processes``, in medians of the distance between two rows: such processes are nearly quadratic.
SMOOTH_LENGTHS = 4.0
# Sizes of its smooth and its linear term, in standard deviations of the label. The smooth term is large, because its length is large.
SMOOTH_SIZES = np.array([4.5, 0.3])
# Standard deviations of the noise that are tried, for a label of standard deviation 1.
SMOOTH_NOISES = (0.015, 0.03, 0.06, 0.12, 0.25)
# Least standard deviation of an input, in the input's unit, so that a constant input does not lead to a division by 0.
LEAST_SPREAD = 1e-9


@dataclass(frozen=True)
class Term:
    """One summand of a kernel.

    Attributes
    ----------
    shape : {"smooth", "linear", "constant"}
    second : bool
        The term is 0 unless both rows are of the second kind.
    reaches : bool
        Whether a smooth term has a reach r of its own, in units of the lengths.
    """

    shape: Literal["smooth", "linear", "constant"]
    second: bool = False
    reaches: bool = False


SMOOTH_AND_LINEAR = (Term("smooth"), Term("linear"))
TWO_FIDELITIES = (*SMOOTH_AND_LINEAR, Term("smooth", second=True, reaches=True), Term("linear", second=True), Term("constant", second=True))
CONSTANT_AND_SMOOTH = (Term("constant"), Term("smooth"))


@dataclass(frozen=True)
class Points:
    """Rows of inputs: those that a process is fitted to, or those whose labels it predicts.

    Attributes
    ----------
    inputs : (M, D) float
    second : (M,) float
        1 for rows of the second kind, 0 for those of the first.
    """

    inputs: np.ndarray
    second: np.ndarray

    @classmethod
    def of(cls, inputs: np.ndarray, *, second: bool = False) -> "Points":
        """Rows (M, D) that are all of one kind."""
        return cls(inputs, np.full(len(inputs), float(second)))

    def __len__(self) -> int:
        return len(self.inputs)

    def rows(self, index: np.ndarray) -> "Points":
        """The rows with these indices."""
        return Points(self.inputs[index], self.second[index])


class Placed(NamedTuple):
    """Rows divided by a kernel's lengths: ``rows`` (M, D), their squared norms (M,), and 1 for rows of the second kind, else 0 (M,)."""

    rows: Any
    squares: Any
    second: Any


@dataclass(frozen=True)
class Kernel:
    """The covariance function with its parameters.

    Attributes
    ----------
    terms : tuple of Term
        The T terms that are added.
    lengths : (D,) float
        Length of each input, in the input's unit.
    sizes : (T,) float
        Size s of each term, in the label's unit.
    noises : (1,) or (2,) float
        Standard deviation of the noise of all rows, or of the rows of each kind.
    reach : float
        Reach r of the terms that have one, in units of the lengths.
    """

    terms: tuple[Term, ...]
    lengths: np.ndarray
    sizes: np.ndarray
    noises: np.ndarray
    reach: float = 1.0

    def __call__(self, a: Points, b: Points) -> np.ndarray:
        """(A, B) the covariance between rows, without noise."""
        return self.between(self.divide_by_lengths(a), self.divide_by_lengths(b))

    def divide_by_lengths(self, points: Points) -> Placed:
        """Rows divided by the lengths."""
        rows = self._library.asarray(points.inputs) / self.lengths
        return Placed(rows, (rows**2).sum(1), self._library.asarray(points.second))

    def between(self, a: Placed, b: Placed) -> Any:
        """(A, B) the covariance between rows, without noise."""
        library, inner = self._library, a.rows @ b.rows.T
        squared = (a.squares[:, None] + b.squares - 2 * inner).clip(0.0)
        found = library.zeros_like(inner)
        for term, size in zip(self.terms, self.sizes, strict=True):
            if term.shape == "smooth":
                part = library.exp(-0.5 * squared / (self.reach if term.reaches else 1.0) ** 2)
            else:
                part = inner if term.shape == "linear" else library.ones_like(inner)
            found = found + size**2 * (part * library.outer(a.second, b.second) if term.second else part)
        return found

    def noisy(self, points: Points) -> Any:
        """(M, M) the covariance of the rows' labels, including noise and ``JITTER``."""
        noises = self.noises[points.second.astype(int) if len(self.noises) > 1 else np.zeros(len(points), int)]
        placed = self.divide_by_lengths(points)
        return self.between(placed, placed) + self._library.diag(noises**2 + JITTER)

    def logs(self) -> np.ndarray:
        """Logarithms of all parameters in one row: lengths, sizes, noises, reach."""
        return np.log(np.concatenate([self.lengths, self.sizes, self.noises, [self.reach]]))

    def with_logs(self, logs: np.ndarray | torch.Tensor) -> "Kernel":
        """The kernel with other parameters, given in the order of ``logs``; they are tensors if these are."""
        values: Any = logs.exp() if isinstance(logs, torch.Tensor) else np.exp(logs)
        ends = np.cumsum([len(self.lengths), len(self.sizes)])
        return replace(self, lengths=values[: ends[0]], sizes=values[ends[0] : ends[1]], noises=values[ends[1] : -1], reach=values[-1])

    def log_likelihood(self, points: Points, label: np.ndarray) -> torch.Tensor:
        """Log marginal likelihood of a label (M,) with mean 0.

        Raises
        ------
        torch.linalg.LinAlgError
            The rows' covariance with ``JITTER`` is not positive definite.
        """
        factor, known = torch.linalg.cholesky(torch.as_tensor(self.noisy(points))), torch.as_tensor(label)[:, None]
        half = torch.linalg.solve_triangular(factor, known, upper=False)
        return -0.5 * half.square().sum() - factor.diagonal().log().sum() - 0.5 * len(label) * math.log(2 * math.pi)

    @property
    def _library(self) -> Any:
        """PyTorch for parameters that are tensors, which have derivatives; NumPy for arrays, which are faster for single frames."""
        return torch if isinstance(self.lengths, torch.Tensor) else np


def climb_likelihood(start: Kernel, points: Points, label: np.ndarray) -> Kernel:
    """The kernel after ``CLIMB_STEPS`` steps of Adam that increase the likelihood of a label (M,).

    The search stops before the maximum, because with many lengths and few rows the maximum is overfitted: it explains these rows
    exactly, and other rows worse.
    """
    logs = torch.from_numpy(start.logs()).requires_grad_()
    optimiser = torch.optim.Adam([logs], lr=CLIMB_RATE)
    for _ in range(CLIMB_STEPS):
        optimiser.zero_grad()
        (-start.with_logs(logs).log_likelihood(points, label)).backward()
        optimiser.step()
    return start.with_logs(logs.detach().numpy())


def likeliest(start: Kernel, points: Points, label: np.ndarray, *, least: Kernel, most: Kernel) -> Kernel:
    """The kernel that maximises the likelihood of a label (M,), with every parameter between that of ``least`` and that of ``most``.

    The method is L-BFGS-B (Byrd et al. 1995) from ``start``, in the logarithms of the parameters.
    """

    def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
        logs = torch.tensor(values, requires_grad=True)
        value = -start.with_logs(logs).log_likelihood(points, label)
        return value.item(), torch.autograd.grad(value, logs)[0].numpy()

    bounds = np.column_stack([least.logs(), most.logs()])
    return start.with_logs(minimize(objective, start.logs(), jac=True, method="L-BFGS-B", bounds=bounds).x)


class Posterior:
    """The posterior distribution of one label, given rows whose label is known.

    Parameters
    ----------
    kernel : Kernel
    points : Points
        The M known rows.
    label : (M,) float
        Their labels; the mean is 0.
    group : (M,) int, optional
        Rows that belong together, such as the states of one contact; they are left out together. By default each row is alone.

    Attributes
    ----------
    weight : (M,) float
        Weight of each known row in a prediction.
    left_out : (M,) float
        Prediction of each known row from all rows of other groups.
    """

    def __init__(self, kernel: Kernel, points: Points, label: np.ndarray, group: np.ndarray | None = None) -> None:
        self.kernel, self.points = kernel, points
        self._factor = cholesky(kernel.noisy(points), lower=True)
        self.weight = cho_solve((self._factor, True), label)
        columns = solve_triangular(self._factor, np.eye(len(points)), lower=True)
        if group is None:
            self.left_out = label - self.weight / (columns**2).sum(axis=0)
        else:  # with K the covariance of the known rows, the part K^-1 of a group is the inverse of its covariance given all others
            self.left_out = np.empty(len(label))
            for rows in (np.flatnonzero(group == name) for name in np.unique(group)):
                part = columns[:, rows].T @ columns[:, rows]
                self.left_out[rows] = label[rows] - np.linalg.solve(part, self.weight[rows])

    def mean(self, wanted: Points) -> np.ndarray:
        """(B,) the expected label of other rows."""
        return self.kernel(wanted, self.points) @ self.weight

    def covariance(self, wanted: Points) -> np.ndarray:
        """(B, B) covariance of the labels of other rows, without their noise."""
        half = solve_triangular(self._factor, self.kernel(self.points, wanted), lower=True)
        return self.kernel(wanted, wanted) - half.T @ half

    def draw(self, wanted: Points, rng: np.random.Generator) -> np.ndarray:
        """(B,) labels of other rows, without noise: one function sampled from the posterior, evaluated at all of them."""
        return rng.multivariate_normal(self.mean(wanted), self.covariance(wanted), method="eigh")


class Processes:
    """The expected values of K labels: one process for each label, all with the same known rows. Small enough to be stored in a file.

    Parameters
    ----------
    kernels : list of Kernel
        One for each of the K labels; all have the same terms.
    points : Points
        The M known rows.
    weight : (M, K) float
        Weight of each known row in the prediction of each label.
    """

    def __init__(self, kernels: list[Kernel], points: Points, weight: np.ndarray) -> None:
        self.kernels, self.points, self.weight = kernels, points, weight
        self._placed = [kernel.divide_by_lengths(points) for kernel in kernels]  # computed once, because it is the same for every frame

    def __call__(self, wanted: Points) -> np.ndarray:
        """(B, K) expected labels of other rows."""
        each = zip(self.kernels, self._placed, self.weight.T, strict=True)
        return np.stack([kernel.between(kernel.divide_by_lengths(wanted), placed) @ weight for kernel, placed, weight in each], axis=1)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that ``of_arrays`` needs; the terms are not among them."""
        stacked = {key: np.stack([getattr(kernel, key) for kernel in self.kernels]) for key in ("lengths", "sizes", "noises", "reach")}
        return stacked | {"inputs": self.points.inputs, "second": self.points.second, "weight": self.weight}

    @classmethod
    def of_arrays(cls, terms: tuple[Term, ...], arrays: Mapping[str, np.ndarray | torch.Tensor]) -> "Processes":
        """The processes that ``arrays`` stored.

        Raises
        ------
        KeyError
            An array is missing.
        """
        found = {key: np.asarray(arrays[key], np.float64) for key in ("lengths", "sizes", "noises", "reach", "inputs", "second", "weight")}
        each = zip(found["lengths"], found["sizes"], found["noises"], found["reach"], strict=True)
        kernels = [Kernel(terms, lengths, sizes, noises, float(reach)) for lengths, sizes, noises, reach in each]
        return cls(kernels, Points(found["inputs"], found["second"]), found["weight"])


def fit_processes(inputs: np.ndarray, labels: np.ndarray, *, seed: int, group: np.ndarray | None = None) -> tuple[Processes, np.ndarray]:
    """Processes with a smooth and a linear term, for K standardised labels (M, K) on inputs (M, D).

    Parameters
    ----------
    seed : int
        Chooses the rows on which the likelihood is maximised. The predictions then use all rows.
    group : (M,) int, optional
        As in ``Posterior``.

    Returns
    -------
    Processes
    left_out : (M, K) float
        Prediction of each row from all rows of other groups. The row itself was used to find lengths, sizes and noises.
    """
    points = Points.of(inputs)
    start = Kernel(SMOOTH_AND_LINEAR, 5.0 * _standard_deviations(inputs), np.array([1.0, 0.3]), np.array([0.05]))
    return _fit_processes(start, points, labels, sample_rows(len(points), seed), group)


def fit_smooth_processes(inputs: np.ndarray, labels: np.ndarray, *, group: np.ndarray | None = None) -> tuple[Processes, np.ndarray]:
    """As ``fit_processes``, but all inputs share one length, and only the noise is chosen, by the error of rows that are left out.

    It is meant for inputs whose scales already show their importance. It takes seconds, and does not overfit with many inputs and few rows.
    """
    points = Points.of(inputs)
    chosen = inputs[sample_rows(len(inputs), 0)]
    squares = (chosen**2).sum(axis=1)
    middle = np.median(np.maximum(squares[:, None] + squares - 2 * chosen @ chosen.T, 0.0))
    lengths = np.full(inputs.shape[1], max(SMOOTH_LENGTHS * np.sqrt(middle), LEAST_SPREAD))
    kernels = [Kernel(SMOOTH_AND_LINEAR, lengths, SMOOTH_SIZES, np.array([noise])) for noise in SMOOTH_NOISES]
    best = []
    for label in labels.T:
        tried = [Posterior(kernel, points, label, group) for kernel in kernels]
        best.append(min(tried, key=lambda posterior: np.abs(posterior.left_out - label).mean()))
    return _join_posteriors(best)


def fit_two_fidelities(
    simulated: np.ndarray, simulated_labels: np.ndarray, real: np.ndarray, real_labels: np.ndarray, *, seed: int
) -> tuple[Processes, np.ndarray]:
    """Processes that learn from S simulated states and n real frames together (co-kriging, Kennedy and O'Hagan 2000).

    The label of a real frame is modelled as the label of a simulated state with the same inputs, plus a difference. Both the label
    and the difference are Gaussian processes.

    Parameters
    ----------
    simulated, real : (S, D) and (n, D) float
        Inputs.
    simulated_labels, real_labels : (S, K) and (n, K) float
        Standardised.
    seed : int
        Seed of the choice of simulated states. Some hundreds show how labels depend on inputs, and more change no result.

    Returns
    -------
    Processes
    left_out : (n, K) float
        Prediction of each real frame from all other rows. The frame itself was used to find lengths, sizes and noises.
    """
    chosen = sample_rows(len(simulated), seed)
    inputs, labels = np.concatenate([simulated[chosen], real]), np.concatenate([simulated_labels[chosen], real_labels])
    points = Points(inputs, np.repeat([0.0, 1.0], [len(chosen), len(real)]))
    start = Kernel(TWO_FIDELITIES, 5.0 * _standard_deviations(inputs), np.array([1.0, 0.3, 0.1, 0.1, 0.1]), np.array([0.05, 0.05]), 2.0)
    processes, left_out = _fit_processes(start, points, labels, np.arange(len(points)), None)
    return processes, left_out[len(chosen) :]


def sample_rows(count: int, seed: int) -> np.ndarray:
    """Indices of at most ``FIT_ROWS`` of ``count`` rows, in random order.

    They are sampled by PyTorch's generator. Another generator would sample other rows, so that the same seed would give another model.
    """
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:FIT_ROWS].numpy()


def _fit_processes(
    start: Kernel, points: Points, labels: np.ndarray, rows: np.ndarray, group: np.ndarray | None
) -> tuple[Processes, np.ndarray]:
    kernels = [climb_likelihood(start, points.rows(rows), label[rows]) for label in labels.T]
    return _join_posteriors([Posterior(kernel, points, label, group) for kernel, label in zip(kernels, labels.T, strict=True)])


def _join_posteriors(found: list[Posterior]) -> tuple[Processes, np.ndarray]:
    """The processes of K labels of the same points, and the predictions (M, K) of left-out rows."""
    weight, left_out = (np.stack([getattr(each, name) for each in found], axis=1) for name in ("weight", "left_out"))
    return Processes([each.kernel for each in found], found[0].points, weight), left_out


def _standard_deviations(inputs: np.ndarray) -> np.ndarray:
    return np.maximum(inputs.std(axis=0, ddof=1), LEAST_SPREAD)
