"""The virtual rig against its own answers: without noise every capture is what was planted."""

import json
import math
from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest

from toftools.calib.board import DEFAULT, dark_at, parse_board
from toftools.calib.residuals import phase_error_rad, wrap_half
from toftools.camera import project, rays
from toftools.cli import main
from toftools.cli.rig import EPILOG
from toftools.conditions import KINDS, conditions_of, expected_range_m
from toftools.io.conditions import labelled, open_labelled, read_conditions
from toftools.phasor import demodulate, phase, phase_sigma_rad
from toftools.sensors import sensor
from toftools.sim._rig_boards import BOARD, pattern
from toftools.sim._rig_plan import PLANS, Plan, takes
from toftools.sim._rig_unit import unit_of
from toftools.sim.rig import FAULTLESS, Errors, exposed, parse_errors, rig, truth_of
from toftools.sim.shapes import tilted
from toftools.sim.target import charuco, chessboard, pixel_rays, plane, printed
from toftools.types import Capture
from toftools.units import path_to_phase, range_to_phase

SMALL = "opt8241:width=24,height=18"
FEW = Plan(4, 5, 2, 4, 1, 2, 3, (0.9, 1.5), 1, (0.1, 0.8), (0.8, 1.7))
"""A plan for tests: every kind, few of each."""


def small(text=SMALL, **noise):
    camera = sensor(text)
    return replace(camera, noise=replace(camera.noise, **noise))


def captures(errors, text=SMALL, **options):
    return dict(rig(small(text), errors, **{"plan": FEW, **options}))


def planes(errors, text=SMALL):
    """Every capture of a plane without noise, through a perfect lens calibration; its take."""
    unit = unit_of(errors, small(text))
    for take in takes(FEW, unit, seed=0):
        if take.conditions.kind in PLANES:
            capture = exposed(take, unit, None)
            camera = unit.sensor.camera
            yield take, replace(capture, sensor=replace(capture.sensor, camera=camera))


def of_kind(found, *kinds):
    return [c for c in found.values() if conditions_of(c).kind in kinds]


PLANES = ("rail", "delay", "wall", "gray", "warmup", "check")
ONLY = {
    "lens": {},
    "delay": {"delay_s": 0.4e-9},
    "offset": {"offset_rad": 0.1},
    "pattern": {"fppn_rad": 0.05},
    "sensor": {"sensor_rad_per_k": 2e-3},
    "light": {"light_rad_per_k": (2e-3, -1e-3)},
    "amplitude": {"amplitude_rad": 8e-3, "amplitude_bend_rad": 1e-3, "amplitude_wave_rad": 4e-3},
    "prnu": {"prnu": 0.02, "dsnu_e": 20.0, "dark_e": 200.0},
}


def left_rad(truth, capture):
    """Phase error that is left when every answer is taken off, in the order of a calibration."""
    told, curve = conditions_of(capture), truth.wiggling
    measured = phase(capture.phasors.values.astype(np.complex128))
    wave = [
        np.interp(layer, curve.phase_rad, error, period=2 * np.pi)
        for layer, error in zip(measured, curve.error_rad, strict=True)
    ]
    rest = measured - np.stack(wave) - truth.common_phase_rad[:, None, None]
    rest = rest - truth.fixed_pattern_rad
    rest = rest - truth.amplitude_error_rad(rest, np.abs(capture.phasors.values))
    drift = truth.sensor_rad_per_k * (told.sensor_c - truth.reference_sensor_c)
    drift = drift + truth.light_rad_per_k * (told.light_c - truth.reference_light_c)
    expected = range_to_phase(expected_range_m(capture), truth.freqs_hz[:, None, None])
    return wrap_half(rest - drift[:, None, None] - expected)


@pytest.mark.parametrize("name", [*ONLY, "all", "trapezoid"])
def test_with_all_answers_taken_off_a_plane_reads_its_range(name):
    errors = replace(FAULTLESS, focal=(0.02, 0.01), dist=(-0.1, 0.02, 1e-3, 0, 0))
    errors = replace(errors, **ONLY.get(name, {}))
    if name in ("all", "trapezoid"):
        errors = Errors(bad_share=0.0, prnu=0.0, waveform={"all": "square"}.get(name, name))
    truth = truth_of(errors, small())
    seen = set()
    for _, capture in planes(errors):
        assert np.abs(left_rad(truth, capture)).max() < 3e-6
        seen.add(conditions_of(capture).kind)
    assert seen == set(PLANES)


def test_common_phase_of_a_fit_that_calls_the_amplitude_error_of_walls_zero():
    errors = Errors(waveform="sine", bad_share=0.0, prnu=0.0, fppn_rad=0.0, amplitude_bend_rad=0.01)
    truth = truth_of(errors, small())
    walls = [c for _, c in planes(errors) if conditions_of(c).kind == "wall"]
    seen = np.mean([phase_error_rad(wall) for wall in walls], axis=(0, 2, 3))
    assert np.abs(truth.common_on(walls) - seen).max() < 1e-6
    assert np.abs(truth.common_on(walls) - truth.common_phase_rad).min() > 1e-4


@pytest.mark.parametrize("name", [name for name in ONLY if name != "prnu"])
def test_what_is_planted_is_there(name):
    plain = replace(FAULTLESS, focal=(0.02, 0.01), dist=(-0.1, 0.02, 1e-3, 0, 0))
    truth = truth_of(plain, small())
    errors = plain if name == "lens" else replace(plain, **ONLY[name])
    nominal = small().camera
    worst = 0.0
    for _, capture in planes(errors):
        if name == "lens":
            capture = replace(capture, sensor=replace(capture.sensor, camera=nominal))
        worst = max(worst, np.abs(left_rad(truth, capture)).max())
    assert worst > 0.01


@pytest.mark.parametrize(
    "text", [SMALL, "kinect2:width=16,height=12", "mlx75027:width=16,height=12",
             "opt8241:width=16,height=12,steps=ab_three_step,taps_per_exposure=2"]
)  # fmt: skip
def test_told_coefficients_are_those_of_the_curve_over_measured_phase(text):
    truth = truth_of(Errors(waveform="trapezoid"), small(text)).wiggling
    order = np.arange(1, truth.cos_rad.shape[1] + 1)
    waves = np.exp(-1j * np.outer(order, truth.phase_rad))
    c = 2 * np.einsum("np,fp->fn", waves, truth.error_rad) / truth.phase_rad.size
    assert np.abs(c.real - truth.cos_rad).max() < 1e-12
    assert np.abs(-c.imag - truth.sin_rad).max() < 1e-12
    assert np.abs(truth.error_rad.mean(axis=1)).max() < 1e-12
    assert np.abs(truth.error_rad).max() > 1e-3


def test_peak_of_square_waves_is_that_of_the_literature():
    # sim.waveform: 4.07 degrees for four taps, 1.12 for three
    four = truth_of(Errors(), small()).wiggling.error_rad
    three = truth_of(Errors(), small("kinect2_nominal:width=16,height=12")).wiggling.error_rad
    assert np.degrees(np.abs(four).max()) == pytest.approx(4.07, abs=0.02)
    assert np.degrees(np.abs(three).max()) == pytest.approx(1.12, abs=0.02)


@pytest.mark.parametrize("offset", ["0+0+0", "0.05+-0.02+0.01"])
def test_planes_agree_with_other_closed_forms_and_with_expected_range(offset):
    camera = small(f"deeptof:width=16,height=12,emitter={offset}")
    unit = unit_of(replace(FAULTLESS, dist=(-0.1, 0.02, 0, 0)), camera)
    for take in takes(FEW, unit, seed=4):
        if take.conditions.kind == "check":
            capture = exposed(take, unit, None)
            lens = replace(capture, sensor=replace(capture.sensor, camera=unit.sensor.camera))
            assert np.abs(phase_error_rad(lens)).max() < 2e-6
    turn = np.radians(25)
    ours = plane(rays(camera.camera), distance_m=1.7, normal=(-np.sin(turn), 0, -np.cos(turn)))
    theirs = tilted(camera.camera, range=1.7, tilt=25.0)
    assert np.abs(ours.range_m - theirs.range_m).max() < 1e-12
    assert np.abs(ours.phasor(3e7, 0) - theirs.phasor(3e7, 0)).max() < 1e-12


def a_view(camera, tilt_deg=40.0):
    """A tilted board in the middle of the image that leaves some of the wall behind."""
    turn = np.radians(tilt_deg)
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    return rotation, np.array([-0.1, -0.09, 0.42])


def test_a_print_is_the_complex_sum_over_its_rays():
    camera = small("opt8241:width=160,height=120").camera
    directions = pixel_rays(replace(camera, dist=np.array([-0.1, 0.02, 0, 0])), 4)
    rotation, origin = a_view(camera)
    lamp = np.array([0.03, 0.0, 0.01])
    view = printed(directions, pattern(), rotation=rotation, origin_m=origin, wall_m=2.0,
                   emitter_m=tuple(lamp))  # fmt: skip
    total = dict.fromkeys((4e7, 7e7, 2.1e9), 0)
    for ray in directions:
        facing = -rotation[:, 2]
        on_board = ray * ((origin @ facing) / (ray @ facing))[..., None]
        albedo, inside = pattern().at(*np.moveaxis((on_board - origin) @ rotation[:, :2], -1, 0))
        on_wall = ray * (2.0 / ray[..., 2])[..., None]
        point = np.where(inside[..., None], on_board, on_wall)
        normal = np.where(inside[..., None], facing, [0.0, 0.0, -1.0])
        leg = point - lamp
        way = np.linalg.norm(leg, axis=-1)
        light = np.where(inside, albedo, 0.3) * -(leg * normal).sum(axis=-1) / way**3
        for freq in total:
            path = way + np.linalg.norm(point, axis=-1)
            total[freq] = total[freq] + light * np.exp(1j * path_to_phase(path, freq)) / 16
    assert 0.1 < inside.mean() < 0.9
    for freq, worst in ((4e7, 4e-9), (7e7, 2e-8), (2.1e9, 1e-3)):
        wanted = total[freq]
        assert (np.abs(view.phasor(freq, 0) - wanted) / np.abs(wanted)).max() < worst


def test_pixels_at_the_edge_of_a_board_fly():
    camera = small("opt8241:width=40,height=30").camera
    rotation, origin = a_view(camera, 0.0)
    view = printed(pixel_rays(camera, 6), pattern(), rotation=rotation, origin_m=origin, wall_m=1.5)
    depth = np.angle(view.phasor(2e7, 0)) / path_to_phase(2.0, 2e7) * rays(camera)[..., 2]
    near, far = (np.abs(depth - z) < 1e-4 for z in (0.42, 1.5))
    flying = (depth > 0.43) & (depth < 1.49)
    assert near.sum() > 100
    assert far.sum() > 100
    assert 5 < flying.sum() < 100


def test_corners_of_the_board_are_seen_where_they_are():
    cv2 = pytest.importorskip("cv2")
    unit = unit_of(Errors(bad_share=0.0), small("opt8241:width=160,height=120"))
    boards = [take for take in takes(FEW, unit, 7) if take.pose is not None]
    assert len(boards) == 2
    for take in boards:
        capture = exposed(take, unit, np.random.default_rng(1))
        image = np.sqrt(np.abs(capture.phasors.values[1]))
        image = cv2.resize(image / image.max() * 255, None, fx=3, fy=3).astype(np.uint8)
        found, corners = cv2.findChessboardCornersSB(image, BOARD[:2], flags=cv2.CALIB_CB_ACCURACY)
        assert found
        seen = (corners.reshape(-1, 2) + 0.5) / 3 - 0.5
        y, x = np.mgrid[1 : BOARD[1] + 1, 1 : BOARD[0] + 1].reshape(2, -1) * BOARD[2]
        rotation, origin = take.pose
        points = np.stack([x, y, 0 * x], axis=-1) @ rotation.T + origin
        wanted = np.stack(project(unit.sensor.camera, points), axis=-1)
        apart = np.linalg.norm(seen[:, None] - wanted, axis=-1).min(axis=1)
        assert np.median(apart) < 0.1
        assert apart.max() < 0.5


def test_boards_cover_the_image_and_tilt_every_way():
    unit = unit_of(Errors(), small("opt8241"))
    camera, poses = unit.sensor.camera, [t.pose for t in takes(PLANS["full"], unit, 0) if t.pose]
    assert len(poses) == 20
    corner = np.array([[0, 0, 0], [0.27, 0, 0], [0, 0.18, 0], [0.27, 0.18, 0]])
    seen = [project(camera, corner @ rotation.T + origin) for rotation, origin in poses]
    u, v = np.stack(seen, axis=1)
    for place, size in ((u, camera.width), (v, camera.height)):
        assert place.min() > 0
        assert place.min() < 0.08 * size
        assert place.max() < size - 1
        assert place.max() > 0.92 * size
    tilt = np.degrees([np.arccos(rotation[2, 2]) for rotation, _ in poses])
    assert tilt.max() <= 40
    assert tilt.max() > 30
    lean = np.array([rotation[:2, 2] for rotation, _ in poses])
    assert (lean.max(axis=0) > 0.3).all()
    assert (lean.min(axis=0) < -0.3).all()


def test_prints_are_those_of_the_board_module():
    board = parse_board(DEFAULT)
    assert (board.columns, board.rows, board.square_m) == BOARD
    for text, drawn in (
        (DEFAULT, chessboard(*BOARD)),
        ("charuco:columns=9,rows=6,square_m=0.03,marker_m=0.024,dictionary=DICT_4X4_50",
         charuco(9, 6, 0.03, 0.024)),
    ):  # fmt: skip
        y, x = np.mgrid[-0.0285:0.21:0.00113, -0.0285:0.3:0.00113]
        albedo, inside = drawn.at(x, y)
        assert inside.all()
        agree = (albedo < 0.4) == dark_at(parse_board(text), x, y)
        assert agree.mean() > 0.999  # points on an edge may fall either way


@pytest.mark.parametrize("frames", [1, 9])
@pytest.mark.parametrize("text", ["opt8241:width=64,height=48", "kinect2:width=48,height=40"])
def test_sigma_is_that_of_the_noise_whatever_is_averaged(text, frames):
    unit = unit_of(Errors(bad_share=0.0), small(text))
    wall = next(t for t in takes(FEW, unit, 0) if t.conditions.kind == "wall")
    noisy = exposed(wall, unit, np.random.default_rng(3), frames)
    clean = exposed(wall, unit, None, frames)
    again = demodulate(noisy.taps, noisy.sensor)
    z = wrap_half(phase(noisy.phasors.values) - phase(clean.phasors.values))
    z = z / phase_sigma_rad(noisy.phasors)
    assert abs(z.std() - 1) < 4 / np.sqrt(2 * z.size)
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert np.array_equal(again.sigma, noisy.phasors.sigma)
    if frames == 9:
        single = exposed(wall, unit, np.random.default_rng(3)).phasors.sigma
        assert (noisy.phasors.sigma / single).mean() == pytest.approx(1 / 3, rel=2e-3)


def test_captures_carry_nothing_of_what_was_planted():
    nominal = small()
    plain = captures(FAULTLESS, noisy=True)
    for name, capture in captures(Errors(unit=9), noisy=True).items():
        assert capture.truth is None
        assert capture.depth is None
        assert capture.sensor.maps is None
        assert capture.sensor.modulation.harmonics.shape[1] == 1
        assert not capture.sensor.camera.dist.size
        assert np.array_equal(capture.sensor.camera.K, nominal.camera.K)
        assert set(capture.provenance) == {"engine", "frames", "seed", "conditions", "file"}
        if conditions_of(capture).kind not in ("board", "check", "warmup"):
            assert repr(vars(conditions_of(capture))) == repr(vars(conditions_of(plain[name])))


def test_check_is_held_out_and_varies():
    unit = unit_of(Errors(), small("opt8241"))
    full = takes(PLANS["full"], unit, 0)
    count = Counter(take.conditions.kind for take in full)
    assert count == {"board": 20, "dark": 4, "flat": 6, "rail": 41, "delay": 32, "wall": 12,
                     "gray": 20, "warmup": 30, "check": 12}  # fmt: skip
    assert set(count) == set(KINDS)
    assert len({take.name for take in full}) == len(full)
    fitted = {t.conditions.distance_m for t in full if t.conditions.kind in PLANES[:-1]}
    checks = [take.conditions for take in full if take.conditions.kind == "check"]
    assert min(abs(c.distance_m - z) for c in checks for z in fitted) > 0.005
    for name in ("sensor_c", "light_c", "distance_m", "exposure"):
        values = [getattr(c, name) for c in checks]
        assert len(set(values)) > 8
        assert np.ptp(values) > 2
    assert all(math.isfinite(t.conditions.sensor_c + t.conditions.light_c) for t in full)
    turn = [range_to_phase(t.conditions.distance_m, 4e7) for t in full
            if t.conditions.kind == "rail"]  # fmt: skip
    assert np.ptp(turn) > 2 * np.pi
    warm = [t.conditions for t in full if t.conditions.kind == "warmup"]
    assert warm[0].sensor_c == warm[0].light_c == 22
    assert warm[-1].light_c == pytest.approx(45, abs=0.1)
    assert 39 < warm[-1].sensor_c < 40


def same(one: Capture, other: Capture) -> bool:
    return np.array_equal(one.taps.values, other.taps.values)


def test_seeds():
    base = captures(Errors())
    again = captures(Errors())
    other = captures(Errors(), seed=1)
    unit = captures(Errors(unit=1))
    assert all(same(base[name], again[name]) for name in base)
    assert not any(same(base[name], other[name]) for name in base)
    assert not any(same(base[name], unit[name]) for name in base)
    walls = of_kind(base, "wall")
    assert not same(walls[0], walls[1])
    one, two = (truth_of(Errors(unit=n), small()) for n in (0, 1))
    assert np.abs(one.fixed_pattern_rad - two.fixed_pattern_rad).max() > 0.01
    assert not np.allclose(one.common_phase_rad, two.common_phase_rad)
    assert np.abs(one.fixed_pattern_rad.mean(axis=(1, 2))).max() < 1e-12


def test_response_is_as_told():
    camera = small("opt8241:width=40,height=30,steps=ab_four_step,taps_per_exposure=2")
    unit = unit_of(Errors(ab_gain=0.05, bad_share=0.02, unit=2), camera)
    found = {t.name: exposed(t, unit, None) for t in takes(FEW, unit, 0)}
    maps, lamp = unit.sensor.maps, [t for t in takes(FEW, unit, 0) if t.conditions.kind == "flat"]
    dark = found["dark_00.h5"].taps.values
    assert np.allclose(dark[0, 0], maps.dark_e[0])
    assert np.allclose(dark[0, 1], maps.dark_e[1])
    for take in lamp:
        flat = found[take.name].taps.values - dark
        assert np.allclose(flat[0, 0], take.lamp_e * maps.gain[0], rtol=1e-5, atol=0.02)
        assert np.allclose(flat[0, 3], take.lamp_e * maps.gain[1], rtol=1e-5, atol=0.02)
        assert np.median(flat[0, 1] / flat[0, 0].clip(1)) == pytest.approx(1.05, abs=2e-3)
    first, last = lamp
    assert last.lamp_e / first.lamp_e == pytest.approx(
        last.conditions.exposure / first.conditions.exposure
    )
    assert 0.005 < unit.bad.mean() < 0.05
    assert (maps.gain[0][unit.bad] == 0).any()
    assert (maps.dark_e[0][unit.bad] > 1e4).any()


@pytest.mark.parametrize(
    ("text", "errors", "message"),
    [
        ("opt8241:width=16,height=12,waveform=square", Errors(), "brings waveform along"),
        ("opt8241:width=16,height=12,prnu=0.01", Errors(), "brings prnu along"),
        ("opt8241:width=16,height=12,beam_deg=60", Errors(), "one isotropic light only"),
        ("opt8241:width=16,height=12", Errors(dist=(-3.0, 0, 0, 0)), "folds the image"),
        ("opt8241:width=16,height=12", Errors(fppn_rad=(0.1, 0.1, 0.1)), "per frequency"),
        ("opt8241:width=16,height=12", Errors(waveform="saw"), "unknown waveform"),
    ],
)
def test_what_a_rig_cannot_do_is_refused(text, errors, message):
    with pytest.raises(ValueError, match=message):
        next(rig(sensor(text), errors))


def test_errors_refuse_nonsense():
    for bad in ({"focal": (0.1,)}, {"prnu": -1.0}, {"bad_share": 0.9}, {"light_tau_s": 0.0}):
        with pytest.raises(ValueError, match="got"):
            Errors(**bad)
    with pytest.raises(ValueError, match="unknown plan"):
        next(rig(small(), Errors(), plan="huge"))
    with pytest.raises(ValueError, match="has no parameter 'wave'"):
        parse_errors("wave=square")
    assert parse_errors("none,fppn_rad=0.1+0.2").fppn_rad == (0.1, 0.2)
    assert parse_errors("dist=-0.1+0+0+0").waveform == "square"


def test_help_tells_every_error_with_its_default():
    told = dict(part.split("=") for part in EPILOG.split("Examples")[0].split() if "=" in part)
    for field in fields(Errors):
        assert getattr(parse_errors(f"none,{field.name}={told[field.name]}"), field.name) == (
            field.default
        ), field.name


def run(capsys, *args):
    with pytest.raises(SystemExit) as stop:
        main(["rig", *map(str, args)])
    told = capsys.readouterr()
    return stop.value.code, told.out, told.err


def test_the_command_writes_a_directory_and_goes_on_where_it_was_left(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("toftools.sim.rig.PLANS", {"small": FEW})
    out = tmp_path / "a" / "rig"
    args = ("--sensor", SMALL, "--out", out, "--frames", 2)
    code, told, _ = run(capsys, *args)
    assert code == 0
    assert f"toftools calibrate all {out} --out cal.json" in told
    assert "wiggling" in told
    names = list(read_conditions(out))
    assert [path.name for path in labelled(out)] == names
    by_library = dict(rig(small(), Errors(), plan=FEW, frames=2))
    assert list(by_library) == names
    for name in names:
        capture = open_labelled(out / name)
        assert same(capture, by_library[name])
        table = read_conditions(out)[name]
        assert repr(vars(table)) == repr(vars(conditions_of(capture)))
    with np.load(out / "truth" / "truth.npz") as file:
        assert np.array_equal(file["fixed_pattern_rad"],
                              truth_of(Errors(), small()).fixed_pattern_rad)  # fmt: skip
    assert json.loads((out / "truth" / "errors.json").read_text())["waveform"] == "square"

    before = {name: (out / name).stat().st_mtime_ns for name in names}
    (out / names[3]).unlink()
    (out / "conditions.csv").unlink()
    code, told, _ = run(capsys, *args, "--json")
    assert code == 0
    assert json.loads(told)["kept"] == len(names) - 1
    assert same(open_labelled(out / names[3]), by_library[names[3]])
    after = {name: (out / name).stat().st_mtime_ns for name in names}
    assert [name for name in names if before[name] != after[name]] == [names[3]]

    code, _, err = run(capsys, *args, "--seed", 5)
    assert code == 2
    assert "other settings" in err
    assert {name: (out / name).stat().st_mtime_ns for name in names} == after


def test_the_command_leaves_other_captures_alone(tmp_path, capsys):
    (tmp_path / "mine.h5").write_text("x")
    (tmp_path / "conditions.csv").write_text("file,kind\nmine.h5,wall\n")
    code, _, err = run(capsys, "--sensor", SMALL, "--out", tmp_path)
    assert code == 2
    assert "of other captures" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["conditions.csv", "mine.h5"]
    (tmp_path / "conditions.csv").unlink()
    (tmp_path / "wall_00.h5").write_text("x")
    code, _, err = run(capsys, "--sensor", SMALL, "--out", tmp_path)
    assert code == 2
    assert "wall_00.h5" in err
    assert not (tmp_path / "truth").exists()
