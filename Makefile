# `make run` and `make test` set everything up by themselves; nothing else has to be typed first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
OUT    ?= out/grasp_and_roll

.PHONY: run test test-slow test-hostile test-newest lint docs wheel clean

run: $(STAMP)
	$(BIN)/python -m experiments.grasp_and_roll --out $(OUT)

test: $(STAMP)
	$(BIN)/python -m pytest

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow --dist worksteal --ignore tests/hostile

# the newest Python that has wheels of everything; a plain install of torch brings some GB of CUDA
NEWEST ?= python3.13
test-newest:
	bash tests/newest.sh $(NEWEST)

test-hostile: $(STAMP)
	$(BIN)/python -m pytest -m slow --dist worksteal tests/hostile --timeout 1800

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/codespell

# chapters and gallery executed, two to four minutes on one core; readable offline
DOCS ?= out/docs
docs: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going --quiet docs $(DOCS)
	@echo "open $(DOCS)/index.html"

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit("torchsoft needs Python 3.11 or newer; set PYTHON=..." if sys.version_info < (3, 11) else 0)'
	@echo "setting up $(VENV) (once, two to ten minutes)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,docs]'
	$(BIN)/python -m torchsoft.solve.kernel.build
	@touch $(STAMP)

# with the compiled kernels of every level of processors
LEVELS := linux-x86-64-v3 linux-x86-64-v2 linux-aarch64
wheel: $(STAMP)
	$(BIN)/python -m torchsoft.solve.kernel.build $(addprefix --level ,$(LEVELS))
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

clean:
	rm -rf $(VENV) out docs/gallery docs/reference build dist torchsoft/solve/kernel/objects *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
