"""Light in the gel at chosen pixels as a differentiable function of LEDs and reflectances.

The derivatives are those of the renderer: Dr.Jit differentiates the light paths in forward mode.
"""

from dataclasses import dataclass

import numpy as np

from twin.errors import RenderError
from twin.optics.render import BOUNCES, GelView, Renderer
from twin.optics.tracer import spectrum
from twin.optics.variant import DrJit, use_variant, with_room
from twin.types import FloatArray, IntArray, PinState

SAMPLES = 32
"""Samples per pixel."""


@dataclass(frozen=True)
class Knobs:
    """Factors on the specification's lights and reflectances. Those with a colour are linear RGB (3,).

    Attributes
    ----------
    leds : (k,) float
        Factor on the power of each lit LED.
    skin, caps, stems : (3,) float
        Factors on the reflectances.
    """

    leds: FloatArray
    skin: FloatArray
    caps: FloatArray
    stems: FloatArray


class LightModel:
    """Light in the gel at chosen pixels of one state, and its derivatives by forward differentiation.

    Parameters
    ----------
    renderer : Renderer
        Renderer of the whole frame of the specification for which all knobs are 1. Its variant must be able to differentiate.
    state : PinState
        Pins as ``Renderer.render`` takes them.
    pixels : (n,) int
        Pixel numbers of the raw frame, counted row by row.
    seed : int

    Raises
    ------
    RenderError
        Only the scalar variant, which can't differentiate, works on this machine.
    """

    def __init__(self, renderer: Renderer, state: PinState, pixels: IntArray, seed: int) -> None:
        if renderer.choice.backend == "scalar":
            raise RenderError(
                "calibration differentiates the renderer, which the scalar variant can't: run 'twin doctor' for what is missing"
            )
        import drjit as dr

        self._mi, self._dr, self._seed = use_variant(renderer.choice), dr, seed
        mi = self._mi
        self._view = GelView(mi, renderer.spec, renderer.window_px, renderer.surfaces(state), BOUNCES)
        self._pixels = mi.UInt32(with_room(pixels, np.uint32))
        tracer = self._view.tracer
        self.led_count = sum(bool(p.half_mm.any()) for p in tracer.patches)
        self._radiance = [mi.Spectrum(r) for r in tracer.radiances]
        self._shapes = {shape.id(): mi.ShapePtr(shape) for shape in tracer.scene.shapes()}

    def light(self, knobs: Knobs) -> FloatArray:
        """Light (n, channels) from the gel on the film."""
        self._turn(knobs, {})
        return np.array(self._view.trace(self._pixels, SAMPLES, self._seed)).T

    def slopes(self, knobs: Knobs) -> dict[str, FloatArray]:
        """Derivatives (n, channels) by the logarithm of each knob: ``led0``..., ``skin``, ``caps``, ``stems``.

        A coloured knob changes each channel independently, so that one pass gives the derivatives of all channels. All passes have the
        same kernel.
        """
        mi, dr = self._mi, self._dr
        names = [*(f"led{k}" for k in range(self.led_count)), "skin", "caps", "stems"]
        found = {}
        for name in names:
            steps = {each: mi.Float(0.0) for each in names}
            dr.enable_grad(steps)
            for each, step in steps.items():
                dr.set_grad(step, dr.opaque(mi.Float, float(each == name)))
            self._turn(knobs, steps)
            image = self._view.trace(self._pixels, SAMPLES, self._seed)
            found[name] = np.array(dr.forward_to(image)).T
        return found

    def _turn(self, knobs: Knobs, steps: dict[str, DrJit]) -> None:
        """Set the knobs. The logarithm of each knob has a step added, which is zero but carries a gradient."""
        mi, dr, tracer = self._mi, self._dr, self._view.tracer

        def factor(knob: str, value: DrJit) -> DrJit:
            return value * (1 + steps[knob]) if knob in steps else value

        lit = self._radiance[: self.led_count]
        turned = [base * factor(f"led{k}", dr.opaque(mi.Float, float(knobs.leds[k]))) for k, base in enumerate(lit)]
        tracer.radiances = [*turned, *self._radiance[self.led_count :]]
        tracer.tints = []
        for part, shape in self._shapes.items():
            tint = spectrum(mi, getattr(knobs, part))
            dr.make_opaque(tint)
            tracer.tints.append((shape, factor(part, tint)))
