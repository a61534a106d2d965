"""Other blob detectors: a masked gray window goes in, places and areas of blobs come out."""

import cv2
import numpy as np
from skimage.feature import blob_dog, blob_doh, blob_log

from scenes.sensor import BlobSpec
from twin.detectors.spec import DetectorSpec
from twin.preprocess.blobs import threshold
from twin.preprocess.mask import Mask

# Gray levels of full contrast.
LEVELS = 255.0
# Sizes between the smallest and the largest that the scale-space detectors look for.
LOG_STEPS = 3
# Response of scikit-image's blob_log (and blob_dog) to a disc of its own size and contrast 1, roughly.
LOG_PEAK = 0.5
# Response of blob_doh to such a disc; it grows with the contrast squared.
DOH_PEAK = 0.05
# Ratio of neighbouring sizes of blob_dog.
DOG_RATIO = 1.4
# Share of a smaller blob that may overlap with a larger one.
OVERLAP = 0.3
# Gray levels between the thresholds of SimpleBlobDetector, and the highest first one.
SIMPLE_STEP, SIMPLE_HIGHEST = 10.0, 240.0
# Largest area of a blob, in areas of the largest cap.
MOST_CAPS = 4


def find(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """Places (K, 2), px of the frame, and areas (K,) of the blobs in a mask's window (h, w) uint8."""
    return FINDERS[detector.method](window, mask, detector)


def _components(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """Connected components above a fixed or adaptive threshold."""
    blob = detector.blob if detector.method == "adaptive" else _fixed(detector.blob)
    binary = threshold(window, mask.disc, blob)
    if blob.erosion_px > 1:
        binary = cv2.erode(binary, np.ones((blob.erosion_px, blob.erosion_px), np.uint8))
    _, _, stats, centroids = cv2.connectedComponentsWithStats(binary, connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA].astype(float)
    keep = (area >= blob.min_area_px2) & (area <= MOST_CAPS * np.pi * detector.radius_px[1] ** 2)
    return centroids[1:][keep] + mask.corner_px, area[keep]


def _fixed(blob: BlobSpec) -> BlobSpec:
    """The same with a fixed threshold."""
    return blob.model_copy(update={"threshold_block_px": 0})


def _simple(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's SimpleBlobDetector."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.blobColor = 255
    settings.minThreshold = min(detector.blob.threshold, SIMPLE_HIGHEST)
    settings.maxThreshold, settings.thresholdStep = 255.0, SIMPLE_STEP
    settings.minDistBetweenBlobs, settings.minRepeatability = max(detector.radius_px[0], 1.0), 1
    settings.filterByArea, settings.minArea = True, max(detector.blob.min_area_px2, 1.0)
    settings.maxArea = MOST_CAPS * np.pi * detector.radius_px[1] ** 2
    settings.filterByCircularity = settings.filterByConvexity = settings.filterByInertia = False
    found = cv2.SimpleBlobDetector.create(settings).detect(cv2.bitwise_and(window, mask.disc))
    px = np.array([point.pt for point in found], float).reshape(-1, 2)
    return px + mask.corner_px, np.array([np.pi / 4 * point.size**2 for point in found])


def _scale_space(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """scikit-image's Laplacian or difference of Gaussians, or determinant of Hessian."""
    contrast = detector.blob.threshold / LEVELS
    small, large = (radius / np.sqrt(2) for radius in detector.radius_px)
    inside = mask.disc > 0
    image = np.where(inside, window, np.median(window[inside])) / LEVELS
    if detector.method == "log":
        found = blob_log(image, min_sigma=small, max_sigma=large, num_sigma=LOG_STEPS, threshold=LOG_PEAK * contrast, overlap=OVERLAP)
    elif detector.method == "dog":
        found = blob_dog(image, min_sigma=small, max_sigma=large, sigma_ratio=DOG_RATIO, threshold=LOG_PEAK * contrast, overlap=OVERLAP)
    else:
        found = blob_doh(image, min_sigma=small, max_sigma=large, num_sigma=LOG_STEPS, threshold=DOH_PEAK * contrast**2, overlap=OVERLAP)
    rows, columns = found[:, 0].astype(int), found[:, 1].astype(int)
    found = found[inside[rows, columns]]
    return found[:, 1::-1] + mask.corner_px, 2 * np.pi * found[:, 2] ** 2


FINDERS = {"adaptive": _components, "fixed": _components, "simple": _simple, "log": _scale_space, "dog": _scale_space, "doh": _scale_space}
