# `make demo` and `make test` need nothing but Python 3.11 or newer: each sets up .venv by itself, once.
# The set-up is repeated only after pyproject.toml or constraints.txt has changed.
# Settings: PYTHON=python3.12 chooses the interpreter, JOBS=4 the number of test processes.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.set-up
JOBS ?= $(shell n=$$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2); [ $$n -gt 8 ] && echo 8 || echo $$n)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test docs results published release format bench constraints clean

help:  ## list the commands
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "%-18s%s\n", $$1, $$2}'

setup: $(STAMP)  ## make .venv with the tested versions of everything

demo: $(STAMP)  ## generate faces, train, score, write one report to ./derender-demo (minutes, offline)
	@$(BIN)/derender demo $(ARGS)

test: $(STAMP)  ## every test, ruff and pyrefly; ARGS="-k render" narrows it down
	@OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 NUMBA_NUM_THREADS=2 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(ARGS)

docs: $(STAMP)  ## build the site into build/docs, warnings as errors
	@$(BIN)/python docs/pages.py && $(BIN)/python -m sphinx -W --keep-going -q docs build/docs
	@echo build/docs/index.html

release: $(STAMP)  ## licences and known advisories of every package, into build/release
	@$(BIN)/python tests/trust/licences.py && $(BIN)/python tests/trust/advisories.py

# Results that need generated data only. Each step is one command and one file; what is there is kept, so a
# stopped run goes on where it was. `make results RESULTS=folder` leaves the files of the repository alone.
RESULTS := benchmarks/results/generated
DATA := build/results
SCORES := heads heads-fitted heads-128 brightness people disentanglement cars-clusters cars-geometry robustness-faces robustness-cars
results: $(STAMP) $(SCORES:%=$(RESULTS)/%.json)  ## repeat the results on generated images (tens of minutes, resumable)
	@$(BIN)/python docs/pages.py

$(DATA)/%: | $(STAMP)
	@rm -rf $@.part; $(BIN)/derender synth $* --benchmark --out $@.part && mv $@.part $@

$(DATA)/faces-128: | $(STAMP)
	@rm -rf $@.part; $(BIN)/derender synth faces --benchmark --image-size 128 --out $@.part && mv $@.part $@

HEADS := evaluate geometry $(DATA)/faces/test --model rendered-faces-64
HEADS-FITTED := $(HEADS) --fit-steps 20
BRIGHTNESS := evaluate brightness $(DATA)/faces/test --model rendered-faces-64
PEOPLE := evaluate cluster $(DATA)/faces/tracks --model rendered-faces-64 --label identity --mean-by identity --mean-by track
CARS-CLUSTERS := evaluate cluster $(DATA)/cars/test --model cars-64 --label class
CARS-GEOMETRY := evaluate geometry $(DATA)/cars/test --model cars-64
SCORE = @$(BIN)/python benchmarks/score.py $@
$(RESULTS)/heads.json: | $(DATA)/faces
	$(SCORE) $(HEADS)
$(RESULTS)/heads-fitted.json: | $(DATA)/faces
	$(SCORE) $(HEADS-FITTED)
$(RESULTS)/heads-128.json: | $(DATA)/faces-128
	$(SCORE) evaluate geometry $(DATA)/faces-128/test --model rendered-faces-128
$(RESULTS)/brightness.json: | $(DATA)/faces
	$(SCORE) $(BRIGHTNESS)
$(RESULTS)/people.json: | $(DATA)/faces
	$(SCORE) $(PEOPLE)
$(RESULTS)/disentanglement.json: | $(DATA)/faces
	$(SCORE) evaluate disentangle $(DATA)/faces/test --model rendered-faces-64 --limit 300 --seeds 1
$(RESULTS)/cars-clusters.json: | $(DATA)/cars
	$(SCORE) $(CARS-CLUSTERS)
$(RESULTS)/cars-geometry.json: | $(DATA)/cars
	$(SCORE) $(CARS-GEOMETRY)
$(RESULTS)/robustness-faces.json: | $(STAMP)
	$(SCORE) evaluate robustness --model rendered-faces-64 --pictures faces
$(RESULTS)/robustness-cars.json: | $(STAMP)
	$(SCORE) evaluate robustness --model cars-64 --pictures cars

# Results on sets that come from their owners: lfw64.zip, utkface64.zip and celeba64.zip in IMAGES, aligned, 64 pixels;
# celebamask128.zip; the cropped Extended Yale B as yaleb.zip, and pairs.txt of LFW.
PUBLISHED := benchmarks/results/published
LFW := --label identity --min-count 20 --max-count 20
SEGMENT := --model build/faces-unet --variants joint-whole,joint-random,random
published: $(STAMP)  ## repeat results on LFW, UTKFace, CelebA and Yale B: make published IMAGES=folder (hours, resumable)
	@mkdir -p build; test -f build/lfw-fitted.parquet || $(BIN)/derender embed $(IMAGES)/lfw64.zip --model faces-64 \
	  --fit-steps 20 --keep-duplicates --out build/lfw-fitted.parquet
	@test -d build/faces-unet || $(BIN)/derender unet $(IMAGES)/utkface64.zip --model faces-64 --out build/faces-unet \
	  --set images=96000 --set precision=bf16-mixed
	@test -f build/lfw-aligned/boxes.csv || $(BIN)/derender align $(IMAGES)/lfw128.zip --out build/lfw-aligned --largest --keep
	@for step in "lfw evaluate cluster $(IMAGES)/lfw64.zip --model faces-64 $(LFW)" \
	  "lfw-fitted evaluate cluster --features build/lfw-fitted.parquet $(LFW)" \
	  "lfw-finch evaluate cluster $(IMAGES)/lfw64.zip --model faces-64 $(LFW) --method finch" \
	  "disentanglement-lfw evaluate disentangle $(IMAGES)/lfw64.zip --model faces-64 --limit 800 --seeds 2" \
	  "reconstruction-utkface evaluate reconstruction $(IMAGES)/utkface64.zip --model faces-64 --part test" \
	  "reconstruction-lfw evaluate reconstruction $(IMAGES)/lfw64.zip --model faces-64 --limit 800" \
	  "reconstruction-lfw-fitted evaluate reconstruction $(IMAGES)/lfw64.zip --model faces-64 --limit 800 --fit-steps 20" \
	  "races evaluate cluster $(IMAGES)/utkface64.zip --model faces-64 --limit 4000 --label race --resamples 200" \
	  "celeba-labels evaluate linear $(IMAGES)/celeba64.zip --model faces-64 --attributes --heads linear,centred,logistic --resamples 200 --seeds 1" \
	  "robustness-lfw evaluate robustness $(IMAGES)/lfw64.zip --model faces-64 --pictures render $(LFW)" \
	  "identity evaluate identify $(IMAGES)/yaleb.zip --model faces-64 --half test" \
	  "identity-all evaluate identify $(IMAGES)/yaleb.zip --model faces-64" \
	  "identity-128 evaluate identify $(IMAGES)/yaleb.zip --model faces-128 --half test" \
	  "light evaluate light $(IMAGES)/yaleb.zip --half test --model faces-64" \
	  "light-optimised evaluate light $(IMAGES)/yaleb.zip --half test --model faces-64 --fit-steps 10" \
	  "relighting evaluate relight $(IMAGES)/yaleb.zip --half test --model faces-64" \
	  "verification evaluate verify $(IMAGES)/lfw64.zip --pairs $(IMAGES)/pairs.txt --half test --model faces-64" \
	  "verification-aligned evaluate verify build/lfw-aligned --pairs $(IMAGES)/pairs.txt --half test --model faces-64" \
	  "brightness-races evaluate brightness $(IMAGES)/utkface64.zip --model faces-64 --by race --limit 2000" \
	  "compare-linear compare --table linear --model faces-64 $(IMAGES)/celeba64.zip --finetune --supervised --seeds 1 --untrained-seeds 1" \
	  "compare-identity compare --table identity --model faces-64 $(IMAGES)/lfw64.zip" \
	  "compare-emotion compare --table emotion --model faces-64 $(IMAGES)/lfw64.zip" \
	  "compare-clustering compare --table clustering --model faces-64 $(IMAGES)/celeba64.zip" \
	  "segmentation-640 evaluate segment $(IMAGES)/celebamask128.zip $(SEGMENT)" \
	  "segmentation-320 evaluate segment $(IMAGES)/celebamask128.zip $(SEGMENT) --labelled 320" \
	  "segmentation-100 evaluate segment $(IMAGES)/celebamask128.zip $(SEGMENT) --labelled 100" \
	  "celeba evaluate cluster $(IMAGES)/celeba64.zip --model faces-64 --attributes --resamples 200"; do \
	  set -- $$step; name=$$1; shift; $(BIN)/python benchmarks/score.py $(PUBLISHED)/$$name.json "$$@" || exit 1; \
	done; $(BIN)/python docs/pages.py

format: $(STAMP)  ## ruff: formatting and the fixes it is sure of
	@$(BIN)/ruff format . && $(BIN)/ruff check --fix .

bench: $(STAMP)  ## the speed tables of docs/performance.md
	@$(BIN)/python benchmarks/rasterize.py
	@$(BIN)/python benchmarks/training_step.py $(ARGS)

constraints: $(STAMP)  ## write the versions installed in .venv to constraints.txt
	@{ sed -n '/^#/p' constraints.txt; \
	   $(BIN)/python -m pip freeze --all --exclude-editable | sed -e 's/+[a-z0-9.]*$$//' -e '/ @ /d'; } > constraints.tmp
	@mv constraints.tmp constraints.txt && touch $(STAMP)

clean:  ## remove .venv and everything a tool has cached
	@rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build dist
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@set -e; \
	for python in $(PYTHON) python3.11 python3.12 python3.13 python3 python; do \
		$$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && found=$$python && break; \
	done; \
	if [ -z "$$found" ]; then \
		echo "derender needs Python 3.11 or newer with its venv module; none was found (name one: make PYTHON=/path/to/python3)" >&2; exit 2; \
	fi; \
	echo "Setting up $(VENV) with $$($$found --version) (once; a few minutes, mostly PyTorch)"; \
	$$found -m venv $(VENV); \
	{ $(BIN)/python -m pip install --upgrade -c constraints.txt pip && \
	  $(BIN)/python -m pip install -c constraints.txt -e . --group dev --group docs; } > $(VENV)/set-up.log 2>&1 \
	|| { tail -n 25 $(VENV)/set-up.log >&2; echo "Set-up failed; the whole log is in $(VENV)/set-up.log" >&2; exit 1; }
	@touch $@
