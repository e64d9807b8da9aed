# Everything runs in a virtual environment of its own, with the versions in constraints.txt.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs/compare
INSTALLED := $(VENV)/.installed

.PHONY: compare test test-slow lint types benchmark clean

compare: $(INSTALLED)
	$(BIN)/ncs compare --out $(OUT)

test: $(INSTALLED)
	$(BIN)/python -m pytest -n auto --dist worksteal

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -n auto --dist worksteal -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	$(BIN)/pyright --pythonpath $(BIN)/python

benchmark: $(INSTALLED)
	$(BIN)/python benchmarks/shield_decision.py
	$(BIN)/python benchmarks/containment.py
	$(BIN)/python benchmarks/synthesis.py
	$(BIN)/python benchmarks/contracts.py
	$(BIN)/python benchmarks/vector_env.py
	$(BIN)/python benchmarks/codesign_grid.py
	$(BIN)/python benchmarks/rendering.py
	$(BIN)/python benchmarks/ppo_settings.py

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[train,render,dev]'
	touch $@

clean:
	rm -rf $(VENV)
