"""Whether the camera sits where it sat in training: a frame that is displaced, turned or scaled as a whole, told from contact.

Contact moves the pins too, but not freely. The best similarity (shift, turn, scale) is taken out of the pins; what is left of their
displacement tells how large that similarity has to be. Where the observed similarity differs from the expected one by far more than it
ever does in training, the difference comes from the camera, and it is taken out of the frame. All frames of one recording share a camera:
there the median over many frames tells its displacement far better than one frame can.

Taking the difference out also removes a little of the contact. A model that also learns from training frames with the whole difference
taken out knows such frames, and loses little on them.
"""

from dataclasses import dataclass

import numpy as np

MODES = 40  # modes of what the similarity leaves, that the expected similarity depends on
SQUARED = 20  # the first modes, whose products it depends on too
RIDGE = 0.1  # penalty of the least-squares fit, in modes of unit deviation
LEAST_SIZE = 1e-5  # of a kept mode, relative to the largest; features are in single precision, rounded to 1e-7 of their size
FILL_RIDGE = 1e-3  # penalty of the modes that lost pins are filled in by
FILL_ROUNDS = 3  # rounds of filling in: the similarity changes with the pins that were filled in
MANY = 30  # frames, from which on their median difference tells where their common camera sits
COMMON = 1.5  # median difference, in usual differences, above which it is taken for the camera's
FREE = 6.0  # difference of a frame, in usual differences, up to which nothing is taken out
FULL = 9.0  # difference of a frame, in usual differences, from which on all of it is taken out


@dataclass(frozen=True)
class Registration:
    """The expected similarity of a frame as a quadratic function of what the similarity leaves.

    Attributes
    ----------
    rest_px : (N, 2) float
    mean : (2 N,) float
    components : (2 N, m) float
    weight : (q, 4) float
        To log scale, turn (rad), shift x and y (px).
    usual : (4,) float
        Root mean square difference between observed and expected similarity, each training frame left out of the fit in turn.
    """

    rest_px: np.ndarray
    mean: np.ndarray
    components: np.ndarray
    weight: np.ndarray
    usual: np.ndarray

    def __call__(self, nodes_px: np.ndarray, area_px2: np.ndarray, *, together: bool = False) -> tuple:
        """Frames with the camera's part taken out.

        Parameters
        ----------
        nodes_px : (M, N, 2) float
        area_px2 : (M, N) float
        together : bool
            Whether the frames are of one camera that did not move between them.

        Returns
        -------
        nodes_px, area_px2
            As given where the camera sits as in training.
        taken : (M, 4) float
            Log scale, turn (rad), shift (px) taken out.
        share : (M,) float
            Part of the frame's own difference that was taken out, 0 to 1.
        """
        difference = self.difference(nodes_px)
        common = np.zeros(4)
        if together and len(nodes_px) >= MANY:
            middle = np.median(difference, axis=0)
            common = middle * (np.abs(middle / self.usual).max() > COMMON)
        far = np.abs((difference - common) / self.usual).max(axis=1)
        share = np.clip((far - FREE) / (FULL - FREE), 0, 1)
        taken = common + (difference - common) * share[:, None]
        return *self.take_out(nodes_px, area_px2, taken), taken, share

    def take_out(self, nodes_px: np.ndarray, area_px2: np.ndarray, taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames (M, N, 2) and areas (M, N) without the similarities ``taken`` (M, 4)."""
        middle = self.rest_px.mean(axis=0)
        z = (nodes_px - middle - taken[:, None, 2:]) @ [1, 1j]
        z = z * np.exp(-taken[:, :1] - 1j * taken[:, 1:2])
        return np.stack([z.real, z.imag], axis=-1) + middle, area_px2 * np.exp(-2 * taken[:, :1])

    def fill(self, nodes_px: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """One frame's pins (N, 2); each lost pin (N,) is put where the modes of the others' displacements place it."""
        directions = self.components / np.maximum(np.linalg.norm(self.components, axis=0), 1e-12)
        known = np.repeat(~lost, 2)
        normal = directions[known].T @ directions[known] + FILL_RIDGE * np.eye(directions.shape[1])
        middle = self.rest_px.mean(axis=0)
        for _ in range(FILL_ROUNDS):  # the similarity sees the pins that were filled in before
            aligned, similarity = align(nodes_px[None], self.rest_px)
            away = aligned.ravel() - self.mean
            found = self.mean + directions @ np.linalg.solve(normal, directions[known].T @ away[known])
            z = (self.rest_px - middle + found.reshape(-1, 2)) @ [1, 1j] * np.exp(similarity[0, 0] + 1j * similarity[0, 1])
            filled = np.stack([z.real, z.imag], axis=-1) + middle + similarity[0, 2:]
            nodes_px = np.where(lost[:, None], filled, nodes_px)
        return nodes_px

    def difference(self, nodes_px: np.ndarray) -> np.ndarray:
        """Differences (M, 4) between the frames' similarities and those that are expected from their contact."""
        aligned, observed = align(nodes_px, self.rest_px)
        return observed - _terms(self._modes(aligned)) @ self.weight

    def _modes(self, aligned: np.ndarray) -> np.ndarray:
        return (aligned.reshape(len(aligned), -1) - self.mean) @ self.components

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that make the same registration again."""
        return {key: getattr(self, key) for key in ("rest_px", "mean", "components", "weight", "usual")}


def fit_registration(nodes_px: np.ndarray, rest_px: np.ndarray) -> tuple[Registration, np.ndarray]:
    """Learn which similarity comes with a contact, from frames (M, N, 2) of one camera position.

    Returns
    -------
    Registration
    left : (M, 4) float
        Each frame's difference when it is left out of the fit.
    """
    aligned, observed = align(nodes_px, rest_px)
    flat = aligned.reshape(len(aligned), -1)
    mean = flat.mean(axis=0)
    _, sizes, directions = np.linalg.svd(flat - mean, full_matrices=False)
    keep = spanned(sizes, MODES)
    components = directions[:keep].T / np.maximum(sizes[:keep] / np.sqrt(len(flat)), 1e-9)
    terms = _terms((flat - mean) @ components)
    inverse = np.linalg.inv(terms.T @ terms + RIDGE * np.eye(terms.shape[1]))
    weight = inverse @ terms.T @ observed
    leverage = np.einsum("mi,ij,mj->m", terms, inverse, terms, optimize=True)
    left = (observed - terms @ weight) / (1 - leverage)[:, None]
    usual = np.sqrt(np.mean(left**2, axis=0)) + 1e-9
    return Registration(rest_px, mean, components, weight, usual), left


def align(nodes_px: np.ndarray, rest_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames brought to rest by their least-squares similarity, and that similarity.

    Parameters
    ----------
    nodes_px : (M, N, 2) float
    rest_px : (N, 2) float

    Returns
    -------
    aligned : (M, N, 2) float
        What is left of the displacement from rest, px.
    similarity : (M, 4) float
        Log scale, turn (rad), shift of the middle x and y (px), from rest to the frame.
    """
    middle = rest_px.mean(axis=0)
    shift = nodes_px.mean(axis=1) - middle
    rest = (rest_px - middle) @ [1, 1j]
    frame = (nodes_px - middle - shift[:, None]) @ [1, 1j]
    factor = (frame @ rest.conj()) / (np.abs(rest) ** 2).sum()
    left = frame / factor[:, None] - rest
    return np.stack([left.real, left.imag], axis=-1), np.column_stack([np.log(np.abs(factor)), np.angle(factor), shift])


def spanned(sizes: np.ndarray, most: int) -> int:
    """How many modes of centred rows to keep, at most ``most``; ``sizes`` are the rows' singular values, the largest first.

    M centred rows span M - 1 directions at most. The modes after these are made of rounding errors. Scaled to unit deviation, they would
    turn the rounding errors of other rows into amplitudes of thousands.
    """
    return int((sizes[:most] > LEAST_SIZE * sizes[0]).sum())


def _terms(modes: np.ndarray) -> np.ndarray:
    few = modes[:, :SQUARED]
    i, j = np.triu_indices(few.shape[1])
    return np.concatenate([np.ones((len(modes), 1)), modes, few[:, i] * few[:, j]], axis=1)
