# make          plan the hopper, prove the plan in MuJoCo and film it: renders/hopper/report.html
# make help     what else there is
#
# Needs git, make and Python >= 3.11; everything else goes into .venv (see .ci/setup).

PLANNER = .venv/bin/planner
PYTHON = .venv/bin/python
PYTEST_FLAGS ?= -n 2
GALLERY = renders/gallery

.DEFAULT_GOAL = run
.PHONY: run test lint gallery clean help setup

run: setup ## plan, prove and film the hopper into renders/hopper (the default)
	@$(PLANNER) run hopper --out renders/hopper

test: ## run all tests; e.g. make test PYTEST_FLAGS="-k hopper"
	@.ci/setup test
	@$(PLANNER) warmup --all
	$(PYTHON) -m pytest $(PYTEST_FLAGS)

lint: ## check style and types
	@.ci/setup test dev
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m pyright

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
	$(PLANNER) paper
	$(PLANNER) paper --proofs --out renders/proofs

clean: ## remove .venv and caches; results in renders/ stay
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find planner tests examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup:
	@.ci/setup
	@$(PLANNER) warmup
