"""Owen-scrambled Sobol points in Dr.Jit: low-discrepancy numbers, a fresh set for every pixel.

Points are the first four dimensions of Sobol's sequence; more dimensions are padded with sets that
are shuffled and scrambled anew, which keeps every set stratified and all sets independent. Seeds
make replicates, whose spread tells the error. Counts that are powers of two are the ones that are
stratified in full.

References
----------
B. Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020: the Laine-Karras hash as a
nested uniform scramble (listing 2 there; its constants are those of N. Vegdahl, 2021, recalled).
S. Joe and F. Kuo, SIAM J. Sci. Comput. 30, 2008: initial direction numbers of dimensions 3 and 4.
"""

from typing import Any

Jit = Any
"""A Dr.Jit array; the package has no types."""

MAX_POINTS = 1 << 16
"""Points of one sequence; what is asked beyond them repeats."""
_VEGDAHL = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)


def pair(mi: Any, index: Jit, seed: Jit, half: Jit) -> Jit:  # noqa: ANN401 - the module mitsuba
    """Two of the four coordinates of a point of a scrambled and shuffled sequence.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    index : UInt32
        Number of the point in its sequence, below 65536.
    seed : UInt32
        Which sequence.
    half : UInt32
        0 for the first two coordinates, 1 for the last two.

    Returns
    -------
    Point2f
        Point in the unit square.
    """
    import drjit as dr

    # Shuffles the order, but keeps every power of two together.
    index = nested_scramble(index, seed) & (MAX_POINTS - 1)
    late = half == 1
    first = dr.select(late, _by_columns(mi, index, _THIRD), dr.brev(index))
    second = dr.select(late, _by_columns(mi, index, _FOURTH), _sobol_second(index))
    return mi.Point2f(
        _unit(mi, nested_scramble(first, hashed(mi, seed ^ 0xA511E9B3 + half))),
        _unit(mi, nested_scramble(second, hashed(mi, seed ^ 0x63D83595 + half))),
    )


def single(mi: Any, index: Jit, seed: Jit) -> Jit:  # noqa: ANN401
    """Point number `index` of a scrambled and shuffled van der Corput sequence.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    index : UInt32
        Number of the point in its sequence.
    seed : UInt32
        Which sequence.

    Returns
    -------
    Float
        Number in [0, 1).
    """
    import drjit as dr

    shuffled = nested_scramble(index, seed)
    return _unit(mi, nested_scramble(dr.brev(shuffled), hashed(mi, seed ^ 0xA511E9B3)))


def hashed(mi: Any, x: Jit) -> Jit:  # noqa: ANN401
    """Hash of a 32-bit number (the output function of a PCG generator).

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    x : UInt32
        Number.

    Returns
    -------
    UInt32
        Hash.
    """
    state = x * mi.UInt32(747796405) + mi.UInt32(2891336453)
    word = ((state >> ((state >> 28) + 4)) ^ state) * mi.UInt32(277803737)
    return (word >> 22) ^ word


def nested_scramble(x: Jit, seed: Jit) -> Jit:
    """Nested uniform (Owen) scramble of the bits of `x`, most significant first.

    Parameters
    ----------
    x : UInt32
        Numbers as 32-bit fractions.
    seed : UInt32
        Which scramble.

    Returns
    -------
    UInt32
        A bit flips depending on the seed and on the bits above it only.
    """
    import drjit as dr

    x = dr.brev(x) + seed
    for constant in _VEGDAHL:
        x = x ^ (x * constant)
    return dr.brev(x)


def _sobol_second(index: Jit) -> Jit:
    """Second dimension of Sobol's sequence: the bits of the index through Pascal's triangle."""
    import drjit as dr

    # Multiplying the bits by Pascal's matrix modulo 2, in five strides instead of 32 columns.
    x = index
    for shift, mask in (
        (16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555),
    ):  # fmt: skip
        x = x ^ ((x >> shift) & mask)
    return dr.brev(x)


def _columns(initial: tuple[int, ...], polynomial: int) -> tuple[int, ...]:
    """Direction numbers as 32-bit fractions, from the first ones and a primitive polynomial.

    Bit ``degree - 1 - k`` of `polynomial` is its coefficient of ``x^(degree - k)``, the outer two
    coefficients left out.
    """
    degree = len(initial)
    found = [number << (31 - i) for i, number in enumerate(initial)]
    for i in range(degree, MAX_POINTS.bit_length() - 1):
        number = found[i - degree] ^ (found[i - degree] >> degree)
        for k in range(1, degree):
            if polynomial >> (degree - 1 - k) & 1:
                number ^= found[i - k]
        found.append(number)
    return tuple(found)


_THIRD, _FOURTH = _columns((1, 3), 1), _columns((1, 3, 1), 1)


def _by_columns(mi: Any, index: Jit, columns: tuple[int, ...]) -> Jit:  # noqa: ANN401
    """One dimension of Sobol's sequence from its direction numbers."""
    import drjit as dr

    bits = dr.zeros(mi.UInt32, dr.width(index))
    for place, column in enumerate(columns):
        bits = bits ^ dr.select(index & (1 << place) != 0, mi.UInt32(column), 0)
    return bits


def _unit(mi: Any, bits: Jit) -> Jit:  # noqa: ANN401
    """The upper 24 bits as a float in [0, 1)."""
    return mi.Float(bits >> 8) * mi.Float(2.0**-24)
