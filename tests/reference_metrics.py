"""Slow, plain twins of toftools.metrics: one pixel, one window, one threshold at a time."""

import math

import numpy as np

LOW_M, HIGH_M, FLOOR_M = 0.05, 50.0, 1e-3
SLOPE_UNIT, SEPARATION = 0.01, 8


def errors(truth_m, answer_m, mask):
    """Errors of the answered scored pixels, and the number of scored pixels."""
    found, scored = [], 0
    for v in range(truth_m.shape[0]):
        for u in range(truth_m.shape[1]):
            if mask[v, u] and math.isfinite(truth_m[v, u]):
                scored += 1
                if math.isfinite(answer_m[v, u]):
                    found.append(float(answer_m[v, u]) - float(truth_m[v, u]))
    return found, scored


def percentile(values, q):
    """Linear interpolation between order statistics."""
    ordered = sorted(values)
    place = q / 100 * (len(ordered) - 1)
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])


def scores(truth_m, answer_m, mask):
    """Every error metric of the registry, by name."""
    error, scored = errors(truth_m, answer_m, mask)
    size = [abs(e) for e in error]
    n = len(error)
    wanted = [
        float(t)
        for t, a, m in zip(truth_m.ravel(), answer_m.ravel(), mask.ravel(), strict=True)
        if m and math.isfinite(t) and math.isfinite(a)
    ]
    middle = math.fsum(wanted) / n
    result = {
        "bias_m": math.fsum(error) / n,
        "mae_m": math.fsum(size) / n,
        "rmse_m": math.sqrt(math.fsum(e * e for e in error) / n),
        "r2": 1 - math.fsum(e * e for e in error) / math.fsum((t - middle) ** 2 for t in wanted),
        "valid_share": n / scored,
        "wrap_share": sum(e > 0.5 for e in size) / n,
    }
    for name, q in (("median_m", 50), ("p25_m", 25), ("p75_m", 75), ("p95_m", 95)):
        result[name] = percentile(size, q)
    for name, limit in (("under_1cm", 0.01), ("under_2cm", 0.02), ("under_5cm", 0.05)):
        result[name] = sum(e < limit for e in size) / scored
    return result


def range_bin(x, step):
    """Bin of x = ln(range), the outermost ones open."""
    n = math.ceil((math.log(HIGH_M) - math.log(LOW_M)) / step)
    return min(max(math.floor((x - math.log(LOW_M)) / step), 0), n - 1), n


def slope_bin(d, step):
    """Bin of a difference of x, zero in the middle one."""
    n = math.ceil(math.asinh(1 / SLOPE_UNIT) / step)
    return min(max(round(math.asinh(d / SLOPE_UNIT) / step), -n), n) + n, 2 * n + 1


WINDOWS = {
    "range": [[(0, 0)]],
    "gradient_h": [[(0, 0), (0, 1)]],
    "gradient_v": [[(0, 0), (1, 0)]],
    "cooccurrence": [[(0, 0), (0, SEPARATION)], [(0, 0), (SEPARATION, 0)]],
    "haar_hv": [[(0, 0), (0, 1), (1, 0), (1, 1)]],
    "haar_hd": [[(0, 0), (0, 1), (1, 0), (1, 1)]],
}


def bins(name, x):
    """Bin per axis of one window with the values x, and the number of bins per axis."""
    if name == "range":
        return [range_bin(x[0], 0.05)]
    if name.startswith("gradient"):
        return [slope_bin(x[1] - x[0], 0.2)]
    if name == "cooccurrence":
        return [range_bin(x[0], 0.1), range_bin(x[1], 0.1)]
    a, b, c, d = x
    horizontal, vertical, diagonal = (a - b + c - d) / 2, (a + b - c - d) / 2, (a - b - c + d) / 2
    other = vertical if name == "haar_hv" else diagonal
    return [slope_bin(horizontal, 0.4), slope_bin(other, 0.4)]


def histogram(range_m, name, mask):
    """Shares of a depth statistic over all windows on finite pixels of the mask."""
    height, width = range_m.shape
    count, shape = {}, None
    for offsets in WINDOWS[name]:
        for v in range(height):
            for u in range(width):
                pixels = [(v + dv, u + du) for dv, du in offsets]
                if not all(
                    p < height and q < width and mask[p, q] and math.isfinite(range_m[p, q])
                    for p, q in pixels
                ):
                    continue
                x = [math.log(max(float(range_m[p, q]), FLOOR_M)) for p, q in pixels]
                found = bins(name, x)
                shape = tuple(n for _, n in found)
                where = tuple(i for i, _ in found)
                count[where] = count.get(where, 0) + 1
    result = np.zeros(shape)
    for where, number in count.items():
        result[where] = number / sum(count.values())
    return result


def dilate(marks):
    """Marked pixels and their eight neighbours."""
    height, width = marks.shape
    result = np.zeros_like(marks)
    for v, u in zip(*np.nonzero(marks), strict=True):
        result[max(v - 1, 0) : min(v + 2, height), max(u - 1, 0) : min(u + 2, width)] = True
    return result


def line_at(w0, w1, step):
    """Line through w0 at 0 and w1 at 1, taken at 1 + step."""
    return w1 + (w1 - w0) * step


def row_jumps(z_m, jump_m):
    """Gap pixels of one row between surfaces that do not meet inside the gap."""
    marks = [False] * len(z_m)
    for u in range(2, len(z_m) - 2):
        far_left, left, right, far_right = (1 / float(z_m[u + k]) for k in (-2, -1, 1, 2))
        miss_right = right - line_at(far_left, left, 2)
        miss_left = line_at(far_right, right, 2) - left
        if miss_left * miss_right > 0:
            scale = float(z_m[u - 1]) * float(z_m[u + 1])
            marks[u] = min(abs(miss_left), abs(miss_right)) * scale > jump_m
    return marks


def edges(z_m, jump_m):
    """Twin of find_edges."""
    marks = np.zeros(z_m.shape, dtype=bool)
    for v in range(z_m.shape[0]):
        marks[v] |= row_jumps(z_m[v], jump_m)
    for u in range(z_m.shape[1]):
        marks[:, u] |= row_jumps(z_m[:, u], jump_m)
    return dilate(marks)


def row_corners(xyz, focal_px, arm_m, turn_rad, jump_m):
    """Pixels of one row where the arms turn towards the camera."""
    z_m = xyz[:, 2]
    blocked = np.array(row_jumps(z_m, jump_m)) | ~np.isfinite(z_m)
    marks = [False] * len(z_m)
    for u in range(len(z_m)):
        if not math.isfinite(z_m[u]):
            continue
        n = max(2, math.ceil(arm_m * focal_px / z_m[u]))
        if u - n < 0 or u + n >= len(z_m) or blocked[u - n : u + n + 1].any():
            continue
        before, after = xyz[u] - xyz[u - n], xyz[u + n] - xyz[u]
        turn = math.atan2(np.linalg.norm(np.cross(before, after)), before @ after)
        concave = 1 / z_m[u] < (1 / z_m[u - n] + 1 / z_m[u + n]) / 2
        marks[u] = concave and turn > turn_rad
    return marks


def corners(xyz, K, arm_m, turn_rad, jump_m):
    """Twin of find_corners, from points (H, W, 3)."""
    marks = np.zeros(xyz.shape[:2], dtype=bool)
    for v in range(xyz.shape[0]):
        marks[v] |= row_corners(xyz[v], K[0, 0], arm_m, turn_rad, jump_m)
    for u in range(xyz.shape[1]):
        marks[:, u] |= row_corners(xyz[:, u], K[1, 1], arm_m, turn_rad, jump_m)
    return marks


def coverage(truth_m, answer_m, trust, limit_m):
    """Rows (coverage, mae, rmse, inlier, outlier, threshold), one per distinct trust."""
    scored = np.isfinite(truth_m)
    total = int(scored.sum())
    rows = []
    for threshold in sorted({float(t) for t in trust[scored & np.isfinite(answer_m)]})[::-1]:
        error, _ = errors(truth_m, np.where(trust >= threshold, answer_m, np.nan), scored)
        size = [abs(e) for e in error]
        right = sum(e < limit_m for e in size)
        rows.append(
            (
                len(size) / total,
                math.fsum(size) / len(size),
                math.sqrt(math.fsum(e * e for e in size) / len(size)),
                right / total,
                (len(size) - right) / total,
                threshold,
            )
        )
    return np.array(rows).T
