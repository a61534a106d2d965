"""Registration: separates the shift, turn and scale of a frame by a moved camera from those by the contact.

A contact also changes the similarity (shift, turn, scale) between the pins and their layout at rest, but not independently of the other
displacements. The best similarity is removed from the pins, and the remaining displacements predict the expected similarity. If the
observed similarity differs from the expected one by far more than in training, the camera causes the difference, and it is removed from the
frame. All frames of one recording are of one camera, so the median over many frames gives its displacement much more precisely than one
frame.

Removing the difference also removes a small part of the contact. Therefore a model is also trained on frames with the whole difference
removed, and loses little accuracy on such frames.
"""

from dataclasses import dataclass

import numpy as np

# Number of modes of the displacements without their similarity, from which the expected similarity is predicted.
MODES = 40
# Number of the first modes whose products are also used for the prediction.
SQUARED = 20
# Penalty of the least-squares fit of the prediction, for modes scaled to a standard deviation of 1.
RIDGE = 0.1
# Least size of a mode relative to the largest. Features are in single precision, with a relative rounding error of 1e-7.
LEAST_SIZE = 1e-5
# Penalty of the least-squares fit of modes by which lost pins are filled in.
FILL_RIDGE = 1e-3
# Rounds of filling in. There are several, because the similarity changes with the pins that were filled in.
FILL_ROUNDS = 3
# Least number of frames for which the median of their differences is used as the difference of their common camera.
MANY = 30
# Median difference, relative to the usual one, above which the camera counts as displaced.
COMMON = 1.5
# Difference of a single frame, relative to the usual one, up to which nothing is removed.
FREE = 6.0
# Difference of a single frame, relative to the usual one, above which the whole difference is removed.
FULL = 9.0


@dataclass(frozen=True)
class Registration:
    """The expected similarity of a frame, as a quadratic function of the displacements without their similarity.

    Attributes
    ----------
    rest_px : (N, 2) float
    mean : (2 N,) float
    components : (2 N, m) float
    weight : (q, 4) float
        Coefficients for the logarithm of scale, turn (rad), shift in x and y (px).
    usual : (4,) float
        Root mean square difference between observed and expected similarity. Each training frame is predicted by a fit without this frame.
    """

    rest_px: np.ndarray
    mean: np.ndarray
    components: np.ndarray
    weight: np.ndarray
    usual: np.ndarray

    def __call__(self, nodes_px: np.ndarray, area_px2: np.ndarray, *, together: bool = False) -> tuple:
        """Remove the camera's displacement from frames.

        Parameters
        ----------
        nodes_px : (M, N, 2) float
        area_px2 : (M, N) float
        together : bool
            Whether the frames are of one camera that did not move between them.

        Returns
        -------
        nodes_px, area_px2
            Unchanged if the camera sits as in training.
        taken : (M, 4) float
            The removed similarity: logarithm of scale, turn (rad), shift (px).
        share : (M,) float
            Share of the frame's own difference that was removed, 0 to 1.
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
        """Frames (M, N, 2), in which each lost pin (M, N) is placed by the modes of the other pins' displacements."""
        directions = self.components / np.maximum(np.linalg.norm(self.components, axis=0), 1e-12)
        filled, middle = nodes_px.copy(), self.rest_px.mean(axis=0)
        for k in np.flatnonzero(lost.any(axis=1)):
            known = np.repeat(~lost[k], 2)
            normal = directions[known].T @ directions[known] + FILL_RIDGE * np.eye(directions.shape[1])
            for _ in range(FILL_ROUNDS):  # the similarity depends on the pins that the round before filled in
                aligned, similarity = align(filled[k, None], self.rest_px)
                away = aligned.ravel() - self.mean
                found = self.mean + directions @ np.linalg.solve(normal, directions[known].T @ away[known])
                z = (self.rest_px - middle + found.reshape(-1, 2)) @ [1, 1j] * np.exp(similarity[0, 0] + 1j * similarity[0, 1])
                filled[k, lost[k]] = (np.stack([z.real, z.imag], axis=-1) + middle + similarity[0, 2:])[lost[k]]
        return filled

    def difference(self, nodes_px: np.ndarray) -> np.ndarray:
        """Differences (M, 4) between the frames' similarities and those expected from their contacts."""
        aligned, observed = align(nodes_px, self.rest_px)
        return observed - _terms((aligned.reshape(len(aligned), -1) - self.mean) @ self.components) @ self.weight


def fit_registration(nodes_px: np.ndarray, rest_px: np.ndarray) -> tuple[Registration, np.ndarray]:
    """Learn which similarity a contact causes, from frames (M, N, 2) of one camera position.

    Returns
    -------
    Registration
    left : (M, 4) float
        Difference of each frame from a fit without this frame.
    """
    aligned, observed = align(nodes_px, rest_px)
    flat = aligned.reshape(len(aligned), -1)
    mean = flat.mean(axis=0)
    _, sizes, directions = np.linalg.svd(flat - mean, full_matrices=False)
    keep = count_modes(sizes, MODES)
    components = directions[:keep].T / np.maximum(sizes[:keep] / np.sqrt(len(flat)), 1e-9)
    terms = _terms((flat - mean) @ components)
    inverse = np.linalg.inv(terms.T @ terms + RIDGE * np.eye(terms.shape[1]))
    weight = inverse @ terms.T @ observed
    leverage = np.einsum("mi,ij,mj->m", terms, inverse, terms, optimize=True)
    left = (observed - terms @ weight) / (1 - leverage)[:, None]
    usual = np.sqrt(np.mean(left**2, axis=0)) + 1e-9
    return Registration(rest_px, mean, components, weight, usual), left


def align(nodes_px: np.ndarray, rest_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove the least-squares similarity to the layout at rest from frames.

    Parameters
    ----------
    nodes_px : (M, N, 2) float
    rest_px : (N, 2) float

    Returns
    -------
    aligned : (M, N, 2) float
        Displacement from rest without the similarity, px.
    similarity : (M, 4) float
        Logarithm of scale, turn (rad), shift of the centre in x and y (px), from rest to the frame.
    """
    middle = rest_px.mean(axis=0)
    shift = nodes_px.mean(axis=1) - middle
    rest = (rest_px - middle) @ [1, 1j]
    frame = (nodes_px - middle - shift[:, None]) @ [1, 1j]
    factor = (frame @ rest.conj()) / (np.abs(rest) ** 2).sum()
    left = frame / factor[:, None] - rest
    return np.stack([left.real, left.imag], axis=-1), np.column_stack([np.log(np.abs(factor)), np.angle(factor), shift])


def count_modes(sizes: np.ndarray, most: int) -> int:
    """Number of modes of centred rows to keep, at most ``most``; ``sizes`` are the rows' singular values, the largest first.

    M centred rows span at most M - 1 directions. All further modes are rounding errors. If they were scaled to a standard deviation of 1,
    the rounding errors of other rows would become amplitudes of thousands.
    """
    return int((sizes[:most] > LEAST_SIZE * sizes[0]).sum())


def _terms(modes: np.ndarray) -> np.ndarray:
    few = modes[:, :SQUARED]
    i, j = np.triu_indices(few.shape[1])
    return np.concatenate([np.ones((len(modes), 1)), modes, few[:, i] * few[:, j]], axis=1)
