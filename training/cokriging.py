"""Labels from the pins' modes by simulated contacts and a few real frames together: a Gaussian process of two fidelities.

A real frame's label is what the twin says of such pins, plus a difference that is a Gaussian process itself (co-kriging,
Kennedy and O'Hagan 2000, eq. 1 with rho = 1):

    k(a, b) = s^2 exp(-|a - b|^2 / 2) + l^2 a.b + [both real] (t^2 exp(-|a - b|^2 / 2 r^2) + m^2 a.b + c^2)

with one length for every mode and noise of its own for simulated and for real frames. Lengths, sizes and noises maximise the
marginal likelihood. Many simulated states change nothing: some hundreds tell how labels go with pins.
"""

from dataclasses import dataclass

import torch

from training.kernel import covariance, likeliest, solved, with_noise

SIMULATED = 1000  # states used, drawn at random
# of s, l, r, t, m, c and the two noises, to begin with: the twin's alone as in training.kernel
START = (1.0, 0.3, 2.0, 0.1, 0.1, 0.1, 0.05, 0.05)
START_LENGTH = 5.0


@dataclass(frozen=True)
class CoKriging:
    """One Gaussian process for each of K labels, on D inputs.

    Attributes
    ----------
    inputs : (M, D) float64
        Simulated states and real frames.
    real : (M,) float64
        1 for a real frame, 0 for a simulated state.
    lengths : (K, D) float64
    sizes : (K, 6) float64
        s, l, r, t, m, c, of standardised labels.
    weight : (M, K) float64
    """

    inputs: torch.Tensor
    real: torch.Tensor
    lengths: torch.Tensor
    sizes: torch.Tensor
    weight: torch.Tensor

    def __call__(self, inputs: torch.Tensor) -> torch.Tensor:
        """Standardised labels (B, K) of real frames with inputs (B, D)."""
        one = torch.ones(len(inputs), dtype=torch.float64)
        found = [
            _between(inputs.double() / lengths, self.inputs / lengths, one, self.real, sizes) @ weight
            for lengths, sizes, weight in zip(self.lengths, self.sizes, self.weight.T, strict=True)
        ]
        return torch.stack(found, dim=1)

    def arrays(self) -> dict[str, torch.Tensor]:
        """All that makes the same again."""
        return {key: getattr(self, key) for key in ("inputs", "real", "lengths", "sizes", "weight")}


def fit_cokriging(
    simulated: torch.Tensor, simulated_labels: torch.Tensor, real: torch.Tensor, real_labels: torch.Tensor, *, seed: int
) -> tuple[CoKriging, torch.Tensor]:
    """Fit to S simulated states and n real frames: inputs (S, D) and (n, D), standardised labels (S, K) and (n, K).

    Returns
    -------
    CoKriging
    left_out : (n, K) float64
        What each real frame is predicted as when it is left out (Rasmussen and Williams 2006, eq. 5.12); lengths, sizes and
        noises have seen it.
    """
    chosen = torch.randperm(len(simulated), generator=torch.Generator().manual_seed(seed))[:SIMULATED]
    inputs = torch.cat([simulated[chosen], real]).double()
    usual = inputs.std(dim=0).clamp(min=1e-9)
    labels = torch.cat([simulated_labels[chosen], real_labels]).double()
    is_real = torch.cat([torch.zeros(len(chosen)), torch.ones(len(real))]).double()
    found = []
    for label in labels.T:

        def matrix(lengths: torch.Tensor, sizes: torch.Tensor) -> torch.Tensor:
            scaled = inputs / (usual * lengths)
            noise = (1 - is_real) * sizes[-2] + is_real * sizes[-1]
            return with_noise(_between(scaled, scaled, is_real, is_real, sizes), noise)

        lengths, sizes = likeliest(matrix, label, [START_LENGTH] * inputs.shape[1], START)
        weight, left_out = solved(matrix(lengths, sizes), label)
        found.append((usual * lengths, sizes[:6], weight, left_out[len(chosen) :]))
    lengths, sizes, weight, left_out = (torch.stack(part) for part in zip(*found, strict=True))
    return CoKriging(inputs, is_real, lengths, sizes, weight.T.contiguous()), left_out.T


def _between(a: torch.Tensor, b: torch.Tensor, a_real: torch.Tensor, b_real: torch.Tensor, sizes: torch.Tensor) -> torch.Tensor:
    smooth, linear, reach, other_smooth, other_linear, offset = sizes[:6]
    difference = covariance(a / reach, b / reach, other_smooth, other_linear * reach) + offset**2
    return covariance(a, b, smooth, linear) + a_real[:, None] * b_real * difference
