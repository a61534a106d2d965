"""Compiles what most tests call, in two processes beside each other. Otherwise each worker of pytest would compile it for itself."""

import subprocess
import sys

PARTS = ("solving", "seeing")


def solving() -> None:
    """The skin's finite elements on a plane."""
    from scenes import load_object, load_sensor
    from twin.geometry.solid import Resolution
    from twin.mechanics import ContactPose, SkinSolver

    SkinSolver(load_sensor("mg400-127"), resolution=Resolution(8)).press(load_object("plane"), ContactPose(1.0, shear_mm=(0.5, 0.0)))


def seeing() -> None:
    """The surrogate's contacts, rasterised pictures, and the pipeline."""
    import gymnasium

    import training.environments  # noqa: F401 (registers them)
    from scenes import load_sensor
    from twin.camera.capture import expose
    from twin.optics.preview import Preview
    from twin.pins import Pipeline
    from twin.types import Form, Frame

    environment = gymnasium.make("tactip/SurfaceFollow-v0", sensor="mg400-127", observation="image")
    environment.reset(seed=0, options={"object": "plane"})
    environment.step(environment.action_space.sample())
    environment.close()
    spec = load_sensor("ur5-331")
    Pipeline(spec, Form.RAW)(Frame(expose(Preview(spec).render(), spec.capture), Form.RAW))


def compile_all() -> None:
    """Compile all parts; the machine code stays on disk."""
    parts = [subprocess.Popen([sys.executable, __file__, part]) for part in PARTS]
    for name, part in zip(PARTS, parts, strict=True):
        if part.wait():
            raise RuntimeError(f"compiling of '{name}' failed; try: python {__file__} {name}")


if __name__ == "__main__":
    globals()[sys.argv[1] if len(sys.argv) > 1 else "compile_all"]()
