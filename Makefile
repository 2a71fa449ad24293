# make run    the paper's case I, from a fresh clone to a picture
# make test   the test suite without its slow tests
# make suite  all tests but benchmarks, validate and firmware, as .ci/run does
# make check  lint and the tests of what your change touches, under a minute
# make lint   ruff and pyright; run it and make suite before you commit
# make coverage  the tests (slower), and the lines that no test reaches
# make validate  full-length checks of verdicts, and the slow commands of the pages: half an hour
# make bench  the benchmarks in tests/benchmarks
# make firmware  compile the sketches, and run them on a simulated ATmega328P and Cortex-M7; .ci/run lists the packages
# make mutate  put small mistakes into the code behind verdicts, and report those that no test notices: ten minutes
# make kernels  compare the files of six designs made idle, under load and three at once, byte by byte; then run the
#   numerical tests under every kernel of OpenBLAS that this processor runs: an hour
# make oldest  the tests of models, controllers and scenarios with the oldest allowed packages, in .venv-oldest
# make installed  the wheel in an empty environment, run beside a user's own models/, sim.py and cli.py
# make figures  the pictures that README and docs show, and the output in their blocks
PYTHON ?= python3
PY := .venv/bin/python
# loadfile keeps each file of tests on one worker, because its tests share fixtures. There is one worker more than cores,
# because sessions in real time mostly wait. tests/conftest.py starts the longest files first.
PARALLEL := -n $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1) --dist loadfile --no-loadscope-reorder

.PHONY: run test suite check validate firmware lint coverage bench mutate kernels oldest installed figures clean

run: .venv/ready
	$(PY) -m sim.run --case I

test: .venv/ready
	$(PY) -m pytest $(PARALLEL) --ignore=tests/benchmarks -m 'not slow and not validate and not firmware'

suite: .venv/ready
	$(PY) -m pytest $(PARALLEL) --ignore=tests/benchmarks

check: .venv/ready build/typed
	@export CHECK_UNTIL=$$(($$(date +%s) + 50)); set -ex; \
	$(PY) -m ruff check .; $(PY) -m ruff format --check .; \
	$(PY) -m pyright; \
	$(PY) -m pytest -rs $(PARALLEL) $$($(PY) tests/touched.py)

validate: .venv/ready
	$(PY) -m pytest -m validate tests
	$(PY) -m tests.checks.faults
	$(PY) tests/tools/hostile.py
	$(PY) tests/tools/hostile.py --signals
	$(PY) tests/tools/regenerate.py --check
	$(MAKE) installed

firmware: .venv/ready
	$(PY) -m pytest -m firmware tests/hw/test_boards.py

mutate: .venv/ready
	$(PY) tests/tools/mutate.py

kernels: .venv/ready
	$(PY) tests/tools/same_designs.py
	$(PY) tests/tools/kernels.py

# links in one folder, so that pyright finds haptic_loop.sim in the folder sim
build/typed: Makefile
	@rm -rf $@ && mkdir -p $@/haptic_loop
	@cd $@/haptic_loop && ln -s ../../../haptic_loop/__init__.py . && \
	  for folder in cli controller design hw models sim; do ln -s ../../../$$folder .; done

lint: .venv/ready build/typed
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --threads 2

coverage: .venv/ready
	$(PY) -m pytest $(PARALLEL) --cov --cov-report=term:skip-covered

figures: .venv/ready
	$(PY) -m sim.run --case none --out out/figure-5
	$(PY) -m sim.run --case I --coupling published --out out/figure-6
	cp out/figure-5/figure.png docs/pictures/figure-5.png
	cp out/figure-6/figure.png docs/pictures/figure-6.png
	$(PY) -m design.compare --coupling published,spring-damper:any-environment,spring-damper --out out/couplings
	for name in required-damping perceived; do cp out/couplings/$$name.png docs/pictures/; done
	$(PY) -m sim.view --case I --video docs/pictures/view.gif --fps 5
	$(PY) examples/wheel.py docs/pictures/wheel.png
	$(PY) -m sim.zwidth --rigid --T 1e-3 --theta 0 --mark 5000,0 --out out/zwidth || test $$? -eq 1 # 1: not certified
	cp out/zwidth/zwidth.png docs/pictures/zwidth.png
	PYTHONPATH=. $(PY) tests/tools/pictures_of_worlds.py docs/pictures/worlds.png
	$(PY) -m sim.zwidth --coupling optimal --out out/zwidth-optimal
	cp out/zwidth-optimal/zwidth.png docs/pictures/zwidth-optimal.png
	$(PY) tests/tools/regenerate.py

bench: .venv/ready
	$(PY) -m pytest tests/benchmarks --benchmark-only -s

installed: .venv/ready
	$(PY) -m pytest tests/project/test_wheel.py

# DeprecationWarning: an old matplotlib warns about a new pyparsing.
oldest:
	$(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python tests/oldest.py >.venv-oldest/floors.txt
	.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check -r .venv-oldest/floors.txt
	.venv-oldest/bin/python -m pytest -W ignore::DeprecationWarning tests/models tests/controller tests/sim/test_scenario.py

.venv/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + \
	  sys.version.split()[0] + ": make PYTHON=python3.11")'
	@echo 'setting up .venv: one to two minutes, once; pip says nothing meanwhile'
	@$(PYTHON) -m venv .venv
	@$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv .venv-oldest out build *.egg-info .pytest_cache .ruff_cache .hypothesis .coverage*
