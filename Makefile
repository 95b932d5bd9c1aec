# Two commands: `make run` (the built-in example) and `make test`. Both make .venv first, once.
# Needed beforehand: make, Python 3.11 or later with venv, pip.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
COMPILER := $(shell command -v g++ || command -v c++ || command -v clang++)
# One thread a worker: two of them on the same core wait for each other.
TESTS = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(shell nproc) --dist worksteal
comma := ,
EXTRAS := test$(if $(COMPILER),,$(comma)compiler)

.PHONY: run test slow lint paper clean

run: $(STAMP)
	$(BIN)/python -m fdi_torch.train

test: $(STAMP)
	$(TESTS)

slow: $(STAMP)
	$(TESTS) -m slow

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

paper: $(STAMP)
	$(BIN)/python -m fdi_torch paper

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$(EXTRAS)]'
	$(if $(COMPILER),,$(BIN)/python -c 'from fdi_torch.simulate.build import warm_up; warm_up()')
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache
