# make run          the pipeline on the simulated sensor, for a minute; open the printed address to watch
# make test         lint, types, tests; the summary says what was skipped
# make soak         what takes longer: faults in running processes, a million frames (two hours)
# make load         results, drops, latency and memory against the load (five minutes)
# make audit        known weaknesses of the packages that are used, where the list can be reached
# make lock         requirements.lock anew: all packages of all environments; LOCK=--upgrade takes newer ones
# make docs         the site in build/site, from docs/ and examples/gallery (an environment of its own)
# make packages     the wheel and the sdist in dist/, checked as a package index does
# make ros-env      rclpy in an environment of its own (130 MB), for the tests of the ROS 2 bridge
# make lerobot-env  LeRobot in an environment of its own (650 MB), for the tests of its camera
# make lerobot-datasets  the same with PyTorch (up to 8 GB), for the tests of its datasets
# make peers        packages to compare with, in environments of their own (5 GB; more with CUDA)
# make peers-page   measures them beside tactflow and writes docs/peers.md; DATA is a folder of recordings
# make system-deps  what the tests need from the system: a browser, ffmpeg (Debian; needs root)

VENV := .venv
PY := $(VENV)/bin/python
TOOLS := $(VENV)-tools
ROS := $(VENV)-ros
LEROBOT := $(VENV)-lerobot
DOCS := $(VENV)-docs
PEERS := $(VENV)-peers
PIP := -m pip --quiet --disable-pip-version-check --no-input
# Nothing is installed that is not the file whose hash stands in requirements.lock; what builds is one of them.
LOCKED := packaging/lock.py install
ITSELF := install --no-deps --no-build-isolation --editable .

# Debian packages that tests use; without them those tests say that they were skipped.
SYSTEM_DEPS := chromium ffmpeg

.PHONY: run test soak load audit lock lint types docs packages ros-env lerobot-env lerobot-datasets peers peers-page \
	system-deps clean

run: $(VENV)/.installed
	$(VENV)/bin/tactflow run pipeline.yaml --realtime --source "sim:press?frames=3600"

# Many tests wait for other processes: half as many again as there are cores keep all of them busy.
WORKERS := $(shell python3 -c "import os; print(3 * os.cpu_count() // 2)")

test: lint types
	$(PY) -m pytest -m "not slow" --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder
	$(PY) -m tactflow stress --quick --json build/stress.json --page build/stress.html

# One at a time: what is measured or stopped at a moment shall not compete with its neighbours.
soak: $(VENV)/.installed-test
	$(PY) -m pytest -m slow
	$(PY) lab/load.py --soak 1000000

load: $(VENV)/.installed-test
	$(PY) lab/load.py

lint: $(VENV)/.installed-test
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

# One beside the other, each with a cache of its own, as what is checked depends on the system.
SYSTEMS := linux darwin win32
types: $(VENV)/.installed-test
	$(MAKE) --jobs=$(shell python3 -c "import os; print(os.cpu_count())") --output-sync $(SYSTEMS:%=types-%)

types-%: $(VENV)/.installed-test
	$(PY) -m mypy --platform $* --cache-dir .mypy_cache/$*


$(VENV)/bin/python:
	python3 -m venv $(VENV)

# Compiled by installing.
LOOPS := $(wildcard src/tactflow/vision/*.c src/tactflow/vision/loops/*.h)

$(VENV)/.installed: pyproject.toml setup.py requirements.lock $(LOOPS) | $(VENV)/bin/python
	$(PY) $(LOCKED) run
	$(PY) $(PIP) $(ITSELF)
	@touch $@

$(VENV)/.installed-test: pyproject.toml setup.py requirements.lock $(LOOPS) | $(VENV)/bin/python
	$(PY) $(LOCKED) test
	$(PY) $(PIP) $(ITSELF)
	@touch $@ $(VENV)/.installed

docs: $(DOCS)/.installed
	$(DOCS)/bin/python docs/site/build.py build/site

$(DOCS)/.installed: pyproject.toml setup.py requirements.lock
	python3 -m venv $(DOCS)
	$(DOCS)/bin/python $(LOCKED) docs
	$(DOCS)/bin/python $(PIP) $(ITSELF)
	@touch $@

packages: $(TOOLS)/.installed
	rm -rf build dist
	$(TOOLS)/bin/python -m build --quiet
	$(TOOLS)/bin/twine check --strict dist/*
	$(TOOLS)/bin/check-wheel-contents dist/*.whl

ros-env: $(ROS)/.installed

# Beside it there is no tactflow, as on a robot.
$(ROS)/.installed: requirements.lock
	python3 -m venv $(ROS)
	$(ROS)/bin/python $(LOCKED) ros
	@touch $@

lerobot-env: $(LEROBOT)/.installed

# Without what LeRobot's cameras do not import, see left_out.txt. Of the two packages that own the folder cv2,
# the one with more in it comes last.
$(LEROBOT)/.installed: requirements.lock plugins/lerobot/camera/pyproject.toml pyproject.toml
	python3 -m venv $(LEROBOT)
	$(LEROBOT)/bin/python $(LOCKED) lerobot
	$(LEROBOT)/bin/python $(LOCKED) lerobot --again opencv-contrib-python-headless
	$(LEROBOT)/bin/python $(PIP) $(ITSELF) --editable plugins/lerobot/camera
	@touch $@

# Bounds as in LeRobot 0.4.4. On a machine without CUDA, `pip config set global.extra-index-url` with PyTorch's index for CPUs saves 4 GB.
lerobot-datasets: $(LEROBOT)/.installed
	$(LEROBOT)/bin/python $(PIP) install \
		"torch<2.11" "torchvision<0.26" "accelerate<2" "datasets<5" "huggingface-hub<0.36" "av<16" \
		"diffusers<0.36" "gymnasium<2" "deepdiff<9" imageio pyserial termcolor pandas pyarrow jsonlines einops

PIN_gs_sdk := gs_sdk==2.0.0
PIN_opentouch-interface := opentouch-interface==0.2.0 torch==2.13.0
PIN_xensesdk := xensesdk==2.0.1
OTHER_PEERS := $(patsubst %,$(PEERS)-others/%/.installed,gs_sdk opentouch-interface xensesdk)

peers: $(PEERS)/.installed $(OTHER_PEERS)

DATA := ../shared/data
peers-page: peers
	$(PEERS)/bin/python -W ignore -m lab.peers --data $(DATA) --page docs/peers.md

# For CPUs alone, as for lerobot-datasets. pytouch's requirements have no wheels here; it imports an old torchvision.
$(PEERS)/.installed: lab/peers/requirements.txt pyproject.toml
	python3 -m venv $(PEERS)
	$(PEERS)/bin/python $(PIP) install --requirement lab/peers/requirements.txt
	$(PEERS)/bin/python $(PIP) install \
		--no-deps --no-build-isolation pytouch==0.4.2 torchvision==0.15.2 --editable .
	@touch $@

$(PEERS)-others/%/.installed:
	python3 -m venv $(@D)
	$(@D)/bin/python $(PIP) install $(PIN_$*)
	@touch $@

$(TOOLS)/.installed:
	python3 -m venv $(TOOLS)
	$(TOOLS)/bin/python $(PIP) install \
		pip-audit uv build twine check-wheel-contents
	@touch $@

lock: $(TOOLS)/.installed
	$(TOOLS)/bin/python packaging/lock.py make $(LOCK)

ADVISORIES := https://pypi.org/pypi/numpy/2.0.0/json
audit: $(TOOLS)/.installed
	@$(TOOLS)/bin/python -c "from urllib.request import urlopen; urlopen('$(ADVISORIES)', timeout=30)" 2>/dev/null || \
		{ echo "audit: $(ADVISORIES) cannot be reached; nothing was checked" >&2; exit 1; }
	$(TOOLS)/bin/python packaging/lock.py show test > $(TOOLS)/requirements.txt
	$(TOOLS)/bin/pip-audit --strict --disable-pip --require-hashes --requirement $(TOOLS)/requirements.txt

# apt may be busy with something else: try again for a while.
system-deps:
	@dpkg --status $(SYSTEM_DEPS) >/dev/null 2>&1 || for attempt in 1 2 3 4 5 6 7 8 9 10; do \
		apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 \
			install --yes --no-install-recommends $(SYSTEM_DEPS) >/dev/null && exit 0; \
		echo "system-deps: attempt $$attempt failed" >&2; sleep 10; \
	done; dpkg --status $(SYSTEM_DEPS) >/dev/null

clean:
	rm -rf $(VENV) $(TOOLS) $(ROS) $(LEROBOT) $(DOCS) $(PEERS) $(PEERS)-others build dist out *.egg-info src/*.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
