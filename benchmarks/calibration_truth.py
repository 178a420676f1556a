"""What a fit should find: the planted errors in the gauge of the fitted stages.

A camera measures ``psi = theta + w(theta)``, ``theta = phi + kappa + g``, for light of phase phi,
the amplitude error g being one of the measured amplitude and of ``phi + g``. A chain writes
``psi - phi = W(psi) + kappa' + S(A, phi')`` with S = 0 at its reference amplitude; so W and kappa'
are those of light that measures just that amplitude at every phase. No fit is involved.
"""

import numpy as np

from toftools.sim._rig_wiggling import _response

N = 4096
ROUNDS = 8


def forward(unit, f, measured, phi):
    """Measured phase of light of phases phi (N,) at a measured amplitude, pattern aside."""
    n = unit.nominal.modulation.n_freqs
    level, g = np.full((n, phi.size), float(measured)), np.zeros(phi.size)
    for _ in range(ROUNDS):
        g = unit.amplitude_error_rad(np.broadcast_to(phi + g, level.shape), level)[f]
    theta = phi + unit.common_rad[f] + g
    z = _response(unit.sensor, np.broadcast_to(theta, level.shape))[0][f]
    return theta + np.angle(z * np.exp(-1j * theta))


def cyclic(unit, f, reference):
    """Wiggling at the reference amplitude over measured phase: cosines, sines, and the mean."""
    phi = np.arange(N) * (2 * np.pi / N)
    psi = forward(unit, f, reference, phi)
    turns = np.concatenate([psi - 2 * np.pi, psi, psi + 2 * np.pi])
    curve = np.interp(phi, turns, np.tile(psi - phi, 3))
    wave = np.fft.rfft(curve) / N
    return 2 * wave[1:].real, -2 * wave[1:].imag, wave[0].real


def curve_at(cos, sin, psi, orders=64):
    """Value of the first harmonics at phases psi (N,)."""
    turn = np.arange(1, orders + 1)[:, None] * psi
    return cos[:orders] @ np.cos(turn) + sin[:orders] @ np.sin(turn)


def surface(unit, f, reference, measured, phi):
    """S at a measured amplitude: the phases that it is looked up at, and its values there."""
    cos, sin, mean = cyclic(unit, f, reference)
    psi = forward(unit, f, measured, phi)
    corrected = psi - curve_at(cos, sin, psi) - mean
    return corrected, corrected - phi
