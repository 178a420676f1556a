"""Correlation functions: harmonics against the waves in time, wiggling against its closed form."""

import numpy as np
import pytest

from toftools.phasor import SCHEMES, demodulation_weights
from toftools.sensors import sensor
from toftools.sim.noise import clean_taps, light_freqs_hz
from toftools.sim.waveform import (
    correlation_harmonics,
    measured_harmonics,
    pulse_coefficients,
    with_waveform,
)

FREQ_HZ = 20e6


def wave(turns, duty, rise):
    """Trapezoid pulse of height 1 centred on 0, at times in turns: what the coefficients say."""
    away = np.abs((np.asarray(turns) + 0.5) % 1 - 0.5)
    return np.clip((duty / 2 + rise / 2 - away) / max(rise, 1e-12), 0, 1)


def correlated(phase, steps, duty, rise, n=200_000):
    """Slow twin: taps (K, P) as the mean over time of light times a square reference."""
    t = (np.arange(n) + 0.5) / n
    references = [wave(t - step / (2 * np.pi), 0.5, 0.0) for step in steps]
    taps = np.empty((steps.size, phase.size))
    for p, angle in enumerate(phase):
        light = wave(t - angle / (2 * np.pi), duty, rise)
        taps[:, p] = [np.mean(light * reference) for reference in references]
    return taps


def one_row(device, phase):
    """Taps (K, P) of pixels that see one return each, at the given phases, charge 1000."""
    device_freq = device.modulation.freqs_hz[0]
    light = lambda freq_hz: 1000 * np.exp(1j * phase * freq_hz / device_freq)[None]  # noqa: E731
    return clean_taps(light, 0.0, device)[0, :, 0]


def phase_error(taps, steps, phase):
    """Demodulated minus true phase, rad; taps (K, P)."""
    z = np.einsum("k,kp->p", demodulation_weights(steps), taps)
    return np.angle(z * np.exp(-1j * phase))


def aliased(harmonics, n_taps, phase):
    """Closed form of what K taps make of harmonics: those of m = 1 and m = -1 modulo K."""
    z = np.zeros(phase.shape, complex)
    for m, weight in enumerate(harmonics, start=1):
        if m % n_taps == 1:
            z += weight * np.exp(1j * m * phase)
        if m % n_taps == n_taps - 1:
            z += np.conj(weight) * np.exp(-1j * m * phase)
    return np.angle(z * np.exp(-1j * phase))


def device_of(scheme, waveform, **keys):
    extra = "".join(f",{key}={value}" for key, value in keys.items())
    return sensor(f"deeptof:width=720,height=1,steps={scheme},waveform={waveform}{extra}")


PHASE = np.linspace(0, 2 * np.pi, 720, endpoint=False)


@pytest.mark.parametrize(("duty", "rise"), [(0.5, 0.0), (0.5, 0.2), (0.3, 0.0), (0.4, 0.4)])
def test_pulse_coefficients_are_those_of_the_wave_in_time(duty, rise):
    n = 1 << 16
    sampled = np.fft.rfft(wave((np.arange(n) + 0.5) / n, duty, rise))
    sampled *= np.exp(-1j * np.pi * np.arange(sampled.size) / n)  # samples lie half a step late
    have = pulse_coefficients(40, duty=duty, rise=rise)
    # A step edge falls between two samples: an area of up to 1 / n at either edge.
    assert np.abs((sampled / sampled[0])[1:41] - have).max() < 4 / n / duty


@pytest.mark.parametrize(
    ("scheme", "peak_deg"),
    [("four_step", 4.0746), ("three_step", 1.1170), ("eight_step", 0.4594)],
)
def test_square_waves_wiggle_by_the_aliasing_sum(scheme, peak_deg):
    few, steps = device_of(scheme, "square"), SCHEMES[scheme]
    many = with_waveform(few, "square", n_harmonics=2001).modulation.harmonics[0]
    fine = np.linspace(0, np.pi / 2, 4001)
    # Harmonics decay as 1 / m^2: those beyond 2001 sum to less than the last digit.
    assert np.degrees(np.abs(aliased(many, steps.size, fine)).max()) == pytest.approx(
        peak_deg, abs=6e-5
    )
    wiggle = phase_error(one_row(few, PHASE), steps, PHASE)
    assert np.allclose(wiggle, aliased(few.modulation.harmonics[0], steps.size, PHASE), atol=1e-12)
    left_out = wiggle - aliased(many, steps.size, PHASE)
    assert np.degrees(np.abs(left_out).max()) < 0.07  # as waveform.N_HARMONICS says


@pytest.mark.parametrize("scheme", ["three_step", "four_step", "eight_step", "ab_four_step"])
@pytest.mark.parametrize(
    "keys",
    [{}, {"duty": 0.3}, {"rise": 0.25}, {"duty": 0.4, "rise": 0.3}],
    ids=["square", "short", "slow", "short_slow"],
)
def test_wiggling_is_that_of_the_waves_correlated_in_time(scheme, keys):
    steps, phase = SCHEMES[scheme], PHASE[5:365:45]
    shape = {"duty": 0.5, "rise": 0.0, **keys}
    slow = phase_error(correlated(phase, steps, **shape), steps, phase)
    device = with_waveform(device_of(scheme, "square"), "square", n_harmonics=2001, **shape)
    z = np.einsum("k,kp->p", demodulation_weights(steps), one_row(device, phase_row(phase)))
    fast = np.angle(z[: phase.size] * np.exp(-1j * phase))
    # The twin's edges lie within 1 / 200 000 of a turn; harmonics beyond 2001 are smaller.
    assert np.abs(fast - slow).max() < 2e-5
    assert np.abs(slow).max() > 2e-4  # there is something to compare


def phase_row(phase):
    return np.resize(phase, 720)


def test_a_third_of_a_period_of_light_has_no_third_harmonic():
    third = device_of("four_step", "square", duty=1 / 3).modulation.harmonics[0]
    assert abs(third[2]) < 1e-15
    steps = SCHEMES["four_step"]
    wiggle = phase_error(one_row(device_of("four_step", "square", duty=1 / 3), PHASE), steps, PHASE)
    assert np.degrees(np.abs(wiggle).max()) < 4.0  # half a period makes 4.07


def test_the_phase_of_the_first_harmonic_is_the_origin():
    light, reference = pulse_coefficients(9, rise=0.2), pulse_coefficients(9)
    late = light * np.exp(-1j * np.arange(1, 10) * 0.7)
    assert np.allclose(correlation_harmonics(late, reference),
                       correlation_harmonics(light, reference), atol=1e-14)  # fmt: skip
    with pytest.raises(ValueError, match="no first harmonic"):
        correlation_harmonics([0.0, 1.0], [1.0, 1.0])


def test_engines_are_asked_for_every_harmonic_in_use():
    device = sensor("opt8241:waveform=square,freqs=20e6+60e6")
    asked = []

    def light(freq_hz):
        asked.append(freq_hz)
        return np.ones(device.camera.shape, complex)

    clean_taps(light, 0.0, device)
    assert sorted(set(asked)) == light_freqs_hz(device).tolist()
    assert light_freqs_hz(device)[:4].tolist() == [0.0, 20e6, 60e6, 100e6]
    assert light_freqs_hz(device).size == 1 + 16 + 16 - 5  # m = 3, 9, 15, 21, 27 are 60e6's 1 .. 9


def skewed(phase):
    """A lopsided correlation: harmonics 1, 2 and 4 with phases of their own."""
    return (
        300 + 100 * np.cos(phase - 0.4) + 12 * np.cos(2 * phase + 1.0) + 3 * np.cos(4 * phase - 2.0)
    )


EXACT = np.array([1, 0.12 * np.exp(1j * (1.0 + 2 * 0.4)), 0, 0.03 * np.exp(1j * (-2.0 + 4 * 0.4))])


@pytest.mark.parametrize("kind", ["csv", "txt", "npy"])
def test_a_measured_correlation_becomes_harmonics(kind, tmp_path):
    rng = np.random.default_rng(5)
    phase = rng.permutation(np.linspace(-1, 2 * np.pi - 1, 90, endpoint=False))
    phase += rng.uniform(-0.01, 0.01, phase.size)
    table = np.stack([phase, skewed(phase)], axis=1)
    path = tmp_path / f"c.{kind}"
    if kind == "npy":
        np.save(path, table)
    else:
        comma = ", " if kind == "csv" else "\t"
        rows = [comma.join(map(repr, row)) for row in table.tolist()]
        path.write_text(f"phase{comma}value\n# a comment\n\n" + "\n".join(rows))
    device = sensor(f"deeptof:width=720,height=1,waveform={path}")
    assert np.allclose(device.modulation.harmonics, EXACT, atol=1e-9)
    # Its taps are the measured function, but for offset, scale and origin.
    taps = one_row(device, PHASE)[0]
    contrast = device.noise.contrast
    assert np.allclose(taps, 1000 * (1 + contrast * (skewed(PHASE + 0.4) - 300) / 100), rtol=1e-9)


def test_measured_harmonics_take_what_the_phases_determine():
    phase = np.linspace(0, 2 * np.pi, 9, endpoint=False)
    assert measured_harmonics(np.stack([phase, skewed(phase)], 1)).size == 4
    with pytest.raises(ValueError, match="do not determine a harmonic"):
        measured_harmonics(np.stack([phase / 40, skewed(phase / 40)], 1))
    with pytest.raises(ValueError, match="no first harmonic"):
        measured_harmonics(np.stack([phase, np.ones(9)], 1))
    with pytest.raises(ValueError, match="do not determine a harmonic"):
        measured_harmonics(np.stack([phase[:2], phase[:2]], 1))


HOSTILE = {
    "empty": b"",
    "one row": b"0,1\n",
    "three columns": b"0,1,2\n1,2,3\n",
    "words": b"a,b\nc,d\n",
    "nan": b"0,1\n1,nan\n2,3\n",
    "infinite": b"0,1\n1,1e999\n2,3\n",
    "binary": bytes(range(256)) * 4,
    "npy cut": b"\x93NUMPY\x01\x00v\x00{'descr': '<f8'",
    "npy huge": b"\x93NUMPY\x01\x00\x46\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 2), }\n".ljust(70),
    "npy object": b"\x93NUMPY\x01\x00\x46\x00"
    + b"{'descr': '|O', 'fortran_order': False, 'shape': (3, 2), }\n".ljust(70),
    "huge": b"0,1\n" * (1 << 19),
    "huge integers": b"0,1\n" + b"9" * 5000 + b",1\n2,2",
    "all the same": b"0,1\n0,1\n0,1\n0,1\n",
}


@pytest.mark.parametrize("key", ["waveform", "beam"])
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_tables_are_refused_in_one_sentence(name, key, tmp_path):
    path = tmp_path / "c.csv"
    path.write_bytes(HOSTILE[name])
    with pytest.raises(ValueError, match=r"^[^\n]{10,400}$"):
        sensor(f"deeptof:{key}={path}")


def test_missing_files_and_unknown_waveforms_are_named():
    with pytest.raises(ValueError, match=r"no_such\.csv is no table of phase .*: no such file"):
        sensor("deeptof:waveform=no_such.csv")
    with pytest.raises(ValueError, match="unknown waveform 'saw'; known: sine, square, trapezoid"):
        sensor("deeptof:waveform=saw")
    with pytest.raises(ValueError, match="duty shape a square or trapezoid waveform, got"):
        sensor("deeptof:duty=0.3")
    for keys in ("duty=0", "duty=1.5", "rise=-0.1", "rise=0.6"):
        with pytest.raises(ValueError, match="wanted 0 < duty < 1 and 0 <= rise"):
            sensor(f"deeptof:waveform=trapezoid,{keys}")


def test_a_contrast_that_the_waveform_cannot_have_is_refused():
    # A triangle between 0 and 2 has 8 / pi^2 = 0.81 in its first harmonic.
    device = device_of("four_step", "square", contrast=0.95)
    with pytest.raises(ValueError, match=r"makes taps of this waveform negative.*at most 0\.82"):
        one_row(device, PHASE)
    one_row(device_of("four_step", "square", contrast=0.81), PHASE)
    one_row(device_of("four_step", "sine", contrast=1.0), PHASE)
