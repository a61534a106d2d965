"""The studio's film and pictures, taken in a real Chromium: ``make film``, or

    python tests/browser/film.py --out out/film [--seconds 40] [--chromium /usr/bin/chromium]

Each picture of the film is taken when the page shows the pose of that picture, so the film runs evenly on a slow machine too. Writes
``studio.mp4`` and ``studio-press.jpg``, ``studio-shear.jpg``, ``studio-degrade.jpg``. Needs Chromium and the extra ``browser``.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from browser_page import open_page
from studio_client import StudioClient

from hardware.live.studio_mode import LiveMode
from scenes import load_sensor
from training.estimate.estimator import models_by_sensor
from twin.studio.pictures import FilmWriter
from twin.studio.pose import ObjectPose
from twin.studio.scene import quaternion
from twin.studio.state import first_state
from twin.studio.studio import Studio, StudioPlan

SENSOR, OBJECT = "mg400-331", "sphere"
RATE_HZ = 8.0  # poses of the film in a second
# seconds, and the pose that is reached then; between them the object moves evenly
KNOTS = [
    (0.0, ObjectPose(depth_mm=-2.0)),
    (5.0, ObjectPose(depth_mm=3.5)),
    (7.0, ObjectPose(depth_mm=3.5)),
    (13.0, ObjectPose(x_mm=4.0, depth_mm=3.5)),
    (19.0, ObjectPose(x_mm=-4.0, y_mm=3.0, depth_mm=3.0)),
    (25.0, ObjectPose(x_mm=-4.0, y_mm=-4.0, depth_mm=4.5)),
    (30.0, ObjectPose(x_mm=3.0, y_mm=-4.0, depth_mm=4.0, tilt_y_deg=20.0)),
    (35.0, ObjectPose(depth_mm=4.0, twist_deg=30.0)),
    (40.0, ObjectPose(depth_mm=-2.0)),
]
PICTURES = {"press": 6.0, "shear": 13.0}  # name, and time in s of the film
WHOLE = ".badge:text-is('path-traced')"  # what the page says of a picture that no further pass will repair
SHOWN_S = 120.0  # longest wait for a picture


def pose_at(time_s: float) -> np.ndarray:
    """The six numbers at a time of the film."""
    times = [t for t, _ in KNOTS]
    table = np.array([[*vars(pose).values()] for _, pose in KNOTS])
    return np.array([np.interp(time_s, times, column) for column in table.T])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/film"))
    parser.add_argument("--seconds", type=float, default=KNOTS[-1][0])
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    radius = load_sensor(SENSOR).skin.outer_radius_mm
    plan = StudioPlan(first_state(None, SENSOR, OBJECT), args.out, port=18190)
    film = FilmWriter(args.out / "studio.mp4")
    with Studio(plan, models_by_sensor(None), LiveMode) as studio, StudioClient(studio.page.url) as client:
        client.wait(lambda u: "90 % interval" in u.html, 120)
        with open_page(studio.page.url, chromium=args.chromium) as (page, messages):
            for k in range(int(args.seconds * RATE_HZ) + 1):
                pose = ObjectPose(*pose_at(k / RATE_HZ))
                T = pose.matrix(radius)
                client.drag(T[:3, 3], tuple(map(float, quaternion(T))))
                client.send({"type": "TransformControlsDragEndMessage", "name": "/wish", "owner": ""})
                wait_for(page, pose.depth_mm)
                picture = picture_of(page)
                film.add(picture, at_s=k / RATE_HZ)
                for name, at_s in PICTURES.items():
                    if k == round(at_s * RATE_HZ):
                        page.wait_for_selector(WHOLE, timeout=1e3 * SHOWN_S)
                        save(args.out / f"studio-{name}.jpg", picture_of(page))
            client.drag((0.0, 0.0, radius - 3.0))
            wait_for(page, 3.0)
            client.set("mode", "Degrade")
            client.set("severity 1", 0.3)
            client.set("severity 2", 0.1)
            page.wait_for_selector("text=/limit/", timeout=1e3 * SHOWN_S)
            time.sleep(3.0)
            save(args.out / "studio-degrade.jpg", picture_of(page))
            print(film.close())
            print("\n".join(messages) or "no message in the browser's console")


def wait_for(page, depth_mm: float) -> None:
    """Wait until the page's numbers belong to a depth."""
    wanted = f"Math.abs(parseFloat(document.querySelector('[data-depth]')?.dataset.depth) - ({depth_mm:.6f})) < 0.002"
    page.wait_for_function(wanted, timeout=1e3 * SHOWN_S)


def picture_of(page) -> np.ndarray:
    """(H, W, 3) uint8 RGB: what the browser shows."""
    return cv2.imdecode(np.frombuffer(page.screenshot(type="png"), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def save(path: Path, picture: np.ndarray) -> None:
    """Write a picture as a JPEG of moderate size."""
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
