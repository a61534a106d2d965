"""Inputs of ``vgnn``: every pin's displacement and area, with the camera's own displacement subtracted."""

import numpy as np
import torch

from training.models.vgnn.registration import Registration
from twin.pins import make_graph
from twin.pins.labelling.reference import Reference


class PinInputs:
    """Dense features of every frame: ``batch`` gives (B, N, 3) and lost pins (B, N).

    Parameters
    ----------
    features : (M, N, 3) float
    lost : (M, N) bool
    displaced : (M,) float, optional
        Share, 0 to 1, of each frame's difference from the expected camera that was removed; 0 for all frames if not given.
    """

    def __init__(self, features: np.ndarray, lost: np.ndarray, displaced: np.ndarray | None = None) -> None:
        self.x, self.lost = torch.from_numpy(features.astype(np.float32)), torch.from_numpy(lost)
        self.displaced = torch.from_numpy(np.zeros(len(lost)) if displaced is None else displaced)

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Arguments of the network for some rows."""
        return self.x[rows], self.lost[rows]


def pin_features(nodes_px: np.ndarray, area_px2: np.ndarray, reference: Reference) -> np.ndarray:
    """Features (M, N, 3) of matched pins: displacement from rest in mean rest spacings, logarithm of the ratio of area to rest area."""
    moved = (nodes_px - reference.pins_px) / reference.spacing_px.mean()
    return np.concatenate([moved, np.log(area_px2 / reference.area_px2)[..., None]], axis=-1)


def fill_lost(
    registration: Registration, nodes_px: np.ndarray, area_px2: np.ndarray, lost: np.ndarray, reference: Reference
) -> tuple[np.ndarray, np.ndarray]:
    """Pins (M, N, 2) and areas (M, N). A lost pin (M, N) is placed by the modes of the other pins' displacements."""
    nodes_px, area_px2 = nodes_px.copy(), area_px2.copy()
    for k in np.flatnonzero(lost.any(axis=1)):
        nodes_px[k] = registration.fill(nodes_px[k], lost[k])
        area_px2[k] = make_graph("voronoi", nodes_px[k], outmost=reference.outmost, net=reference.net).area_px2
    return nodes_px, area_px2


def seated_inputs(
    registration: Registration,
    nodes_px: np.ndarray,
    area_px2: np.ndarray,
    lost: np.ndarray,
    reference: Reference,
    *,
    together: bool = False,
) -> PinInputs:
    """Inputs of frames (see ``fill_lost``) without the camera's displacement; ``together`` as in ``Registration``."""
    nodes, area, _, share = registration(nodes_px, area_px2, together=together)
    return PinInputs(pin_features(nodes, area, reference), lost, share)
