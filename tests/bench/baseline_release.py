"""The published method written plainly: the baseline that the pipeline's speed is measured against.

SimpleBlobDetector with the release's parameters, edges from every pair within every Delaunay simplex, and one
polygon area per Voronoi region.
"""

from itertools import permutations

import cv2
import numpy as np
from scipy.spatial import Delaunay, Voronoi

from scenes.sensor import SensorSpec
from twin.pins.detectors.detector import LEGACY, boundary_nodes, legacy_detector


def polygon_area(vertices: np.ndarray) -> float:
    """Shoelace area of a convex polygon (k, 2) whose vertices may come in any order."""
    around = vertices - vertices.mean(axis=0)
    x, y = around[np.argsort(np.arctan2(around[:, 1], around[:, 0]))].T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


class Baseline:
    """Blob detection and the Voronoi graph of one recorded frame, as published."""

    def __init__(self, spec: SensorSpec) -> None:
        self.parameters = LEGACY[spec.pins.layout]
        self.detector = legacy_detector(self.parameters)

    def detect(self, image: np.ndarray) -> np.ndarray:
        """Blob centres (K, 2), px of the resized image."""
        size = self.parameters.size_px
        gray = cv2.resize(image, (size, size))
        _, binary = cv2.threshold(gray, self.parameters.threshold, 255, cv2.THRESH_BINARY)
        mask = np.zeros((size, size), np.uint8)
        dx, dy = self.parameters.mask_offset_px
        cv2.circle(mask, (size // 2 + dx, size // 2 + dy), size // 2 - self.parameters.mask_margin_px, 255, -1)
        return np.array([point.pt for point in self.detector.detect(cv2.bitwise_and(binary, mask))]).reshape(-1, 2)

    def graph(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Edges (E, 2) and Voronoi areas (N,) of blob centres."""
        nodes = nodes - np.median(nodes)
        n = len(nodes)
        extended = np.concatenate([nodes, boundary_nodes(nodes, self.parameters)])
        triangulated = extended if self.parameters.virtual_scales else nodes
        edges = set()
        for simplex in Delaunay(triangulated).simplices:
            for i, j in permutations(simplex.tolist(), 2):
                if i < n and j < n:
                    edges.add((i, j))
        diagram = Voronoi(extended)
        areas = np.full(n, np.nan)
        for i in range(n):
            region = diagram.regions[diagram.point_region[i]]
            if region and -1 not in region:
                areas[i] = polygon_area(diagram.vertices[region])
        return np.array(sorted(edges)), areas
