# Needs Python 3.10+ and make. Every target sets up what it needs in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
BENCH_READY := $(VENV)/.bench_ready
SERVICES_READY := $(VENV)/.services_ready

.PHONY: demo table1 test test-slow test-services check format docs bench bench-methods bench-toy clean

demo: $(READY)
	$(BIN)/sb3-ars train demo

# The paper's Table 1 with the ablations of Table 4, in small: toy tasks and real ones, three seeds, one report.
table1: $(READY)
	$(BIN)/sb3-ars bench table1 table4 --scale toy small --seeds 3 --output sweep \
		--only mt10-sac mt10-ars mt10-ars-ln mt10-ablation-no-reset mt10-ablation-no-scaling

test: $(READY)
	$(BIN)/pytest -n auto

test-slow: $(READY)
	$(BIN)/pytest -n auto -m slow

# Ray comes with its extra; PostgreSQL's server from Debian's package postgresql. What is missing is skipped, with a reason.
test-services: $(SERVICES_READY)
	$(BIN)/pytest -m services

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest -n auto

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(READY)
	$(BIN)/python -m sphinx -W --keep-going -b html docs build/docs

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

$(SERVICES_READY): $(READY)
	@echo "Adding Ray: about 70 MB of downloads the first time."
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,ray]"
	@touch $(SERVICES_READY)

clean:
	rm -rf $(VENV) build *.egg-info
