"""Slow readable twins of the light-transport fits: float64, all pairs as matrices, no numba."""

import numpy as np

from toftools.units import path_to_phase


def transfer(position, normal, area_m2):
    """Form factors (N, N), receiver by sender, and distances (N, N), m."""
    way = position[:, None, :] - position[:, :, None]  # (3, receiver, sender)
    far = np.sqrt((way**2).sum(axis=0) + 1e-12)
    cos_in = np.maximum(np.einsum("ki,kij->ij", normal, way), 0)
    cos_out = np.maximum(-np.einsum("kj,kij->ij", normal, way), 0)
    return cos_in * cos_out * area_m2 / (far**2 * (np.pi * far**2 + area_m2)), far


def seen_light(position, normal, area_m2, albedo, flash, freqs_hz):
    """Phasors (F, N) of diffuse patches lit by a flash at the camera: all bounces, solved."""
    factors, far = transfer(position, normal, area_m2)
    home = np.linalg.norm(position, axis=0)
    shown = []
    for own, freq in zip(flash, freqs_hz, strict=True):
        lit = own * np.exp(1j * path_to_phase(home, freq))
        sent = np.exp(1j * path_to_phase(far, freq)) * factors
        radiosity = np.linalg.solve(np.eye(home.size) - albedo[:, None] * sent, albedo * lit)
        shown.append(radiosity * np.exp(1j * path_to_phase(home, freq)))
    return np.array(shown)


def objective(task, x_m):
    """The objective J of `toftools.correct._jimenez_fit`."""
    here = task.nodes
    d = here.range_m + x_m
    position = here.patches.position.astype(np.float64) + here.ray.astype(np.float64) * x_m
    normal = here.patches.normal.astype(np.float64)
    area = here.patches.area_m2.astype(np.float64) * (d / here.range_m) ** 2
    factors, far = transfer(position, normal, area)
    total = 0.0
    model = np.zeros_like(here.light)
    for f, freq in enumerate(task.freqs_hz):
        measured = here.light[f] * np.exp(1j * path_to_phase(2 * here.range_m, freq))
        sent = measured * np.exp(-1j * path_to_phase(d, freq))
        arrived = (factors * np.exp(1j * path_to_phase(far, freq))) @ sent
        flash = here.flash[f] * (here.range_m / d) ** 2 * np.exp(1j * path_to_phase(d, freq))
        shown = (flash + arrived) * np.exp(1j * path_to_phase(d, freq))
        model[f] = shown * np.exp(-1j * path_to_phase(2 * here.range_m, freq))
    for u in range(d.size):  # the albedo of least squares, not below zero
        weight, m, z = task.weight[:, u], model[:, u], here.light[:, u]
        albedo = max((weight * (np.conj(m) * z).real).sum() / (weight * abs(m) ** 2).sum(), 0)
        total += 0.5 * (weight * abs(albedo * m - z) ** 2).sum()
    for (a, b), bond in zip(here.pairs.T, task.bond, strict=True):
        total += 0.5 * bond * (x_m[a] - x_m[b]) ** 2
    return total


def slope_of(task, x_m, step_m=1e-6):
    """Gradient of the objective by central differences; it has kinks where patches turn away."""
    gradient = np.empty_like(x_m)
    for i in range(x_m.size):
        step = np.zeros_like(x_m)
        step[i] = step_m
        gradient[i] = (objective(task, x_m + step) - objective(task, x_m - step)) / (2 * step_m)
    return gradient


def corner_frame(sensor, albedos, *, edge_m=1.6, angle_deg=90.0):
    """A corner that fills the view, with all bounces: range (H, W), albedo, phasors (F, H, W).

    `albedos` are those of the left and the right wall, or an image.
    """
    from toftools.correct._scene import lit, optics, surface
    from toftools.sim.shapes import corner

    big = {"range": edge_m, "angle": angle_deg, "size": 50.0, "height": 100.0}
    range_m = corner(sensor.camera, **big).range_m.astype(np.float32)
    view = optics(sensor)
    seen = surface(view, range_m)
    shape = range_m.shape
    albedo = np.asarray(albedos, np.float64)
    if albedo.ndim == 1:
        albedo = np.where(seen.position[0] < 0, albedo[0], albedo[1])
    flat = [a.reshape(*a.shape[:-2], -1) for a in (seen.position, seen.normal, seen.area_m2)]
    flash = lit(view, seen).reshape(len(view.freqs_hz), -1)
    light = seen_light(*(a.astype(np.float64) for a in flat), albedo.ravel(), flash, view.freqs_hz)
    return range_m, albedo, light.reshape(-1, *shape)
