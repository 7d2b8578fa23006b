# `make demo` and `make test` start from a bare clone: they need Python 3.11+, make and a network to the package index.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: setup demo test fuzz soak audit lint notebooks docs docs-test wheel bench bench-gpu accuracy capture-range trust ablation plans

setup: .venv/.installed

# done again only when the dependencies changed
.venv/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[all,dev]' --constraint constraints.txt
	touch $@

demo: setup
	$(BIN)/femoreg demo --out out/demo

# several processes, each with its share of the cores; the tests of one file run in one of them;
# in the plainest locale, which shows where a file's encoding was left open
test: setup
	LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

# ten thousand broken files at all doors, from a new seed; FEMOREG_FUZZ_SEED=… repeats one
fuzz: setup
	FEMOREG_FUZZ_COUNT=10000 $(BIN)/python -m pytest tests/fuzz

# two hundred registrations of a small case in one process (some 40 minutes): equal results, memory flat;
# FEMOREG_SOAK_COUNT says how many
soak: setup
	MALLOC_ARENA_MAX=2 $(BIN)/python -m pytest -m soak tests/evaluation/test_soak.py

# known vulnerabilities of what constraints.txt pins; needs a network, and fails where a package could not be looked up
audit: setup
	$(BIN)/python -m pip install --quiet pip-audit
	$(BIN)/python -m pip_audit --strict --requirement constraints.txt --no-deps --disable-pip

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# executes all notebooks in place, at full size
notebooks: setup
	$(BIN)/python notebooks/execute.py

.venv/.docs: .venv/.installed
	$(BIN)/python -m pip install --quiet --editable '.[docs]' --constraint constraints.txt
	touch $@

# the documentation site: open out/site/index.html
docs: .venv/.docs
	$(BIN)/sphinx-build -q -W --keep-going -c docs -d out/.doctrees . out/site
	$(BIN)/python docs/site/check_site.py out/site

# every block of code on the pages, all notebooks at reduced size, the site, and a user's typed script (minutes)
docs-test: .venv/.docs
	$(BIN)/python -m pytest -m long tests/docs tests/notebooks tests/test_examples.py

# a wheel in dist/; without what an older build left, which would be packed as well
wheel: setup
	rm -rf build dist
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

bench: setup
	$(BIN)/python benchmarks/drr.py
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/refinement.py

bench-gpu: setup
	$(BIN)/python benchmarks/drr.py --device cuda
	$(BIN)/python benchmarks/scaling.py --device cuda

# Studies on simulated procedures; they renew docs/accuracy.md. Made once, the procedures stay in out/accuracy, and so do
# runs. The real bone shapes are looked for in the folder FEMOREG_DATA.
PRESET ?= fast
JOBS ?= 1
TIMED ?= 5

accuracy: setup
	$(BIN)/python -m sim.study accuracy --preset $(PRESET) --jobs $(JOBS) --timed $(TIMED) --docs docs

capture-range: setup
	$(BIN)/python -m sim.study capture-range --preset $(PRESET) --docs docs

trust: setup
	$(BIN)/python -m sim.study trust --preset $(PRESET) --docs docs

# Plans for three femora, their offsets, and meshes; renews docs/planning.md. Goes on where it was stopped.
plans: setup
	$(BIN)/python -m sim.study plans --docs docs

ablation: setup
	$(BIN)/python -m sim.study ablation --jobs $(JOBS) --docs docs
