# make demo: installs, reconstructs the sample capture and opens it up in a .blend and a picture.
# make test: the whole test suite.
# make test-bpy52: the add-on's tests on Blender 5.2, where there is a Python 3.13.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
PYTHON313 ?= $(shell command -v python3.13)
VENV := .venv
VENV45 := .venv-bpy45
VENV52 := .venv-bpy52
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
INSTALLED45 := $(VENV45)/.installed
INSTALLED52 := $(VENV52)/.installed
ZIP := dist/insideout-$(shell sed -n 's/^version = "\(.*\)"/\1/p' blender_manifest.toml).zip
BLENDER_EXT = $(shell find $(VENV)/lib -path '*bl_pkg/cli/blender_ext.py' | head -1)

.PHONY: demo test test-bpy52 test-slow lint extension sample clean

demo: $(INSTALLED)
	$(BIN)/insideout run samples/matryoshka --out demo --preset draft
	$(BIN)/python examples/make_blend.py -- demo --out demo

# Renderers and trainers first, with as many threads as users have; the rest with one in a process.
THREADED := tests/core/render tests/core/train
# Two processes compile what has little in common, at once: no test waits for the other's kernels.
COMPILE = $(BIN)/python -c 'import sys; from insideout.core.render.kernels.cpu import warm_up; warm_up(sys.argv[1:])'
ADDON := tests/insideout_addon tests/operators tests/panels tests/examples

test: $(INSTALLED) $(INSTALLED45)
	$(COMPILE) splat splat_effects & $(COMPILE) radiograph section; wait
	$(BIN)/pytest -q -n 2 --dist loadfile $(THREADED)
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/pytest -q -n 2 --dist loadfile $(THREADED:%=--ignore %)
	$(VENV45)/bin/pytest -q -n 2 --dist loadfile $(ADDON)

ifneq ($(PYTHON313),)
test-bpy52: $(INSTALLED52)
	$(VENV52)/bin/pytest -q -n 2 --dist loadfile $(ADDON)
else
test-bpy52:
	@echo "There is no python3.13 here, so Blender 5.2 is left out; make test-bpy52 PYTHON313=/path/to/python3.13"
endif

test-slow: $(INSTALLED)
	$(BIN)/pytest -q -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p $(VENV)/typed && ln -sfn $(CURDIR) $(VENV)/typed/insideout
	cd $(VENV)/typed && ../bin/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache -p insideout.core

extension: $(INSTALLED)
	mkdir -p dist
	$(BIN)/python $(BLENDER_EXT) build --source-dir . --output-filepath $(ZIP)
	$(BIN)/python $(BLENDER_EXT) validate $(ZIP)

sample: $(INSTALLED)
	rm -rf build/sample
	$(BIN)/insideout phantom matryoshka --shells 5 --photos-by rays --surface-mm 2 --out build/sample
	rm -rf samples/matryoshka && mv build/sample samples/matryoshka

clean:
	rm -rf demo build dist

# PyPI's torch for Linux brings several GB for graphics cards, which only `--kernel cuda` uses. Where the other index
# cannot be reached pip goes on with those that it is told of.
CPU_TORCH := $(if $(filter Linux,$(shell uname -s)),--no-deps --retries 0 --index-url https://download.pytorch.org/whl/cpu torch)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11) and "InsideOut needs Python 3.11; make PYTHON=/path/to/python3.11")'
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --upgrade pip
	$(if $(CPU_TORCH),-$(BIN)/python -m pip install --quiet --constraint constraints.txt $(CPU_TORCH))
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[blender,dev]"
	touch $@

$(INSTALLED45): constraints-bpy45.txt
	$(VENV45)/bin/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV45)
	$(VENV45)/bin/python -m pip install --quiet --constraint constraints-bpy45.txt --upgrade pip
	$(VENV45)/bin/python -m pip install --quiet --requirement constraints-bpy45.txt
	$(VENV45)/bin/python -m pip install --quiet --no-deps --editable .
	touch $@

# The engine's Python is 3.11, so pip would refuse this checkout; the add-on needs no more than to be found.
$(INSTALLED52): constraints-bpy52.txt
	@$(PYTHON313) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 13) and "Blender 5.2 needs Python 3.13; make test-bpy52 PYTHON313=/path/to/python3.13")'
	$(VENV52)/bin/python -m pip --version >/dev/null 2>&1 || $(PYTHON313) -m venv $(VENV52)
	$(VENV52)/bin/python -m pip install --quiet --constraint constraints-bpy52.txt --upgrade pip
	$(VENV52)/bin/python -m pip install --quiet --requirement constraints-bpy52.txt
	ln -sfn $(CURDIR) $(VENV52)/lib/python3.13/site-packages/insideout
	touch $@
