# `make demo` and `make test` do all set-up themselves: one environment, .venv, in the checkout.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DATA ?=
OUT ?= out/demo

.PHONY: setup demo test lint bench docs clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: setup
	$(BIN)/idm-env demo $(if $(DATA),--data '$(DATA)') --out '$(OUT)'

test: setup
	$(BIN)/python -m pytest -n 2

lint: setup
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

bench: setup
	$(BIN)/idm-env bench

# The site, into build/site: warnings are errors, and no network is needed once the libraries are there.
docs: setup
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/doctrees docs build/site
	@echo "Site: build/site/index.html"

clean:
	rm -rf $(VENV) out build docs/generated docs/gallery *.egg-info
