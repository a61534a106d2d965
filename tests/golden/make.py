"""Make the golden renders anew, because a change of the pictures is wanted: ``make golden``, or with ``--pictures DIR`` also to look at."""

import argparse
from pathlib import Path

import cv2
import numpy as np
from golden_renders import CASES, dented, make

from twin.camera.capture import expose
from twin.optics.render import Renderer

REFERENCE = Path(__file__).with_name("renders.npz")


def main() -> None:
    """Write ``renders.npz`` beside this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=Path, help="folder for a frame of each case")
    pictures = parser.parse_args().pictures
    make(REFERENCE)
    for name, case in CASES.items() if pictures else ():
        spec = case.spec()
        frame = expose(Renderer(spec, "llvm", spp=64).render(dented(spec, case.dent_mm)), spec.capture, np.random.default_rng(0))
        pictures.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(pictures / f"{name}.png"), frame if frame.ndim == 2 else frame[..., ::-1])


if __name__ == "__main__":
    main()
