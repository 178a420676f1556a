"""The preview of a capture: right figures in its maps, and a picture for every kind of capture."""

import io

import numpy as np
import pytest
from PIL import Image

from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Capture, DepthMap, Phasors, Scene, Shot, Taps, Truth
from toftools.viz.preview import WIDTH_PX, _maps, preview_png

DEVICE = sensor("opt8241:width=24,height=18")


def shot(scene="two_returns", device=DEVICE, **params):
    return analytic(Scene(scene, params))(Shot(device, noisy=False))


def maps_of(capture):
    return {shown.title.split(",")[0].split(" (")[0]: shown for shown in _maps(capture)}


def test_maps_show_the_figures_that_they_name():
    capture = shot(range=2.0, extra=0.5, ratio=0.25)
    maps = maps_of(capture)
    assert list(maps) == [
        "amplitude at 40 MHz", "measured range", "true range", "measured - true range",
        "light that came indirectly", "sigma of range from sensor noise",
    ]  # fmt: skip
    amplitude = np.abs(capture.phasors.values[0])
    assert np.allclose(maps["amplitude at 40 MHz"].image, amplitude)
    # Two returns with moduli 1 to 0.25: a fifth of the light.
    assert np.allclose(maps["light that came indirectly"].image, 20, atol=0.1)
    error = maps["measured - true range"]
    wanted = maps["measured range"].image - capture.truth.range_m
    factor = {"m": 1, "cm": 100, "mm": 1000}[error.title.split(", ")[1].split(" ")[0]]
    assert np.allclose(error.image, factor * wanted, atol=1e-3)
    assert error.low == -error.high
    assert np.abs(error.image).max() <= 1.2 * error.high
    layers = [capture.truth.direct, 0.2j * capture.truth.direct, 0.05j * capture.truth.direct]
    split = Truth(capture.truth.range_m, *layers)
    told = maps_of(Capture(DEVICE, taps=capture.taps, truth=split))
    assert np.allclose(told["light that came indirectly"].image, 20)  # 0.25 to 1


def test_wraps_do_not_hide_multipath():
    capture = shot("wall")
    depth_m = np.full((18, 24), 2.01, np.float32)
    depth_m[:9] += 3.75
    made = Capture(DEVICE, depth=DepthMap(depth_m), truth=Truth(capture.truth.range_m))
    error = maps_of(made)["measured - true range"]
    assert "cm" in error.title
    assert error.high < 100


def captures():
    yield "one frequency", shot("cavity", sensor("deeptof:width=9,height=7"))
    yield "taps in DN", shot("wall", sensor("opt8241:width=9,height=7,adc_bits=10"))
    yield "edge of a corner", shot("corner", range=6.0)  # pixels that see nothing
    whole = shot("wall")
    yield "no truth", Capture(DEVICE, taps=whole.taps)
    yield "phasors alone", Capture(DEVICE, phasors=Phasors(whole.phasors.values))
    yield "a depth alone", Capture(DEVICE, depth=DepthMap(np.full((18, 24), 1.5)))
    yield "darkness", Capture(DEVICE, taps=Taps(np.zeros((2, 4, 18, 24))))
    nothing = Truth(np.full((18, 24), np.nan), np.zeros((2, 18, 24)))
    yield "nothing there", Capture(DEVICE, taps=whole.taps, truth=nothing)
    yield (
        "no valid pixel",
        Capture(
            DEVICE, taps=Taps(whole.taps.values, valid=np.zeros((18, 24), bool)), truth=whole.truth
        ),
    )
    yield "a strip", shot("wall", sensor("opt8241:width=200,height=2"))
    yield "one pixel", shot("wall", sensor("opt8241:width=1,height=1"))


@pytest.mark.parametrize(("name", "capture"), list(captures()), ids=[n for n, _ in captures()])
def test_every_capture_has_a_preview(name, capture):
    image = Image.open(io.BytesIO(preview_png(capture, title=name)))
    assert image.width == WIDTH_PX
    assert np.asarray(image.convert("L")).std() > 1, "blank"
