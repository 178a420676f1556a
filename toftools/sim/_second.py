"""First and second surface points of paths that pixels share, and what lies between them."""

from dataclasses import dataclass
from math import gcd
from typing import Any

from toftools.sim._sobol import hashed
from toftools.sim._task import Jit
from toftools.sim._tracer import lane_keys


@dataclass
class Found:
    """Second surface points of one lane each (sample-major), and the light that arrives there.

    Parameters
    ----------
    p, n, sh_n : Point3f, Normal3f, Normal3f
        Place, geometric and shading normal, turned towards the pixel that drew it.
    valid, shared : Bool
        Whether there is a point, and whether others may use it.
    weight, length_m : Float
        Of the pixel's own use: material over density, and optical length from the first surface.
    sums : pytree
        Light leaving towards the pixel, by frequency and bounce.
    ambient : Float
        The same without modulation.
    seen, density : UInt32, Float
        Which pixels of the group see it, and the sum of their densities per area.
    """

    p: Jit
    n: Jit
    sh_n: Jit
    valid: Jit
    shared: Jit
    weight: Jit
    length_m: Jit
    sums: Jit
    ambient: Jit
    seen: Jit
    density: Jit


@dataclass
class Mine:
    """What connecting needs of first surfaces: place, normal towards the camera, albedo, range."""

    p: Jit
    up: Jit
    albedo: Jit
    far_m: Jit
    valid: Jit


@dataclass(frozen=True, eq=False)
class Points:
    """Which first surface a pixel looks at with which path, when it has several points.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    first : SurfaceInteraction3f
        First surfaces, those of a pixel in a row.
    inside : int
        Points per pixel.
    seed : int
        Of the point that a pixel starts with.
    """

    mi: Any
    first: Jit
    inside: int
    seed: int

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        import drjit as dr

        return int(dr.width(self.first.t)) // self.inside

    def slot(self, pixel: Jit, number: Jit) -> Jit:
        """Number of the first surface of a path of a pixel: all points in turn, widely spread."""
        if self.inside == 1:
            return pixel
        begin = hashed(self.mi, lane_keys(self.mi, pixel, self.seed)) % self.inside
        return pixel * self.inside + (begin + number * _stride(self.inside)) % self.inside


def _stride(count: int) -> int:
    """Step through `count` points that visits all of them, near the golden section."""
    return next(k for k in range(max(1, round(0.618 * count)), count + 1) if gcd(k, count) == 1)


def scatters_alike(mi: Any, si: Jit) -> Jit:  # noqa: ANN401 - the module mitsuba
    """Whether surfaces scatter alike in all directions of the side that is looked at."""
    import drjit as dr

    bsdf, valid = si.bsdf(), si.is_valid()
    kinds = mi.BSDFFlags
    for kind in (kinds.Glossy, kinds.Delta, kinds.DiffuseTransmission):
        valid &= ~mi.has_flag(bsdf.flags(), kind)
    # Flags tell nothing of bent normals and black backs: try one direction.
    trial = mi.Vector3f(0.48, 0.36, dr.copysign(mi.Float(0.8), si.wi.z))
    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, trial, valid)
    albedo = bsdf.eval_diffuse_reflectance(si, valid)[0]
    off = dr.maximum(dr.abs(dr.pi * density - 0.8), dr.abs(dr.pi * value[0] - 0.8 * albedo))
    return valid & (off < 1e-5)


def facing(normal: Jit, towards: Jit) -> Jit:
    import drjit as dr

    return dr.select(dr.dot(normal, towards) < 0, -normal, normal)


def up_of(si: Jit) -> Jit:
    """Shading normal on the side that is looked at."""
    return facing(si.sh_frame.n, si.to_world(si.wi))


def face_of(si: Jit) -> Jit:
    """Normal of the surface itself, as areas need it, on the side that is looked at."""
    return facing(si.n, si.to_world(si.wi))


def geometry(si: Jit, p: Jit, n: Jit, sh_n: Jit) -> tuple[Jit, Jit, Jit]:
    """From first surfaces to a second point: direction, cosine there over distance squared, way.

    The cosine is zero on the back of the second point, whose light is another.
    """
    import drjit as dr

    away = p - si.p
    far = dr.norm(away)
    to = away / far
    cosine = -dr.dot(n, to)
    front = (cosine > 0) & (dr.dot(sh_n, to) < 0) & (far > 0)
    return to, dr.select(front, cosine / dr.square(far), 0.0), far
