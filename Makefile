# Two commands on a fresh machine: `make demo` and `make test`. Both create .venv and install the pinned requirements.
# `make test-all` runs `make test`, then the tests that take long. docs/developers.md says what is where.
# `make bench` times every stage beside plain torch and fails if one fell behind bench/baseline.json; options go in
# BENCH, for example `make bench BENCH=--quick`.
# `make demo PYTHON=python3.12` names the Python. `make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu` takes torch
# from there, for the CPU alone: on Linux that saves most of the download (docs/install.md).
VENV := .venv
BIN := $(VENV)/bin
# Two processes, because most of a first run is compiling kernels, which takes one core. Files stay together.
QUICK := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
HAS_CHROMIUM := { test -n "$$ENDOPRIOR_CHROMIUM" || command -v chromium || command -v google-chrome; } >/dev/null 2>&1
export PYTHON TORCH_INDEX

.PHONY: demo test coverage test-all test-faults style lint browser bench figures docs clean

demo: $(VENV)/.installed
	$(BIN)/endoprior demo demo
	@echo "To type endoprior without its folder: source $(BIN)/activate"

test: $(VENV)/.test-installed style
	@$(HAS_CHROMIUM) || echo "No Chromium: tests of viewer and player will be skipped. Fix: make browser"
	$(QUICK)

# Which lines the quick tests run; compiled kernels count as not run.
coverage: $(VENV)/.test-installed
	$(QUICK) --cov --cov-report=
	$(BIN)/python -m coverage report --skip-covered --sort=cover

# One process: slow tests start processes of their own and watch the clock.
test-all: test
	$(BIN)/python -m pytest -m slow

# Kills, full disks, little memory, property tests with many examples, long and large sequences: docs/reliability.md.
test-faults: $(VENV)/.test-installed
	$(BIN)/python faults/run.py $(FAULTS)

PYTHON_CODE := setup.py src tests bench faults docs examples tools

style: $(VENV)/.test-installed
	$(BIN)/ruff check $(PYTHON_CODE)
	$(BIN)/ruff format --check $(PYTHON_CODE)

lint: style
	$(BIN)/pyright
	$(BIN)/python tools/check_examples.py

# The viewer and the player are tested in headless Chromium: this installs Debian's package where there is none.
browser:
	@$(HAS_CHROMIUM) || { test "$$(id -u)" = 0 && command -v apt-get >/dev/null; } || \
	  { echo "Chromium: expected a browser or rights to install it, got none. Fix: sudo apt-get install chromium" >&2; exit 2; }
	@$(HAS_CHROMIUM) || { apt-get -qq update && \
	  DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends chromium >/dev/null; }

bench: $(VENV)/.installed
	$(BIN)/python bench/run.py --baseline bench/baseline.json $(BENCH)

# The documentation's pictures; ENDOPRIOR_DATA holds the two clips.
figures: $(VENV)/.test-installed browser
	$(BIN)/python bench/figures.py figures
	$(BIN)/python bench/method_figures.py figures
	$(BIN)/python bench/symptom_figures.py figures

# The site, in build/docs/html; it needs no network. Warnings, such as a link that leads nowhere, are errors.
docs: $(VENV)/.docs-installed
	$(BIN)/python -m sphinx -W --keep-going -q -c docs . build/docs/html
	@echo "build/docs/html/index.html"

$(VENV)/.installed: pyproject.toml constraints.txt
	sh tools/install.sh
	touch $@

$(VENV)/.test-installed: $(VENV)/.installed
	sh tools/install.sh test
	touch $@

# The site takes the program from src/: one that is installed stays as it is, so a plain install does not become editable.
$(VENV)/.docs-installed: pyproject.toml constraints.txt
	sh tools/install.sh docs
	touch $@

clean:
	rm -rf $(VENV) demo
