# Two commands: `make run` (the built-in example) and `make test`. Both make .venv first, once.
# Needed beforehand: make, Python 3.11 or later with venv, pip.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
COMPILER := $(shell command -v g++ || command -v c++ || command -v clang++)
# One thread a worker: two of them on the same core wait for each other. nproc would answer with a given OMP_NUM_THREADS.
TESTS = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(shell env -u OMP_NUM_THREADS nproc) --dist worksteal
comma := ,
LOWEST = tests/test_units.py tests/test_yaml_files.py tests/test_config_plant.py tests/test_config_run.py \
	tests/test_recording_csv.py tests/test_hostile_files.py tests/test_command_line.py tests/logbook/test_reader.py \
	tests/test_recording_tables.py tests/test_recording_sheets.py tests/test_recording_database.py tests/test_live_outlets.py \
	tests/test_live_rows.py tests/test_live_mqtt.py tests/test_live_modbus.py tests/test_live_opcua.py
LOWEST_EXTRAS := parquet,excel,hdf5,sql,influx,mqtt,opcua,modbus,prometheus
EXTRAS := test$(if $(COMPILER),,$(comma)compiler)

.PHONY: run test slow longest mutants lint paper docs lowest clean

run: $(STAMP)
	$(BIN)/python -m fdi_torch.train

# The fast tests; MARKS='not longest' adds the slow ones, as CI does: libraries are loaded and tests collected once.
test: $(STAMP)
	$(TESTS) $(if $(MARKS),-m '$(MARKS)')

slow: $(STAMP)
	$(TESTS) -m slow

longest: $(STAMP)
	$(TESTS) -m longest

# Deliberate faults in the core, each of which the tests of its room must notice; WORDS=estimate runs some of them.
mutants: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.mutants $(WORDS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

paper: $(STAMP)
	$(BIN)/python -m benchmarks.paper

# The site, in site/; its links are checked.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# The quickest tests of every reader and writer, on the lowest versions that pyproject.toml allows.
lowest:
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet --constraint constraints-lowest.txt --editable '.[$(LOWEST_EXTRAS)]' pytest hypothesis
	OMP_NUM_THREADS=1 .venv-lowest/bin/python -m pytest $(LOWEST)

# pip would compile 15000 files to bytecode on one core; of some packages, a few are not meant to be compiled.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[$(EXTRAS)]'
	$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true
	$(if $(COMPILER),,$(BIN)/python -c 'from fdi_torch.simulate.build import warm_up; warm_up()')
	touch $@

clean:
	rm -rf $(VENV) .venv-lowest .pytest_cache .mypy_cache .ruff_cache site
