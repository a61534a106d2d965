"""Does denoising pay? Open Image Denoise on data-set frames, without a guide and guided by the preview, against more samples.

Run: pip install pyoidn, then PYTHONPATH=.:tests/helpers python tests/bench/bench_denoise.py [--sensor mg400-331].
"""

import argparse

import numpy as np
from bench_render import CONVERGED, Bench
from image_error import timed_ms
from pyoidn import denoise

from twin.optics.preview import Preview

SAMPLES = (1, 2, 4, 8)
BRIGHT = 99.5  # percentile of the preview that counts as albedo 1


def three(light: np.ndarray) -> np.ndarray:
    """A mono picture as three equal colours."""
    return np.ascontiguousarray(np.repeat(light[..., None].astype(np.float32), 3, axis=2))


def main():
    """Print errors of gray levels and centroids with and without denoising, and what it costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default="mg400-331", help="a mono one")
    bench = Bench(parser.parse_args().sensor, 3)
    state = bench.states[1]
    truth = bench.truth(bench.renderer(CONVERGED).render(state, seed=999))
    preview = Preview(bench.spec, window_px=bench.window)
    preview.calibrate(bench.renderer(64))
    guide = preview.render(state)
    albedo = three((guide / np.percentile(guide, BRIGHT)).clip(0, 1))
    normal = np.zeros_like(albedo)
    normal[..., 2] = 1
    ways = {"as it is": {}, "no guide": {}, "guided": {"albedo": albedo, "normal": normal, "clean_aux": True}}
    print(f"{'samples':>8s}{'denoised':>10s}{'gray rms':>10s}{'px rms':>8s}{'CPU ms':>8s}")
    for spp in SAMPLES:
        light = bench.renderer(spp).render(state, seed=1)
        for name, how in ways.items():
            made, cpu = light, 0.0
            if name != "as it is":
                made = denoise(three(light), hdr=True, **how).mean(axis=2)
                _, cpu = timed_ms(lambda k, light=light, how=how: denoise(three(light), hdr=True, **how), 3)
            gray, rms, _ = truth.errors(made)
            print(f"{spp:8d}{name:>10s}{gray:10.2f}{rms:8.3f}{cpu:8.0f}", flush=True)
    gray, rms, _ = truth.errors(guide)
    print(f"{'preview':>8s}{'':10s}{gray:10.2f}{rms:8.3f}")


if __name__ == "__main__":
    main()
