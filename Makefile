# The commands set up everything they need in .venv (pinned by constraints.txt), then do their job.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed

.PHONY: demo test fuzz docs without-torch clean

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	touch $(STAMP)

demo: $(STAMP)
	$(VENV)/bin/python examples/demo.py

test: $(STAMP)
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile

fuzz: $(STAMP)
	$(VENV)/bin/python tests/fuzz/hunt.py --mutants 100000

docs: $(STAMP)
	$(VENV)/bin/python tools/build_reference.py docs/reference

without-torch: $(STAMP)
	PYTHON=$(PYTHON) .ci/without_torch

clean:
	rm -rf $(VENV) docs/reference
