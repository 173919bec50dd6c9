# `make demo` and `make test` do all set-up themselves, in one environment, .venv, in the checkout.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DATA ?=
OUT ?= out/demo
PYTEST ?=

.PHONY: setup demo test test-much test-little test-gymnasium test-lowest rllib lint bench docs clean

setup: $(VENV)/.installed

# Stamps: .data is what the command line needs, .installed what tests need besides, in the same environment.
$(VENV)/.data: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[data,kernels]'
	touch $@

$(VENV)/.installed: $(VENV)/.data
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,docs]'
	touch $@

demo: $(VENV)/.data
	$(BIN)/idm-env demo $(if $(DATA),--data '$(DATA)') --out '$(OUT)'

# Most tests, of compiled code above all, run it as users do. Those that make many environments and step each of them a little
# compile it unoptimised, which takes half the time. Each file on one worker, which compiles its programs once; those that take
# longest stand first, so that no worker waits for another in the end.
FACES := $(addprefix tests/envs/test_,gym.py pettingzoo.py sb3.py render.py limits.py fitting_wrapper.py)
COMMANDS := $(addprefix tests/test_,cli.py docs.py docs_commands.py examples.py faults.py)
LITTLE := $(filter-out $(COMMANDS),$(wildcard tests/test_*.py)) tests/agents/ tests/tasks/ \
  $(addprefix tests/envs/test_,recording.py unroll.py step_gradients.py) $(FACES) \
  tests/laws/test_printed.py tests/kernels/test_policy_rows.py
MUCH := $(COMMANDS) $(filter-out $(LITTLE),$(sort $(dir $(wildcard tests/*/test_*.py))))
TEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(PYTEST)
test: test-much test-little

test-much: setup
	$(TEST) $(addprefix --ignore=,$(filter-out %/,$(LITTLE))) $(MUCH)

test-little: setup
	NUMBA_OPT=0 $(TEST) $(LITTLE)

# What meets Gymnasium's own code, on the version that RLlib pins: that one alone, before the one of .venv.
GYMNASIUM := build/gymnasium-1.2.2
test-gymnasium: setup
	test -d $(GYMNASIUM)/gymnasium || \
	  $(BIN)/python -m pip install --quiet --no-deps --target $(GYMNASIUM) gymnasium==1.2.2
	PYTHONPATH=$(GYMNASIUM) NUMBA_OPT=0 $(TEST) $(FACES) tests/envs/test_vector.py

# What users touch, on the lowest versions that pyproject.toml allows (torch: that of constraints.txt), in an environment of
# its own; without what takes further libraries from .venv.
LOWEST := build/lowest
test-lowest: setup
	$(PYTHON) -m venv $(LOWEST)
	$(BIN)/python .ci/lowest.py > $(LOWEST)/versions.txt
	$(LOWEST)/bin/python -m pip install --quiet --constraint $(LOWEST)/versions.txt --editable '.[all,ray]' \
	  pytest pytest-xdist pytest-timeout hypothesis packaging 'setuptools>=77'
	$(LOWEST)/bin/python -m pytest -n 2 --ignore tests/envs/test_torchrl.py -k 'not supersuit and not record_video' \
	  tests/envs tests/tasks tests/data tests/fitting tests/prediction tests/trajectories/test_files.py \
	  tests/test_cli.py tests/test_storage.py tests/test_executor.py tests/test_report.py tests/test_wheel.py

# RLlib's example, in the environment that RLlib wants (2 GB).
RLLIB := build/rllib
rllib:
	$(PYTHON) -m venv $(RLLIB)
	$(RLLIB)/bin/python -m pip install --quiet --requirement examples/rllib.txt --editable '.[data,kernels]'
	$(RLLIB)/bin/python examples/train_rllib.py

lint: setup
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

bench: setup
	$(BIN)/python -m benchmarks.bench

# The site, into build/site: warnings are errors, and no network is needed once the libraries are there. GALLERY=0 shows the
# examples without running them, as continuous integration does, whose tests run them all.
docs: setup
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/doctrees $(if $(filter 0,$(GALLERY)),-D plot_gallery=0) docs build/site
	@echo "Site: build/site/index.html"

clean:
	rm -rf $(VENV) out build docs/generated docs/gallery *.egg-info
