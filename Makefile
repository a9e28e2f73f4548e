# Everything happens in a virtual environment of its own: make VENV=elsewhere puts it somewhere else.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
RUN = $(BIN)/python -m

.PHONY: demo test lint clean

demo: $(VENV)/ready
	$(RUN) ctm_plugin.demo

# One thread a worker: two workers with two threads each wait for one another on two cores.
test: $(VENV)/ready
	OMP_NUM_THREADS=1 $(RUN) pytest -q -n 2

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# torch first and alone: its CPU build is the one that a plain index gives for this exact version.
$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) runs build dist
