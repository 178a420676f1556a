"""Learned corrections: what a network sees, which files are taken, and how they are run."""

import dataclasses
import json
import sys

import numpy as np
import onnx
import pytest
from network_twin import described, ordered
from onnx import TensorProto, helper

from toftools.camera import resized
from toftools.correct._net_coarse import MIDDLE_ALBEDO, SHIFT_M, coarse_light
from toftools.correct._net_engine import OVERLAP, TILE, engine, tiled
from toftools.correct._net_file import (
    KEY,
    NORMALISATION,
    WEIGHTS,
    Card,
    fitted,
    read_card,
    to_text,
    wanted,
)
from toftools.correct._net_guide import guide_of, prefer
from toftools.correct._net_inputs import channels, seen, view_of
from toftools.correct.network import network
from toftools.registry import CORRECTIONS, find
from toftools.sensors import sensor
from toftools.types import DepthMap, Phasors
from toftools.units import C_M_S, range_to_phase

DEVICE = "opt8241:width=48,height=32"
CARD = Card("made", "phasors", (40e6, 70e6), (0.5, 2.0), 16, "CC0", "abc", dict(NORMALISATION))


def corner(device, noise=0.0, bounced=0.0):
    """Phasors of two walls that meet in the middle, and their range."""
    height, width = device.camera.shape
    range_m = 1.5 + 0.01 * np.abs(np.arange(width) - width / 2) + 0.005 * np.arange(height)[:, None]
    freqs = device.modulation.freqs_hz[:, None, None]
    values = np.exp(1j * range_to_phase(range_m, freqs)) / range_m**2
    values = values + bounced * np.exp(1j * range_to_phase(range_m + 0.4, freqs))
    rng = np.random.default_rng(0)
    values = values + noise * (rng.standard_normal((2, *values.shape)) * [[[[1]]], [[[1j]]]]).sum(0)
    return values.astype(np.complex64), range_m


def net(path, card=CARD, n_freqs=2, shift=0.0, log_scale=0.0, logits=(0.0, 0.0), word=KEY):
    """A network that answers the same everywhere, plus the mean of its input times nothing."""
    full, coarse = channels(n_freqs)
    outs = 2 + len(logits)
    weights = np.zeros((outs, full, 1, 1), np.float32)
    bias = np.array([shift, log_scale, *logits], np.float32)
    nodes = [
        helper.make_node("Conv", ["full", "w", "b"], ["one"]),
        helper.make_node("ReduceMean", ["coarse"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["none"]),
        helper.make_node("Add", ["one", "none"], ["out"]),
    ]
    shapes = {"full": [1, full, None, None], "coarse": [1, coarse, None, None]}
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()]
    output = helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, outs, None, None])
    values = {"w": weights, "b": bias, "zero": np.zeros((1, 1, 1, 1), np.float32)}
    made = helper.make_graph(
        nodes,
        "g",
        inputs,
        [output],
        [onnx.numpy_helper.from_array(v, n) for n, v in values.items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if word:
        helper.set_model_props(model, {"other": "words", word: to_text(card)})
    path.write_bytes(model.SerializeToString())
    return path


# What a network sees


@pytest.mark.parametrize("text", [DEVICE, "deeptof:width=48,height=32"])
def test_channels_are_those_of_the_slow_twin(text):
    device = sensor(text)
    values, _ = corner(device, noise=0.02, bounced=0.1)
    valid = np.ones(values.shape[1:], bool)
    valid[3, 4] = False
    view = view_of(device, 1.3, 0.0)
    got = seen(Phasors(values, valid=valid), view)
    assert got.full.shape[0] == channels(values.shape[0])[0]
    assert got.coarse.shape[0] == channels(values.shape[0])[1]
    want = described(values, got.candidates_m, valid, device, 1.3)
    assert np.allclose(got.full, want, atol=2e-3)


def test_brightness_and_common_factors_of_frequency_change_nothing():
    device = sensor(DEVICE)
    values, _ = corner(device, noise=0.02, bounced=0.1)
    first = seen(Phasors(values), view_of(device, 1.0, 7.0))
    brighter = seen(Phasors(values * 1e4), view_of(device, 1.0, 7.0))
    assert np.allclose(first.full, brighter.full, atol=1e-4)
    assert np.allclose(first.coarse, brighter.coarse, atol=1e-3)
    # Twice the frequency, half the size, four times the light: the same numbers.
    smaller = sensor(DEVICE + ",freqs=80e6+140e6")
    half = seen(Phasors(4 * values), view_of(smaller, 2.0, 3.5))
    assert np.allclose(first.full, half.full, atol=2e-3)
    assert np.allclose(first.coarse, half.coarse, atol=2e-3)
    assert np.allclose(first.candidates_m, 2 * half.candidates_m, atol=1e-4)


def test_one_bounce_is_that_of_all_pairs_in_closed_form():
    """A cell's light from one other: form factor cos cos A / (pi r^2 + A), and the longer way."""
    device = sensor("deeptof:width=20,height=15,hfov_deg=80")
    view = view_of(device, 1.0, 0.0).coarse
    columns = np.abs(np.arange(20) - 9.5)
    range_m = np.broadcast_to(1.5 - 0.03 * columns, (15, 20)).astype(np.float32)
    lit = np.ones(range_m.shape, bool)
    from toftools.correct._scene import lit as flash_on
    from toftools.correct._scene import surface

    got = coarse_light(range_m, np.zeros_like(range_m), lit, view, 1.0)
    patch = surface(view.optics, range_m)
    leaves = MIDDLE_ALBEDO / range_m**2
    k = 2 * np.pi * device.modulation.freqs_hz[0] / C_M_S
    total = np.zeros(range_m.shape, complex)
    place, normal = patch.position.reshape(3, -1), patch.normal.reshape(3, -1)
    for v in np.flatnonzero(patch.flat.ravel()):
        way = place[:, v, None] - place
        r2 = (way**2).sum(axis=0) + 1e-12
        cos_u = np.maximum((normal * way).sum(axis=0), 0)
        cos_v = np.maximum(-(normal[:, v, None] * way).sum(axis=0), 0)
        area = patch.area_m2.ravel()[v]
        factor = cos_u * cos_v * area / (r2 * (np.pi * r2 + area))
        later = np.sqrt(r2) + range_m.ravel()[v] - range_m.ravel()
        total += (factor * leaves.ravel()[v] * np.exp(1j * k * later)).reshape(total.shape)
    rho = total / flash_on(view.optics, patch)[0]
    import cv2

    shift = np.angle(1 + rho) / (2 * k) / SHIFT_M
    for channel, wanted_image in ((5, rho.real), (6, shift)):
        small = cv2.resize(wanted_image.astype(np.float32), (5, 4), interpolation=1)
        assert np.allclose(got[channel], small, rtol=2e-2, atol=2e-3)
    assert rho.real.max() > 0.01


def test_candidates_are_ordered_as_by_the_slow_twin():
    device = sensor("opt8241:width=50,height=33")
    rng = np.random.default_rng(3)
    values = rng.standard_normal((2, 33, 50)) + 1j * rng.standard_normal((2, 33, 50))
    lit = rng.random((33, 50)) < 0.9
    lit[:9, :9] = False
    candidates = rng.uniform(0, 5, (3, 33, 50)).astype(np.float32)
    guide = guide_of(dataclasses.replace(device, camera=resized(device.camera, 50, 33)), 1.0, 0.0)
    guide = dataclasses.replace(guide, rows=np.arange(9) * 33 // 8, columns=np.arange(11) * 5)
    asked = {}

    def run(phasors):
        asked["cells"], asked["valid"] = phasors.values, phasors.valid
        told = rng.uniform(0, 5, phasors.valid.shape).astype(np.float32)
        asked["range_m"] = np.where(phasors.valid, told, np.nan)
        return DepthMap(asked["range_m"])

    guide = dataclasses.replace(guide, run=run)
    dim = np.ones((33, 50), np.float32)
    got = candidates.copy()
    prefer(got, values.astype(np.complex64), lit, dim, guide)
    cells, want = ordered(candidates, values, lit, guide, asked["range_m"])
    ratio = asked["cells"][:, asked["valid"]] / cells[:, asked["valid"]]
    assert np.allclose(ratio, ratio.flat[0].real, rtol=1e-4), "a common gain"
    assert np.array_equal(asked["valid"], np.abs(cells).min(axis=0) > 0)
    assert not asked["valid"].all() and asked["valid"].any()
    assert np.array_equal(got, want) and (got[0] != candidates[0]).any()


def test_a_neighbourhood_overrules_the_phases_of_a_pixel():
    """A wall whose phase at 70 MHz is off by a third of a turn in one pixel."""
    device = sensor("opt8241:width=40,height=30")
    k = range_to_phase(1.0, device.modulation.freqs_hz)[:, None, None]
    values = np.exp(1j * k * np.full((30, 40), 2.0))
    values[1, 14, 21] *= np.exp(2.2j)
    got = seen(Phasors(values.astype(np.complex64)), view_of(device, 1.0, 0.0))
    same = np.broadcast_to(values[:, 14:15, 21:22], values.shape).astype(np.complex64)
    alone = seen(Phasors(same), view_of(device, 1.0, 0.0))
    assert abs(alone.candidates_m[0, 14, 21] - 2) > 1
    # The turn is right; what the phase is off by is left to the shift.
    assert abs(got.candidates_m[0, 14, 21] - 2) < 0.7


def test_pixels_without_signal_leave_no_trace():
    device = sensor(DEVICE)
    values, _ = corner(device)
    valid = np.ones(values.shape[1:], bool)
    valid[:8, :12] = False
    wild = values.copy()
    wild[:, ~valid] = 1e6j
    one, two = (seen(Phasors(v, valid=valid), view_of(device, 1.0, 0.0)) for v in (values, wild))
    assert np.array_equal(one.full, two.full) and np.array_equal(one.coarse, two.coarse)
    assert np.isfinite(one.coarse).all() and not one.full[4][~valid].any()


def test_a_frame_without_signal_is_seen_as_nothing():
    device = sensor(DEVICE)
    nothing = Phasors(np.zeros((2, 32, 48), np.complex64))
    got = seen(nothing, view_of(device, 1.0, 0.0))
    assert np.isfinite(got.full).all() and np.isfinite(got.coarse).all() and not got.valid.any()


# Answers


def test_candidate_shift_and_scale_are_what_the_network_says(tmp_path):
    device = sensor(DEVICE)
    values, range_m = corner(device)
    path = net(tmp_path / "net.onnx", shift=-0.5, log_scale=-1.0)
    depth = network(device, model=str(path))(Phasors(values))
    assert np.allclose(depth.range_m, range_m - 0.5 * SHIFT_M, atol=1e-3)
    assert np.allclose(depth.sigma_m, np.sqrt(2) * SHIFT_M * np.exp(-1), rtol=1e-4)
    assert np.allclose(depth.info["shift_m"], -0.05) and not depth.info["candidate"].any()
    assert depth.info["network"] == {"name": "made", "licence": "CC0", "recipe": "abc"}
    other = network(device, model=str(net(tmp_path / "b.onnx", logits=(1.0, 3.0))))(Phasors(values))
    assert (other.info["candidate"] == 2).all()
    looked = seen(Phasors(values), view_of(device, 1.0, 0.0))
    assert np.allclose(other.range_m, looked.candidates_m[2], atol=1e-5)


def test_frequencies_in_any_order_and_common_multiples(tmp_path):
    path = str(net(tmp_path / "net.onnx", shift=1.0))
    device = sensor(DEVICE)
    values, range_m = corner(device)
    turned = sensor(DEVICE + ",freqs=70e6+40e6")
    depth = network(turned, model=path)(Phasors(values[::-1]))
    assert np.allclose(depth.range_m, range_m + SHIFT_M, atol=1e-3)
    # At half the frequencies a shift counts twice.
    lower = sensor(DEVICE + ",freqs=20e6+35e6")
    slow, far_m = corner(lower)
    assert np.allclose(network(lower, model=path)(Phasors(slow)).range_m, far_m + 2 * SHIFT_M,
                       atol=1e-3)  # fmt: skip


def test_frames_of_another_size_are_the_same_view(tmp_path):
    run = network(sensor(DEVICE), model=str(net(tmp_path / "net.onnx")))
    for shape in ((30, 45), (32, 48), (1, 1), (17, 90)):
        depth = run(Phasors(np.ones((2, *shape), np.complex64)))
        assert depth.range_m.shape == shape


def test_tiles_are_as_the_whole(tmp_path):
    """A network that only adds neighbours gives the same in tiles."""
    rng = np.random.default_rng(0)
    big = rng.standard_normal((1, 2 * TILE - OVERLAP + 32, TILE + OVERLAP + 48)).astype(np.float32)

    def blur(inputs):
        a = inputs["full"]
        padded = np.pad(a, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge")
        half = inputs["coarse"].repeat(4, axis=2).repeat(4, axis=3)
        return padded[:, :, :-2, 1:-1] + padded[:, :, 2:, 1:-1] + a + half

    coarse = big[:, ::4, ::4].copy()
    got = tiled(blur, {"full": big, "coarse": coarse}, {"full": 1, "coarse": 4}, 16)
    want = blur({"full": big[None], "coarse": coarse[None]})[0]
    assert np.array_equal(got, want)


def test_opencv_answers_where_onnxruntime_is_not_installed(tmp_path, monkeypatch):
    files = sorted(WEIGHTS.glob("*.onnx"))
    assert len(files) > 2
    for path in files:
        data = path.read_bytes()
        card, _ = read_card(path)
        full, coarse = channels(len(card.freqs_hz))
        rng = np.random.default_rng(1)
        shapes = {"full": (1, full, 64, 96), "coarse": (1, coarse, 16, 24)}
        if card.input == "range":
            shapes = {"range_m": (1, 1, 64, 96)}
        inputs = {name: rng.uniform(0.5, 2, shape).astype(np.float32)
                  for name, shape in shapes.items()}  # fmt: skip
        want = engine(data, "net")(inputs)
        with monkeypatch.context() as patch:
            patch.setattr("importlib.util.find_spec", lambda _: None)
            patch.setitem(sys.modules, "onnxruntime", None)
            got = engine(data, "net")(inputs)
        assert np.allclose(got, want, atol=1e-3 * np.abs(want).max())


# Files


def test_a_card_is_read_as_it_was_written(tmp_path):
    card, data = read_card(net(tmp_path / "net.onnx"))
    assert card == CARD and data == (tmp_path / "net.onnx").read_bytes()
    assert wanted(card) == "40 and 70 MHz times 0.5 to 2"


@pytest.mark.parametrize(
    "damage",
    [b"", b"\x00", b"\xff" * 40, b"PK\x03\x04", b"\x72\xff\xff\xff\xff\x0f", b"\x09\x01", b"\x0b"],
)
def test_what_is_no_network_is_refused_in_a_sentence(tmp_path, damage):
    path = tmp_path / "net.onnx"
    path.write_bytes(damage)
    with pytest.raises(ValueError, match=r"no ONNX file|does not say what its input is") as caught:
        read_card(path)
    assert "\n" not in str(caught.value)


def test_cut_files_are_refused(tmp_path):
    data = net(tmp_path / "net.onnx").read_bytes()
    for size in range(0, len(data), 97):
        (tmp_path / "cut.onnx").write_bytes(data[:size])
        with pytest.raises(ValueError, match=r"cut\.onnx"):
            network(sensor(DEVICE), model=str(tmp_path / "cut.onnx"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 2}, "words this version does not know"),
        ({"input": "colours"}, "words this version does not know"),
        ({"freqs_hz": []}, "words this version does not know"),
        ({"freqs_hz": [float("nan")]}, "words this version does not know"),
        ({"scales": [1.0]}, "words this version does not know"),
        ({"multiple": 0}, "words this version does not know"),
        ({"licence": 3}, "words this version does not know"),
        ({"more": 3}, "words this version does not know"),
        ({"normalisation": {"range_m": 1.0}}, "train it anew"),
        ({"freqs_hz": [20e6, 50e6]}, "trained for: 20 and 50 MHz times 0.5 to 2"),
    ],
)
def test_cards_of_others_are_refused(tmp_path, change, said):
    path = net(tmp_path / "net.onnx")
    model = onnx.load(str(path))
    text = json.dumps({**json.loads(to_text(CARD)), **change})
    helper.set_model_props(model, {KEY: text})
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match=said) as caught:
        network(sensor(DEVICE), model=str(path))
    assert "\n" not in str(caught.value)


def test_networks_that_say_nothing_or_are_broken_inside(tmp_path):
    device = sensor(DEVICE)
    with pytest.raises(ValueError, match="does not say what its input is"):
        network(device, model=str(net(tmp_path / "net.onnx", word="")))
    with pytest.raises(ValueError, match="cannot read the network"):
        network(device, model=str(tmp_path / "none.onnx"))
    with pytest.raises(ValueError, match="gave 3 channels, wanted one per candidate and 2"):
        network(device, model=str(net(tmp_path / "net.onnx", logits=(0.0,))))
    path = net(tmp_path / "net.onnx")
    model = onnx.load(str(path))
    model.graph.node[0].op_type = "Nonsense"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match="cannot build the network") as caught:
        network(device, model=str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("freqs", "order", "metre"),
    [
        ((40e6, 70e6), [0, 1], 1.0),
        ((70e6, 40e6), [1, 0], 1.0),
        ((80e6, 140e6), [0, 1], 2.0),
        ((39.9e6, 70.1e6), [0, 1], 1.0),
        ((100e6, 175e6), None, None),
        ((40e6, 75e6), None, None),
        ((40e6,), None, None),
    ],
)
def test_which_frequencies_suit(freqs, order, metre):
    found = fitted(CARD, np.array(freqs))
    if order is None:
        assert found is None
    else:
        assert found[0] == order and found[1] == pytest.approx(metre, rel=2e-3)


def test_an_emitter_elsewhere_is_refused(tmp_path):
    device = dataclasses.replace(sensor(DEVICE), emitter_offset_m=(0.1, 0, 0))
    with pytest.raises(ValueError, match="off the camera"):
        network(device, model=str(net(tmp_path / "net.onnx")))


def test_the_registry_and_the_command_line_take_a_file(tmp_path):
    path = net(tmp_path / "net.onnx")
    run = find(CORRECTIONS, f"network:model={path}").build(sensor(DEVICE))
    assert np.isfinite(run(Phasors(np.ones((2, 4, 4), np.complex64))).range_m).all()


def test_pixels_whose_noise_is_no_number_have_no_answer():
    device = sensor(DEVICE)
    values, _ = corner(device)
    sigma = np.full(values.shape, 0.01, np.float32)
    sigma[:, 3, 4], sigma[0, 5, 6], sigma[:, 7, 8] = np.nan, np.nan, np.inf
    run = network(device)
    bare, depth = run(Phasors(values)), run(Phasors(values, sigma))
    lost = ~np.isfinite(depth.range_m)
    assert lost[3, 4] and lost[5, 6] and lost[7, 8] and lost.sum() == 3
    assert np.array_equal(depth.range_m[~lost], bare.range_m[~lost])
