SHELL := /bin/bash
.DEFAULT_GOAL := help
PY := .venv/bin/python
STAMP := .venv/.setup-done
DEV_STAMP := .venv/.dev-done
IMAGES ?=
OUT ?= out/demo
WORKERS ?= 2
TEST_WORKERS ?= 3
DATA ?= ../shared
SEED ?= 1
CASES ?= 10000
TRIALS ?= 200
DRAWS ?= 10000
SEEDS ?= 100
FRAMES ?= 24 100
SIZE ?= --lines 20 --per-line 50
ONLY ?=
ROWS = --summary docs/results/summary.json

help: ## list the targets
	@grep -hE '^[a-z][a-z-]*:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

setup: $(STAMP) ## prepare .venv with the program and its simulator (installs libgdal-dev with apt where missing and allowed)

dev: $(DEV_STAMP) ## add to .venv what tests, the site, Dask and `geomosaic view` need

$(STAMP): pyproject.toml geomosaic_simulate/pyproject.toml constraints.txt tools/setup.sh
	bash tools/setup.sh
	@touch $@

$(DEV_STAMP): $(STAMP)
	bash tools/setup.sh dev
	@touch $@

demo: setup ## simulate a small survey and mosaic it; IMAGES=folder mosaics that folder instead
	@if [ -n "$(IMAGES)" ]; then .venv/bin/geomosaic mosaic "$(IMAGES)" -o "$(OUT)"; \
	else $(PY) tools/demo.py "$(OUT)"; fi

test: dev ## all checks and tests, two at a time: mypy takes one core while tests begin
	$(MAKE) --no-print-directory -j2 lint types layers unit

lint: dev ## ruff, and codespell on code and pages
	.venv/bin/ruff check geomosaic geomosaic_simulate tests tools examples
	.venv/bin/ruff format --check geomosaic geomosaic_simulate tests tools examples
	.venv/bin/codespell geomosaic geomosaic_simulate tests tools examples docs *.md

types: dev ## mypy --strict on both packages
	.venv/bin/mypy

layers: dev ## import-linter: data walks one way
	.venv/bin/lint-imports

unit: dev ## pytest, three workers: two cores have work while a test waits; TEST_WORKERS=n
	@.venv/bin/pytest --collect-only -qq >/dev/null || true # compiles the tests once, not in each worker
	.venv/bin/pytest -n $(TEST_WORKERS) --dist loadfile -m "not proof"

bench-proofs: dev ## the tests that take long: draws, whole runs, commands of the docs (about half an hour); before a change lands
	.venv/bin/pytest -n $(TEST_WORKERS) --dist loadfile -m proof

bench-paper: setup ## the paper's comparison of adjustment methods (about 10 minutes)
	$(PY) -m tools.bench.bench_paper --out out/bench-paper

bench-composition: setup ## how much like the ground the mosaic looks, on flights of uneven light (about 10 minutes)
	$(PY) -m tools.bench.bench_composition $(ROWS) --out out/bench-composition

bench-light: setup ## mosaics of simulated flights with sun, hot spot, automatic exposure and clouds against the true radiance
	$(PY) -m tools.bench.bench_light --results docs/results/light --out out/bench-light

bench-surface: setup ## the dense surface of three simulated towns against their truth, and of real flights (40 minutes on two idle cores, reckoned from its parts)
	$(PY) -m tools.bench.bench_surface $(ROWS) --roofs --rival --scale --large --out out/bench-surface

bench-accuracy: bench-monte-carlo bench-bundle ## accuracy on simulated surveys against their truth (about an hour)
	$(PY) -m tools.bench.bench_accuracy $(ROWS) --out out/bench-accuracy --rivals

bench-accuracy-raster: setup ## accuracy.tif against the truth on 20 simulated surveys (about 20 minutes); ONLY="names", SEED=first
	$(PY) -m tools.bench.bench_accuracy_raster $(if $(ONLY),--only $(ONLY)) --first-seed $(SEED) --out out/bench-accuracy-raster \
	  --results docs/results/accuracy_raster

bench-monte-carlo: setup ## stated covariance and error against the Cramer-Rao bound, 30 seeds (about 20 minutes)
	$(PY) -m tools.bench.bench_monte_carlo $(ROWS) --out out/bench-monte-carlo

bench-constants: setup ## each constant halved and doubled on small scenes, and what moves (about 3 hours); ROOMS="names"
	$(PY) -m tools.bench.bench_constants --out out/bench-constants $(if $(ROOMS),--rooms $(ROOMS))

bench-start: setup ## whether the solve finds its block: 20 seeds of each kind, matched once, then solved (about an hour)
	$(PY) -m tools.bench.bench_start $(ROWS) --out out/bench-start

bench-dirty: setup ## 100 surveys as people deliver them, and 30 plain ones (about 2 hours); SEEDS=n SEED=n WORKERS=n
	$(PY) -m tools.bench.bench_dirty --seeds $(SEEDS) --seed $(SEED) --workers $(WORKERS) --out out/bench-dirty --results docs/results/dirty

bench-fixes: setup ## whether each fix that a verdict names changes the outcome, on simulated surveys (about 15 minutes)
	$(PY) -m tools.bench.bench_fixes --seed $(SEED) --results docs/results/fixes --out out/bench-fixes

bench-reflectance: setup ## reflectance of simulated multispectral flights against the truth (about 2 minutes); SEED=n
	$(PY) -m tools.bench.bench_reflectance --seed $(SEED) --results docs/results/reflectance --out out/bench-reflectance

bench-halves: DATA = ../flights
bench-halves: setup ## two maps of every second frame of real flights, with what both state (about 10 minutes); DATA=../flights
	$(PY) -m tools.bench.bench_halves "$(DATA)" --results docs/results/halves --out out/bench-halves

bench-speed: setup ## real and simulated frames against the floor and other programs (about an hour); DATA=../shared, skips the real ones without it
	$(PY) -m tools.bench.bench_speed $(ROWS) --shared "$(DATA)" --out out/bench-speed

bench-cluster: dev ## Dask workers without a shared disk: killed, slow, by an object store (about 15 minutes; root)
	$(PY) -m tools.bench.bench_cluster --seed $(SEED) --out out/bench-cluster --results docs/results/cluster

bench-incremental: setup ## a 21st line of 50 frames added by --incremental, against a whole run (about an hour); SIZE="--lines n --per-line n" or "--frames FOLDER --added n"
	$(PY) -m tools.bench.bench_incremental $(SIZE) --seed $(SEED) --out out/bench-incremental --results docs/results/incremental

bench-peers: setup ## geomosaic against pycolmap, pyOrthomosaic, OpenCV and stitching on the same frames (an hour on two idle cores); FRAMES="24 100", DATA=../shared
	$(PY) -m tools.bench.bench_peers --frames $(FRAMES) --seed $(SEED) --shared "$(DATA)" --out out/bench-peers --results docs/results/peers

bench-marking: dev ## a scripted session that marks 8 targets in 20 frames in Chromium, with a person's waits (about 5 minutes); SEED=n
	$(PY) -m tools.bench.bench_marking --seed $(SEED) --out out/bench-marking --results docs/results/marking

bench-scale: setup ## 50 to 5,000 frames from pixels, 50,000 windows planned (about two hours)
	$(PY) -m tools.bench.bench_scale $(ROWS) --out out/bench-scale

bench-bundle: setup ## 1,000 frames with 300,000 image observations (about a minute)
	$(PY) -m tools.bench.bench_bundle $(ROWS) --whole

bench-oracle: setup ## the bundle against COLMAP's on the same tie points; says how to get pycolmap (about 2 minutes)
	$(PY) -m tools.bench.bench_oracle $(ROWS)

bench-recording: setup ## what the recording costs: at most 5 % of the time and 1 MB a frame (about 20 minutes)
	$(PY) -m tools.bench.bench_recording $(ROWS) --out out/bench-recording

bench-worst: setup ## faults that inspect names on simulated surveys, against the truth (about 25 minutes)
	$(PY) -m tools.bench.bench_worst --out out/bench-worst --seed 301 --results docs/results/worst
	$(PY) -m tools.bench.bench_worst $(ROWS) --out out/bench-worst --seed 401 --seeds 4 --dry 1

bench-strips: setup ## CCD strips against truth: cases, mixed scenes, object space, speed, the paper's figures (about 2 hours)
	$(PY) -m tools.bench.bench_strips $(ROWS) --seeds 20 --methods all --out out/bench-strips
	$(PY) -m tools.bench.bench_strips $(ROWS) --mixed 60 --out out/bench-strips
	$(PY) -m tools.bench.bench_strips_crossover
	$(PY) -m tools.bench.bench_strips_speed $(ROWS)
	$(PY) -m tools.bench.bench_strips_figures --out out/bench-strips

bench-real: setup ## real surveys; needs the data folder, DATA=../shared, and skips without it
	$(PY) -m tools.bench.bench_real $(ROWS) --shared "$(DATA)" --out out/bench-real

bench-flights: DATA = ../flights
bench-flights: setup ## every flight of a folder, a sheet NAME.yaml each (CONTRIBUTING.md); DATA=../flights, skips without it; ONLY="names"
	$(PY) -m tools.bench.bench_flights $(ROWS) "$(DATA)" $(if $(ONLY),--only $(ONLY)) --out out/bench-flights

results: setup ## docs/results.md from the files in docs/results
	$(PY) tools/docs/results_page.py

check-qgis: setup ## open layers.gpkg and project.qgz in a real QGIS and draw its window (about 2 minutes); QGIS=options
	$(PY) -m tools.check.check_qgis $(ROWS) $(QGIS)

check-clone: ## time `make setup` and `make demo` in a fresh clone (about 2 minutes)
	$(PY) -m tools.check.fresh_clone $(ROWS)

fuzz: setup ## 10,000 spoiled files of every kind through the commands (about 2 hours); CASES=n SEED=n
	$(PY) -m tools.fuzz $(ROWS) --cases $(CASES) --seed $(SEED) --out out/fuzz

trial-degenerate: setup ## 10,000 degenerate blocks: each has to end finite, without an exception (about 40 minutes); DRAWS=n SEED=n
	$(PY) -m tools.trials.trial_degenerate $(ROWS) --draws $(DRAWS) --seed $(SEED) --workers $(WORKERS) --out out/trial-degenerate

chaos: dev ## 200 runs killed, stopped, starved and their inputs changed (about 40 minutes); TRIALS=n SEED=n
	$(PY) -m tools.trials.chaos $(ROWS) --trials $(TRIALS) --seed $(SEED) --out out/chaos

docs: dev ## the site, by mkdocs-material, in out/site (needs no network to be read)
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --quiet

format: dev ## rewrite the code's layout
	.venv/bin/ruff check --fix geomosaic geomosaic_simulate tests tools examples
	.venv/bin/ruff format geomosaic geomosaic_simulate tests tools examples

clean: ## delete results and caches, keep .venv
	rm -rf out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

.PHONY: help setup dev demo test lint types layers unit bench-paper bench-composition bench-light bench-surface bench-accuracy bench-accuracy-raster bench-monte-carlo bench-constants bench-start bench-dirty bench-fixes bench-halves bench-bundle bench-speed bench-cluster bench-incremental bench-peers bench-marking bench-scale bench-oracle bench-recording bench-worst bench-strips bench-real results check-qgis check-clone bench-flights fuzz trial-degenerate chaos docs format clean
