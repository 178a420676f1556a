"""Subpixel corners by least squares: two blurred edges that cross, fitted to the pixels around.

Model around a corner c: ``I(p) = (1 + g . d) (m + a E1 E2)``, d = p - c,
``E = erf(n . d / (sqrt 2 s))``, n the normals of the two edges, s the blur, g the fall-off of the
light across the window. All nine numbers of all corners are found together by damped Gauss-Newton.
Apart from the light, the model is the same turned by half a turn about c, so a monotone change of
brightness (gamma) hardly moves c. Fails below about 5 px a square, where the window holds too few
pixels, and under glare: such corners are reported as lost.
"""

import math

import numpy as np

from toftools._arrays import F32, F64, Bool

STEPS, STILL_PX = 15, 5e-4
REACH = 0.7
"""Radius of the window in squares: within it there is one crossing only."""
MOST_PX = 10
LEAST_PX = 2.2
AWAY = 0.35
"""Squares that a corner may move from where it was found."""
BLUR_PX = (0.25, 4.0)


def crossing(image: F32, corners: F64, along: F64, reach: float = REACH) -> tuple[F64, Bool]:
    """Corners moved to where the two edges cross.

    Parameters
    ----------
    image : ndarray, (H, W)
        Brightness, best with noise of one size everywhere (the square root of an amplitude).
    corners : ndarray, (N, 2)
        First guess, px.
    along : ndarray, (N, 2, 2)
        Steps to the next corner along columns and along rows of the board, px, as rows.
    reach : float
        Radius of the window in squares.

    Returns
    -------
    corners : ndarray, (N, 2)
        Corners; where the fit failed, the first guess.
    good : ndarray, (N,), bool
        Where it did not fail.
    """
    spacing = np.linalg.norm(along, axis=2).min(axis=1)
    radius = np.clip(reach * spacing, LEAST_PX, MOST_PX)
    values, offsets, weights = _window(image, corners, radius)
    theta = _start(values, along, weights)
    theta = _fitted(theta, values, offsets, weights)
    moved = theta[:, 4:6]
    contrast = np.abs(theta[:, 3])
    good = (
        (np.linalg.norm(moved, axis=1) < np.minimum(AWAY * spacing, radius))
        & np.isfinite(theta).all(axis=1)
        & (contrast > 0.25 * np.median(contrast))
    )
    return np.where(good[:, None], corners + moved, corners), good


def _window(image: F32, corners: F64, radius: F64) -> tuple[F64, F64, F64]:
    """Pixels around every corner (N, M), their offsets from it (N, M, 2), and weights (N, M)."""
    half = math.ceil(float(radius.max())) + 1
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    base = np.round(corners).astype(int)
    u, v = base[:, :1] + dx, base[:, 1:] + dy
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
    values = image[np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)]
    offsets = np.stack([u, v], axis=-1) - corners[:, None]
    far = np.linalg.norm(offsets, axis=2)
    weights = np.clip(radius[:, None] + 0.5 - far, 0, 1) * inside
    return values.astype(np.float64), offsets, weights


def _start(values: F64, along: F64, weights: F64) -> F64:
    """First nine numbers: mean, light (2), contrast, shift (2), angles (2), log of the blur."""
    theta = np.zeros((len(values), 9))
    total = np.maximum(weights.sum(axis=1), 1e-9)
    theta[:, 0] = (values * weights).sum(axis=1) / total
    theta[:, 6:8] = np.arctan2(along[:, :, 1], along[:, :, 0]) + math.pi / 2
    theta[:, 8] = math.log(0.8)
    return theta


def _fitted(theta: F64, values: F64, offsets: F64, weights: F64) -> F64:
    damping = np.full(len(theta), 1e-2)
    theta = _with_linear(theta, values, offsets, weights)
    residual, by = _model(theta, values, offsets)
    cost = (weights * residual**2).sum(axis=1)
    for _ in range(STEPS):
        weighted = by * weights[:, :, None]
        across = weighted.transpose(0, 2, 1)
        normal, right = across @ by, (across @ residual[:, :, None])[:, :, 0]
        diagonal = np.diagonal(normal, axis1=1, axis2=2)
        scale = np.sqrt(np.maximum(diagonal, 1e-12))
        scaled = normal / (scale[:, :, None] * scale[:, None, :])
        scaled += (damping[:, None] + 1e-9)[:, :, None] * np.eye(9)
        step = np.linalg.solve(scaled, (right / scale)[:, :, None])[:, :, 0] / scale
        trial = theta + step
        trial[:, 8] = np.clip(trial[:, 8], *np.log(BLUR_PX))
        residual_then, by_then = _model(trial, values, offsets)
        cost_then = (weights * residual_then**2).sum(axis=1)
        better = cost_then < cost
        theta = np.where(better[:, None], trial, theta)
        residual = np.where(better[:, None], residual_then, residual)
        by = np.where(better[:, None, None], by_then, by)
        cost = np.where(better, cost_then, cost)
        damping = np.where(better, damping / 5, damping * 5)
        still = np.abs(step[:, 4:6]).max(axis=1) < STILL_PX
        if (still | (damping > 1e6)).all():
            break
    return theta


def _with_linear(theta: F64, values: F64, offsets: F64, weights: F64) -> F64:
    """Contrast from the data, for the edges as they are."""
    _, by = _model(theta, values, offsets)
    cross = by[:, :, 3]
    level = values - theta[:, :1]
    top = (weights * cross * level).sum(axis=1)
    out = np.array(theta)
    out[:, 3] = top / np.maximum((weights * cross**2).sum(axis=1), 1e-12)
    return out


def _model(theta: F64, values: F64, offsets: F64) -> tuple[F64, F64]:
    """Measured minus modelled brightness (N, M), and the derivatives of the model (N, M, 9)."""
    from scipy.special import erf

    mean, slope, contrast = theta[:, :1], theta[:, None, 1:3], theta[:, 3:4]
    d = offsets - theta[:, None, 4:6]
    blur = np.exp(theta[:, 8:9])
    scale = 1 / (math.sqrt(2) * blur)
    edges, slopes, normals, turned = [], [], [], []
    for k in (6, 7):
        cos, sin = np.cos(theta[:, k : k + 1]), np.sin(theta[:, k : k + 1])
        q = (cos * d[:, :, 0] + sin * d[:, :, 1]) * scale
        edges.append(erf(q))
        slopes.append(2 / math.sqrt(math.pi) * np.exp(-q * q))
        normals.append((cos * scale, sin * scale, q))
        turned.append((cos * d[:, :, 1] - sin * d[:, :, 0]) * scale)
    product = edges[0] * edges[1]
    paper = mean + contrast * product
    light = 1 + (slope * d).sum(axis=2)
    model = paper * light
    first, second = contrast * edges[1] * slopes[0], contrast * edges[0] * slopes[1]
    (ax, ay, aq), (bx, by_, bq) = normals
    derivatives = [
        light,
        d[:, :, 0] * paper,
        d[:, :, 1] * paper,
        product * light,
        -slope[:, :, 0] * paper - (first * ax + second * bx) * light,
        -slope[:, :, 1] * paper - (first * ay + second * by_) * light,
        first * turned[0] * light,
        second * turned[1] * light,
        -(first * aq + second * bq) * light,
    ]
    return values - model, np.stack(derivatives, axis=-1)
