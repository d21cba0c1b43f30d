# Setting up, training and testing from a clean checkout: needs Python 3.11 with venv, and nothing else (but `test-all`).
PYTHON := $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALLED := .venv/installed
PROCESSES := 3
SELDOM := /(tests?|moto|rllib|_inductor|OpenGL|debugpy)/

.DEFAULT_GOAL := help
.PHONY: help setup train evaluate cluster cluster-stop docs test test-all missing tools mutants fuzz check-deploy audit clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):[^#]*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 16

setup: $(INSTALLED) ## install the project and its pinned dependencies into .venv (once, and again when they change)

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "setup: found no python3, wanted Python 3.11: apt-get install python3 python3-venv"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "setup: $(PYTHON) is not Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "setup: $(PYTHON) cannot make virtual environments: apt-get install python3-venv"; exit 1; }
	@echo "setup 1/2: $$($(PYTHON) --version) into .venv"
	@$(PYTHON) -m venv .venv
	@echo "setup 2/2: the project and its pinned dependencies, some minutes the first time"
	@$(BIN)/python -m pip install -qq --no-compile --disable-pip-version-check -c constraints.txt -e '.[test]'
	@$(BIN)/python -m compileall -qq -j 0 -x '$(SELDOM)' .venv/lib || true # on all cores; some files are no Python 3
	@touch $@

train: setup ## meta-train; its options go in ARGS: make train ARGS="--help"
	$(BIN)/python -m services.meta_train $(ARGS)

MODEL := ml10
evaluate: setup ## adapt a shipped model to its new tasks, and compare with its card: make evaluate MODEL=ml45
	$(BIN)/python -m services.evaluate $(MODEL) --expect $(ARGS)

cluster: setup ## start a Ray head and an MLflow server on this machine, for Ray jobs; options go in ARGS
	@$(BIN)/python -m services.local_cluster start $(ARGS)

cluster-stop: setup ## stop these two
	@$(BIN)/python -m services.local_cluster stop

docs: setup ## build the documentation's site into build/site; a broken link or a warning is an error
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

define CHECK
$(BIN)/ruff check
$(BIN)/ruff format --check
$(BIN)/pyright
$(BIN)/lint-imports
endef

test test-all: export OMP_NUM_THREADS = 1
test test-all: export PYTHONDONTWRITEBYTECODE = # each program that a test starts would compile the project anew
test: setup ## what proves the product, in some minutes: lint, format, types, imports and tests
	$(CHECK)
	$(BIN)/python -m pytest --ignore tests/deploy -m "not thorough" -n $(PROCESSES) --dist loadfile --no-loadscope-reorder --durations 10

test-all: tools setup ## everything, also what wants a browser, a database, promtool, kubectl and half an hour
	@$(INSTALL_CHECKERS)
	$(CHECK)
	$(BIN)/python -m pytest -m "not alone" -n $(PROCESSES) --dist loadfile --no-loadscope-reorder --durations 20
	$(BIN)/python -m pytest -m alone $$(grep -rl --include='test_*.py' mark.alone tests) --durations 20

MISSING = $(strip \
	$(if $(shell command -v chromium),,chromium) \
	$(if $(shell command -v promtool),,prometheus) \
	$(if $(wildcard /usr/lib/postgresql/*/bin/postgres),,postgresql))
INSTALL_CHECKERS = $(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test,deploy,docs]'
NEEDS_KUBECTL = command -v kubectl >/dev/null || \
	{ echo "found no kubectl, 1.27 or newer, to render overlays: https://kubernetes.io/docs/tasks/tools"; exit 1; }

missing: ## print which packages of apt-get test-all still wants
	@echo $(MISSING)

tools:
	@test -z "$(MISSING)" || \
		{ echo "test-all: found no $(MISSING): apt-get install --no-install-recommends $(MISSING)"; exit 1; }
	@$(NEEDS_KUBECTL)

mutants: setup ## put 40 faults into copies of the tree, one by one, and print which test of `make test` notices each
	@$(BIN)/python -m tests.mutants

fuzz: setup ## for an hour, try random settings, paths, data and faults together; options go in ARGS, as ARGS="--first 17 --count 1"
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.faults.combinations $(ARGS)

check-deploy: setup ## of test-all, what holds deploy/ against schemas, checkers and the project; no container engine
	@command -v promtool >/dev/null || { echo "check-deploy: found no promtool: apt-get install prometheus"; exit 1; }
	@$(NEEDS_KUBECTL)
	@$(INSTALL_CHECKERS)
	$(BIN)/python -m pytest tests/deploy

audit: setup ## ask PyPI for known vulnerabilities of every pinned dependency; options go in ARGS, as ARGS="-s osv"
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[audit]'
	@$(BIN)/python -m pip_audit --strict --disable-pip --no-deps --progress-spinner off -r constraints.txt $(ARGS) || \
		{ echo "audit: not passed: a dependency has a known vulnerability, or, where it says that one could not be" \
			"audited or a connection failed, nothing is known: it needs https://pypi.org/pypi, with ARGS=\"-s osv\"" \
			"https://api.osv.dev"; exit 1; }

clean: ## remove .venv, caches and builds; data/ and runs/ stay
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
