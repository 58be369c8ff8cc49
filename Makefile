PYTHON ?= python3
# Each Python that is named has an environment of its own: .venv, or .venv-3.12 for make test PYTHON=python3.12.
VERSION := $(filter-out 3,$(patsubst python%,%,$(notdir $(PYTHON))))
VENV := .venv$(if $(VERSION),-$(VERSION))
BIN := $(VENV)/bin
SYSTEMS := reverse_duffing van_der_pol rossler lorenz
LARGE := $(SYSTEMS:%=%-large)

.PHONY: demo install test test-coverage guard test-slow test-research test-long test-browser lint format maps results figures benchmark ablation \
	faults agents environments speed clients docs clean help

demo: $(VENV)/ready  ## run the four environments with their shipped observers
	$(BIN)/kkl-gym demo

install: $(VENV)/ready  ## make the environment .venv with everything in it

# Two processes of one thread each: with more threads they get in each other's way.
test: $(VENV)/ready $(if $(AREA),,lint)  ## all that CI runs; AREA=training/maps runs tests/training/maps alone
	$(if $(AREA),$(BIN)/pytest tests/$(AREA),OMP_NUM_THREADS=1 $(BIN)/pytest -n 2)

test-coverage: $(VENV)/ready  ## the same tests, and which lines they run, in htmlcov; takes a quarter longer
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --cov --cov-report=html

guard: $(VENV)/ready  ## what must not change: estimates, dynamics, names, held-out errors, short trainings; two minutes
	OMP_NUM_THREADS=1 $(BIN)/python tests/guard/guard.py

test-slow: $(VENV)/ready  ## the tests that train for minutes
	$(BIN)/pytest -m slow

test-research: $(VENV)/ready  ## the longer tests of examples/research, five minutes
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m research

test-long: $(VENV)/ready  ## campaigns of kills and random steps, half an hour; they print counts
	OMP_NUM_THREADS=1 $(BIN)/pytest -m long -s

test-browser: $(VENV)/ready  ## the demo in headless Chromium; it says what to install
	$(BIN)/python -m pip install --quiet --group browser
	$(BIN)/pytest tests/browser -m browser

lint: $(VENV)/ready  ## style, types and the contract of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/ready  ## mend what can be mended of style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Into runs/. What ships lies in observers/maps: NAME, NAME-large and NAME-spinn.
# One thread each, with which the same machine makes the same numbers to the last bit.
maps: $(SYSTEMS:%=maps-%)  ## train the shipped maps again, an hour, or one with make -j 2 maps; resumable

maps-%: $(VENV)/ready
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym train $* --resume
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym train $* --size large --resume
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym train $* --pipeline spinn --resume

# T_inv alone is that of NAME-large, without tracking.
results: $(VENV)/ready  ## the accuracy in the README and in docs/
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

figures: $(VENV)/ready  ## the pictures of the pages, light and dark, from the files in docs/results, two minutes
	$(BIN)/python -m examples.research.figures

benchmark: $(VENV)/ready  ## every method on every system, hours on two cores; resumable
	$(BIN)/python -m examples.research benchmark
	mkdir -p docs/results/benchmark
	cp $(addprefix runs/benchmark/cpu/,results.csv methods.csv table.md) docs/results/benchmark
	$(MAKE) figures

SPINN := $(addprefix ablation-spinn-,soap spectrum motions scaling solved transients)
ABLATION := ablation-spinn $(SPINN) ablation-transients ablation-noise ablation-modes ablation-soap ablation-free \
	default

ablation: $(VENV)/ready  ## what each idea earns, an hour on two cores; resumable
	$(BIN)/python -m examples.research benchmark --budget short --methods $(ABLATION) --out runs/benchmark/ablation
	mkdir -p docs/results/ablation
	cp $(addprefix runs/benchmark/ablation/,results.csv methods.csv table.md) docs/results/ablation
	$(MAKE) figures

faults: $(VENV)/ready  ## the faults in docs/results
	$(BIN)/kkl-gym evaluate $(SYSTEMS) --faults --csv docs/results/faults/faults.csv
	$(MAKE) figures

# The one on y is what `kkl-gym agent train van_der_pol --information y` makes, for the picture of two agents side by side.
agents: $(VENV)/ready  ## every agent in docs/guides/agents.md, and those that ship: an hour and a half on two cores; resumable
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

environments: $(VENV)/ready  ## agents that see a part of other environments, hours on two cores; resumable
	$(BIN)/python -m examples.research agents $(HIDDEN)
	mkdir -p docs/results/environments
	cp $(addprefix runs/agents/environments/,results.csv curves.csv table.md) docs/results/environments
	$(BIN)/python -m examples.research agents CartPole-v1 Pendulum-v1 --measurement-noise 0.1 0.2 0.3 \
		--information state x_hat z stacked recurrent --aggregate 4 --seeds 5 --out runs/agents/noise
	cp runs/agents/noise/results.csv docs/results/environments/noise.csv
	$(BIN)/python -m examples.research agents InvertedDoublePendulum-v5 --information state x_hat --seeds 10 \
		--out runs/agents/double-pendulum
	cp runs/agents/double-pendulum/results.csv docs/results/environments/double-pendulum.csv
	$(BIN)/python -m examples.research agents Pendulum-v1 --information z --angles 0,1 --time-constants 1 --no-past-actions \
		--out runs/agents/short
	cp runs/agents/short/results.csv docs/results/environments/short.csv
	$(MAKE) figures

speed: $(VENV)/ready  ## environments against Pendulum-v1 and CartPole-v1, one thread
	OMP_NUM_THREADS=1 $(BIN)/python -m examples.research speed

# RLlib pins Gymnasium, and Tianshou what tyro needs: each has an environment of its own.
CLIENTS_zoo := --editable ".[agents]" rl-zoo3 torchrl "minari[create,hdf5]>=0.5.3" moviepy pygame-ce tensorboard
CLIENTS_rllib := --editable . "distributed>=2025.1" "ray[rllib]>=2.40" "torch<2.14" tyro
CLIENTS_tianshou := --editable . "tianshou[eval]>=2" "torch<2.14"
CLIENTS := zoo rllib tianshou

clients: $(CLIENTS:%=.venv-clients-%/ready)  ## programs of others on our environments, as they are; CLEANRL=FILE.py adds one
	status=0; for name in $(CLIENTS); do CLEANRL="$(if $(CLEANRL),$(abspath $(CLEANRL)))" RAY_worker_niceness=0 \
		.venv-clients-$$name/bin/pytest -W default -m clients tests/clients || status=1; done; \
		cat runs/clients/table.md; exit $$status

.venv-clients-%/ready: pyproject.toml Makefile
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --upgrade "pip>=25.1"
	$(@D)/bin/python -m pip install --quiet pytest $(CLIENTS_$*)
	touch $@

# With what they print and draw, which the files in examples/ do not hold.
TALKS := $(patsubst examples/%,runs/%,$(wildcard examples/notebooks/*.ipynb))

runs/notebooks/%.ipynb: examples/notebooks/%.ipynb | $(VENV)/ready
	mkdir -p $(@D)
	OMP_NUM_THREADS=1 $(BIN)/jupyter execute $< --output=../../$@

docs: $(VENV)/ready $(TALKS)  ## the site, in runs/site, with the notebooks executed; any doubtful link is an error
	$(BIN)/python docs/site/commands.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -f docs/site/mkdocs.yml
	$(BIN)/python docs/demo/build.py runs/site/demo

clean:  ## remove environments and caches; what lies under runs/ stays
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
