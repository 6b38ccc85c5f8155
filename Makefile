# make          plan the hopper, prove the plan in MuJoCo and film it: renders/hopper/report.html
# make help     what else there is
#
# Needs git, make and Python >= 3.11; everything else goes into .venv (see .ci/setup).

PLANNER = .venv/bin/planner
PYTHON = .venv/bin/python
# Two workers; a file stays with one of them, so that its fixtures are built once.
PYTEST_FLAGS ?= -n 2 --dist loadfile
GALLERY = renders/gallery

.DEFAULT_GOAL = run
.PHONY: run test test-slow test-all lint docs linkcheck gallery assets clean help setup setup-test

run: setup ## plan, prove and film the hopper into renders/hopper (the default)
	@$(PLANNER) run hopper --out renders/hopper

# The matrices of the tests are small: more threads of linear algebra than one only wait for each other.
test test-slow test-all: export OPENBLAS_NUM_THREADS = 1

test: setup-test ## run the tests; e.g. make test PYTEST_FLAGS="-k hopper"
	$(PYTHON) -m pytest -m "not slow" $(PYTEST_FLAGS)

test-slow: setup-test ## run the tests that are marked slow
	$(PYTHON) -m pytest -m slow $(PYTEST_FLAGS)

test-all: setup-test ## run both
	$(PYTHON) -m pytest $(PYTEST_FLAGS)

lint: ## check style and types
	@.ci/setup test dev
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m pyright

docs: ## build the documentation site: docs/_build/index.html
	@.ci/setup docs
	$(PYTHON) -m sphinx -W --keep-going -q -b html -d docs/_build/.doctrees docs docs/_build

linkcheck: ## check every link: files, headings, and pages of others (none so far, for which it would need the network)
	@.ci/setup docs test
	$(PYTHON) -m pytest -q tests/test_links.py
	$(PYTHON) -m sphinx -W --keep-going -q -b linkcheck -d docs/_build/.doctrees docs docs/_build/linkcheck

gallery: setup ## make the committed pictures and videos again
	@mkdir -p $(GALLERY)
	@for case in hopper two-link acrobot puma high-dive human-step; do \
	    $(PLANNER) run $$case --out renders/$$case && \
	    cp renders/$$case/video.mp4 $(GALLERY)/$$case.mp4 && \
	    cp renders/$$case/strip.png $(GALLERY)/$$case.strip.png && \
	    cp renders/$$case/plots.png $(GALLERY)/$$case.plots.png && \
	    cp renders/$$case/proof.png $(GALLERY)/$$case.proof.png || exit 1; \
	done
	@for name in poses measures paths; do \
	    cp renders/human-step/$$name.png $(GALLERY)/human-step.$$name.png || exit 1; \
	done
	@for film in quadruped quadrotor examples/tasks/around_a_post.toml; do \
	    name=$$(basename $$film .toml | tr _ -) && $(PLANNER) run $$film --out renders/$$name && \
	    cp renders/$$name/video.mp4 $(GALLERY)/$$name.mp4 || exit 1; \
	done
	@$(PYTHON) examples/montage.py renders $(GALLERY)/planner.gif
	$(PYTHON) docs/figures/draw.py
	$(PYTHON) docs/figures/gallery.py
	$(PLANNER) paper --full
	$(PLANNER) paper --proofs --out renders/proofs

assets: ## bundle three.js for the 3-D view of reports again (needs npm and the network)
	@rm -rf build/assets && mkdir -p build/assets && cp planner/view/assets/three.entry.js build/assets/entry.js
	@cd build/assets && npm install --silent --no-save three@0.170.0 esbuild@0.24.0 && \
	    npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=inline \
	    --outfile=three.min.js
	@cp build/assets/three.min.js planner/view/assets/three.min.js
	@cp build/assets/node_modules/three/LICENSE planner/view/assets/LICENSE-three.txt
	@sha256sum planner/view/assets/three.min.js # NOTICE has the digest

clean: ## remove .venv and caches; results in renders/ stay
	rm -rf .venv build dist docs/_build *.egg-info .pytest_cache .ruff_cache .hypothesis
	find planner tests examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-9s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup:
	@.ci/setup
	@$(PLANNER) warmup

setup-test:
	@.ci/setup test
	@$(PLANNER) warmup --all
