# Needs Python 3.10+ and make. Every target sets up what it needs in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
BENCH_READY := $(VENV)/.bench_ready

.PHONY: demo test test-slow check format bench bench-methods bench-toy clean

demo: $(READY)
	$(BIN)/sb3-ars train demo

test: $(READY)
	$(BIN)/pytest -n auto

test-slow: $(READY)
	$(BIN)/pytest -n auto -m slow

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest -n auto

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(BENCH_READY)
	$(BIN)/python -m benchmarks.run_all

bench-methods: $(READY)
	$(BIN)/python -m benchmarks.run_all --only methods

bench-toy: $(READY)
	$(BIN)/python -m benchmarks.toy_methods
	$(BIN)/python -m benchmarks.report

$(READY): setup.cfg pyproject.toml constraints.txt
	@echo "Setting up $(VENV): a few minutes, and about 1 GB of downloads the first time."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $(READY)

$(BENCH_READY): $(READY)
	@echo "Adding the peers that the benchmarks measure beside: about 300 MB of downloads the first time."
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,benchmarks]"
	@touch $(BENCH_READY)

clean:
	rm -rf $(VENV) build *.egg-info
