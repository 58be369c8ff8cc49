PYTHON ?= python3
# make test PYTHON=python3.12 takes the virtual environment .venv-3.12 in place of .venv.
VERSION := $(filter-out 3,$(patsubst python%,%,$(notdir $(PYTHON))))
VENV := .venv$(if $(VERSION),-$(VERSION))
BIN := $(VENV)/bin
SYSTEMS := reverse_duffing van_der_pol rossler lorenz
LARGE := $(SYSTEMS:%=%-large)

.PHONY: demo install test test-coverage guard test-slow test-research test-long test-browser lint format maps results figures benchmark ablation \
	faults agents environments kinds speed clients docs clean help

demo: $(VENV)/ready  ## run the four environments with their shipped observers
	$(BIN)/kkl-gym demo

install: $(VENV)/ready  ## make the virtual environment .venv with the package, all extras and the tools

# Two processes of one thread each: more threads would compete for the cores.
test: $(VENV)/ready $(if $(AREA),,lint)  ## lint, then all tests without a target of their own; AREA=training/maps runs tests/training/maps alone, without lint
	$(if $(AREA),$(BIN)/pytest tests/$(AREA),OMP_NUM_THREADS=1 $(BIN)/pytest -n 2)

test-coverage: $(VENV)/ready  ## the same tests, and a report in htmlcov of the lines that they run; takes a quarter longer
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --cov --cov-report=html

guard: $(VENV)/ready  ## compare estimates, dynamics, names, held-out errors and short trainings with stored ones; two minutes
	OMP_NUM_THREADS=1 $(BIN)/python tests/guard/guard.py

test-slow: $(VENV)/ready  ## the tests that train for minutes
	$(BIN)/pytest -m slow

test-research: $(VENV)/ready  ## the longer tests of examples/research, five minutes
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m research

test-long: $(VENV)/ready  ## half an hour of killed trainings, random steps and repetitions; prints counts
	OMP_NUM_THREADS=1 $(BIN)/pytest -m long -s

test-browser: $(VENV)/ready  ## test the demo in headless Chromium; a failure names the packages to install
	$(BIN)/python -m pip install --quiet --group browser
	$(BIN)/pytest tests/browser -m browser

lint: $(VENV)/ready  ## check style, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/ready  ## correct style where ruff can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The maps are written into runs/; NAME, NAME-large and NAME-spinn in observers/maps ship.
# Each training has one thread, so that the same machine reproduces it to the last bit.
maps: $(SYSTEMS:%=maps-%)  ## train the shipped maps again, about an hour, two at once with make -j 2 maps; resumable

maps-%: $(VENV)/ready
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym train $* --resume
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym train $* --size large --resume
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym train $* --pipeline spinn --resume

# The rows on T_inv alone come from NAME-large without tracking.
results: $(VENV)/ready  ## the tables of accuracy in README.md and docs/results
	mkdir -p runs/calibration
	$(BIN)/kkl-gym evaluate $(SYSTEMS) --measurement-noise 0 0.1 0.5 1 --ekf --limit \
		--csv docs/results/tracking/accuracy.csv
	$(BIN)/kkl-gym evaluate $(SYSTEMS) --process-noise 0.05 --csv docs/results/tracking/process-noise.csv
	$(BIN)/kkl-gym evaluate $(SYSTEMS) --plant-error 0.1 --csv docs/results/tracking/plant-error.csv
	$(BIN)/kkl-gym evaluate $(LARGE) $(SYSTEMS:%=%-spinn) --no-tracking --measurement-noise 0 0.1 0.5 1 \
		--csv docs/results/accuracy.csv
	$(BIN)/kkl-gym evaluate $(LARGE) --no-tracking --process-noise 0.05 --csv docs/results/accuracy-process-noise.csv
	$(BIN)/kkl-gym evaluate $(LARGE) --no-tracking --plant-error 0.1 --csv docs/results/plant-error.csv
	for map in $(SYSTEMS); do $(BIN)/kkl-gym evaluate $$map --calibration --trajectories 200 \
		--csv runs/calibration/$$map.csv || exit 1; done
	cp $(SYSTEMS:%=runs/calibration/%.csv) docs/results/tracking
	$(MAKE) figures

figures: $(VENV)/ready  ## the figures of the pages, light and dark, from the files in docs/results, two minutes
	$(BIN)/python -m examples.research.figures

benchmark: $(VENV)/ready  ## the benchmark: every method on every system, hours on two cores; resumable
	$(BIN)/python -m examples.research benchmark
	mkdir -p docs/results/benchmark
	cp $(addprefix runs/benchmark/cpu/,results.csv methods.csv table.md) docs/results/benchmark
	$(MAKE) figures

SPINN := $(addprefix ablation-spinn-,soap spectrum motions scaling solved transients)
ABLATION := ablation-spinn $(SPINN) ablation-transients ablation-noise ablation-modes ablation-soap ablation-free \
	default

ablation: $(VENV)/ready  ## the ablation: how each change of the method changes errors, an hour on two cores; resumable
	$(BIN)/python -m examples.research benchmark --budget short --methods $(ABLATION) --out runs/benchmark/ablation
	mkdir -p docs/results/ablation
	cp $(addprefix runs/benchmark/ablation/,results.csv methods.csv table.md) docs/results/ablation
	$(MAKE) figures

faults: $(VENV)/ready  ## the table of sensor faults in docs/results
	$(BIN)/kkl-gym evaluate $(SYSTEMS) --faults --csv docs/results/faults/faults.csv
	$(MAKE) figures

# The figure of two agents side by side needs the agent on y, van_der_pol-y.
agents: $(VENV)/ready  ## every agent in docs/results/agents.md, and those that ship, an hour and a half on two cores; resumable
	$(BIN)/python -m examples.research agents
	$(BIN)/python -m examples.research agents reverse_duffing van_der_pol --information x_hat_std --measurement-noise 0.5
	mkdir -p docs/results/agents training/agents/shipped
	cp $(addprefix runs/agents/comparison/,results.csv table.md) docs/results/agents
	for system in $(SYSTEMS); do cp runs/agents/comparison/jobs/$$system-0.5/x_hat/0/agent.safetensors \
		training/agents/shipped/$$system.safetensors || exit 1; done
	cp runs/agents/comparison/jobs/van_der_pol-0.5/y/0/agent.safetensors training/agents/shipped/van_der_pol-y.safetensors
	$(MAKE) figures

HIDDEN := CartPole-v1 Pendulum-v1 MountainCarContinuous-v0 LunarLander-v3 InvertedPendulum-v5 \
	InvertedDoublePendulum-v5 Reacher-v5 Hopper-v5 HalfCheetah-v5

environments: $(VENV)/ready  ## agents that see a part of Gymnasium's environments, hours on two cores; resumable
	$(BIN)/python -m examples.research agents $(HIDDEN)
	mkdir -p docs/results/environments
	cp $(addprefix runs/agents/environments/,results.csv curves.csv table.md) docs/results/environments
	$(BIN)/python -m examples.research agents InvertedDoublePendulum-v5 --information state x_hat --seeds 10 \
		--out runs/agents/double-pendulum
	cp runs/agents/double-pendulum/results.csv docs/results/environments/double-pendulum.csv
	$(BIN)/python -m examples.research agents Pendulum-v1 --information z --angles 0,1 --time-constants 1 --no-past-actions \
		--out runs/agents/short
	cp runs/agents/short/results.csv docs/results/environments/short.csv
	$(MAKE) figures

kinds: $(VENV)/ready  ## agents in five kinds of partial observability, an hour and a half on two cores; resumable
	$(BIN)/python -m examples.research kinds --seeds 3
	mkdir -p docs/results/kinds
	cp $(addprefix runs/agents/kinds/,kinds.csv table.md) docs/results/kinds
	$(MAKE) figures

speed: $(VENV)/ready  ## the speed of environments, beside Pendulum-v1 and CartPole-v1, one thread
	OMP_NUM_THREADS=1 $(BIN)/python -m examples.research speed

# RLlib pins Gymnasium's version, and Tianshou the version of a package that tyro needs: each has a virtual environment.
CLIENTS_zoo := --editable ".[agents]" rl-zoo3 torchrl "minari[create,hdf5]>=0.5.3" moviepy pygame-ce tensorboard
CLIENTS_rllib := --editable . "distributed>=2025.1" "ray[rllib]>=2.40" "torch<2.14" tyro
CLIENTS_tianshou := --editable . "tianshou[eval]>=2" "torch<2.14"
CLIENTS := zoo rllib tianshou

clients: $(CLIENTS:%=.venv-clients-%/ready)  ## other libraries, unchanged, on the environments; CLEANRL=FILE.py adds CleanRL's script
	status=0; for name in $(CLIENTS); do CLEANRL="$(if $(CLEANRL),$(abspath $(CLEANRL)))" RAY_worker_niceness=0 \
		.venv-clients-$$name/bin/pytest -W default -m clients tests/clients || status=1; done; \
		cat runs/clients/table.md; exit $$status

.venv-clients-%/ready: pyproject.toml Makefile
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --upgrade "pip>=25.1"
	$(@D)/bin/python -m pip install --quiet pytest $(CLIENTS_$*)
	touch $@

# The notebooks with their printed lines and figures, which the files in examples/ lack.
TALKS := $(patsubst examples/%,runs/%,$(wildcard examples/notebooks/*.ipynb))

runs/notebooks/%.ipynb: examples/notebooks/%.ipynb | $(VENV)/ready
	mkdir -p $(@D)
	OMP_NUM_THREADS=1 $(BIN)/jupyter execute $< --output=../../$@

docs: $(VENV)/ready $(TALKS)  ## the site, in runs/site, with the notebooks executed; any doubtful link is an error
	$(BIN)/python docs/site/commands.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -f docs/site/mkdocs.yml
	$(BIN)/python docs/demo/build.py runs/site/demo

clean:  ## remove virtual environments and caches, but nothing under runs/
	rm -rf .venv .venv-* .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache htmlcov .coverage .coverage.*
	find kkl_gym observers training tests examples -name __pycache__ -type d -prune -exec rm -rf {} +

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-13s %s\n", $$1, $$2}' Makefile

$(VENV)/ready: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(None if (3, 11) <= sys.version_info < (3, 14) else "kkl-gym needs Python 3.11 to 3.13, this is %d.%d: make PYTHON=python3.12" % sys.version_info[:2])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable ".[all]" --group dev
	touch $@
