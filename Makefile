# Every target sets itself up in .venv first, and again only when pyproject.toml or constraints.txt changed.
VENV ?= .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# What `make reproduce` makes: one name, several, or all.
NAME ?= all
TESTFLAGS ?=
SETUP := pyproject.toml constraints.txt tools/make_venv.sh

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint format reproduce bench build constraints clean

help:  ## show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(VENV)/.ready-demo: $(SETUP)
	@tools/make_venv.sh $(VENV) cli,plots
	@touch $@

$(VENV)/.ready-dev: $(SETUP)
	@tools/make_venv.sh $(VENV) dev
	@touch $@ $(VENV)/.ready-demo

demo: $(VENV)/.ready-demo  ## watch five agents learn the 89-state maze, then see them beside the thesis (3 minutes)
	@$(BIN)/jaxpomdp demo

test: $(VENV)/.ready-dev  ## the usual tests
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile $(TESTFLAGS)

test-slow: $(VENV)/.ready-dev  ## all tests, the long ones too
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "slow or not slow" $(TESTFLAGS)

lint: $(VENV)/.ready-dev  ## style, format, layering and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python

format: $(VENV)/.ready-dev  ## rewrite the code in the usual format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

reproduce: $(VENV)/.ready-demo  ## the thesis's tables and figures: make reproduce NAME=table-3.1
	$(BIN)/jaxpomdp reproduce $(NAME)

$(VENV)-bench/.ready: $(SETUP) benchmarks/speed/requirements.txt
	@tools/make_venv.sh $(VENV)-bench cli,plots
	@$(VENV)-bench/bin/python -m pip install --quiet --disable-pip-version-check -r benchmarks/speed/requirements.txt
	@touch $@

bench: $(VENV)-bench/.ready  ## speed, beside other libraries, in an environment of its own (half an hour)
	$(VENV)-bench/bin/python benchmarks/speed/bench.py

build: $(VENV)/.ready-dev  ## the wheel and the source archive, in dist/
	$(BIN)/python -m build

constraints: $(VENV)/.ready-dev  ## pin the newest versions that fit together
	$(BIN)/python tools/pin.py > constraints.new
	mv constraints.new constraints.txt

clean:  ## remove what the targets made
	rm -rf $(VENV) $(VENV)-bench build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
