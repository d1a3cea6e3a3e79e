# The commands set up everything they need in .venv (pinned by constraints.txt), then do their job; the demo needs the least.
PYTHON ?= python3
VENV := .venv
PIP := $(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable
USE := $(VENV)/.installed-to-use
STAMP := $(VENV)/.installed

.PHONY: demo test types fuzz fuzz-minute docs without-torch budget clean

$(USE): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) .
	touch $(USE)

$(STAMP): $(USE) lab/pyproject.toml
	$(PIP) '.[test]' --editable lab
	touch $(STAMP)

demo: $(USE)
	$(VENV)/bin/python examples/demo.py

test: $(STAMP)
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile

types: $(STAMP)
	$(VENV)/bin/python -m mypy
	$(VENV)/bin/python -m pyright --pythonpath $(VENV)/bin/python

fuzz: $(STAMP)
	$(VENV)/bin/python tests/fuzz/hunt.py --mutants 100000

fuzz-minute: $(STAMP)
	$(VENV)/bin/python tests/fuzz/hunt.py --mutants 100000 --seconds 60

docs: $(STAMP)
	$(VENV)/bin/python tools/build_site.py build/site

without-torch: $(STAMP)
	PYTHON=$(PYTHON) .ci/without_torch

budget: $(STAMP)
	$(VENV)/bin/python benchmarks/budget.py

clean:
	rm -rf $(VENV) build/site
