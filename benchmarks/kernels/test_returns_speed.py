"""Kernels that take several returns apart, per pixel, beside their readable twins."""

import numpy as np
import pytest
import reference_heide
import reference_jimenez
import reference_spectral as spectral
import test_feigin2016
import test_jimenez2014
from reference_two_returns import cauchy_twin, ratio_twin, two_twin
from test_heide2013 import HUBER

from toftools.correct import _heide_fit, godbaz2012_cauchy, godbaz2012_ratio
from toftools.correct._heide_solver import problem, transients
from toftools.correct._jimenez_fit import misfit
from toftools.correct._spectral_moments import pisarenko
from toftools.correct.bhandari2014 import pursue
from toftools.registry import CORRECTIONS, find
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import range_to_phase

N = 320 * 240
FIVE = "20e6+40e6+60e6+80e6+100e6"


def planted(freqs_hz, n=N, *, noise=0.01, seed=0):
    """Phasors (F, n) of two returns with noise."""
    rng = np.random.default_rng(seed)
    first, apart, ratio = (rng.uniform(*of, n) for of in ((0.5, 2), (0.5, 1.0), (0.2, 0.8)))
    k = range_to_phase(1.0, np.asarray(freqs_hz))[:, None]
    z = np.exp(1j * k * first) + ratio * np.exp(1j * k * (first + apart))
    return z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))


def each(run, z, n):
    return lambda: [run(z[:, p]) for p in range(n)]


def test_ratio(beside):
    z = planted([40e6, 80e6])
    beside("godbaz2012_ratio", lambda: godbaz2012_ratio.separate(z, np.ones(z.shape)), many=N,
           twin=("Pisarenko's method", each(lambda p: ratio_twin(*p), z, 100)),
           few=100)  # fmt: skip


def test_cauchy(beside):
    freqs = np.array([20e6, 40e6, 60e6, 80e6])
    z, k = planted(freqs), range_to_phase(1.0, freqs)
    beside("godbaz2012_cauchy",
           lambda: godbaz2012_cauchy.separate(z, np.ones(z.shape), k[0], k[0], 1), many=N,
           twin=("Prony's method", each(cauchy_twin, z, 100)), few=100)  # fmt: skip


def test_dorrington(beside):
    text = "kinect2_nominal:width=160,height=120"
    freqs = sensor(text).modulation.freqs_hz
    z, k = planted(freqs, 160 * 120), range_to_phase(1.0, freqs)
    frame = Phasors(z.reshape(-1, 120, 160).astype(np.complex64))
    run = find(CORRECTIONS, "dorrington2011").build(sensor(text))
    beside("dorrington2011, whole", lambda: run(frame), many=160 * 120,
           twin=("a general solver from a grid",
                 each(lambda p: two_twin(p, np.full(3, 0.01), k, 4.0, 2.5), z, 1)))  # fmt: skip


def test_pursuit(beside):
    freqs = [float(f) for f in FIVE.split("+")]
    z, k, grid = planted(freqs, 9600), range_to_phase(1.0, np.array(freqs)), np.arange(0, 7.4, 0.05)
    noise, angle = np.ones(z.shape), k[:, None] * grid
    tables = [f(angle).astype(np.float32) for f in (np.cos, np.sin)]
    beside("bhandari2014, pursuit", lambda: pursue(z, noise, k, grid, *tables, 3), many=9600,
           twin=("dense least squares",
                 each(lambda p: spectral.pursuit(p, noise[:, 0], k, grid, 3), z, 50)),
           few=50)  # fmt: skip


def test_pisarenko(beside):
    c = planted([20e6, 40e6, 60e6, 80e6], 19200)
    beside("peters2015_pisarenko, measure", lambda: pisarenko(c), many=19200,
           twin=("dense eigenvectors", each(spectral.pisarenko, c, 100)), few=100)  # fmt: skip


def test_feigin(beside):
    device = sensor(f"deeptof:freqs={FIVE},width=160,height=120")
    z = planted(device.modulation.freqs_hz, 160 * 120)
    frame = Phasors(z.reshape(-1, 120, 160).astype(np.complex64))
    run = CORRECTIONS["feigin2016"].build(device)
    beside("feigin2016, whole", lambda: run(frame), many=160 * 120,
           twin=("SVD and roots", each(lambda p: test_feigin2016.twin(p, 2), z, 100)),
           few=100)  # fmt: skip


def test_heide(beside):
    freqs = np.arange(10e6, 170e6, 10e6)
    task = problem(freqs, 6.0, 0.003, cyclic=False)
    z = planted(freqs, 512)
    parts = np.concatenate([z.real, z.imag]).astype(np.float32) / 4
    matrix, wide = task.adjoint.T.astype(np.float64), parts.astype(np.float64)

    def twin():
        reference_heide.transient(matrix, wide[:, 0], task.weight, HUBER, cyclic=False)

    beside("heide2013, transients, 60 iterations", lambda: transients(parts, task, 60), many=512,
           twin=("L-BFGS-B to the minimum", twin))  # fmt: skip


def test_jimenez(beside):
    task = test_jimenez2014.task_of(test_jimenez2014.TWO, 400)
    x_m = 0.01 * np.random.default_rng(0).standard_normal(task.nodes.range_m.size)
    n = x_m.size
    beside("jimenez2014, objective and gradient", lambda: misfit(task, x_m), many=n**2,
           twin=("objective alone, matrices", lambda: reference_jimenez.objective(task, x_m)),
           few=n**2, unit="pairs of nodes")  # fmt: skip


def test_heide_fit(beside):
    k = range_to_phase(1.0, np.arange(10e6, 170e6, 10e6))
    truth = np.array([1.0, 2.0, 0.5, 6.0])
    z = reference_heide.model(truth, k, 2, decay=False) + 0.01
    start = truth + 0.03
    p, normal = np.zeros(2 * _heide_fit.MOST + 2), np.empty((2 * _heide_fit.MOST + 2,) * 2)

    def kernel():
        for _ in range(100):
            p[:4] = start
            _heide_fit.fit(z, np.ones(k.size), k, 2, False, p, normal)

    beside("heide2013, fit of two returns", kernel, many=100,
           twin=("scipy's least squares",
                 lambda: reference_heide.fit(z, k, start, 2, decay=False)))  # fmt: skip


WHOLE = {
    "auto": "kinect2_nominal:width=160,height=120",
    "gupta2015": "phasor_imaging:width=160,height=120",
    "two_returns": "kinect2_nominal:width=160,height=120",
    "kirmani2013": f"deeptof:freqs={FIVE},width=160,height=120",
    "bhandari2014": f"deeptof:freqs={FIVE},width=160,height=120",
    "bhandari2014_annihilating": f"deeptof:freqs={FIVE},width=160,height=120",
    "peters2015": f"deeptof:freqs={FIVE},width=160,height=120",
    "heide2013": "heide2013:width=32,height=24",
}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_method(beside, name):
    device = sensor(WHOLE[name])
    height, width = device.camera.shape
    z = planted(device.modulation.freqs_hz, height * width).reshape(-1, height, width)
    frame = Phasors(z.astype(np.complex64), np.full(z.shape, 0.01, np.float32))
    run = CORRECTIONS[name].build(device)
    freqs = f"{device.modulation.n_freqs} frequencies"
    beside(f"{name}, whole, {freqs}", lambda: run(frame), many=height * width)
