"""Owen-scrambled Sobol points against scipy, a slow twin in whole numbers, and their own claims."""

import numpy as np
import pytest

from toftools._native import import_mitsuba
from toftools.sim import _sobol

WORD = 0xFFFFFFFF
SEEDS = (0, 1, 12345, 0xDEADBEEF)


@pytest.fixture(scope="module")
def mi():
    return import_mitsuba()


# The slow twin: one number at a time, as integers of Python


def reverse(x):
    return int(f"{x:032b}"[::-1], 2)


def slow_hash(x):
    state = (x * 747796405 + 2891336453) & WORD
    word = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & WORD
    return (word >> 22) ^ word


def slow_scramble(x, seed):
    x = (reverse(x) + seed) & WORD
    for constant in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= (x * constant) & WORD
    return reverse(x)


def slow_columns():
    """Direction numbers of the first four dimensions after Joe and Kuo: s, a and m_i."""
    table = [None, (1, 0, [1]), (2, 1, [1, 3]), (3, 1, [1, 3, 1])]
    columns = [[1 << (31 - i) for i in range(32)]]
    for degree, a, initial in table[1:]:
        m = list(initial)
        for i in range(degree, 32):
            new = m[i - degree] ^ (m[i - degree] << degree)
            for k in range(1, degree):
                new ^= ((a >> (degree - 1 - k)) & 1) * (m[i - k] << k)
            m.append(new)
        columns.append([number << (31 - i) for i, number in enumerate(m)])
    return columns


COLUMNS = slow_columns()


def slow_sobol(index, dimension):
    bits = 0
    for i in range(16):
        if index >> i & 1:
            bits ^= COLUMNS[dimension][i]
    return bits


def slow_pair(index, seed, half):
    index = slow_scramble(index, seed) & 0xFFFF
    bits = [slow_sobol(index, 2 * half + i) for i in (0, 1)]
    keys = [slow_hash(seed ^ 0xA511E9B3 + half), slow_hash(seed ^ 0x63D83595 + half)]
    return [(slow_scramble(b, k) >> 8) * 2.0**-24 for b, k in zip(bits, keys, strict=True)]


def slow_single(index, seed):
    bits = reverse(slow_scramble(index, seed))
    return (slow_scramble(bits, slow_hash(seed ^ 0xA511E9B3)) >> 8) * 2.0**-24


def pairs(mi, count, seed, half, start=0):
    import drjit as dr

    index = dr.arange(mi.UInt32, count) + start
    point = _sobol.pair(mi, index, mi.UInt32(seed), mi.UInt32(half))
    return np.array(point, np.float64).T


def singles(mi, count, seed):
    import drjit as dr

    return np.array(_sobol.single(mi, dr.arange(mi.UInt32, count), mi.UInt32(seed)), np.float64)


def four(mi, count, seed):
    return np.hstack([pairs(mi, count, seed, half) for half in (0, 1)])


@pytest.mark.parametrize("seed", SEEDS)
def test_kernels_equal_the_slow_twin(mi, seed):
    x = np.random.default_rng(seed).integers(0, 1 << 32, 200, dtype=np.uint32)
    numbers = [int(i) for i in x]
    assert np.array_equal(
        np.array(_sobol.hashed(mi, mi.UInt32(x))), [slow_hash(i) for i in numbers]
    )
    scrambled = np.array(_sobol.nested_scramble(mi.UInt32(x), mi.UInt32(seed)))
    assert np.array_equal(scrambled, [slow_scramble(i, seed) for i in numbers])
    for half in (0, 1):
        assert np.array_equal(
            pairs(mi, 300, seed, half), [slow_pair(i, seed, half) for i in range(300)]
        )
    assert np.array_equal(singles(mi, 300, seed), [slow_single(i, seed) for i in range(300)])


def test_unscrambled_columns_are_those_of_scipy(mi):
    import drjit as dr
    from scipy.stats import qmc

    count = 1 << 12
    index = dr.arange(mi.UInt32, count)
    ours = [dr.brev(index), _sobol._sobol_second(index)]
    ours += [_sobol._by_columns(mi, index, c) for c in (_sobol._THIRD, _sobol._FOURTH)]
    ours = np.stack([np.array(bits) for bits in ours], axis=1) * 2.0**-32
    theirs = qmc.Sobol(4, scramble=False, bits=30).random_base2(12)
    # scipy walks in Gray-code order: the same points in another order.
    assert {tuple(row) for row in ours} == {tuple(row) for row in theirs}
    slow = [[slow_sobol(i, d) * 2.0**-32 for d in range(4)] for i in range(100)]
    assert np.array_equal(ours[:100], slow)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("power", [1, 4, 8])
def test_every_prefix_of_a_power_of_two_is_stratified(mi, seed, power):
    count = 1 << power
    points = four(mi, count, seed)
    for column in (*points.T, singles(mi, count, seed)):
        assert np.array_equal(np.sort(np.floor(column * count)), np.arange(count))
    for k in range(power + 1):  # elementary boxes 2^-k by 2^(k - power): one point each
        boxes = np.floor(points[:, :2] * [1 << k, 1 << (power - k)])
        assert len({tuple(b) for b in boxes}) == count


def test_scrambling_keeps_how_all_four_dimensions_are_stratified(mi):
    """Counts of points in elementary boxes are those of the plain sequence, in another order."""
    from scipy.stats import qmc

    power = 8
    plain, ours = qmc.Sobol(4, scramble=False).random_base2(power), four(mi, 1 << power, 99)
    for shape in ((2, 2, 2, 2), (1, 3, 1, 3), (0, 4, 4, 0), (0, 0, 4, 4), (4, 0, 2, 2)):
        cells = 2 ** np.array(shape)
        counts = [
            np.unique(np.ravel_multi_index(np.floor(p * cells).astype(int).T, cells),
                      return_counts=True)[1]
            for p in (plain, ours)
        ]  # fmt: skip
        assert np.array_equal(np.sort(counts[0]), np.sort(counts[1])), shape


def test_the_scramble_is_nested(mi):
    """Whether a bit flips depends on the bits above it, and on the seed, alone."""
    rng = np.random.default_rng(3)
    x = rng.integers(0, 1 << 32, 500, dtype=np.uint32)
    for keep in (0, 1, 7, 20, 31):
        mask = np.uint32(WORD ^ (WORD >> keep))
        other = (x & mask) | (rng.integers(0, 1 << 32, 500, dtype=np.uint32) & ~mask)
        flips = [
            np.array(_sobol.nested_scramble(mi.UInt32(v), mi.UInt32(77))) ^ v for v in (x, other)
        ]
        same = np.uint32(WORD ^ (WORD >> (keep + 1)))  # the flip of the next bit is settled too
        assert np.array_equal(flips[0] & same, flips[1] & same)


def test_points_are_uniform_over_seeds(mi):
    """First point of many sequences: moments of a uniform number, and no correlation."""
    count = 1 << 16
    seeds = mi.UInt32(np.arange(count, dtype=np.uint32))
    keys = _sobol.hashed(mi, seeds)
    columns = []
    for half in (0, 1):
        point = _sobol.pair(mi, mi.UInt32(5), keys, mi.UInt32(half))
        columns += list(np.array(point, np.float64))
    # The tracer gives single numbers a seed of their own; under the same one they are the pair's.
    columns.append(np.array(_sobol.single(mi, mi.UInt32(5), keys ^ 0x55), np.float64))
    for column in columns:
        for power, variance in ((1, 1 / 12), (2, 4 / 45), (3, 9 / 112)):
            z = ((column**power).mean() - 1 / (power + 1)) / np.sqrt(variance / count)
            assert abs(z) < 4
        hits = np.bincount((column * 256).astype(int), minlength=256)
        chi2 = ((hits - count / 256) ** 2).sum() / (count / 256)
        assert abs(chi2 - 255) < 4 * np.sqrt(2 * 255)
    together = np.corrcoef(columns) - np.eye(5)
    assert np.abs(together).max() < 4.5 / np.sqrt(count)


def test_replicates_are_independent_and_better_than_chance(mi):
    """Errors of an integral under successive seeds: no bias, no correlation, less than random."""
    import drjit as dr

    count, seeds = 64, 4096
    lane = dr.arange(mi.UInt32, count * seeds)
    points = _sobol.pair(mi, lane % count, _sobol.hashed(mi, lane // count), mi.UInt32(0))
    points = np.array(points, np.float64).T.reshape(seeds, count, 2)
    means = np.cos(3 * points.sum(axis=2)).mean(axis=1)
    exact = ((np.exp(3j) - 1) / 3j) ** 2
    error = means - exact.real
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(seeds)
    for lag in (1, 2, 7):
        together = np.corrcoef(error[:-lag], error[lag:])[0, 1]
        assert abs(together) < 4 / np.sqrt(seeds)
    random = np.cos(3 * np.random.default_rng(0).random((seeds, count, 2)).sum(axis=2)).mean(axis=1)
    assert error.std() < 0.1 * random.std()
