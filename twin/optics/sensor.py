"""A Mitsuba camera whose rays come from a table, so that any lens distortion is exact.

Only for Dr.Jit variants: a scalar variant would call Python once per sample.
"""

import functools

import numpy as np

PLUGIN = "tactip_camera"


@functools.cache
def register(variant: str) -> None:
    """Make the camera known to Mitsuba's current variant (which must be ``variant``)."""
    import drjit as dr
    import mitsuba as mi

    class TableCamera(mi.Sensor):
        """Rays from one pinhole; properties ``table`` (H + 1, W + 1, 2), ``camera_to_world`` and ``film``."""

        def __init__(self, props):
            super().__init__(props)
            table = np.array(props["table"])
            self.rows, self.columns = table.shape[0] - 1, table.shape[1] - 1
            self.table = mi.TensorXf(table.astype(np.float32))
            self.lookup = mi.Texture2f(self.table, filter_mode=dr.FilterMode.Linear, wrap_mode=dr.WrapMode.Clamp)

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            # Texel centres lie at (i + 0.5) / n; the table's nodes are the pixels' corners.
            size = mi.Vector2f(self.columns, self.rows)
            x, y = self.lookup.eval(dr.fma(sample2, size, 0.5) / (size + 1), active)
            ray = dr.zeros(mi.RayDifferential3f, dr.width(sample2))
            transform = self.world_transform()
            ray.o = transform @ mi.Point3f(0, 0, 0)
            ray.d = transform @ dr.normalize(mi.Vector3f(x, y, 1))
            ray.time = time
            ray.maxt = dr.largest(mi.Float)
            ray.has_differentials = False
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            ray.wavelengths = wavelengths
            return ray, weight

        def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
            return self.sample_ray(time, sample1, sample2, sample3, active)

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return f"TableCamera[{self.columns} x {self.rows} px]"

    mi.register_sensor(PLUGIN, TableCamera)
