"""The map of chosen models: one colour each, shares told, kept from worker to report."""

import io

import numpy as np
import pytest
from PIL import Image

from toftools.bench.score import read_answer
from toftools.bench.worker import _store_answer
from toftools.io.export import write_npz
from toftools.sensors import sensor
from toftools.types import DepthMap
from toftools.viz.models import COLOURS, models_png

MODEL = np.repeat(np.array([[0, 1, 2]], np.uint8), 20, axis=0).repeat(20, axis=1)
NAMES = ("one return", "bounced light", "two returns")


def test_every_model_has_its_colour_and_no_answer_is_white():
    known = np.ones(MODEL.shape, bool)
    known[:5] = False
    picture = np.asarray(Image.open(io.BytesIO(models_png(MODEL, NAMES, known))).convert("RGB"))
    shown = {tuple(int(x) for x in c) for c in picture.reshape(-1, 3)}
    for colour in COLOURS[:3]:
        assert tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5)) in shown
    assert (255, 255, 255) in shown


def test_an_index_without_a_name_is_refused():
    with pytest.raises(ValueError, match="wanted \\(H, W\\) below 2"):
        models_png(MODEL, NAMES[:2], np.ones(MODEL.shape, bool))


def test_the_map_survives_storing(tmp_path):
    info = {"status": np.zeros(MODEL.shape, np.uint8), "model": MODEL, "models": NAMES}
    depth = DepthMap(np.ones(MODEL.shape, np.float32), info=info)
    _store_answer(tmp_path / "a.npz", depth)
    again = read_answer(tmp_path / "a.npz")
    assert np.array_equal(again.info["model"], MODEL)
    assert tuple(again.info["models"]) == NAMES
    write_npz(tmp_path / "b.npz", depth, sensor("deeptof:width=60,height=20").camera)
    with np.load(tmp_path / "b.npz", allow_pickle=False) as stored:
        assert tuple(stored["models"]) == NAMES
