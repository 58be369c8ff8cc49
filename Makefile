PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SYSTEMS := reverse_duffing van_der_pol rossler lorenz
CLOSED := reverse_duffing van_der_pol

.PHONY: demo test test-slow lint format maps results benchmark ablation certificates agents speed clean

demo: $(VENV)/ready  ## run the four environments with their shipped observers
	$(BIN)/kkl-gym demo

test: $(VENV)/ready lint  ## everything CI runs
	$(BIN)/pytest

test-slow: $(VENV)/ready  ## the tests that train for minutes
	$(BIN)/pytest -m slow

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The commands that made the shipped maps, both versions: about three hours on two cores, into runs/; resumable. A new version ships
# as observers/maps/NAME-vN.safetensors, beside the old ones.
maps: $(VENV)/ready
	for system in $(SYSTEMS); do for method in input-aware spinn; do \
		$(BIN)/kkl-gym train $$system --method $$method --resume || exit 1; done; done
	for system in $(CLOSED); do \
		$(BIN)/kkl-gym train $$system --closed-loop --config training/version1.json --resume || exit 1; done
	for system in $(SYSTEMS); do \
		$(BIN)/kkl-gym train $$system --config training/version1.json --out runs/$$system-v1 --resume || exit 1; done

# The figures in the README and in docs/.
results: $(VENV)/ready
	$(BIN)/kkl-gym demo --out docs/figures
	$(BIN)/kkl-gym agent evaluate van_der_pol --out docs/figures
	$(BIN)/kkl-gym evaluate $(SYSTEMS) $(SYSTEMS:%=%-spinn) $(CLOSED:%=%-closed-loop) \
		--csv docs/results/accuracy.csv
	$(BIN)/kkl-gym evaluate $(SYSTEMS) $(SYSTEMS:%=%-v1) --process-noise 0.05 --csv docs/results/accuracy-process-noise.csv

benchmark: $(VENV)/ready  ## every method on every system, hours on two cores; resumable
	$(BIN)/kkl-gym benchmark
	mkdir -p docs/results/benchmark
	cp $(addprefix benchmark/cpu/,results.csv methods.csv table.md heatmap.png) docs/results/benchmark

ABLATION := ablation-spinn ablation-solved ablation-transients ablation-noise ablation-modes ablation-soap ablation-free \
	default ablation-tuned

ablation: $(VENV)/ready  ## what each idea earns, half an hour on two cores; resumable
	$(BIN)/kkl-gym benchmark --budget short --methods $(ABLATION) --out benchmark/ablation
	mkdir -p docs/results/ablation
	cp $(addprefix benchmark/ablation/,results.csv methods.csv table.md heatmap.png) docs/results/ablation

certificates: $(VENV)/ready  ## the figures in docs/certificates.md
	$(BIN)/kkl-gym certify $(SYSTEMS) $(SYSTEMS:%=%-spinn) --out docs/results/certificates
	$(BIN)/kkl-gym faults --out docs/results/faults

agents: $(VENV)/ready  ## every agent in docs/agents.md, and those that ship: hours on two cores; resumable
	$(BIN)/kkl-gym agent compare
	mkdir -p docs/results/agents training/agents/shipped
	cp $(addprefix agents/comparison/,results.csv table.md scores.png) docs/results/agents
	for system in $(SYSTEMS); do cp agents/comparison/jobs/$$system-0.5/x_hat/0/agent.safetensors \
		training/agents/shipped/$$system.safetensors || exit 1; done

speed: $(VENV)/ready  ## environments against Pendulum-v1 and CartPole-v1, one thread
	OMP_NUM_THREADS=1 $(BIN)/kkl-gym speed

clean:
	rm -rf $(VENV) runs agents certificates tuning demo .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache

$(VENV)/ready: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "kkl-gym needs Python 3.11 to 3.13: make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable ".[all]" --group dev
	touch $@
