# Every target sets up what it needs in .venv; nothing else on the machine is touched.
PYTHON ?= python3
PYTEST_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SETUP_FILES := pyproject.toml constraints.txt
DEMO_OUT := runs/demo
DEMO_STUDENT_OUT := runs/demo-student

.DEFAULT_GOAL := help
.PHONY: help setup demo demo-student test test-unit test-generate test-sentences test-lerobot test-lerobot-env test-vla-eval test-rlinf test-ray test-sb3 test-skrl test-maniskill test-mshab test-rsl-rl test-rllib test-browser release-check docs check check-static format bench gpu-report clean distclean test-docs test-panda test-torchrl gpu-train docs-media

help:  ## show this list
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-16s %s\n", $$1, $$2}'

$(BIN)/python:
	@command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	  echo "mjhab: no '$(PYTHON)' found. Install Python 3.11 or newer, or name one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "mjhab needs Python >= 3.11, but '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1). Name a newer one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@"$(PYTHON)" -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "mjhab: could not make a virtual environment (on Debian/Ubuntu: apt install python3-venv)." >&2; exit 1; }

$(VENV)/.core: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing into $(VENV), once"
	@$(PIP) install -q -c constraints.txt -e .
	@touch $@

$(VENV)/.dev: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing with development tools into $(VENV), once"
	@$(PIP) install -q -c constraints.txt -e '.[dev]'
	@touch $(VENV)/.core $@

$(VENV)/.learn: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing with torch into $(VENV), once"
	@$(PIP) install -q -c constraints.txt -e '.[learn]'
	@touch $(VENV)/.core $@

setup: $(VENV)/.dev  ## install mjhab and its development tools into .venv

demo: $(VENV)/.core  ## a Fetch robot does SetTable in furnished homes; films and report in runs/demo
	$(BIN)/mjhab demo --out $(DEMO_OUT)

demo-student: $(VENV)/.learn  ## learned policies set the table, the expert drives; films in runs/demo-student
	$(BIN)/mjhab eval --policy learned:builtin --task set_table --navigate drive --split test \
	  --episodes 4 --worlds 4 --seed 0 --films 2 --out $(DEMO_STUDENT_OUT) --overwrite
	@echo "Open in a browser (no network needed): $(CURDIR)/$(DEMO_STUDENT_OUT)/report.html"

test: $(VENV)/.dev  ## the whole test suite, with the slowest tests listed at the end
	@# Kernels are compiled before several pytest workers could do so at the same time; those of Warp for the device of
	@# the tests, which take more than two minutes.
	$(BIN)/mjhab warmup --task set_table --backend warp --device $${MJHAB_TEST_DEVICE:-cpu}
	$(BIN)/python -m pytest --durations=15 --durations-min=0.5 $(PYTEST_ARGS)

UNIT_TESTS := tests/core tests/tasks tests/rollout tests/reports tests/serving
test-unit: $(VENV)/.dev  ## the fast unit tests alone, without simulation of homes: under a minute on 2 cores
	$(BIN)/python -m pytest -q -n 2 --dist loadfile $(UNIT_TESTS) $(PYTEST_ARGS)

GENERATE_OUT := runs/generate
EPISODES ?= 50
test-generate: $(VENV)/.dev  ## generate EPISODES=50 with two kills -9, resume; check all, replay all bit by bit
	$(BIN)/python tests/generate/check_generate.py $(GENERATE_OUT) $(EPISODES)

MSHAB_OUT := runs/mshab
test-mshab: $(VENV)/.dev  ## run the scripts of a checkout of MS-HAB, MSHAB=FOLDER, unchanged (needs its libraries: omegaconf dacite wandb tensorboardX diffusers); VLA=FOLDER: and an evaluation of pi0
	@test -d "$(MSHAB)/mshab" || { echo "MSHAB=FOLDER must be a checkout of MS-HAB"; exit 2; }
	PYTHONPATH=. $(BIN)/python tests/compat/originals.py $(MSHAB) $(MSHAB_OUT) $(if $(VLA),--vla $(VLA))

SENTENCES_OUT := runs/sentences.json
PACKS ?= builtin
test-sentences: $(VENV)/.dev  ## read the instructions of EPISODES=50 episodes per task and pack (PACKS=builtin,FOLDER) back against the simulator
	PYTHONPATH=. $(BIN)/python tests/sentences/check_sentences.py $(EPISODES) $(SENTENCES_OUT) $(PACKS)

# The real lerobot package needs other versions than mjhab and, on Linux, CUDA libraries: 8 GB in a place of its own.
# The reader of v2.1 (the last lerobot before v3.0) lies beside it with the datasets package it was made for.
LEROBOT := .venv-lerobot
LEROBOT_OUT := runs/lerobot
$(LEROBOT)/.ready: Makefile
	@echo "mjhab: installing lerobot into $(LEROBOT), once (8 GB)"
	@"$(PYTHON)" -m venv $(LEROBOT)
	@$(LEROBOT)/bin/python -m pip install -q lerobot==0.4.4 h5py
	@$(LEROBOT)/bin/python -m pip install -q --no-deps --upgrade --target $(LEROBOT)/v21 lerobot==0.3.3 \
	  datasets==3.6.0 dill==0.3.8 multiprocess==0.70.16 fsspec==2025.3.0
	@touch $@

test-lerobot: $(VENV)/.dev $(LEROBOT)/.ready  ## load exported data sets with older lerobot packages, 0.4.4 and 0.3.3 (8 GB to install)
	$(BIN)/python tests/lerobot/make_set.py $(LEROBOT_OUT)/shards $(EPISODES)
	$(BIN)/mjhab export lerobot $(LEROBOT_OUT)/shards --version 3.0 --out $(LEROBOT_OUT)/v30 --overwrite --json
	$(BIN)/mjhab export lerobot $(LEROBOT_OUT)/shards --version 2.1 --out $(LEROBOT_OUT)/v21 --overwrite --json
	HF_HUB_OFFLINE=1 HF_DATASETS_CACHE=$(LEROBOT_OUT)/cache30 \
	  $(LEROBOT)/bin/python tests/lerobot/check_export.py $(LEROBOT_OUT)/v30 $(LEROBOT_OUT)/shards
	HF_HUB_OFFLINE=1 HF_DATASETS_CACHE=$(LEROBOT_OUT)/cache21 PYTHONPATH=$(LEROBOT)/v21 \
	  $(LEROBOT)/bin/python tests/lerobot/check_export.py $(LEROBOT_OUT)/v21 $(LEROBOT_OUT)/shards

VLA := .venv-vla-eval
$(VLA)/.ready: $(SETUP_FILES)
	@echo "mjhab: installing vla-eval into $(VLA), once"
	@"$(PYTHON)" -m venv $(VLA)
	@$(VLA)/bin/python -m pip install -q --disable-pip-version-check -e '.[serve]' vla-eval==0.8.0
	@touch $@

test-vla-eval: $(VLA)/.ready  ## run episodes with the real vla-eval package
	$(VLA)/bin/python tests/integrations/check_vla_eval.py

# RLinf asks for the libraries of its trainers, too; its environment worker needs these.
RLINF := .venv-rlinf
$(RLINF)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing RLinf into $(RLINF), once"
	@"$(PYTHON)" -m venv $(RLINF)
	@$(RLINF)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[learn,scale]' omegaconf regex 'imageio[ffmpeg]'
	@$(RLINF)/bin/python -m pip install -q --disable-pip-version-check --no-deps rlinf==0.3.0
	@touch $@

test-rlinf: $(RLINF)/.ready  ## a rollout and an evaluation by the environment worker of the real RLinf package
	$(RLINF)/bin/python tests/integrations/check_rlinf.py

# lerobot 0.6 needs Python 3.12: make PYTHON=python3.12 test-lerobot-env
LEROBOT_ENV := .venv-lerobot-env
$(LEROBOT_ENV)/.ready: $(SETUP_FILES) plugins/lerobot_env_mjhab/pyproject.toml
	@echo "mjhab: installing lerobot into $(LEROBOT_ENV), once (8 GB)"
	@"$(PYTHON)" -m venv $(LEROBOT_ENV)
	@$(LEROBOT_ENV)/bin/python -m pip install -q --disable-pip-version-check -e '.[data,serve]' -e plugins/lerobot_env_mjhab "lerobot[dataset]==0.6.1"
	@touch $@

test-lerobot-env: $(LEROBOT_ENV)/.ready  ## read, learn, evaluate and serve with the newest lerobot package (8 GB to install, Python 3.12)
	HF_HUB_OFFLINE=1 HF_DATASETS_CACHE=$(LEROBOT_OUT)/cache06 $(LEROBOT_ENV)/bin/python tests/integrations/check_lerobot_env.py
	$(LEROBOT_ENV)/bin/python tests/lerobot/make_set.py $(LEROBOT_OUT)/shards $(EPISODES)
	$(LEROBOT_ENV)/bin/python -m mjhab export lerobot $(LEROBOT_OUT)/shards --version 3.0 --out $(LEROBOT_OUT)/v30 --overwrite --json
	HF_HUB_OFFLINE=1 HF_DATASETS_CACHE=$(LEROBOT_OUT)/cache30 \
	  $(LEROBOT_ENV)/bin/python tests/lerobot/check_export.py $(LEROBOT_OUT)/v30 $(LEROBOT_OUT)/shards

RAY := .venv-ray
$(RAY)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing Ray into $(RAY), once"
	@"$(PYTHON)" -m venv $(RAY)
	@$(RAY)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[scale]' pytest
	@touch $@

test-ray: $(RAY)/.ready  ## generation on a local Ray cluster, with workers killed in the middle
	PYTHONPATH=src:. $(RAY)/bin/python -m pytest tests/data/record/ray_cluster.py $(PYTEST_ARGS)

BROWSER_OUT := runs/browser
test-browser: $(VENV)/.dev  ## the viewer, and the site of make docs, in headless Chromium (skipped without); pictures in runs/browser
	PYTHONPATH=src:. $(BIN)/python tests/viewer/check_browser.py $(BROWSER_OUT)

DOCS_OUT := runs/docs
test-docs: $(VENV)/.dev  ## run the commands of the documentation with small numbers, page by page; in runs/docs
	PYTHONPATH=src:. $(BIN)/python tests/docs/check_commands.py $(DOCS_OUT)

DOCS := .venv-docs
$(DOCS)/.ready: docs/requirements.txt
	@echo "mjhab: installing mkdocs into $(DOCS), once"
	@"$(PYTHON)" -m venv $(DOCS)
	@$(DOCS)/bin/python -m pip install -q --disable-pip-version-check -r docs/requirements.txt
	@touch $@

docs: $(DOCS)/.ready  ## the documentation as a site, with a reference made of docstrings, in runs/site
	$(DOCS)/bin/mkdocs build --clean
	@echo "Open in a browser (no network needed): $(CURDIR)/runs/site/index.html"

release-check:  ## build sdist and wheel, install the wheel alone into an empty environment, run demo and examples there
	"$(PYTHON)" tests/packaging/release_check.py

SB3 := .venv-sb3
$(SB3)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing stable-baselines3 into $(SB3), once"
	@"$(PYTHON)" -m venv $(SB3)
	@$(SB3)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[learn]' pytest \
	  stable-baselines3==2.9.2
	@touch $@

test-sb3: $(SB3)/.ready  ## stable-baselines3 trains in our environments
	$(SB3)/bin/python -m pytest tests/adapters/check_sb3.py $(PYTEST_ARGS)

SKRL := .venv-skrl
$(SKRL)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing skrl into $(SKRL), once"
	@"$(PYTHON)" -m venv $(SKRL)
	@$(SKRL)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[learn]' pytest skrl==2.1.1
	@touch $@

test-skrl: $(SKRL)/.ready  ## skrl trains in our environments
	$(SKRL)/bin/python -m pytest tests/adapters/check_skrl.py $(PYTEST_ARGS)

MANISKILL := .venv-maniskill
$(MANISKILL)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing mani_skill into $(MANISKILL), once"
	@"$(PYTHON)" -m venv $(MANISKILL)
	@$(MANISKILL)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[learn]' pytest \
	  mani_skill==3.0.1
	@touch $@

test-maniskill: $(MANISKILL)/.ready  ## ManiSkill's own reader takes exported data sets
	$(MANISKILL)/bin/python -m pytest tests/adapters/check_maniskill.py $(PYTEST_ARGS)

RSL_RL := .venv-rsl-rl
$(RSL_RL)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing rsl_rl into $(RSL_RL), once"
	@"$(PYTHON)" -m venv $(RSL_RL)
	@$(RSL_RL)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[learn]' pytest \
	  rsl-rl-lib==5.5.1
	@touch $@

test-rsl-rl: $(RSL_RL)/.ready  ## rsl_rl trains in our environments
	$(RSL_RL)/bin/python -m pytest tests/adapters/check_rsl_rl.py $(PYTEST_ARGS)

# RLlib names one version of Gymnasium, an older one than constraints.txt has.
RLLIB := .venv-rllib
$(RLLIB)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing Ray RLlib into $(RLLIB), once"
	@"$(PYTHON)" -m venv $(RLLIB)
	@grep -v '^gymnasium' constraints.txt > $(RLLIB)/constraints.txt
	@$(RLLIB)/bin/python -m pip install -q --disable-pip-version-check -c $(RLLIB)/constraints.txt -e '.[learn]' pytest \
	  'ray[rllib]==2.60.0'
	@touch $@

test-rllib: $(RLLIB)/.ready  ## Ray RLlib trains in our environments, with samplers in other processes
	PYTHONPATH=src $(RLLIB)/bin/python -m pytest tests/adapters/check_rllib.py $(PYTEST_ARGS)

TORCHRL := .venv-torchrl
$(TORCHRL)/.ready: $(SETUP_FILES) | $(BIN)/python
	@echo "mjhab: installing torchrl into $(TORCHRL), once"
	@"$(PYTHON)" -m venv $(TORCHRL)
	@$(TORCHRL)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[learn]' pytest \
	  torchrl==0.14.1 tensordict==0.15.3
	@touch $@

test-torchrl: $(TORCHRL)/.ready  ## torchrl trains in our environments
	$(TORCHRL)/bin/python -m pytest tests/adapters/check_torchrl.py $(PYTEST_ARGS)

ROBOSUITE := .venv-robosuite
$(ROBOSUITE)/.ready: | $(BIN)/python
	@echo "mjhab: getting the files of robosuite into $(ROBOSUITE), once (160 MB)"
	@$(PIP) install -q --no-deps --target $(ROBOSUITE) robosuite==1.5.2
	@touch $@

test-panda: $(VENV)/.dev $(ROBOSUITE)/.ready  ## the robot panda_omron does every subtask; its episodes are recorded and replayed
	PYTHONPATH=src:$(ROBOSUITE) $(BIN)/python -m pytest tests/robots/check_panda_omron.py $(PYTEST_ARGS)

check: check-static  ## lint, format, types, dead names and the import rule
	$(BIN)/python -m pytest -q tests/test_imports.py

# What `make test` does not run; continuous integration runs both.
check-static: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python tests/guard/dead_names.py

format: $(VENV)/.dev  ## rewrite the sources in the house format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(VENV)/.core  ## control steps per second of the engine and of the environment
	$(BIN)/python -m benchmarks.sim --worlds 16

docs-media: $(VENV)/.dev $(VENV)/.learn  ## draw the pictures and films of README and documentation anew, in docs/media
	$(BIN)/python docs/scripts/media.py --into docs/media

gpu-report: $(VENV)/.dev  ## measure the warp backend, on a GPU if there is one; writes docs/results/gpu-*.json
	$(BIN)/python -m benchmarks.gpu_report docs/results

GPU_TRAIN_OUT ?= runs/gpu-train
MINUTES ?= 10
TRAIN_ARGS ?=
gpu-train: $(VENV)/.dev  ## train the ten rows of Table 1 by reinforcement, MINUTES=10 each, on a GPU if there is one
	$(BIN)/mjhab reproduce table1 --column rl_all --preset fast --backend auto --budget-minutes $(MINUTES) \
	  --out $(GPU_TRAIN_OUT) $(if $(wildcard $(GPU_TRAIN_OUT)/config.json),--resume) $(TRAIN_ARGS)

clean:  ## remove caches and build products (runs and .venv stay)
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## also remove .venv
	rm -rf $(VENV) $(LEROBOT) $(LEROBOT_ENV) $(VLA) $(RAY) $(DOCS) $(SB3) $(SKRL) $(MANISKILL) $(RSL_RL) $(RLLIB) $(TORCHRL) $(ROBOSUITE) src/*.egg-info
