PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := out/demo
OUT ?= $(DEMO)
export TACTIP_REAL ?= ../shared/real
# workers of tests that compute, and of tests of devices, which often wait
WORKERS ?= $(shell nproc)
DEVICES ?= $(shell expr $$(nproc) + 1)
PYTEST := $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder --durations=15 --durations-min=1
DEVICE_TESTS := $(PYTEST) -o cache_dir=.pytest_cache/devices tests/contract tests/live
SCRIPT := PYTHONPATH=$(CURDIR):$(CURDIR)/tests:$(CURDIR)/tests/helpers:$(CURDIR)/tests/bench $(BIN)/python

.PHONY: help setup demo test golden bench figures film browser gallery tables docs validate lint types wheel clean
help:            ## what can be made
	@sed -n 's/^\([a-z]*\): .*## /\1\t/p' $(MAKEFILE_LIST)

setup: $(VENV)/.installed ## install everything into .venv (as root also the system packages)
	@.ci/system-packages $(VENV)/lib/private

$(VENV)/.installed: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "no venv: install python3-venv, remove $(VENV) and run make again"; exit 1; }
	@echo "installing Python packages into $(VENV) (3 to 7 GB, a few minutes the first time; docs/install.md says how to have the smaller)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c requirements.lock -e '.[dev]'
	@$(BIN)/python -m compileall -q -j 0 -x '/tests?/' $(VENV)/lib >/dev/null 2>&1 || true # on all cores, where pip uses one; some libraries ship files for other Pythons
	@$(BIN)/twin doctor --prepare >/dev/null 2>&1 || true # compiles ahead, half a minute
	@touch $@

$(VENV)/.with-%: $(VENV)/.installed # a further extra
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[dev,$*]'
	@touch $@

# out/demo is the program's own folder: a demo of an earlier version there is replaced. In another folder only own files are.
demo: setup      ## the main job: press, render, detect, graph; pictures and a page in out/demo, or in OUT=DIR
	@$(BIN)/twin demo --out $(OUT) $(if $(filter $(DEMO),$(OUT)),--force)

# What computes leaves the cores to devices, which are watched by the clock. A test of devices that failed beside it counts if it fails by itself, too.
test: setup      ## run the tests: those of devices and, beside them, those that compute, which report afterwards
	@$(SCRIPT) tests/helpers/compiling.py
	@log=$$(mktemp); nice $(PYTEST) -n $(WORKERS) tests --ignore tests/contract --ignore tests/live >$$log 2>&1 & beside=$$!; failed=0; devices=0; \
	$(DEVICE_TESTS) -n $(DEVICES) || devices=$$?; wait $$beside || failed=1; cat $$log; rm -f $$log; \
	if [ $$devices = 1 ]; then echo "== once more, by themselves: the tests of devices that failed"; devices=0; \
		$(DEVICE_TESTS) -n 0 --last-failed --last-failed-no-failures none || devices=$$?; fi; \
	[ $$failed = 0 ] && [ $$devices = 0 ]

golden: setup    ## make the golden renders anew (after a wanted change of the pictures; look at them in out/golden)
	@$(SCRIPT) tests/golden/make.py --pictures out/golden

bench: setup     ## speed, as ratios to named baselines in the same run
	@$(SCRIPT) tests/bench/bench_pipeline.py --sensor mg400-331
	@$(SCRIPT) tests/bench/bench_pipeline.py --sensor mg400-127
	@$(SCRIPT) tests/bench/bench_mechanics.py
	@$(SCRIPT) tests/bench/bench_environments.py
	@$(SCRIPT) tests/bench/bench_mujoco.py
	@$(SCRIPT) tests/bench/bench_render.py
	@$(SCRIPT) tests/bench/bench_ros2.py

validate: setup $(VENV)/.with-rerun ## heavier proofs: the recordings named by TACTIP_REAL, CalculiX, random contacts, Rerun (670 MB)
	@$(BIN)/python -m pytest -n 0 tests/unit/test_rerun_view.py
	@$(BIN)/python -m pytest -m hypothesis --hypothesis-profile=anew tests  # other draws than those of make test
	@$(BIN)/python -m pytest -m slow -n 0 -s tests

figures: setup   ## every figure that a document states, into figures.json; goes on where it was; ONLY=pins,render for some, LIST=1 to list
	@$(SCRIPT) -m figures $(if $(ONLY),--only $(ONLY)) $(if $(LIST),--list)

film: setup $(VENV)/.with-browser ## the studio's film and three pictures, in out/film; needs Debian's chromium
	@$(SCRIPT) tests/browser/film.py --out out/film

gallery: setup   ## the pictures of the gallery, from the code of its page, and the film of the gripper
	@cd docs && PYTHONPATH=$(CURDIR) $(CURDIR)/$(BIN)/python -m generators.gallery
	@cd docs && PYTHONPATH=$(CURDIR) MUJOCO_GL=$${MUJOCO_GL:-egl} $(CURDIR)/$(BIN)/python -m generators.gripper

browser: setup $(VENV)/.with-browser ## the studio in a real Chromium, wide and narrow; pictures in out/browser; skipped without Debian's chromium
	@$(BIN)/python -m pytest -m slow -n 0 -rs tests/browser tests/system/test_studio_browser.py

tables: setup    ## make the documents' tables from figures.json
	@$(SCRIPT) -m figures --tables

docs: setup $(VENV)/.with-docs ## the documentation, from this code, in out/docs; a warning is an error; NOTEBOOKS=written runs no notebook
	@NOTEBOOKS=$(NOTEBOOKS) $(BIN)/python -m sphinx -W --keep-going -q -b html docs out/docs
	@echo "wrote out/docs/index.html"

lint: setup      ## style
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .

types: setup     ## the type checker over all product packages
	@$(BIN)/mypy scenes twin training hardware

wheel: setup     ## build the wheel, install it into a clean environment, try it from there
	@.ci/try-wheel $(BIN)/python

clean:
	rm -rf $(VENV) out build *.egg-info
