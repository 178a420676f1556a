"""Response stage against planted patterns, curves, bad pixels; its kernel against a slow twin."""

from dataclasses import replace

import numpy as np
import pytest

from toftools.calib._response_kernel import linearise
from toftools.calib.chain import applied, chain_for, extended
from toftools.calib.response import DEAD, HOT, NOISY, Response, response
from toftools.calib.store import load_chain, save_chain
from toftools.conditions import Conditions, with_conditions
from toftools.registry import CALIBRATIONS
from toftools.sensors import sensor
from toftools.sim.defects import pixel_maps
from toftools.sim.noise import capture_taps
from toftools.types import Capture, Defects, PixelMaps, Taps

TWO_TAP = (
    "opt8241:width=48,height=36,freqs=40e6,prnu=0.03,dsnu_e=40,dark_e=300,read_e=20,dn_per_e=0.5,"
    "steps=ab_four_step,taps_per_exposure=2,ab_gain=0.1"
)
EXPOSURES = (0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9, 1.0)
FULL_E = 20_000


def shot(device, kind, exposure, seed, *, modulated=False, bend=0.0, shade=0.0):
    """One capture of even light; `bend` takes that share off a tap at 20,000 DN."""
    shape = device.camera.shape
    column = np.linspace(-1, 1, shape[1]) * np.ones(shape)
    charge = FULL_E * exposure * (1 + shade * column)
    light = charge * np.exp(1j * (1 + column)) if modulated else np.zeros(shape)
    rest = 0.0 if modulated else charge
    taps = capture_taps(lambda f: light if f else np.abs(light), rest, device, seed=seed)
    raw = taps.values.astype(np.float64)
    taps = Taps(np.float32(raw - bend * raw**2 / 20_000), taps.unit, taps.valid)
    nominal = replace(device, defects=Defects(), maps=None)
    told = Conditions(kind, exposure=exposure) if kind == "flat" else Conditions(kind)
    return with_conditions(Capture(nominal, taps=taps), told, file=f"{kind}_{seed}.h5")


def bench(device, exposures=EXPOSURES, *, repeats=2, **how):
    bend = {"bend": how["bend"]} if "bend" in how else {}
    darks = [shot(device, "dark", 0.0, seed, **bend) for seed in range(4)]
    flats = [shot(device, "flat", e, 10 + i, **how) for i, e in enumerate(exposures * repeats)]
    return [*darks, *flats]


def planted(device):
    """Dark level in DN and gain relative to the mean of node A, per node."""
    maps, defects = pixel_maps(device), device.defects
    nodes = device.timing.taps_per_exposure
    gain = maps.gain * np.array([1.0, 1 + defects.ab_gain])[:nodes, None, None]
    return maps.dark_e * device.noise.gain_dn_per_e, gain / gain[0].mean()


def scatter(error, sd):
    return float(np.sqrt(np.mean((np.asarray(error) / sd) ** 2)))


@pytest.mark.parametrize("modulated", [False, True], ids=["ambient", "modulated"])
def test_dark_levels_gains_and_noise_come_back_within_their_deviations(modulated):
    device = sensor(TWO_TAP)
    stage = response(bench(device, modulated=modulated))
    dark, gain = planted(device)
    assert 0.95 < scatter(stage.offset - dark, stage.offset_sd) < 1.05
    assert 0.93 < scatter(stage.gain - gain, stage.gain_sd) < 1.07
    assert np.median(stage.gain_sd) < 0.002  # planted spread: 0.03
    assert stage.gain[1].mean() / stage.gain[0].mean() == pytest.approx(1.1, abs=0.003)
    assert abs(stage.dn_per_e - 0.5) < 4 * stage.dn_per_e_sd < 0.02
    wanted = np.hypot(20, np.sqrt(pixel_maps(device).dark_e.mean()))  # dark charge has shot noise
    assert abs(stage.read_e - wanted) < 4 * stage.read_e_sd < 0.7
    assert not stage.bad.any()
    assert (stage.terms == 0).all()
    assert stage.curve.size == 2
    assert stage.residual.unit == "%"
    assert stage.residual.after < 1.1 * stage.residual.noise < 0.2 * stage.residual.before
    assert stage.residual.held_out < 1.15 * stage.residual.noise
    assert "no curve" in stage.residual.notes[1]


def test_a_companded_converter_needs_no_curve_and_hides_no_gain():
    device = sensor(TWO_TAP.replace("dn_per_e=0.5", "full_well_e=40000,companding=kinect2"))
    stage = response(bench(device))
    dark, gain = planted(device)
    assert stage.curve.size == 2  # its taps are numbers already, in steps that grow with the signal
    assert 0.93 < scatter(stage.gain - gain, stage.gain_sd) < 1.07
    assert 0.95 < scatter(stage.offset - dark, stage.offset_sd) < 1.05
    assert abs(stage.dn_per_e - device.noise.gain_dn_per_e) < 4 * stage.dn_per_e_sd
    wanted = np.hypot(20, np.sqrt(pixel_maps(device).dark_e.mean()))
    assert abs(stage.read_e - wanted) < 4 * stage.read_e_sd


@pytest.mark.parametrize("modulated", [False, True], ids=["ambient", "modulated"])
def test_a_bent_read_out_is_straightened(modulated):
    device = replace(sensor(TWO_TAP), name="bent")
    captures = bench(device, modulated=modulated, bend=0.08)
    stage = response(captures)
    top = stage.step * (stage.curve.size - 1)
    charge = np.linspace(0.02, 1, 50) * top
    raw = charge - 0.08 * charge**2 / 20_000
    scale = 1 - 0.08 * top_charge(top) / 20_000  # the curve meets raw numbers at the top
    linear = np.interp(raw, stage.step * np.arange(stage.curve.size), stage.curve)
    seen = raw <= top
    assert np.abs(linear / (scale * charge) - 1)[seen].max() < 0.001  # bent by 5 to 9 %
    assert (stage.terms_sd > 0).all()
    assert (np.diff(stage.curve) > 0).all()
    _, gain = planted(device)
    assert scatter(stage.gain - gain, stage.gain_sd) < 1.1
    straight = response(bench(device, modulated=modulated))
    assert stage.residual.held_out < 1.05 * straight.residual.held_out


def top_charge(top):
    """Charge that the bent read-out shows as `top`: q - 0.08 q^2 / 20000 = top."""
    return (1 - np.sqrt(1 - 4 * 0.08 / 20_000 * top)) / (2 * 0.08 / 20_000)


def test_bad_pixels_are_found_and_counted_and_no_others():
    device = sensor(TWO_TAP)
    maps = pixel_maps(device)
    dark, gain = np.array(maps.dark_e), np.array(maps.gain)
    dark[0, 3, 5] += 2000
    gain[1, 7, 9], gain[:, 20, 30] = 0.0, 0.5
    device = replace(device, maps=PixelMaps(gain, dark, maps.phase_rad))
    captures, rng = [], np.random.default_rng(0)
    for capture in bench(device):
        values = np.array(capture.taps.values)
        values[:, :, 11, 13] += rng.normal(0, 300, values.shape[:2])  # 30 times the read noise
        captures.append(replace(capture, taps=Taps(values, "DN", capture.taps.valid)))
    stage = response(captures)
    found = {tuple(map(int, at)): int(stage.bad[tuple(at)]) for at in np.argwhere(stage.bad)}
    assert set(found) == {(3, 5), (7, 9), (20, 30), (11, 13)}
    assert found[3, 5] & HOT
    assert found[7, 9] & DEAD
    assert found[20, 30] & DEAD
    assert found[11, 13] & NOISY
    assert stage.residual.notes[0].startswith("4 of 1728 pixels (0.23%) are bad: 1 hot, 2 dead")
    assert abs(stage.dn_per_e - 0.5) < 4 * stage.dn_per_e_sd
    out = stage(replace_valid(captures[-1]))
    assert (out.valid == (stage.bad == 0)).all()


def replace_valid(capture):
    from toftools.phasor import demodulate

    return demodulate(capture.taps, capture.sensor)


def test_applied_taps_are_even_and_carry_the_right_phase():
    device = sensor(
        TWO_TAP.replace("ab_four_step", "0+3.141592653589793+1.5707963267948966+4.71238898038469")
    )
    stage = response(bench(device))
    capture = shot(device, "flat", 0.8, 99, modulated=True)
    chain = extended(chain_for(capture.sensor), stage)
    after = applied(chain, capture)
    truth = 1 + np.linspace(-1, 1, 48)
    wrong = [np.angle(c.values[0] * np.exp(-1j * truth)) for c in (
        replace_valid(capture), after.phasors)]  # fmt: skip
    assert np.sqrt(np.mean(wrong[0] ** 2)) > 0.03  # A and B differ by 10 %, never swapped
    assert np.sqrt(np.mean(wrong[1] ** 2)) < 0.01  # noise alone: 0.0092
    level = after.taps.values.mean(axis=(0, 1))
    assert level.std() / level.mean() < 0.008
    assert after.provenance["calibrated"] == ["response"]


def test_saturated_taps_are_invalid_and_the_converter_says_where():
    device = sensor(TWO_TAP.replace("dn_per_e=0.5", "full_well_e=17000,adc_bits=12"))
    stage = response(bench(device, (0.1, 0.3, 0.5, 0.7), repeats=1))
    assert stage.saturation == 4095
    taps = np.full((1, 4, 36, 48), 1000, np.float32)
    taps[0, 2, 4, 4], taps[0, 1, 5, 5] = 4095, np.nan
    valid = stage.on_taps(Taps(taps, "DN")).valid
    assert not valid[4, 4]
    assert not valid[5, 5]
    assert valid.sum() == valid.size - 2
    assert response(bench(device, (0.1, 0.5), repeats=1), saturation=3000.0).saturation == 3000


def test_few_exposures_and_no_repeats_are_said():
    device = sensor(TWO_TAP)
    stage = response(bench(device, (0.5, 1.0), repeats=1, modulated=True))
    notes = " ".join(stage.residual.notes)
    assert "Linearity was not examined: flats have 2 exposures, wanted four." in notes
    assert "Conversion gain unknown" in notes
    assert np.isnan(stage.dn_per_e)
    lone = response(bench(device, (1.0,), repeats=1))
    assert np.isfinite(lone.dn_per_e)  # taps of one node repeat in light that is not modulated
    _, gain = planted(device)
    assert np.abs(lone.gain - gain).std() < 0.01
    shaded = response(bench(device, shade=0.2))
    assert any("lit unevenly: 11" in note for note in shaded.residual.notes)
    assert not shaded.bad.any()


def refused(captures, match):
    with pytest.raises(ValueError, match=match) as caught:
        response(captures)
    assert "\n" not in str(caught.value)


def test_bad_captures_are_refused_by_name():
    device = sensor(TWO_TAP)
    few = bench(device, (0.3, 0.6, 1.0), repeats=1)
    refused([c for c in few if "flat" in c.provenance["file"]], "needs a capture of kind dark, got")
    refused(few[:4], "needs a capture of kind flat, got dark; take an evenly lit")
    black = with_conditions(few[0], Conditions("flat", exposure=0.8), file="black.h5")
    refused([*few, black], r"^black.h5 is black: .* light it, or leave it out$")
    lit = with_conditions(few[-1], Conditions("dark"), file="lamp_on.h5")
    refused([*few, lit], "^lamp_on.h5 is not dark: cover the lens")
    bright = replace(few[-1], taps=Taps(few[-1].taps.values * 2, "DN", np.zeros((36, 48), bool)))
    bright = with_conditions(bright, Conditions("flat", exposure=1.0), file="bright.h5")
    refused([*few, bright], "^bright.h5 is saturated in 100% of its pixels; shorten its exposure")
    bare = replace(few[-1], taps=None, phasors=replace_valid(few[-1]))
    refused(
        [*few, with_conditions(bare, Conditions("flat"), file="bare.h5")], "^bare.h5 holds no taps"
    )
    other = shot(sensor(TWO_TAP.replace("width=48", "width=40")), "flat", 1.0, 5)
    refused([*few, with_conditions(other, Conditions("flat"), file="x.h5")], "40 x 36 px")


def test_two_taps_of_a_node_need_steady_light():
    device = sensor(
        TWO_TAP.replace("ab_four_step", "0+3.141592653589793+1.5707963267948966+4.71238898038469")
    )
    refused(bench(device, modulated=True), "flat_10.h5 is modulated, and 2 taps of a node do not")


def twin(taps, offset, inverse_gain, curve, step, limits, valid):
    nodes = offset.shape[0]
    out, good = taps.copy(), valid.copy()
    for t, y, x in np.ndindex(taps.shape):
        raw = float(taps[t, y, x])
        inside = np.isfinite(raw) and limits[0] <= raw < limits[1]
        good[y, x] &= inside and raw != limits[2]
        if not inside:
            continue
        i = min(max(int(np.floor(raw / step)), 0), curve.size - 2)
        value = curve[i] + (raw / step - i) * (curve[i + 1] - curve[i])
        out[t, y, x] = (value - offset[t % nodes, y, x]) * inverse_gain[t % nodes, y, x]
    return out, good


def test_kernel_equals_its_slow_twin():
    rng = np.random.default_rng(3)
    taps = rng.uniform(-50, 1100, (6, 7, 9)).astype(np.float32)
    taps[0, 0, 0], taps[3, 2, 2], taps[1, 4, 4] = np.nan, np.inf, 500
    offset = rng.normal(20, 5, (2, 7, 9)).astype(np.float32)
    inverse = rng.uniform(0.9, 1.1, (2, 7, 9)).astype(np.float32)
    curve = np.cumsum(rng.uniform(5, 15, 65)).astype(np.float32)
    slope = (np.diff(curve) / 16).astype(np.float32)
    intercept = (curve[:-1] - slope * 16 * np.arange(64)).astype(np.float32)
    rest = (16.0, (-40.0, 1080.0, 500.0), rng.random((7, 9)) > 0.2)
    got, good = linearise(taps, offset, inverse, intercept, slope, *rest)
    wanted, wanted_good = twin(taps, offset, inverse, curve, *rest)
    assert (good == wanted_good).all()
    assert np.allclose(got, wanted, rtol=1e-5, atol=1e-3, equal_nan=True)


def test_stage_is_saved_whole_and_hostile_fields_are_refused(tmp_path):
    device = sensor(TWO_TAP)
    captures = bench(device, (0.5, 1.0), repeats=1)
    stage = CALIBRATIONS["response"].build(captures)
    save_chain(tmp_path / "cal.json", extended(chain_for(captures[0].sensor), stage))
    again = load_chain(tmp_path / "cal.json").stage("response")
    assert isinstance(again, Response)
    assert (again.gain == stage.gain).all()
    assert again.saturation == stage.saturation
    with pytest.raises(ValueError, match="gain positive"):
        replace(stage, gain=-np.array(stage.gain))
    with pytest.raises(ValueError, match="bad must have shape"):
        replace(stage, bad=np.zeros((2, 2), np.int64))
    with pytest.raises(ValueError, match="the response is of 2 nodes"):
        stage.on_taps(Taps(np.zeros((1, 4, 5, 5))))
