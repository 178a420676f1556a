"""Training: the same weights however it came about, files that answer as what was trained."""

import json

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from learning import DEVICE, planes

from toftools.cli import cli
from toftools.correct._net_engine import engine
from toftools.correct._net_file import LEAST_PIXELS, read_card
from toftools.correct._net_inputs import channels
from toftools.registry import CORRECTIONS, find
from toftools.sensors import sensor
from toftools.train import loop
from toftools.train.export import card_of, example, export, quantised
from toftools.train.frames import read_frames
from toftools.train.recipe import RECIPES, read_train_recipe
from toftools.train.samples import SIZES, Samples, mirrored, noisy
from toftools.train.standard import StandardConv, folded
from toftools.train.train import kept, network, trained
from toftools.types import Phasors

SMALL = """model = "phasornet"
freqs_hz = [40e6, 70e6]
scales = [0.5, 1.0]
widths = [8, 8, 8]
steps = 6
batch = 2
"""
RANGE = """model = "deeptof2017"
freqs_hz = [20e6]
widths = [4, 4, 4, 4, 4, 4]
pretrain_steps = 3
steps = 4
batch = 2
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return planes(tmp_path_factory.mktemp("learning") / "planes")


def recipe(folder, text, name="small"):
    path = folder / f"{name}.toml"
    path.write_text(text)
    return read_train_recipe(path)


def weights(model):
    return {name: value.numpy().copy() for name, value in model.state_dict().items()}


def same(one, two):
    return all(np.array_equal(one[name], two[name]) for name in one | two)


# Recipes


@pytest.mark.parametrize("name", sorted(p.stem for p in RECIPES.glob("*.toml")))
def test_recipes_of_the_package_are_whole(name):
    found = read_train_recipe(name)
    assert found.name == name and found.about and found.digest
    inputs = example(card_of(found, ""), channels(len(found.freqs_hz)))
    out = network(found).eval()(*(torch.from_numpy(a) for a in inputs.values()))
    assert out.shape[2:] == next(iter(inputs.values())).shape[2:]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('model = "resnet"', "model = 'resnet', wanted one of phasornet"),
        ("widths = [8, 8]", "wanted 3 positive numbers"),
        ("freqs_hz = [40e6, 40e6]", "wanted different positive frequencies"),
        ("freqs_hz = 40e6", "freqs_hz = 40000000.0, wanted a list"),
        ("steps = 0", "wanted 1 or more"),
        ("steps = 1.5", "wanted int"),
        ("snr = [20.0]", "wanted least and largest"),
        ('without = ["everything"]', "wanted some of bounce"),
        ("stepz = 4", "has the key 'stepz'"),
    ],
)
def test_what_a_recipe_cannot_ask_for(tmp_path, line, said):
    key = line.partition(" ")[0]
    text = "\n".join(r for r in SMALL.splitlines() if not r.startswith(f"{key} ")) + "\n" + line
    with pytest.raises(ValueError, match="recipe") as caught:
        recipe(tmp_path, text)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_deeptof_takes_one_frequency(tmp_path):
    with pytest.raises(ValueError, match="one frequency"):
        recipe(tmp_path, RANGE.replace("[20e6]", "[20e6, 40e6]"))


# Draws


def test_draws_follow_from_seed_and_step(data, tmp_path):
    plan = recipe(tmp_path, SMALL)
    frames = read_frames(data, "train", [20e6, 35e6, 40e6, 70e6])
    assert len(frames) == 3
    one, two = Samples(frames, plan), Samples(frames, plan)
    two.drawn(3)
    for name in ("full", "coarse", "candidates", "truth", "known"):
        assert np.array_equal(getattr(one.drawn(5), name), getattr(two.drawn(5), name)), name
    assert not np.array_equal(one.drawn(5).full[:, 3], one.drawn(6).full[:, 3])
    apart = one.drawn(5, "unlabelled")
    assert not np.array_equal(one.drawn(5).full[:, 3], apart.full[:, 3])
    # The second run reads the quick copies, which hold the same.
    assert all(np.array_equal(a.values, b.values) and a.id == b.id for a, b in
               zip(frames, read_frames(data, "train", [40e6]), strict=True))  # fmt: skip


def test_the_shift_that_is_asked_for_is_that_of_the_bounced_light(data, tmp_path):
    """In closed form: arg(1 + share exp(j k extra)) / k, weighted by squared frequencies."""
    plan = recipe(tmp_path, SMALL + "max_range_m = 3.7")
    samples = Samples(read_frames(data, "train", [20e6, 35e6, 40e6, 70e6]), plan)
    for scale in plan.scales:
        batch = samples.fixed(0, scale, 0.0)
        freqs = np.array(plan.freqs_hz) * scale
        k = 4 * np.pi * freqs / 299_792_458.0
        shifts = np.angle(1 + 0.25 * np.exp(1j * k / 2 * 0.6)) / k
        wanted_dm = 10 * scale * (shifts * freqs**2).sum() / (freqs**2).sum()
        best = np.abs(batch.candidates - batch.truth[:, None]).min(axis=1)[batch.known]
        assert batch.known.mean() > 0.95
        assert np.median(best) == pytest.approx(wanted_dm, rel=0.02)


def test_mirrored_cameras_see_mirrored_directions():
    from toftools.camera import rays

    device = sensor(DEVICE)
    own = rays(device.camera)
    for across, down in ((True, False), (False, True)):
        turned = rays(mirrored(device, across, down).camera)
        back = turned[:, ::-1] * [-1, 1, 1] if across else turned[::-1] * [1, -1, 1]
        assert np.allclose(back, own, atol=1e-6)


def test_the_smallest_frames_are_those_that_auto_knows_of():
    assert min(rows * columns for rows, columns, _ in SIZES) == LEAST_PIXELS


def test_noise_has_the_ratio_asked_for():
    values = np.full((2, 200, 200), 100.0 + 0j, np.complex64)
    spread = noisy(values, 50.0, np.random.default_rng(0)) - values
    for part in (spread.real, spread.imag):  # 80,000 draws: 0.25 % of standard error
        assert part.std() == pytest.approx(2.0, rel=0.01)
    assert noisy(values, 0.0, np.random.default_rng(0)) is values


def test_a_set_without_the_frequencies_is_refused(data):
    with pytest.raises(ValueError, match="no train captures with all of 20, 50 MHz"):
        read_frames(data, "train", [20e6, 50e6])
    with pytest.raises(ValueError, match="found no data set"):
        read_frames(data / "nowhere", "train", [20e6])


# Training


@pytest.mark.parametrize("text", [SMALL, RANGE], ids=["phasornet", "deeptof2017"])
def test_a_training_cut_short_ends_with_the_same_weights(data, tmp_path, monkeypatch, text):
    monkeypatch.setattr(loop, "EVERY", 2)
    plan = recipe(tmp_path, text)
    whole = weights(trained(plan, data, tmp_path / "whole"))

    class Killed(Exception):
        pass

    said = []

    def told(line):
        said.append(line)
        if line.startswith("network: step 2"):
            raise Killed

    with pytest.raises(Killed):
        trained(plan, data, tmp_path / "cut", told)
    resumed = trained(plan, data, tmp_path / "cut", said.append)
    assert same(whole, weights(resumed))
    assert sum(line.startswith("network: step 2") for line in said) == 1
    curves = [(tmp_path / name / "network.jsonl").read_text() for name in ("whole", "cut")]
    assert curves[0] == curves[1]


def test_another_seed_gives_other_weights(data, tmp_path):
    one, two = (
        weights(trained(recipe(tmp_path, SMALL + f"seed = {i}"), data, tmp_path / f"{i}"))
        for i in (0, 1)
    )
    assert not same(one, two)


def test_the_frozen_encoder_stays_as_it_was(data, tmp_path):
    plan = recipe(tmp_path, RANGE)
    model = trained(plan, data, tmp_path / "work")
    with np.load(tmp_path / "work" / "autoencoder.npz", allow_pickle=False) as first:
        for name, value in weights(model).items():
            stays = np.array_equal(first[f"model {name}"], value)
            assert stays == name.startswith("encoder"), name


def test_it_learns(data, tmp_path):
    """A quarter of the light comes 0.6 m later, in every frame: a shift that is easily learnt."""
    text = SMALL.replace("steps = 6", "steps = 120\nlearning_rate = 0.01\nmax_range_m = 3.7")
    trained(recipe(tmp_path, text), data, tmp_path / "work")
    last = json.loads((tmp_path / "work" / "network.jsonl").read_text().splitlines()[-1])
    assert last["median_cm"] < 0.5 * last["raw_cm"]


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 no archive"])
def test_damaged_checkpoints_are_refused(data, tmp_path, damage):
    plan = recipe(tmp_path, SMALL)
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "network.npz").write_bytes(damage)
    with pytest.raises(ValueError, match="damaged or of another network; delete"):
        trained(plan, data, tmp_path / "work")


def test_ablations_leave_their_channels_out(tmp_path):
    full, coarse = channels(2)
    keep = kept(2, ("bounce", "residuals", "candidates", "reflectance"))
    assert keep.size == full + coarse
    assert keep[[0, 1, 2, 4]].all() and not keep[[3, *range(5, full)]].any()
    assert keep[full : full + 5].all() and not keep[full + 5 :].any()
    plan = recipe(tmp_path, SMALL + 'without = ["bounce"]')
    model = network(plan).eval()
    torch.nn.init.normal_(model.head.weight)
    inputs = [torch.from_numpy(a) for a in example(card_of(plan, ""), (full, coarse)).values()]
    told = model(*inputs)
    inputs[1][:, 5:] = 7.0
    assert torch.equal(model(*inputs), told)
    inputs[1][:, 3] = 7.0
    assert not torch.equal(model(*inputs), told)


# Standardised convolutions


def test_standardised_weights_keep_the_size_of_signals():
    torch.manual_seed(0)
    layer = StandardConv(40, 30)
    weights = layer.standard().detach().numpy()
    own = layer.weight.detach().numpy()
    for filtered, given in zip(weights, own, strict=True):
        want = 1.7128586 * (given - given.mean()) / (given.std() * np.sqrt(given.size))
        assert np.allclose(filtered, want, rtol=1e-4, atol=1e-6)
    # Normal in, ReLU, convolution, ReLU, convolution: the variance stays (borders aside).
    x = torch.randn(8, 40, 40, 40)
    with torch.no_grad():
        for _ in range(4):
            x = StandardConv(40, 40)(torch.relu(x))
    assert float(x[:, :, 6:-6, 6:-6].var(dim=(0, 2, 3)).mean()) == pytest.approx(1, abs=0.35)


def test_a_frame_is_answered_alone_as_in_a_batch(tmp_path):
    plan = recipe(tmp_path, SMALL)
    model = network(plan).train()
    torch.nn.init.normal_(model.head.weight)
    inputs = example(card_of(plan, ""), channels(2))
    alone = model(*(torch.from_numpy(a) for a in inputs.values()))
    beside = model(*(torch.from_numpy(np.concatenate([a, 9 + a])) for a in inputs.values()))
    assert torch.allclose(beside[:1], alone, atol=1e-4)


def test_folded_networks_are_plain_and_answer_the_same(tmp_path):
    plan = recipe(tmp_path, SMALL)
    model = network(plan).eval()
    torch.nn.init.normal_(model.head.weight)
    inputs = [torch.from_numpy(a) for a in example(card_of(plan, ""), channels(2)).values()]
    with torch.no_grad():
        told = model(*inputs)
        assert any(isinstance(m, StandardConv) for m in model.modules())
        again = folded(model)(*inputs)
    assert not any(isinstance(m, StandardConv) for m in model.modules())
    assert torch.allclose(told, again, atol=1e-4 * float(told.abs().max()))


# Files


@pytest.mark.parametrize(
    "text", [SMALL, RANGE, RANGE + 'skip = "concat"', RANGE + 'skip = "none"'],
    ids=["phasornet", "add", "concat", "none"],
)  # fmt: skip
def test_exported_networks_answer_as_what_was_trained(tmp_path, text):
    plan = recipe(tmp_path, text)
    torch.manual_seed(1)
    model = network(plan).eval()
    torch.nn.init.normal_(model.head.weight)
    card = card_of(plan, "abc")
    shape = channels(len(plan.freqs_hz))
    export(model, card, example(card, shape), tmp_path / "net.onnx")
    told, file = read_card(tmp_path / "net.onnx")
    assert told == card
    run = engine(file, "net")
    for rows, columns in ((96, 128), (32, 224)):  # others than it was traced with
        inputs = example(card, shape)
        wide = {name: np.resize(a, (*a.shape[:2], rows * a.shape[2] // 64,
                                    columns * a.shape[3] // 64))
                for name, a in inputs.items()}  # fmt: skip
        with torch.no_grad():
            wanted = model(*(torch.from_numpy(a) for a in wide.values())).numpy()
        assert np.allclose(run(wide), wanted, atol=1e-4 * np.abs(wanted).max())


def test_a_file_that_answers_otherwise_is_not_written(tmp_path, monkeypatch):
    plan = recipe(tmp_path, SMALL)
    model, card = network(plan), card_of(plan, "")
    torch.nn.init.ones_(model.head.bias)
    monkeypatch.setattr("toftools.train.export.engine", lambda *_: lambda _: np.zeros(1))
    with pytest.raises(RuntimeError, match="off the trained one"):
        export(model, card, example(card, channels(2)), tmp_path / "net.onnx")
    assert not (tmp_path / "net.onnx").exists()


def test_eight_bits_answer_nearly_the_same(tmp_path):
    plan = recipe(tmp_path, SMALL)
    torch.manual_seed(2)
    model, card = network(plan).eval(), card_of(plan, "")
    torch.nn.init.normal_(model.head.weight)
    inputs = example(card, channels(2))
    export(model, card, inputs, tmp_path / "net.onnx")
    quantised(tmp_path / "net.onnx", [inputs], card, tmp_path / "eight.onnx")
    told, file = read_card(tmp_path / "eight.onnx")
    assert told == card
    whole, eight = (engine(f, "net")(inputs) for f in ((tmp_path / "net.onnx").read_bytes(), file))
    assert 0 < np.abs(whole - eight).mean() < 0.1 * np.abs(whole).mean()


# The command


def test_the_command_makes_a_file_that_corrects(data, tmp_path):
    (tmp_path / "small.toml").write_text(SMALL)
    out = tmp_path / "net.onnx"
    line = ["train", str(tmp_path / "small.toml"), "--data", str(data), "--out", str(out)]
    eight = tmp_path / "eight.onnx"
    done = CliRunner().invoke(cli, [*line, "--json", "--int8", str(eight)])
    assert done.exit_code == 0, done.output
    assert read_card(eight)[0] == read_card(out)[0] and eight.read_bytes() != out.read_bytes()
    assert json.loads(done.stdout)["step"] == 6
    assert (tmp_path / "net" / "curves.png").read_bytes().startswith(b"\x89PNG")
    device = sensor("opt8241:width=64,height=48")
    run = find(CORRECTIONS, f"network:model={out}").build(device)
    depth = run(Phasors(np.ones((2, 48, 64), np.complex64)))
    assert np.isfinite(depth.range_m).all() and (depth.sigma_m > 0).all()
    assert depth.info["network"]["name"] == "small"
    again = CliRunner().invoke(cli, line)
    assert again.exit_code == 0 and "mean absolute error" in again.output
    (tmp_path / "small.toml").write_text(SMALL + "seed = 4")
    other = CliRunner().invoke(cli, line)
    assert isinstance(other.exception, ValueError) and "another recipe" in str(other.exception)


def test_range_networks_correct_too(data, tmp_path):
    (tmp_path / "range.toml").write_text(RANGE)
    out = tmp_path / "range.onnx"
    line = ["train", str(tmp_path / "range.toml"), "--data", str(data), "--out", str(out)]
    assert CliRunner().invoke(cli, line).exit_code == 0
    run = find(CORRECTIONS, f"network:model={out}").build(sensor("deeptof:width=50,height=41"))
    depth = run(Phasors(np.ones((1, 41, 50), np.complex64)))
    assert depth.range_m.shape == (41, 50) and depth.sigma_m is None


def test_a_recipe_may_name_its_data(data, tmp_path):
    (data.parent / "near.toml").write_text(SMALL + f'data = "{data.name}"')
    line = ["train", str(data.parent / "near.toml"), "--out", str(tmp_path / "a.onnx")]
    done = CliRunner().invoke(cli, line)
    assert done.exit_code == 0, done.output
    (tmp_path / "none.toml").write_text(SMALL)
    line[1] = str(tmp_path / "none.toml")
    assert "names no data set; give --data" in str(CliRunner().invoke(cli, line).exception)


def test_wrong_names_are_told(tmp_path):
    line = ["train", "nothing", "--data", str(tmp_path), "--out", str(tmp_path / "a.onnx")]
    assert "one of: deeptof2017" in str(CliRunner().invoke(cli, line).exception)
    line[-1] = str(tmp_path / "a.bin")
    assert "wanted one that ends in .onnx" in str(CliRunner().invoke(cli, line).exception)
