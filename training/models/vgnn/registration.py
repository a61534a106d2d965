"""How many of some rows' principal components are directions, and not rounding.

Whether the camera sits where it sat: a frame displaced, turned or scaled as a whole, told from one changed by contact.

Contact moves the pins too, but not freely: what is left of the pins after the best similarity (shift, turn, scale) has
been taken out tells how large that similarity has to be. Where the one observed differs from the one expected by far more
than it ever does in training, the difference is the camera's, and it is taken out of the frame. Frames of one recording
share a camera: there the median over many frames tells its displacement far better than one frame can.

What is taken out takes a little of the contact with it. A model that also learns from training frames with all of the
difference taken out knows such frames, and loses little on them."""

from dataclasses import dataclass

import numpy as np

LEAST_SIZE = 1e-5  # of a mode, relative to the largest: features are in single precision, whose rounding is 1e-7 of each of their numbers


def spanned(sizes: np.ndarray, most: int) -> int:
    """How many modes to keep, at most ``most``, of centred rows with these singular values, largest first.

    M rows span M - 1 directions at most. The modes after those are made of rounding errors: scaled to unit deviation, they would
    turn the rounding errors of other rows into amplitudes of thousands.
    """
    return int((sizes[:most] > LEAST_SIZE * sizes[0]).sum())


MODES, SQUARED = 40, 20  # modes taken linearly, and those of them whose products are taken too
RIDGE = 0.1
FILL_RIDGE, FILL_ROUNDS = 1e-3, 3
MANY, COMMON = 30, 1.5  # frames whose median difference, if larger than that usual size, is their one camera's
FREE, FULL = 6.0, 9.0  # differences, in their usual size, up to which nothing and from which everything is taken out


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
        Root mean square difference between observed and expected, each training frame left out.
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
        """One frame's pins (N, 2) with the lost ones (N,) where the modes that the others show put them."""
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
        """By how much the similarities (M, 4) of frames differ from those that their contact lets expect."""
        aligned, observed = align(nodes_px, self.rest_px)
        return observed - _terms(self._modes(aligned)) @ self.weight

    def _modes(self, aligned: np.ndarray) -> np.ndarray:
        return (aligned.reshape(len(aligned), -1) - self.mean) @ self.components

    def arrays(self) -> dict[str, np.ndarray]:
        """All that makes the same again."""
        return {key: getattr(self, key) for key in ("rest_px", "mean", "components", "weight", "usual")}


def fit_registration(nodes_px: np.ndarray, rest_px: np.ndarray) -> tuple[Registration, np.ndarray]:
    """Learn what similarity contact brings, from frames (M, N, 2) of one camera position.

    Returns
    -------
    Registration
    left : (M, 4) float
        Each frame's difference as if it had not been fitted to.
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


def _terms(modes: np.ndarray) -> np.ndarray:
    few = modes[:, :SQUARED]
    i, j = np.triu_indices(few.shape[1])
    return np.concatenate([np.ones((len(modes), 1)), modes, few[:, i] * few[:, j]], axis=1)
