"""The house rules of DESIGN section 2, as tests: order of imports, one home for constants, size."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from toftools.registry import (
    CALIBRATIONS,
    CORRECTIONS,
    METRICS,
    READERS,
    SIMULATORS,
    find,
    parameters_of,
)

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "toftools"
FILES = sorted(PACKAGE.rglob("*.py"))

# From the bottom of the house to the top; a file imports only what stands before it.
LAYERS = [
    "units", "_arrays", "_lens", "electronics", "device", "types", "tap_noise", "phasor", "crlb",
    "camera", "transient", "_params", "_recipe_file", "conditions", "registry", "chain",
    "_overrides", "sensors", "_native", "_turns", "_transfer", "io", "sim", "calib", "correct",
    "filter", "metrics", "viz", "bench", "dataset", "train", "cli", "__main__",
]  # fmt: skip
# _overrides reads waveforms by name and sits below sim for that one function-level import.
UPWARD = {("_overrides", "sim"): "waveforms, beams and codes by name are the simulator's"}
HEAVY = ("mitsuba", "drjit", "open3d", "cv2", "onnxruntime", "matplotlib", "numba", "scipy", "h5py")


def layer_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0]


def imported(path: Path) -> set[str]:
    """First-level toftools modules a file imports, wherever in the file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        found |= {name.split(".")[1] for name in names if name.startswith("toftools.")}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_downwards(path):
    layer = layer_of(path)
    if layer == "__init__":
        return
    assert layer in LAYERS, f"{layer} has no place in the order of the house"
    for other in imported(path):
        allowed = LAYERS.index(other) <= LAYERS.index(layer) or (layer, other) in UPWARD
        assert allowed, f"{path.name} ({layer}) imports {other}, which stands above it"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_speed_of_light_and_four_pi_live_in_units(path):
    if path.name == "units.py":
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            near_c = any(abs(node.value - c) < 1e-3 * c for c in (299_792_458.0, 299.792458))
            assert not near_c, f"{path.name}:{node.lineno} holds the speed of light"
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            text = ast.unparse(node)
            four_pi = any(s in text for s in ("4 * np.pi", "4.0 * np.pi", "np.pi * 4"))
            assert not four_pi, f"{path.name}:{node.lineno} holds 4 pi; use units.py"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_and_functions_stay_small(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 300, f"{path.name} has {len(lines)} lines"
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            size = body[-1].end_lineno - body[0].lineno + 1 if body else 0
            assert size <= 50, f"{path.name}:{node.name} has {size} lines"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_print_and_no_global_random(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called != "print", f"{path.name}:{node.lineno} prints"
            if called.startswith("np.random."):
                known = called in ("np.random.default_rng", "np.random.Generator")
                assert known, f"{path.name}:{node.lineno} uses the global random state"
        if isinstance(node, ast.Name):
            assert node.id not in ("pickle", "eval", "exec"), f"{path.name}:{node.lineno}"


def test_import_is_light():
    code = "import sys, toftools; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    heavy = set(HEAVY) & set(loaded.stdout.split())
    assert not heavy, f"import toftools loads {heavy}"


def test_help_is_light():
    code = (
        "import sys\nfrom toftools.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit: pass\n"
        "print(*sorted({m.split('.')[0] for m in sys.modules}), file=sys.stderr)"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "Commands" in loaded.stdout
    assert not set(HEAVY) & set(loaded.stderr.split())


@pytest.mark.parametrize(
    "table",
    [SIMULATORS, CALIBRATIONS, CORRECTIONS, METRICS],
    ids=["sim", "calib", "correct", "metric"],
)
def test_entries_load_and_take_keyword_parameters_with_defaults(table):
    import inspect

    for name, spec in table.items():
        make = spec.load()
        assert make.__doc__, name
        positional = [p for p in inspect.signature(make).parameters.values()
                      if p.kind is not inspect.Parameter.KEYWORD_ONLY]  # fmt: skip
        assert len(positional) == 1, f"{name} takes one context"
        for key, default in parameters_of(make).items():
            assert default is not inspect.Parameter.empty, f"{name}: {key} has no default"
        for key in (*spec.grid, *spec.params):
            assert key in parameters_of(make), f"{name}: grid or params name {key}"


def test_readers_have_a_sniffer():
    import importlib

    for name, spec in READERS.items():
        module = importlib.import_module(spec.target.partition(":")[0])
        assert callable(module.sniff), name


def test_unknown_method_and_unknown_parameter_are_refused():
    with pytest.raises(ValueError, match="unknown name 'nope'; known: single,"):
        find(CORRECTIONS, "nope")
    with pytest.raises(ValueError, match="cannot load method 'no_such_package"):
        find(CORRECTIONS, "no_such_package.x:make").load()
    with pytest.raises(
        ValueError, match="single has no parameter 'frequency'; it takes: freq_index"
    ):
        find(CORRECTIONS, "single:frequency=1").build(object())
