"""Slow readable twins of light transport in float64: the kernel, and scenes with all bounces."""

import numpy as np

from toftools.correct._scene import lit, optics, surface
from toftools.types import Phasors
from toftools.units import path_to_phase


def transfer(at, facing, from_, normal, area, freq_hz):
    """Irradiance at N receivers per radiosity of M emitters, (N, M) complex."""
    apart = from_.T[None] - at.T[:, None]  # (N, M, 3)
    r = np.linalg.norm(apart, axis=-1)
    r = np.where(r > 0, r, np.inf)
    cos_u = np.maximum(np.einsum("nmk,nk->nm", apart, facing.T) / r, 0)
    cos_v = np.maximum(-np.einsum("nmk,mk->nm", apart, normal.T) / r, 0)
    turn = np.exp(1j * path_to_phase(np.where(np.isfinite(r), r, 0), freq_hz))
    return cos_u * cos_v * area / (np.pi * r**2 + area) * turn


def all_bounces(sensor, range_m, albedo):
    """Phasors of a diffuse scene whose pixels are all its patches: the radiosity equation solved.

    Returns (F, H, W) of all light and of direct light.
    """
    view = optics(sensor)
    seen = surface(view, range_m)
    known = seen.known
    at, normal = (a[:, known].astype(float) for a in (seen.position, seen.normal))
    area, n = seen.area_m2[known].astype(float), int(known.sum())
    range_m = np.linalg.norm(at, axis=0)
    out = np.zeros((2, *lit(view, seen).shape), np.complex128)
    for f, freq_hz in enumerate(view.freqs_hz):
        flash = lit(view, seen)[f][known] * np.exp(1j * path_to_phase(range_m, freq_hz))
        system = np.eye(n) - albedo * transfer(at, normal, at, normal, area, freq_hz)
        to_camera = np.exp(1j * path_to_phase(range_m, freq_hz))
        out[0, f][known] = np.linalg.solve(system, albedo * flash) * to_camera
        out[1, f][known] = albedo * flash * to_camera
    return out


def corner_frame(sensor, albedo, *, noise=0.0, seed=0):
    """Truth, phasors with all bounces and direct ones of a right-angled corner 2 m away."""
    from toftools.camera import rays

    way = rays(sensor.camera)
    range_m = 2.0 / (way[..., 2] + np.abs(way[..., 0]))  # z = 2 - |x|
    both, direct = all_bounces(sensor, range_m.astype(np.float32), albedo)
    rng = np.random.default_rng(seed)
    mess = rng.standard_normal(both.shape) + 1j * rng.standard_normal(both.shape)
    sigma = np.full(both.shape, max(noise, 1e-3), np.float32)
    return range_m, Phasors((both + noise * mess).astype(np.complex64), sigma), direct
