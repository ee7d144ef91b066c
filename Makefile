# Everything runs in the checkout's own .venv, which the first target to need it sets up.
PYTHON ?= python3
BIN := .venv/bin
ROOMS := lab projector tracking robot analysis

.PHONY: setup session samples notebooks test coverage check bench docs clean

setup: .venv/ready

.venv/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "chordlab needs Python 3.11 or newer: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,projector]'
	@touch $@

# A full session on the virtual bench: the Eiffel Tower, a virtual BOLT, a filmed floor, a report.
session: setup
	$(BIN)/chordlab run --simulate --shape eiffel $(ARGS)

# The stored sessions of data/sessions, rolled anew from the settings beside them.
samples: setup
	$(BIN)/python data/sessions/make.py

# The notebooks, run anew, with what they print and draw.
notebooks: setup
	$(BIN)/python docs/notebooks/make.py

test: setup
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

# The same, counting the lines that were run; half as slow again.
coverage: setup
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term --cov-fail-under=90 $(ARGS)

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports --no-logo
	$(BIN)/codespell $(ROOMS) tests docs README.md CHANGELOG.md Makefile pyproject.toml

bench: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python -m pytest tests/bench -o addopts=--import-mode=importlib -o python_files='bench_*.py' -o timeout=600 \
		--benchmark-columns=min,median,max,rounds --benchmark-sort=name $(ARGS)

# The site, in build/docs; a warning is an error. Then the links, commands and outputs of the pages.
docs: setup
	$(BIN)/sphinx-build -q -W -n --keep-going docs build/docs
	$(BIN)/python -m pytest -q tests/docs $(ARGS)

clean:
	rm -rf .venv build dist
