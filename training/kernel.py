"""A Gaussian process on the amplitudes of the pins' modes, averaged with the networks.

Kernel: ``s^2 exp(-|a - b|^2 / 2) + l^2 a.b`` with one length for every mode; lengths and sizes maximise the marginal
likelihood on some of the rows (Rasmussen and Williams 2006, eq. 5.8), the solution then uses all. What each training row
is predicted as without itself comes in closed form (eq. 5.12).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch

FIT_ROWS = 1000
FIT_STEPS = 60
JITTER = 1e-6


@dataclass
class KernelHead:
    """One Gaussian process for each of K labels, on D inputs.

    Attributes
    ----------
    inputs : (M, D) float64
        Training rows.
    lengths : (K, D) float64
    smooth, linear, noise : (K,) float64
        s, l and the noise's standard deviation, of standardised labels.
    weight : (M, K) float64
    """

    inputs: torch.Tensor
    lengths: torch.Tensor
    smooth: torch.Tensor
    linear: torch.Tensor
    noise: torch.Tensor
    weight: torch.Tensor

    def __post_init__(self) -> None:
        self._scaled = [self.inputs / lengths for lengths in self.lengths]  # once, not for every frame
        self._halves = [0.5 * scaled.square().sum(1) for scaled in self._scaled]

    def __call__(self, inputs: torch.Tensor) -> torch.Tensor:
        """Standardised labels (B, K) for inputs (B, D)."""
        found = []
        for k, (scaled, half) in enumerate(zip(self._scaled, self._halves, strict=True)):
            here = inputs.double() / self.lengths[k]
            inner = here @ scaled.T
            closeness = torch.exp((inner - half - 0.5 * here.square().sum(1)[:, None]).clamp(max=0))
            found.append((self.smooth[k] ** 2 * closeness + self.linear[k] ** 2 * inner) @ self.weight[:, k])
        return torch.stack(found, dim=1)

    def arrays(self) -> dict[str, torch.Tensor]:
        """All that makes the same again."""
        return {key: getattr(self, key) for key in ("inputs", "lengths", "smooth", "linear", "noise", "weight")}


def fit_kernel(inputs: torch.Tensor, labels: torch.Tensor, *, seed: int, progress=None) -> tuple[KernelHead, torch.Tensor]:
    """Fit to inputs (M, D) and standardised labels (M, K).

    Returns
    -------
    KernelHead
    left_out : (M, K) float64
        What each training row is predicted as when it is left out.
    """
    inputs, labels = inputs.double(), labels.double()
    usual = inputs.std(dim=0).clamp(min=1e-9)
    chosen = torch.randperm(len(inputs), generator=torch.Generator().manual_seed(seed))[:FIT_ROWS]
    found, left_out = [], []
    for k in range(labels.shape[1]):

        def matrix(lengths: torch.Tensor, sizes: torch.Tensor, rows: torch.Tensor | slice) -> torch.Tensor:
            scaled = inputs[rows] / (usual * lengths)
            return with_noise(covariance(scaled, scaled, sizes[0], sizes[1]), sizes[2])

        lengths, sizes = likeliest(partial(matrix, rows=chosen), labels[chosen, k], [5.0] * inputs.shape[1], (1.0, 0.3, 0.05))
        weight, left = solved(matrix(lengths, sizes, slice(None)), labels[:, k])
        left_out.append(left)
        found.append((usual * lengths, sizes, weight))
        if progress:
            progress(k + 1, labels.shape[1])
    lengths, sizes, weight = (torch.stack(part) for part in zip(*found, strict=True))
    return KernelHead(inputs, lengths, sizes[:, 0], sizes[:, 1], sizes[:, 2], weight.T.contiguous()), torch.stack(left_out, dim=1)


def covariance(a: torch.Tensor, b: torch.Tensor, smooth: torch.Tensor, linear: torch.Tensor) -> torch.Tensor:
    """(A, B) the module's kernel between inputs (A, D) and (B, D) in units of their lengths."""
    inner = a @ b.T
    squared = (a.square().sum(1)[:, None] + b.square().sum(1) - 2 * inner).clamp(min=0)
    return smooth**2 * torch.exp(-0.5 * squared) + linear**2 * inner


def with_noise(kernel: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """A kernel (A, A) of rows that each have noise of a standard deviation, one number or (A,)."""
    return kernel + torch.diag((noise**2 + JITTER).expand(len(kernel)))


def solved(matrix: torch.Tensor, label: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (A,) of the rows in a prediction, ``matrix`` (A, A) being their covariance, and what each is predicted as when left out."""
    factor = torch.linalg.cholesky(matrix)
    weight = torch.cholesky_solve(label[:, None], factor)[:, 0]
    return weight, label - weight / torch.cholesky_inverse(factor).diagonal()


def likeliest(matrix: Callable, label: torch.Tensor, lengths: Sequence, sizes: Sequence) -> tuple[torch.Tensor, torch.Tensor]:
    """Lengths and sizes of the largest marginal likelihood of ``label`` (A,), where ``matrix(lengths, sizes)`` (A, A) is its covariance.

    ``lengths`` and ``sizes`` are where the search begins.
    """
    count = len(lengths)
    logs = torch.tensor([*lengths, *sizes], dtype=torch.float64).log().requires_grad_(True)
    optimiser = torch.optim.Adam([logs], lr=0.1)
    for _ in range(FIT_STEPS):
        optimiser.zero_grad()
        factor = torch.linalg.cholesky(matrix(logs[:count].exp(), logs[count:].exp()))
        weight = torch.cholesky_solve(label[:, None], factor)[:, 0]
        loss = 0.5 * label @ weight + factor.diagonal().log().sum()
        loss.backward()
        optimiser.step()
    found = logs.detach().exp()
    return found[:count], found[count:]
