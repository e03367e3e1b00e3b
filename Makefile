# make run          the pipeline on the simulated sensor, publishing over ZeroMQ, with its live view
# make test         lint, types, tests
# make soak         the tests that take longer: faults in running processes, load over time
# make fuzz         damaged input to every parser, SECONDS for each
# make reliability  lets every fault happen, and writes docs/reliability.md
# make kernels      measures what compiling gains, and writes docs/kernels.md
# make system-deps  what the tests need from the system: a browser, ffmpeg (Debian; needs root)

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --quiet --disable-pip-version-check --no-input

# Debian packages that tests use; without them those tests say that they were skipped.
SYSTEM_DEPS := chromium ffmpeg

.PHONY: run test soak fuzz lint types reliability kernels system-deps clean

run: $(VENV)/.installed
	$(VENV)/bin/tactflow run pipeline.yaml --realtime

test: lint types
	$(PY) -m pytest -m "not slow" --numprocesses auto --dist loadfile

# One at a time: what is measured or stopped at a moment shall not compete with its neighbours.
soak: $(VENV)/.installed-test
	$(PY) -m pytest -m slow

fuzz: SECONDS := 300
fuzz: $(VENV)/.installed-test
	$(PY) -m tests.fuzz --seconds $(SECONDS) --seed $$(date +%s)

lint: $(VENV)/.installed-test
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

types: $(VENV)/.installed-test
	$(PY) -m mypy
	$(PY) -m mypy --platform darwin
	$(PY) -m mypy --platform win32

reliability: $(VENV)/.installed-test
	$(PY) -m tests.faults

kernels: $(VENV)/.installed-test
	$(PY) -m tests.oracles

$(VENV)/bin/python:
	python3 -m venv $(VENV)

$(VENV)/.installed: pyproject.toml setup.py constraints.txt | $(VENV)/bin/python
	$(PIP) install --constraint constraints.txt --editable ".[all]"
	@touch $@

$(VENV)/.installed-test: pyproject.toml setup.py constraints.txt | $(VENV)/bin/python
	$(PIP) install --constraint constraints.txt --editable ".[test]"
	@touch $@ $(VENV)/.installed

# apt may be busy with something else: try again for a while.
system-deps:
	@dpkg --status $(SYSTEM_DEPS) >/dev/null 2>&1 || for attempt in 1 2 3 4 5 6 7 8 9 10; do \
		apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 \
			install --yes --no-install-recommends $(SYSTEM_DEPS) >/dev/null && exit 0; \
		echo "system-deps: attempt $$attempt failed" >&2; sleep 10; \
	done; dpkg --status $(SYSTEM_DEPS) >/dev/null

clean:
	rm -rf $(VENV) build dist out *.egg-info src/*.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
