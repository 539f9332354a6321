# Everything lives in .venv. `make help` lists what there is.
SHELL := /bin/bash
.DEFAULT_GOAL := help
BIN := .venv/bin
# One numerical thread per process: two pool children with two threads each are slower than with one.
export OMP_NUM_THREADS ?= 1
# Two processes, a file at a time in the order of collection: the long acceptance tests come first.
PARALLEL := -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: help setup setup-dev demo up test check lint type format fast-test bench screenshots chromium clean

help: ## This list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

setup: ## Install what the system needs into .venv
	@scripts/setup.sh runtime

setup-dev:
	@scripts/setup.sh dev

demo: setup ## The whole loop on TASK (avoid), then the site. ARGS="--headless --json out.json" ends by itself
	@$(BIN)/rodif demo $(TASK) $(ARGS)

up: setup ## Start the embedded system and leave it running. ARGS="--port 8080"
	@$(BIN)/rodif up $(ARGS)

test: setup-dev chromium lint type ## Everything: lint, types and all tests
	@$(BIN)/pytest $(PARALLEL) $(ARGS)

check: setup-dev lint type fast-test ## Lint, types and the fast tests

fast-test: setup-dev
	@$(BIN)/pytest $(PARALLEL) -m "not slow and not browser"

lint: setup-dev ## Style and formatting
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

type: setup-dev ## Strict types
	@$(BIN)/mypy

format: setup-dev ## Rewrite the files as the formatter wants them
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: setup ## The three methods on fresh seeds. ARGS="--seeds 100-104 --json out.json"
	@$(BIN)/rodif bench avoid $(ARGS)

screenshots: setup-dev chromium ## Make docs/images from a real running system
	@$(BIN)/python scripts/screenshots.py $(ARGS)

chromium:
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit 0; done; \
	echo "The browser tests need Chromium. On Debian or Ubuntu:  sudo apt-get install -y chromium"; exit 1

clean: ## Remove caches and the demo's state; .venv and .rodif stay
	@rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis dist build .rodif/demo-*
	@find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +
