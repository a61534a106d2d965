"""Pictures of the gallery, from the code of its page.

Run by ``make gallery``, or: cd docs && PYTHONPATH=.. python -m generators.gallery
"""

import os
import re
import tempfile
from pathlib import Path

os.environ["MPLBACKEND"] = "Agg"

import cv2  # noqa: E402
import matplotlib.pyplot as plt  # noqa: E402

from generators.notebooks import DOCS, blocks  # noqa: E402

PICTURES = DOCS / "pictures" / "gallery"
WIDTH_PX, QUALITY = 480, 85


def make_pictures() -> list[Path]:
    """Run each block of the page in a fresh folder, and keep its picture, smaller."""
    made = []
    PICTURES.mkdir(exist_ok=True)
    for block in blocks((DOCS / "gallery.md").read_text(encoding="utf-8")):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            exec(compile(block.code, f"line {block.line}", "exec"), {"__name__": "__main__"})
            plt.close("all")
            name = re.search(r'savefig\("(\w+)\.png"\)', block.code)[1]
            image = cv2.imread(f"{name}.png")
            os.chdir(DOCS)
        image = cv2.resize(image, (WIDTH_PX, WIDTH_PX * image.shape[0] // image.shape[1]), interpolation=cv2.INTER_AREA)
        made.append(PICTURES / f"{name}.jpg")
        cv2.imwrite(str(made[-1]), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return made


if __name__ == "__main__":
    print(*make_pictures(), sep="\n")
