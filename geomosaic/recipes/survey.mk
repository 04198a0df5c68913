# Mosaics of many surveys, for your own Makefile (GNU make, find and flock). In it:
#
#     FLIGHTS := flights              # folders of frames: flights/north becomes out/north
#     OUT := out
#     GEOMOSAIC_FLAGS := --strict     # of every survey
#     north_FLAGS := --gsd 0.1        # of one
#     include $(shell geomosaic recipes --makefile)
#
#     out/north/run.json: control/north.csv    # a file that north_FLAGS name
#
# `make -j2 mosaics reports tiles`, `make out/north/layers.gpkg`. A finished survey is up to date: it is run again
# only if its frames or its flags change, and then from its cache. Names of surveys have no blanks.

FLIGHTS ?= flights
OUT ?= out
SURVEYS ?= $(notdir $(patsubst %/,%,$(wildcard $(FLIGHTS)/*/)))
GEOMOSAIC ?= geomosaic
# what is run of the frames' folder: `run quick-look` is another
GEOMOSAIC_COMMAND ?= mosaic
WORKERS ?=
EXPORTS ?= tiles stac vrt

RUNS := $(SURVEYS:%=$(OUT)/%/run.json)
PRODUCTS := mosaic.tif sources.tif layers.gpkg positions.csv report.html run.mcap

mosaics: $(SURVEYS:%=$(OUT)/%/mosaic.tif)
layers: $(SURVEYS:%=$(OUT)/%/layers.gpkg)
reports: $(SURVEYS:%=$(OUT)/%/report.html)
.PHONY: mosaics layers reports $(EXPORTS)

# What a run is made of: its frames with their sizes and times, and how it is called. The list is written anew
# only where it differs, while make reads its files, so that removed frames and other flags count too.
survey_command = $(GEOMOSAIC) $(GEOMOSAIC_COMMAND) $(FLIGHTS)/$1 -o $(OUT)/$1 \
	$(if $(WORKERS),--workers $(WORKERS)) $(GEOMOSAIC_FLAGS) $($1_FLAGS)
survey_list = mkdir -p $(OUT); { echo '$(subst ','\'',$(call survey_command,$1))'; \
	find $(FLIGHTS)/$1 -name '.?*' -prune -o ! -type d -printf '%P %s %T@\n' | LC_ALL=C sort; } > $(OUT)/.$1.new; \
	cmp -s $(OUT)/.$1.new $(OUT)/.$1.made_of && rm $(OUT)/.$1.new || mv $(OUT)/.$1.new $(OUT)/.$1.made_of
$(foreach survey,$(SURVEYS),$(shell $(call survey_list,$(survey))))

# run.json is a run's last file, written also where all else was in the cache and keeps its time.
# A run that --strict refuses has written it: an old time makes the next make try again.
$(RUNS): $(OUT)/%/run.json: $(OUT)/.%.made_of
	$(call survey_command,$*) || { failed=$$?; touch -c -t 197001020000 $@; exit $$failed; }

$(foreach file,$(PRODUCTS),$(eval $(SURVEYS:%=$(OUT)/%/$(file)): $(OUT)/%/$(file): $(OUT)/%/run.json ;))

# One export at a time of a run: each lists its files in the run's folder.
define survey_export
$1: $$(SURVEYS:%=$$(OUT)/%/.$1)
$$(SURVEYS:%=$$(OUT)/%/.$1): $$(OUT)/%/.$1: $$(OUT)/%/run.json
	flock $$(OUT)/.$$*.made_of $$(GEOMOSAIC) export $1 $$(OUT)/$$*
	@touch $$@
endef
$(foreach kind,$(EXPORTS),$(eval $(call survey_export,$(kind))))
