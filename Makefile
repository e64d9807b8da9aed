# Everything runs in a virtual environment of its own, with the versions in constraints.txt.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs/compare
# Where torch comes from; empty for pip's own index, whose torch for Linux brings gigabytes of libraries for graphics cards.
# Without them: make TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=
# Instructions of processors that numpy chooses when it starts.
WIDE := AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR AVX2 FMA3 X86_V4 X86_V3
PACKAGES := ncs_gym shields agents experiments
# Modules are compiled once, when they are first imported: not all of them by pip, nor in every process that tests start.
export PYTHONDONTWRITEBYTECODE :=
INSTALLED := $(VENV)/.installed
DOCS_INSTALLED := $(VENV)/.installed-docs
AUDIT_INSTALLED := $(VENV)/.installed-audit
RAY_INSTALLED := $(VENV)/.installed-ray
LOWEST := $(VENV)-lowest
NEWEST := $(VENV)-newest

# The project's public address, written into pyproject.toml, CITATION.cff, README.md, the notebook and the site by `make address`.
ADDRESS ?=

.DEFAULT_GOAL := help
.PHONY: help compare suite pretrained test test-other-processor test-lowest test-newest coverage coverage-report test-slow test-slow-part mutants lint types benchmark \
	example-times docs words audit dist address clean

help: ## this list
	@echo 'make TARGET; everything is installed into $(VENV) when it is first needed.'
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-22s%s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

compare: $(INSTALLED) ## agents with and without a shield, compared (OUT=runs/compare)
	$(BIN)/ncs compare --out $(OUT)

# Runs that runs/suite has already are kept, so that it can be done in parts.
suite: $(INSTALLED) ## the whole benchmark, and its page
	$(BIN)/python -m benchmarks.suite measure
	$(BIN)/python -m benchmarks.suite pages

test: $(INSTALLED) ## the tests
	$(BIN)/python -m pytest -n auto --dist worksteal $(TEST_FLAGS)

# The small agents of the package, in agents/trained. The extra [mujoco] adds ncs_gym/InvertedPendulum-v0.
pretrained: $(INSTALLED) ## the small agents of the package, trained again
	$(BIN)/python -m benchmarks.learning pretrained

# What proves, verifies and decides, once more with other kernels of linear algebra and without wide instructions (x86).
test-other-processor: $(INSTALLED) ## what proves and decides, as on another processor
	OPENBLAS_CORETYPE=Prescott NPY_DISABLE_CPU_FEATURES='$(WIDE)' $(BIN)/python -m pytest -n auto --dist worksteal \
		tests/ncs_gym/estimation tests/ncs_gym/plants tests/ncs_gym/test_ellipsoid.py tests/ncs_gym/test_gaussian_noise.py \
		tests/ncs_gym/test_disturbances.py tests/ncs_gym/test_vector_disturbances.py tests/shields tests/hardening \
		--ignore=tests/shields/paper --ignore=tests/hardening/test_bounded_inputs.py

test-lowest: $(LOWEST)/.installed ## the tests, with the lowest versions of dependencies that pyproject.toml allows
	$(LOWEST)/bin/python -m pytest -n auto --dist worksteal

# What calls a solver, or shows that nothing is printed by one.
NEWEST_TESTS ?= tests/shields/synthesis
test-newest: $(NEWEST)/.installed ## what calls solvers, with the newest versions of dependencies that pyproject.toml allows
	$(NEWEST)/bin/python -m pytest -n auto --dist worksteal $(NEWEST_TESTS)

# The suite, and the share of lines and branches it runs, by package. Tracing takes half as much time again.
coverage: $(INSTALLED) ## the tests, and what share of the code they run
	$(MAKE) test TEST_FLAGS='--cov --cov-report='
	$(MAKE) coverage-report

coverage-report: ## that share, of the tests that ran last
	@echo 'lines and branches run by the tests [%], without worker processes:'
	@for package in $(PACKAGES) '*'; do \
		printf '%-12s' "$$package"; $(BIN)/coverage report --include="$$package/*" --format=total || exit; done

test-slow: $(INSTALLED) $(RAY_INSTALLED) $(AUDIT_INSTALLED) ## the long attacks, and examples in processes of their own
	$(BIN)/python -m pytest -n auto --dist worksteal -m slow

# What CI has time for: that the synthesis still gives the certificates of the package, the paper's audit, the benchmark and a record as the
# pages have them, published plants, the same bits in every process, and what worker processes do.
SLOW_PART ?= tests/shields/test_packaged_certificates.py tests/experiments/commands/test_paper.py tests/test_suite.py \
	tests/experiments/commands/test_requirements.py \
	tests/test_published_plants.py \
	tests/hardening/test_determinism.py::test_same_seed_gives_the_same_bits_in_every_process \
	tests/hardening/test_portability.py::test_operating_points_that_are_found_are_the_same_under_other_kernels \
	tests/experiments/backends/test_execution.py \
	tests/test_packaging.py tests/ncs_gym/rendering/test_rendering.py::test_images_need_no_display_and_leave_the_driver_alone
test-slow-part: $(INSTALLED) ## a fixed part of the long tests
	$(BIN)/python -m pytest -n auto --dist worksteal -m slow $(SLOW_PART)

mutants: $(INSTALLED) ## sixty small faults, and the test that notices each
	$(BIN)/python -m benchmarks.project mutants

lint: $(INSTALLED) ## style, declared dependencies, and who imports whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/deptry $(PACKAGES)
	$(BIN)/lint-imports --no-cache

types: $(INSTALLED) ## types
	$(BIN)/pyright --pythonpath $(BIN)/python

benchmark: $(INSTALLED) ## times of imports, shields, environments ...
	$(BIN)/python -m benchmarks.speed imports
	$(BIN)/python -m benchmarks.speed first-shield
	$(BIN)/python -m benchmarks.speed networked
	$(BIN)/python -m benchmarks.shield decision
	$(BIN)/python -m benchmarks.shield cost
	$(BIN)/python -m benchmarks.shield containment
	$(BIN)/python -m benchmarks.networks gains
	$(BIN)/python -m benchmarks.synthesis times
	$(BIN)/python -m benchmarks.networks contracts
	$(BIN)/python -m benchmarks.synthesis families
	$(BIN)/python -m benchmarks.synthesis trust
	$(BIN)/python -m benchmarks.speed environments
	$(BIN)/python -m benchmarks.speed rendering
	$(BIN)/python -m benchmarks.speed ppo

example-times: $(INSTALLED) ## how long each example takes, and what it says (EXAMPLES="quick_start.py")
	$(BIN)/python -m benchmarks.speed examples $(EXAMPLES)

# Fails on a broken link, anchor, reference or formula; makes a page per registered environment. Look at it: python -m http.server -d site (from a file the search is missing).
docs: $(DOCS_INSTALLED) ## the site, in site/
	$(BIN)/python docs/hooks/build_site.py
	$(BIN)/python -m pytest -n auto --dist worksteal -m 'site and not slow'

words: ## words of README and of every page, with the sum of the pages
	@wc -w README.md
	@wc -w docs/*.md

# Known vulnerabilities of what constraints.txt names, by OSV: any index of packages will do, a network is needed.
audit: $(AUDIT_INSTALLED) ## known vulnerabilities of the dependencies (asks a database on the internet)
	@$(BIN)/python .ci/audit.py

dist: $(INSTALLED) ## sdist and wheel, in dist/
	rm -rf dist
	$(BIN)/python -m hatchling build

address: $(INSTALLED) ## writes the public address everywhere (ADDRESS=https://...)
	@$(BIN)/python .ci/address.py '$(ADDRESS)'

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[train,contrib,render,video,dev]'
	touch $@

# Torch is the one of constraints.txt: it takes the longest to fetch.
$(LOWEST)/.installed: pyproject.toml
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt uv
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct "$$(grep '^torch==' constraints.txt)" \
		-e '.[train,contrib,render,video,dev]'
	touch $@

# Without torch and what else only agents need.
$(NEWEST)/.installed: pyproject.toml
	$(PYTHON) -m venv $(NEWEST)
	$(NEWEST)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile -e . pytest pytest-xdist hypothesis
	touch $@

$(DOCS_INSTALLED): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[docs]'
	touch $@

$(AUDIT_INSTALLED): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[audit]'
	touch $@

$(RAY_INSTALLED): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[ray]'
	touch $@

clean: ## removes the environment and the site
	rm -rf $(VENV) site dist
