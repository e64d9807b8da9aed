"""Random numbers as a pure function of (key, number): every environment has a key, every draw of a step a number.

A number is the finalizer of SplitMix64 (Steele, Lea and Flood 2014) of the sum of both, themselves its values. Nothing
is carried from draw to draw, so that loops over environments run in parallel lanes, and what an environment draws does
not depend on the others.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Products and sums are not fused: what is drawn does not depend on the processor.
drawing = njit(cache=True, nogil=True, error_model="numpy")

# Constants of SplitMix64: the golden ratio, shifts and multipliers.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
S1, M1 = np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)
S2, M2 = np.uint64(27), np.uint64(0x94D049BB133111EB)
S3 = np.uint64(31)
# Twelve bits of a float64 are sign and exponent; these are the exponents of [1, 2).
SPARE, ONE = np.uint64(12), np.uint64(0x3FF0000000000000)
# The two lowest bits of a number, which fractions leave out, choose a quarter of the circle.
QUARTER, SIGN_BIT, SIGN = np.uint64(1), np.uint64(62), np.uint64(1 << 63)
# The bits of sqrt(1/2): a float64 is split into a power of two and a rest in [sqrt(1/2), sqrt(2)).
ROOT_HALF, FRACTION_BITS = np.int64(0x3FE6A09E667F3BCD), np.int64(52)
LOG_2 = float(np.log(2.0))
# Squares at the edge of a truncation are pulled in by a few roundings.
EDGE = 1.0 - 4e-15
# A sum of squares below this counts as zero.
SMALLEST_SQUARE = 1e-300


@njit(inline="always", error_model="numpy")
def _mixed(z):
    """Returns the finalizer of SplitMix64."""
    z = (z ^ (z >> S1)) * M1
    z = (z ^ (z >> S2)) * M2
    return z ^ (z >> S3)


@njit(inline="always", error_model="numpy")
def _fraction(z):
    """Returns the upper 52 bits as an odd multiple of 2^-53 in (0, 1)."""
    return np.uint64((z >> SPARE) | ONE).view(np.float64) - (1.0 - 2.0**-53)


@njit(inline="always", error_model="numpy")
def _minus_log(x):
    """Returns -log(x) for a normal x in (0, 1], to a few roundings: a polynomial of fdlibm after the exponent."""
    bits = np.float64(x).view(np.int64)
    exponent = (bits - ROOT_HALF) >> FRACTION_BITS
    m = np.int64(bits - (exponent << FRACTION_BITS)).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    tail = 1.479819860511658591e-01
    tail = tail * q + 1.531383769920937332e-01
    tail = tail * q + 1.818357216161805012e-01
    tail = tail * q + 2.222219843214978396e-01
    tail = tail * q + 2.857142874366239149e-01
    tail = tail * q + 3.999999999940941908e-01
    tail = tail * q + 6.666666666666735130e-01
    return -(2.0 * s + s * q * tail + exponent * LOG_2)


@njit(inline="always", error_model="numpy")
def _sine(t):
    """Returns sin(t) for |t| <= pi/4 to a few roundings, by a polynomial of fdlibm."""
    q = t * t
    tail = 1.58969099521155010221e-10
    tail = tail * q - 2.50507602534068634195e-08
    tail = tail * q + 2.75573137070700676789e-06
    tail = tail * q - 1.98412698298579493134e-04
    tail = tail * q + 8.33333333332248946124e-03
    tail = tail * q - 1.66666666666666324348e-01
    return t + t * q * tail


@njit(inline="always", error_model="numpy")
def _cosine(t):
    """Returns cos(t) for |t| <= pi/4 to a few roundings, by a polynomial of fdlibm."""
    q = t * t
    tail = -1.13596475577881948265e-11
    tail = tail * q + 2.08757232129817482790e-09
    tail = tail * q - 2.75573143513906633035e-07
    tail = tail * q + 2.48015872894767294178e-05
    tail = tail * q - 1.38888888888741095749e-03
    tail = tail * q + 4.16666666666666019037e-02
    return 1.0 - 0.5 * q + q * q * tail


@drawing
def fill_keys(key, out):
    """Fills the keys of environments, shape (N,), from one number."""
    for e in range(out.size):
        out[e] = _mixed(_mixed(key) + GOLDEN * np.uint64(e))


@drawing
def fill_stream(seed, out):
    """Fills `out`, shape (rows, N), with the numbers that SplitMix64 yields from a seed, uniform in (0, 1)."""
    for i in range(out.shape[0]):
        for e in range(out.shape[1]):
            out[i, e] = _fraction(_mixed(seed + GOLDEN * np.uint64(i * out.shape[1] + e + 1)))


def uniform_many(rng, rows, count):
    """Returns uniform numbers in (0, 1), shape (rows, count): `rng` gives the seed, which takes a third of the time."""
    out = np.empty((rows, count))
    fill_stream(np.uint64(rng.bit_generator.random_raw()), out)
    return out


@drawing
def fill_uniform(keys, number, rows, out):
    """Fills row i < `rows` of `out`, shape (>= rows, N), with draw `number` + i of each key, uniform in (0, 1)."""
    for i in range(rows):
        shift = _mixed(GOLDEN * np.uint64(number + i))
        for e in range(keys.size):
            out[i, e] = _fraction(_mixed(keys[e] + shift))


@drawing
def fill_normal(keys, number, share, most, out):
    """Fills `out`, shape (even, N), with standard normal numbers, draws `number`.. of each key, two rows at a time.

    A pair lies at an angle uniform in one of four quarters, and at a radius r with r^2 / 2 exponential (Box and Muller
    1958). A `share` below 1 keeps the smaller radii of this probability, and none is above sqrt(most).
    """
    for i in range(0, out.shape[0], 2):
        one, other = _mixed(GOLDEN * np.uint64(number + i)), _mixed(GOLDEN * np.uint64(number + i + 1))
        for e in range(keys.size):
            square = 2.0 * _minus_log(1.0 - share * _fraction(_mixed(keys[e] + one)))
            bits = _mixed(keys[e] + other)
            radius = np.float64(np.sqrt(min(square, most))).view(np.uint64)
            radius = np.uint64(radius ^ ((bits << SIGN_BIT) & SIGN)).view(np.float64)
            turn = (_fraction(bits) - 0.5) * (0.5 * np.pi)
            sine, cosine = radius * _sine(turn), radius * _cosine(turn)
            swapped = bits & QUARTER != np.uint64(0)
            out[i, e], out[i + 1, e] = sine if swapped else cosine, cosine if swapped else sine


@drawing
def normals(rank, count):
    """Returns room for `rank` rows of normal numbers, and one more where they are odd."""
    return np.empty((rank + rank % 2, count))


@drawing
def fill_truncated(keys, number, energy, rank, out):
    """Fills `rank` rows of `out` (see `normals`) with normal numbers whose sum of squares is at most `energy`."""
    if rank == 2:  # the radius of a pair is truncated at once
        fill_normal(keys, number, 1.0 - np.exp(-0.5 * energy), energy * EDGE, out)
        return
    fill_normal(keys, number, 1.0, np.inf, out)
    who, attempt = _beyond(out, rank, energy), np.uint64(0)
    while who.size > 0:  # draws anew, with other keys, where it is too much
        attempt += np.uint64(1)
        others, again = np.empty(who.size, np.uint64), normals(rank, who.size)
        for k in range(who.size):
            others[k] = _mixed(keys[who[k]] + GOLDEN * attempt)
        fill_normal(others, number, 1.0, np.inf, again)
        for i in range(rank):
            for k in range(who.size):
                out[i, who[k]] = again[i, k]
        who = who[_beyond(again, rank, energy)]


@drawing
def _squares(g, rank):
    """Returns the sum of squares of the first rows of each column, shape (N,)."""
    squares = np.zeros(g.shape[1])
    for i in range(rank):
        for e in range(squares.size):
            squares[e] += g[i, e] * g[i, e]
    return squares


@drawing
def _beyond(g, rank, energy):
    """Returns the columns of g whose sum of squares is above `energy`."""
    squares = _squares(g, rank)
    bad, count = np.empty(squares.size, np.int64), 0
    for e in range(squares.size):
        bad[count] = e
        count += not squares[e] <= energy
    return bad[:count]


@drawing
def fill_directions(keys, number, rank, out):
    """Fills `rank` rows of `out` (see `normals`) with uniform directions, of length 1."""
    fill_normal(keys, number, 1.0, np.inf, out)
    lengths = _squares(out, rank)
    for e in range(lengths.size):
        lengths[e] = 1.0 / np.sqrt(max(lengths[e], SMALLEST_SQUARE))
    for i in range(rank):
        for e in range(lengths.size):
            out[i, e] *= lengths[e]
