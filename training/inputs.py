"""What each kind of network sees of the frames: dense pin features, graphs, or small images."""

from collections.abc import Callable

import cv2
import numpy as np
import torch

from training.dataset import Dataset, PinTable
from training.models.cnn import INPUT_PX
from training.models.gcn import GraphRows, graph_rows
from twin.preprocess.graph import knn_edges
from twin.preprocess.reference import Reference
from twin.preprocess.voronoi import directed_edges, triangulate
from twin.recordings import open_recording
from twin.recordings.forms import gray_levels
from twin.store import cached_arrays

RELEASE_PX = 300.0  # side of the release's resized image, in whose px and px^2 its features are


def pin_features(nodes_px: np.ndarray, area_px2: np.ndarray, reference: Reference) -> np.ndarray:
    """Features (M, N, 3) of matched pins: displacement from rest in mean rest spacings, logarithm of area over rest area."""
    moved = (nodes_px - reference.pins_px) / reference.spacing_px.mean()
    return np.concatenate([moved, np.log(area_px2 / reference.area_px2)[..., None]], axis=-1)


def pixel_features(nodes_px: np.ndarray, area_px2: np.ndarray | None, width_px: int) -> np.ndarray:
    """Features (M, N, 2 or 3) as published: x, y about their medians in px of the release's image, and the area (px^2)."""
    scale = RELEASE_PX / width_px
    centred = scale * (nodes_px - np.median(nodes_px, axis=1, keepdims=True))
    return centred if area_px2 is None else np.concatenate([centred, scale**2 * area_px2[..., None]], axis=-1)


class PinInputs:
    """Dense features of every frame: ``batch`` gives (B, N, 3) and lost pins (B, N).

    ``displaced`` (M,) is the part of a frame's difference from the expected camera that was taken out.
    """

    def __init__(self, features: np.ndarray, lost: np.ndarray, displaced: np.ndarray | None = None) -> None:
        self.x, self.lost = torch.from_numpy(features.astype(np.float32)), torch.from_numpy(lost)
        self.displaced = torch.from_numpy(np.zeros(len(lost)) if displaced is None else displaced)

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: torch.Tensor) -> tuple:
        """Arguments of the network for some rows."""
        return self.x[rows], self.lost[rows]


class GraphInputs:
    """A graph for every frame: ``batch`` gives (B, N, F) and the block diagonal adjacency with its transpose."""

    def __init__(self, features: np.ndarray, edges: list, *, symmetric: bool) -> None:
        self.x = torch.from_numpy(features.astype(np.float32))
        nodes = features.shape[1]
        self.forward: GraphRows = graph_rows(edges, nodes)
        self.back: GraphRows = self.forward if symmetric else graph_rows(edges, nodes, transposed=True)

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: torch.Tensor) -> tuple:
        """Arguments of the network for some rows."""
        chosen = rows.numpy()
        matrix = self.forward.batch(chosen)
        return self.x[rows], matrix, matrix if self.back is self.forward else self.back.batch(chosen)


class ImageInputs:
    """Frames of 128 x 128: ``batch`` gives (B, 128, 128) uint8."""

    def __init__(self, images: np.ndarray) -> None:
        self.images = torch.from_numpy(images)

    def __len__(self) -> int:
        return len(self.images)

    def batch(self, rows: torch.Tensor) -> tuple:
        """Arguments of the network for some rows."""
        return (self.images[rows],)


def frame_edges(kind: str, nodes_px: np.ndarray) -> np.ndarray:
    """Directed edges (E, 2) of one frame: ``knn``, or ``delaunay`` (nearest neighbours where there are no triangles)."""
    triangles = None if kind == "knn" else triangulate(nodes_px)
    return knn_edges(nodes_px) if triangles is None else directed_edges(triangles, len(nodes_px))


def graph_inputs(model: str, pins: PinTable, width_px: int) -> GraphInputs:
    """What ``gnn`` (kNN, x and y) or ``tac-vgnn`` (Delaunay, with the Voronoi area) sees."""
    if model == "gnn":
        return GraphInputs(pixel_features(pins.nodes_px, None, width_px), [frame_edges("knn", n) for n in pins.nodes_px], symmetric=False)
    edges = [frame_edges("delaunay", n) for n in pins.nodes_px]
    return GraphInputs(pixel_features(pins.nodes_px, pins.area_px2, width_px), edges, symmetric=True)


def small_image(image: np.ndarray) -> np.ndarray:
    """A frame as the convolutional networks see it: (128, 128) uint8."""
    return cv2.resize(gray_levels(image), (INPUT_PX, INPUT_PX), interpolation=cv2.INTER_AREA)


def image_inputs(dataset: Dataset, progress: Callable | None = None) -> ImageInputs:
    """The frames of a data set, small, in its order."""

    def compute() -> dict[str, np.ndarray]:
        recording = open_recording(dataset.folder, dataset.pins.sensor, dataset.pins.form)
        images = {}
        for frame in recording:
            images[frame.name] = small_image(frame.image)
            if progress:
                progress(frame.sequence + 1, len(recording))
        return {"images": np.stack([images[name] for name in dataset.pins.image_name])}

    key = {"path": str(dataset.folder.resolve()), "names": dataset.pins.image_name.tolist(), "pins": dataset.pins.nodes_px.tobytes()}
    return ImageInputs(cached_arrays("small-images", key | {"px": INPUT_PX}, compute)["images"])
