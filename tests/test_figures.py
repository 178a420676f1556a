"""Pictures are judged by their content: colours where they belong, labels apart, hover texts."""

import io
import itertools
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from toftools.viz._labels import CHAR_EM
from toftools.viz.figures import (
    Coverage,
    Curve,
    coverage_svg,
    depth_png,
    error_png,
    maps_png,
    pareto_svg,
)

SVG = "{http://www.w3.org/2000/svg}"


def pixels(png: bytes) -> np.ndarray:
    assert png.startswith(b"\x89PNG\r\n")
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def middle(image: np.ndarray, left: float, right: float) -> np.ndarray:
    """Mean colour of a vertical strip of a one-panel picture (map at 10..522 px of 640)."""
    columns = slice(round(10 + 512 * left), round(10 + 512 * right))
    rows = slice(image.shape[0] // 3, 2 * image.shape[0] // 3)
    return image[rows, columns].mean(axis=(0, 1))


def thirds(left: float, centre: float, right: float) -> np.ndarray:
    return np.repeat([[left, centre, right]], 48, axis=0).repeat(20, axis=1)


def test_depth_map_runs_from_dark_to_yellow_and_hatches_missing_pixels():
    image = pixels(depth_png(thirds(1.0, np.nan, 3.0), vmin_m=1, vmax_m=3, title="truth"))
    assert image.shape[1] == 640
    near, missing, far = middle(image, 0.05, 0.3), middle(image, 0.36, 0.64), middle(image, 0.7, 1)
    np.testing.assert_allclose(near, [68, 1, 84], atol=2)  # the ends of viridis
    np.testing.assert_allclose(far, [253, 231, 37], atol=2)
    assert np.ptp(missing) < 1.5  # grey ...
    hatched = image[image.shape[0] // 2 - 40 : image.shape[0] // 2 + 40, 210:320]
    assert np.ptp(hatched) > 20  # ... and not flat


def test_error_map_is_white_at_zero_red_too_far_blue_too_near():
    image = pixels(error_png(thirds(-0.02, 0.0, 0.02), limit_m=0.02))
    near, right, far = middle(image, 0.05, 0.3), middle(image, 0.36, 0.64), middle(image, 0.7, 1)
    assert near[2] > near[0] + 50
    assert far[0] > far[2] + 50
    assert right.min() > 240


def test_error_maps_of_one_picture_share_their_scale():
    both = maps_png([("a", thirds(0, 0.01, 0.04), "error"), ("b", thirds(0.01, 0, 0), "error")])
    image = pixels(both)
    assert image.shape[1] == 1200
    cell = (1200 - 118) / 2
    row = image.shape[0] // 2
    assert (image[row, round(cell / 2)] == image[row, round(cell * 1.15)]).all()  # 10 mm in both


def test_scale_of_a_kind_ignores_the_other_kinds():
    far, errors = np.full((48, 60), 9.0), thirds(-0.01, 0, 0.01)
    alone = pixels(maps_png([("e", errors, "error"), ("e", errors, "error")]))
    beside = pixels(maps_png([("e", errors, "error"), ("far", far, "range")]))
    columns = slice(20, 540)  # the left-hand map
    assert (alone[120, columns] == beside[120, columns]).all()


def test_a_map_without_any_answer_says_so():
    nothing = pixels(maps_png([("none", np.full((24, 32), np.nan), "error")]))
    assert (nothing.min(axis=2) < 100).any()  # the words
    assert np.ptp(nothing, axis=2)[:, :1000].max() < 12  # and no colour at all in the map


@pytest.mark.parametrize(
    ("panels", "complaint"),
    [
        ([], "0 panels"),
        ([("a", np.zeros((4, 4)), "depth")], "kind 'depth'"),
        ([("a", np.zeros(4), "range")], r"shape \(4,\)"),
    ],
)
def test_bad_panels_are_refused(panels, complaint):
    with pytest.raises(ValueError, match=complaint):
        maps_png(panels)


def test_maps_leave_pyplot_alone():
    code = (
        "import sys, numpy; from toftools.viz.figures import depth_png, error_png;"
        "assert 'matplotlib' not in sys.modules; depth_png(numpy.eye(8), title='x');"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def some_curves(seed: int, n: int = 14) -> list[Curve]:
    rng = np.random.default_rng(seed)
    curves = []
    for i in range(n):
        k = int(rng.integers(1, 5))
        ms = 10 ** (rng.uniform(-1, 2.5) + np.linspace(0, 1, k))
        mae = 10 ** (rng.uniform(-2.3, -0.7) - np.linspace(0, 0.4, k) * rng.uniform(-0.2, 1))
        curves.append(Curve(f"method_{i}_2014", ms, mae, [f"p={j}" for j in range(k)]))
    return [*curves, Curve("camera's own answer", (), (0.055,), timed=False)]


def label_boxes(svg: str) -> list[tuple[float, float, float, float]]:
    boxes = []
    for text in ElementTree.fromstring(svg).iter(f"{SVG}text"):
        if text.get("class") == "label":
            x, y, size = (float(text.get(key)) for key in ("x", "y", "font-size"))
            boxes.append((x, y - 0.8 * size, x + CHAR_EM * size * len(text.text), y + 0.2 * size))
    return boxes


@pytest.mark.parametrize("seed", range(12))
def test_labels_stand_inside_the_plot_and_apart(seed):
    boxes = label_boxes(pareto_svg(some_curves(seed), title="t"))
    assert len(boxes) == 15
    for left, top, right, bottom in boxes:
        assert left >= 84
        assert right <= 936
        assert top >= 84
        assert bottom <= 498
    for a, b in itertools.combinations(boxes, 2):
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        assert apart, (a, b)


def staircase(curves: list[Curve]) -> list[tuple[float, float]]:
    """Slow twin of the frontier: points that no other point beats or equals twice."""
    points = [(m, e) for c in curves if c.timed for m, e in zip(c.ms, c.mae_m, strict=True)]
    return sorted(
        (m, e)
        for m, e in points
        if not any((n <= m and f <= e) and (n, f) != (m, e) for n, f in points)
    )


@pytest.mark.parametrize("seed", range(4))
def test_frontier_passes_through_the_undominated_points_only(seed):
    curves = some_curves(seed)
    root = ElementTree.fromstring(pareto_svg(curves, title="t"))
    path = next(p for p in root.iter(f"{SVG}path") if p.get("class") == "frontier").get("d")
    corners = [tuple(map(float, pair.split(","))) for pair in path[1:].split("L")]
    tips = {}
    for group in root.iter(f"{SVG}g"):
        x, y = group.get("transform")[10:-1].split(",")
        tips[group.find(f"{SVG}title").text] = (float(x), float(y))
    inner = [tips[t] for t in tips if tips[t] in corners]
    assert len(staircase(curves)) == len(inner)
    assert sorted(inner) == sorted(corners[1::2])
    assert all(a[0] <= b[0] and a[1] <= b[1] for a, b in itertools.pairwise(corners))


def test_every_setting_can_be_hovered_and_untimed_answers_are_dashed():
    curves = [
        Curve("sra<1>", [1.0, 10.0], [0.02, 0.01], ["grid_m=0.04", "grid_m=0.02"]),
        Curve("camera", [], [0.03], timed=False),
    ]
    root = ElementTree.fromstring(pareto_svg(curves, title="a & b"))
    tips = [title.text for title in root.iter(f"{SVG}title")]
    assert tips == [
        "a & b",
        "camera: 3 cm, not timed",
        "sra<1> grid_m=0.04: 1 ms, 2 cm",
        "sra<1> grid_m=0.02: 10 ms, 1 cm",
    ]
    dashed = [p for p in root.iter(f"{SVG}path") if p.get("stroke-dasharray") == "6 4"]
    assert len(dashed) == 1
    assert root.find(f"{SVG}rect").get("fill") == "#fff"


def test_points_that_cannot_be_charted_are_left_out():
    curves = [
        Curve("a", [1.0, np.nan, 0.0, 4.0], [0.01, 0.01, 0.01, 0.0]),  # an exact zero stays
        Curve("b", [2.0], [np.nan]),
    ]
    root = ElementTree.fromstring(pareto_svg(curves, title="t"))
    assert len(list(root.iter(f"{SVG}g"))) == 2
    assert "nan" not in ElementTree.tostring(root, encoding="unicode").lower()


@pytest.mark.parametrize("curves", [[], [Curve("a", [1.0], [np.nan])]])
def test_nothing_to_chart_is_said(curves):
    assert "Nothing to chart" in pareto_svg(curves, title="t")
    assert "Nothing to chart" in coverage_svg([], title="t")


def test_coverage_curves_end_at_all_pixels():
    share = np.linspace(0.1, 1, 10)
    svg = coverage_svg([Coverage("a", share, 0.01 * share), Coverage("b", share, 0.02 * share)],
                       title="t")  # fmt: skip
    tips = [title.text for title in ElementTree.fromstring(svg).iter(f"{SVG}title")]
    assert tips[10] == "a: 100 %, 10 mm"
    assert len(tips) == 21


def test_curves_whose_lists_do_not_pair_up_are_refused():
    with pytest.raises(ValueError, match=r"2 x values and 1 errors"):
        pareto_svg([Curve("a", [1.0, 2.0], [0.1])], title="t")
    with pytest.raises(ValueError, match=r"1 labels for 2 points"):
        pareto_svg([Curve("a", [1.0, 2.0], [0.1, 0.1], ["x"])], title="t")
