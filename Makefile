PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LLM := .venv-llm
LLM_PORT ?= 18080
LLM_THREADS ?= $(shell nproc)
WORKERS ?= 2

# One process compiles for all others, whatever the caller's shell says.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-long coverage test-llm check loops bench manifests images sbom chaos soak load clean
.DEFAULT_GOAL := demo

demo: $(VENV)/installed
	$(BIN)/prior-sg demo

test: $(VENV)/installed-dev
	$(MAKE) --no-print-directory -j 2 check loops
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

# Two hosts (as root), every service exchanged in mid-run, a system disturbed, more robots: minutes.
test-long: $(VENV)/installed-dev
	PSG_TEST_LONG=1 $(BIN)/python -m pytest tests/test_hosts.py tests/test_exchange.py tests/test_encoder_swap.py \
		tests/test_ros_robot.py tests/chaos tests/services/ingest/test_ros_live_robots.py tests/deploy/keys \
		tests/deploy/evaluation tests/deploy/running/test_fleet_demo.py tests/deploy/running/test_warm.py \
		tests/services/feature_pyramid/test_detectors.py tests/endurance

# Shares of the cores that tests run; measuring makes them half as slow again.
coverage: $(VENV)/installed-dev
	$(BIN)/coverage erase
	PSG_TEST_COVERAGE=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report --include='services/**/*.py,schemas/*.py' --omit='services/*/service.py,services/runtime/**'

# Inner loops of the services, which one process compiles for all tests.
loops: $(VENV)/installed-dev
	$(BIN)/prior-sg warm

# A real language model of 1.5 B parameters behind a server on loopback: 1.1 GB into ~/.cache/prior-sg/models, once, and
# skipped where it cannot be had. Eight minutes on two cores that do nothing else.
test-llm: $(VENV)/installed-dev
	$(BIN)/python tests/help/language_model.py $(LLM) $(LLM_PORT) $(LLM_THREADS) \
		$(BIN)/python -m pytest -v -s tests/services/prior_gateway/test_llm.py

check: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/prior-sg topics --check

bench: $(VENV)/installed-dev
	$(BIN)/prior-sg bench all --json

# Compose, Helm and the schemas of Kubernetes, which take what deploys Prior-SG. Helm's library is large.
manifests: $(VENV)/installed-manifests
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m pytest tests/deploy/test_compose.py tests/deploy/test_helm.py \
		tests/deploy/test_systemd.py

# Builds deploy/Dockerfile by Buildah, which needs root and no engine, and runs a service of the image.
images: $(VENV)/installed-dev
	PSG_TEST_IMAGES=1 $(BIN)/python -m pytest -v tests/deploy/test_images.py --timeout 3600

sbom: $(VENV)/installed-audit
	mkdir -p build
	$(BIN)/cyclonedx-py environment $(BIN)/python --pyproject pyproject.toml --output-file build/sbom.json

# Hundreds of faults on whole systems; CHAOS='--faults 20 --seed 7' for others. It goes on where it was.
chaos: $(VENV)/installed-dev
	$(BIN)/python -m tests.chaos $(CHAOS)

# One robot for an hour; robots times rate until something is dropped. ENDURANCE='--seconds 600' for less.
soak load: $(VENV)/installed-dev
	$(BIN)/python -m tests.endurance $@ --out out/$@ $(ENDURANCE)

INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt
# Loops compiled for another version may name what it lacks now.
FORGET_LOOPS := find schemas services deploy -name '*.nb[ci]' -delete

$(VENV)/installed: pyproject.toml constraints.txt | $(BIN)/pip
	$(INSTALL) -e '.[encode,dsg,fast-cut,view]'
	$(FORGET_LOOPS)
	$(BIN)/prior-sg warm
	touch $@

# Holds all of the other. Bytecode is written for what is used, when it is used.
$(VENV)/installed-dev: pyproject.toml constraints.txt | $(BIN)/pip
	$(INSTALL) --no-compile -e '.[dev]'
	$(FORGET_LOOPS)
	touch $(VENV)/installed $@

$(VENV)/installed-manifests: $(VENV)/installed-dev
	$(INSTALL) -e '.[manifests]'
	touch $@

$(VENV)/installed-audit: $(VENV)/installed
	$(INSTALL) -e '.[audit]'
	touch $@

$(BIN)/pip: # one that finds versions in half the time of those that come with Python
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --upgrade pip

clean:
	rm -rf $(VENV) $(LLM) out build
