"""Closed forms and slow readable twins of light transport: float64, plain numpy, no renderer.

All phasors are per unit source strength: a white, fronto-parallel surface at 1 m gives 1. ``leg``
is the mean phasor of one leg of a path between two surfaces.
"""

import numpy as np

from toftools.units import path_to_phase


def turn(path_m, freq_hz):
    """Phase factor of an optical path."""
    return np.exp(1j * path_to_phase(path_m, freq_hz))


def integral(integrand, low, high):
    """Adaptive quadrature of a complex function of one variable."""
    from scipy.integrate import quad

    parts = [
        quad(lambda x, part=part: part(integrand(x)), low, high, epsabs=1e-12, limit=500)[0]
        for part in (np.real, np.imag)
    ]
    return complex(*parts)


def chord_leg(radius, freq_hz):
    """Leg inside a sphere: chord lengths l have the density ``l / (2 R^2)`` on 0..2R."""
    return integral(lambda way: way / (2 * radius**2) * turn(way, freq_hz), 0.0, 2 * radius)


def series(gain, bounces=None):
    """``1 + gain + ... + gain^bounces``, or all of it."""
    whole = 1 / (1 - gain)
    return whole if bounces is None else whole * (1 - gain ** (bounces + 1))


def cavity(radius, albedo, freq_hz, bounces=None):
    """Camera and source at the centre of a diffuse sphere."""
    gain = albedo * chord_leg(radius, freq_hz)
    return albedo / radius**2 * turn(2 * radius, freq_hz) * series(gain, bounces)


def plates_leg(gap, freq_hz):
    """Leg between endless parallel plates: ``2 E3(-j k gap)``, of density ``2 gap^2 / d^3``."""
    from scipy.special import exp1

    z = -1j * float(path_to_phase(gap, freq_hz))
    if z == 0:
        return 1.0 + 0j
    # E_(n+1)(z) = (exp(-z) - z E_n(z)) / n, DLMF 8.19.12
    second = np.exp(-z) - z * exp1(z)
    return complex(np.exp(-z) - z * second)


def disc_leg(gap, radius, freq_hz):
    """The same from a coaxial disc: the integrand ends at its rim."""
    rim = np.hypot(gap, radius)
    return integral(lambda d: 2 * gap**2 / d**3 * turn(d, freq_hz), gap, rim)


def slab_leg(distance, thickness, index, freq_hz, *, passes=None):
    """Transmission straight through a pane, all echoes inside it added as powers (no coherence).

    `passes` keeps that many echoes.
    """
    lost = ((index - 1) / (index + 1)) ** 2  # Fresnel at normal incidence
    through = turn(distance + (index - 1) * thickness, freq_hz) * (1 - lost) ** 2
    return through * series(lost**2 * turn(2 * index * thickness, freq_hz), passes)


def corner_one_bounce(at, *, edge, angle, albedo, size, height, freq_hz):
    """Light with one bounce seen at a point of the right wall of a corner, by adaptive quadrature.

    The corner is that of the scene `corner`: a vertical edge on the axis, walls that open towards
    the camera.
    """
    from scipy.integrate import dblquad

    half = np.radians(angle) / 2
    to, across = np.array([-np.sin(half), -np.cos(half)]), np.array([np.cos(half), -np.sin(half)])
    mine = np.array([-np.cos(half), 0.0, -np.sin(half)])

    def integrand(y, along, part):
        # Source point on the left wall; `across` is its normal in the plane of x and z.
        x, z = along * to[0], edge + along * to[1]
        lit = np.sqrt(x * x + y * y + z * z)
        dx, dy, dz = x - at[0], y - at[1], z - at[2]
        far = np.sqrt(dx * dx + dy * dy + dz * dz)
        cos_lit = -(x * across[0] + z * across[1]) / lit
        cos_out = -(dx * across[0] + dz * across[1]) / far
        cos_in = (dx * mine[0] + dz * mine[2]) / far
        value = albedo * cos_lit / lit**2 * cos_out * cos_in / (np.pi * far**2)
        angle_rad = float(path_to_phase(lit + far + np.linalg.norm(at), freq_hz))
        return value * part(angle_rad)

    options = {"epsabs": 1e-9, "epsrel": 1e-9}
    parts = [
        dblquad(integrand, 0, size, -height / 2, height / 2, args=(part,), **options)[0]
        for part in (np.cos, np.sin)
    ]
    return albedo * complex(*parts)


# A path tracer that can be read in one go: rectangles, diffuse, light at the camera.


def quads_of(world):
    """Rectangles (Q, 3, 3) as corner and two sides, and their albedos, of a world of such."""
    square = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [-1, 1, 0, 1.0]])
    found, albedos = [], []
    for entry in world.description.values():
        pose = np.asarray(entry["to_world"], np.float64)
        for corners in [square] if entry["type"] == "rectangle" else _cube_faces():
            placed = (corners @ pose.T)[:, :3]
            found.append([placed[0], placed[1] - placed[0], placed[2] - placed[0]])
            albedos.append(entry["bsdf"]["bsdf"]["reflectance"])
    return np.array(found), np.array(albedos)


def _cube_faces():
    """Three corners (3, 4) of each face of the cube from -1 to 1."""
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners = np.ones((3, 4))
            corners[:, axis] = side
            corners[:, (axis + 1) % 3] = [-1, 1, -1]
            corners[:, (axis + 2) % 3] = [-1, -1, 1]
            yield corners


def nearest(quads, origins, directions):
    """Distance (N,) and number (N,) of the first rectangle along every ray; inf and 0 for none."""
    best, which = np.full(len(origins), np.inf), np.zeros(len(origins), int)
    for number, (corner, side_a, side_b) in enumerate(quads):
        normal = np.cross(side_a, side_b)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (corner - origins) @ normal / (directions @ normal)
            at = origins + far[:, None] * directions - corner
        a, b = at @ side_a / (side_a @ side_a), at @ side_b / (side_b @ side_b)
        with np.errstate(invalid="ignore"):
            hit = (far > 1e-9) & (far < best) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        best[hit], which[hit] = far[hit], number
    return best, which


def slow_paths(quads, albedos, directions, freqs_hz, *, bounces, rng):
    """One path per direction: phasors (bounces + 1, F, N) by number of indirect bounces."""
    found = np.zeros((bounces + 1, len(freqs_hz), len(directions)), np.complex128)
    origins, carried = np.zeros_like(directions), np.ones(len(directions))
    length = np.zeros(len(directions))
    for bounce in range(bounces + 1):
        far, which = nearest(quads, origins, directions)
        carried = np.where(np.isfinite(far), carried * albedos[which], 0.0)
        far = np.where(np.isfinite(far), far, 0.0)
        origins, length = origins + far[:, None] * directions, length + far
        normals = np.cross(quads[which, 1], quads[which, 2])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
        home = np.linalg.norm(origins, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            back = -origins / home[:, None]
            cosine = (normals * back).sum(axis=1)
            clear = nearest(quads, origins, np.nan_to_num(back))[0] >= home * (1 - 1e-9)
            light = np.where(clear & (cosine > 0) & (carried > 0), carried * cosine / home**2, 0.0)
        for i, freq in enumerate(freqs_hz):
            found[bounce, i] = light * turn(length + home, freq)
        directions = _cosine(normals, rng)
    return found


def _cosine(normals, rng):
    """Directions with a density of cosine / pi around normals."""
    away = rng.standard_normal(normals.shape)
    away = normals * (1 + 1e-12) + away / np.linalg.norm(away, axis=1, keepdims=True)
    return away / np.linalg.norm(away, axis=1, keepdims=True)
