"""Probability that a frame shows any contact, from the pins alone. It needs measured pins at rest.

Without contact, a frame differs from the frame at rest by the noise of the pins, and by a shift, turn and scale of the whole view if the
camera moved a little. A contact moves neighbouring pins together. Therefore the similarity is removed, each pin's displacement is averaged
with its neighbours', and the largest average, a (px), gives the probability (at the rim, averages of fewer pins have a smaller weight)

    P(contact) = 1 / (1 + exp(-(a - MIDDLE_PX) / WIDTH_PX))
"""

import numpy as np

from training.models.vgnn.registration import align
from twin.pins.labelling.reference import Reference
from twin.pins.voronoi import directed_edges
from twin.types import BoolArray, FloatArray

MIDDLE_PX = 0.28
"""Average displacement, px, at which the probability of a contact is 0.5. Noise of 0.1 px gives at most 0.23 px in 2,000 frames of the
shipped sensors. A plate or a ball that presses a soft tip with 0.2 N gives at least 0.3 px."""
USUAL = 7.0
"""Usual number of pins in an average: one pin and its six neighbours. At the rim, averages of fewer pins are noisier and weigh less."""
WIDTH_PX = 0.02
"""Change of this average, px, that multiplies the odds by e."""


class TouchAnswer:
    """Computes the probability that a frame's pins show a contact.

    Parameters
    ----------
    reference : Reference
        The pins at rest, measured with the camera of the frames.
    """

    def __init__(self, reference: Reference) -> None:
        count = len(reference.pins_px)
        self._reference, self._around = reference, np.eye(count)
        self._around[tuple(directed_edges(reference.triangles, count).T)] = 1.0

    def __call__(self, nodes_px: FloatArray, lost: BoolArray) -> float:
        """Probability of a contact, from pins (N, 2). Pins that are ``lost`` (N,) are not used. NaN if all are lost."""
        seen = ~lost
        if not seen.any():
            return float("nan")
        apart, _ = align(nodes_px[None, seen], self._reference.pins_px[seen])
        around = self._around[np.ix_(seen, seen)]
        count = around.sum(axis=1, keepdims=True)
        mean = around @ apart[0] / count * np.sqrt(count / USUAL)
        largest_px = float(np.linalg.norm(mean, axis=1).max())
        return float(1 / (1 + np.exp(-np.clip((largest_px - MIDDLE_PX) / WIDTH_PX, -50, 50))))
