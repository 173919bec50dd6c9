# `make demo` and `make test` do all set-up themselves: one environment, .venv, in the checkout.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DATA ?=
OUT ?= out/demo

.PHONY: setup demo test lint bench clean

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

clean:
	rm -rf $(VENV) out build *.egg-info
