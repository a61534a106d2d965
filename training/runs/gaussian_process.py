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

Lengths, sizes and noises maximise the log marginal likelihood (Rasmussen and Williams 2006, eq. 5.8); its gradient (eq. 5.9) is
implemented in closed form, and so is the prediction of a row from all other rows (leave-one-out, eq. 5.12).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

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
# Decay rates of Adam's means of the gradient and of the squared gradient (Kingma and Ba 2015).
ADAM_DECAYS = (0.9, 0.999)
# Number that Adam adds to the root of the mean squared gradient (Kingma and Ba 2015).
ADAM_LEAST = 1e-8
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
TWO_FIDELITIES = (
    *SMOOTH_AND_LINEAR,
    Term("smooth", second=True, reaches=True),
    Term("linear", second=True),
    Term("constant", second=True),
)
CONSTANT_AND_SMOOTH = (Term("constant"), Term("smooth"))


@dataclass(frozen=True)
class Points:
    """Rows of inputs: those that a process learns from, or those that it predicts labels of.

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

    rows: np.ndarray
    squares: np.ndarray
    second: np.ndarray


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
        return self.between(self.placed(a), self.placed(b))

    def placed(self, points: Points) -> Placed:
        """Rows divided by the lengths."""
        rows = points.inputs / self.lengths
        return Placed(rows, (rows**2).sum(axis=1), points.second)

    def between(self, a: Placed, b: Placed) -> np.ndarray:
        """(A, B) the covariance between rows, without noise."""
        inner, squared = _products(a, b)
        found = np.zeros_like(inner)
        for term, size in zip(self.terms, self.sizes, strict=True):
            part = size**2 * self._shape(term, inner, squared)
            found += part * np.outer(a.second, b.second) if term.second else part
        return found

    def noisy(self, points: Points) -> np.ndarray:
        """(M, M) the covariance of the rows' labels, including noise and ``JITTER``."""
        return self(points, points) + np.diag(self._noise_of(points) ** 2 + JITTER)

    def logs(self) -> np.ndarray:
        """Logarithms of all parameters in one row: lengths, sizes, noises, and the reach if a term has one."""
        return np.log(np.concatenate([self.lengths, self.sizes, self.noises, [self.reach] if self._reaches else []]))

    def with_logs(self, logs: np.ndarray) -> "Kernel":
        """The kernel with other parameters, given in the order of ``logs``."""
        values = np.exp(logs)
        ends = np.cumsum([len(self.lengths), len(self.sizes), len(self.noises)])
        reach = float(values[-1]) if self._reaches else self.reach
        return replace(self, lengths=values[: ends[0]], sizes=values[ends[0] : ends[1]], noises=values[ends[1] : ends[2]], reach=reach)

    def log_likelihood(self, points: Points, label: np.ndarray) -> tuple[float, np.ndarray]:
        """Log marginal likelihood of a label (M,) with mean 0, and its gradient with respect to ``logs``.

        Raises
        ------
        numpy.linalg.LinAlgError
            The rows' covariance with ``JITTER`` is not positive definite.
        """
        factor = cholesky(self.noisy(points), lower=True)
        weight = cho_solve((factor, True), label)
        value = -0.5 * label @ weight - np.log(np.diag(factor)).sum() - 0.5 * len(label) * np.log(2 * np.pi)
        pull = 0.5 * (
            np.outer(weight, weight) - cho_solve((factor, True), np.eye(len(label)))
        )  # derivative of the likelihood by the covariance
        return float(value), self._gradient(points, pull)

    def _gradient(self, points: Points, pull: np.ndarray) -> np.ndarray:
        """Derivatives by ``logs`` of a quantity whose derivatives by the elements of ``noisy(points)`` are ``pull`` (M, M)."""
        here = self.placed(points)
        a, (inner, squared) = here.rows, _products(here, here)
        of_inner, of_squared = np.zeros_like(inner), np.zeros_like(inner)
        sizes, reach = np.empty(len(self.terms)), 0.0
        for k, (term, size) in enumerate(zip(self.terms, self.sizes, strict=True)):
            part = pull * np.outer(points.second, points.second) if term.second else pull
            shaped = size**2 * part * self._shape(term, inner, squared)
            sizes[k] = 2 * shaped.sum()
            if term.shape == "linear":
                of_inner += size**2 * part
            elif term.shape == "smooth":
                of_squared -= 0.5 * shaped / self._reach_of(term) ** 2
                if term.reaches:
                    reach += (shaped * squared).sum() / self.reach**2
        # a.b and |a - b|^2 are inversely proportional to the square of each length. For a column x of a and w the row sums of W,
        # sum_ij W_ij (x_i - x_j)^2 = 2 (w.x^2 - x.W x).
        twice = 2 * (of_squared.sum(axis=1) @ a**2 - (a * (of_squared @ a)).sum(axis=0))
        lengths = -2 * twice - 2 * (a * (of_inner @ a)).sum(axis=0)
        noise = 2 * self._noise_of(points) ** 2 * np.diag(pull)
        noises = [noise.sum()] if len(self.noises) == 1 else [(noise * (1 - points.second)).sum(), (noise * points.second).sum()]
        return np.concatenate([lengths, sizes, noises, [reach] if self._reaches else []])

    def _shape(self, term: Term, inner: np.ndarray, squared: np.ndarray) -> np.ndarray:
        if term.shape == "smooth":
            return np.exp(-0.5 * squared / self._reach_of(term) ** 2)
        return inner if term.shape == "linear" else np.ones_like(inner)

    def _reach_of(self, term: Term) -> float:
        return self.reach if term.reaches else 1.0

    def _noise_of(self, points: Points) -> np.ndarray:
        return self.noises[points.second.astype(int) if len(self.noises) > 1 else np.zeros(len(points), int)]

    @property
    def _reaches(self) -> bool:
        return any(term.reaches for term in self.terms)


def climbed(start: Kernel, points: Points, label: np.ndarray) -> Kernel:
    """The kernel after ``CLIMB_STEPS`` steps of Adam that increase the likelihood of a label (M,).

    The search stops before the maximum, because with many lengths and few rows the maximum is overfitted: it explains these rows
    exactly, and other rows worse.
    """
    logs, mean, square = start.logs(), np.zeros_like(start.logs()), np.zeros_like(start.logs())
    first, second = ADAM_DECAYS
    for step in range(1, CLIMB_STEPS + 1):
        gradient = -start.with_logs(logs).log_likelihood(points, label)[1]
        mean = first * mean + (1 - first) * gradient
        square = second * square + (1 - second) * gradient**2
        size = np.sqrt(square / (1 - second**step)) + ADAM_LEAST
        logs = logs - CLIMB_RATE * mean / (1 - first**step) / size
    return start.with_logs(logs)


def likeliest(start: Kernel, points: Points, label: np.ndarray, *, least: Kernel, most: Kernel) -> Kernel:
    """The kernel that maximises the likelihood of a label (M,), with every parameter between that of ``least`` and that of ``most``.

    The method is L-BFGS-B (Byrd et al. 1995) from ``start``, in the logarithms of the lengths and of the variances.
    """
    per_log = np.ones_like(start.logs())
    per_log[len(start.lengths) : len(start.lengths) + len(start.sizes) + len(start.noises)] = 2.0  # variances

    def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = start.with_logs(scaled / per_log).log_likelihood(points, label)
        return -value, -gradient / per_log

    bounds = np.column_stack([least.logs(), most.logs()]) * per_log[:, None]
    found = minimize(objective, start.logs() * per_log, jac=True, method="L-BFGS-B", bounds=bounds)
    return start.with_logs(found.x / per_log)


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

    def mean(self, asked: Points) -> np.ndarray:
        """(B,) the expected label of other rows."""
        return self.kernel(asked, self.points) @ self.weight

    def covariance(self, asked: Points) -> np.ndarray:
        """(B, B) covariance of the labels of other rows, without their noise."""
        half = solve_triangular(self._factor, self.kernel(self.points, asked), lower=True)
        return self.kernel(asked, asked) - half.T @ half

    def draw(self, asked: Points, rng: np.random.Generator) -> np.ndarray:
        """(B,) labels of other rows, without noise: one function drawn from the posterior, evaluated at all of them."""
        return rng.multivariate_normal(self.mean(asked), self.covariance(asked), method="eigh")


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
        self._placed = [kernel.placed(points) for kernel in kernels]  # computed once, because it is the same for every frame

    def __call__(self, asked: Points) -> np.ndarray:
        """(B, K) expected labels of other rows."""
        found = [
            kernel.between(kernel.placed(asked), placed) @ weight
            for kernel, placed, weight in zip(self.kernels, self._placed, self.weight.T, strict=True)
        ]
        return np.stack(found, axis=1)

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


def fit_processes(
    inputs: np.ndarray, labels: np.ndarray, *, seed: int, group: np.ndarray | None = None, progress: Callable | None = None
) -> tuple[Processes, np.ndarray]:
    """Processes with a smooth and a linear term, for K standardised labels (M, K) on inputs (M, D).

    Parameters
    ----------
    seed : int
        Chooses the rows on which the likelihood is maximised. The predictions then use all rows.
    group : (M,) int, optional
        As in ``Posterior``.
    progress : callable, optional
        Called with (labels done, K).

    Returns
    -------
    Processes
    left_out : (M, K) float
        Prediction of each row from all rows of other groups. The row itself was used to find lengths, sizes and noises.
    """
    points = Points.of(inputs)
    start = Kernel(SMOOTH_AND_LINEAR, 5.0 * _spread(inputs), np.array([1.0, 0.3]), np.array([0.05]))
    return _fitted(start, points, labels, drawn_rows(len(points), seed), group, progress)


def fit_smooth_processes(inputs: np.ndarray, labels: np.ndarray, *, group: np.ndarray | None = None) -> tuple[Processes, np.ndarray]:
    """As ``fit_processes``, but all inputs share one length, and only the noise is chosen, by the error of rows that are left out.

    It is meant for inputs whose scales already show their importance. It takes seconds, and does not overfit with many inputs and few rows.
    """
    points = Points.of(inputs)
    chosen = inputs[drawn_rows(len(inputs), 0)]
    squares = (chosen**2).sum(axis=1)
    middle = np.median(np.maximum(squares[:, None] + squares - 2 * chosen @ chosen.T, 0.0))
    lengths = np.full(inputs.shape[1], max(SMOOTH_LENGTHS * np.sqrt(middle), LEAST_SPREAD))
    kernels, weights, left_out = [], [], []
    for label in labels.T:
        kernel_of = [Kernel(SMOOTH_AND_LINEAR, lengths, SMOOTH_SIZES, np.array([noise])) for noise in SMOOTH_NOISES]
        tried = [Posterior(kernel, points, label, group) for kernel in kernel_of]
        best = tried[int(np.argmin([np.abs(posterior.left_out - label).mean() for posterior in tried]))]
        kernels.append(best.kernel)
        weights.append(best.weight)
        left_out.append(best.left_out)
    return Processes(kernels, points, np.stack(weights, axis=1)), np.stack(left_out, axis=1)


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
    chosen = drawn_rows(len(simulated), seed)
    inputs, labels = np.concatenate([simulated[chosen], real]), np.concatenate([simulated_labels[chosen], real_labels])
    points = Points(inputs, np.repeat([0.0, 1.0], [len(chosen), len(real)]))
    start = Kernel(TWO_FIDELITIES, 5.0 * _spread(inputs), np.array([1.0, 0.3, 0.1, 0.1, 0.1]), np.array([0.05, 0.05]), 2.0)
    processes, left_out = _fitted(start, points, labels, np.arange(len(points)), None, None)
    return processes, left_out[len(chosen) :]


def drawn_rows(count: int, seed: int) -> np.ndarray:
    """Indices of at most ``FIT_ROWS`` of ``count`` rows, in random order.

    They are drawn by PyTorch's generator. Another generator would draw other rows, so that the same seed would give another model.
    """
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:FIT_ROWS].numpy()


def _fitted(
    start: Kernel, points: Points, labels: np.ndarray, rows: np.ndarray, group: np.ndarray | None, progress: Callable | None
) -> tuple[Processes, np.ndarray]:
    kernels, weights, left_out = [], [], []
    for k, label in enumerate(labels.T):
        posterior = Posterior(climbed(start, points.rows(rows), label[rows]), points, label, group)
        kernels.append(posterior.kernel)
        weights.append(posterior.weight)
        left_out.append(posterior.left_out)
        if progress:
            progress(k + 1, labels.shape[1])
    return Processes(kernels, points, np.stack(weights, axis=1)), np.stack(left_out, axis=1)


def _spread(inputs: np.ndarray) -> np.ndarray:
    return np.maximum(inputs.std(axis=0, ddof=1), LEAST_SPREAD)


def _products(a: Placed, b: Placed) -> tuple[np.ndarray, np.ndarray]:
    """(A, B) inner products and squared distances of rows."""
    inner = a.rows @ b.rows.T
    return inner, np.maximum(a.squares[:, None] + b.squares - 2 * inner, 0.0)
