# Two commands: `make test` (everything CI checks) and `make bench` (the main job: the suite core).
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/bench

# Real captures are used where they exist; without them the suites run on simulated scenes.
ifneq ($(wildcard ../shared/data/real),)
export TOFTOOLS_DATA ?= $(abspath ../shared/data/real)
endif

.PHONY: test bench docs kernels peers lint types pytest install clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "toftools needs Python 3.11 or newer; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

lint: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: install
	$(BIN)/mypy

# One BLAS thread per worker: two spinning pools on two cores made small solves eight times slower.
pytest: install
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadgroup

test: lint types pytest

bench: install
	$(BIN)/toftools bench core --out $(OUT)

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache

# Docs that come out of code; RESULTS=DIR takes over a finished run's results first.
docs: install
	$(BIN)/python benchmarks/long_range.py --out docs/long_range
	$(BIN)/python benchmarks/proofs.py
	$(BIN)/python benchmarks/make_docs.py --pictures $(if $(RESULTS),--results $(RESULTS))
	$(BIN)/python benchmarks/leaderboard.py $(if $(RESULTS),--take $(RESULTS))

# Milliseconds of the kernels beside their readable twins (pytest-benchmark); TABLE=FILE keeps them.
kernels: install
	$(BIN)/python -m pytest benchmarks/kernels -o addopts="" -p no:dash --benchmark-only $(if $(TABLE),--table $(TABLE))

# Ours and other people's side by side, in one run; says which of them are not installed.
peers: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[peers]'
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/side_by_side.py --out docs/peers
