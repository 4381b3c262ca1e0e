# make setup | demo | test | bench | lint | clean.  All of it happens in .venv; nothing else is installed.

VENV := .venv
BIN := $(VENV)/bin
STAMPS := $(VENV)/stamps
ROOT := $(CURDIR)
DATA := $(abspath $(ROOT)/../shared/data)

# .venv is complete in itself: a sourced ROS workspace or another environment must not mix in.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH \
  AMENT_CURRENT_PREFIX ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION _ROS_WHEELS_BOOTSTRAP_COMPLETE
export PATH := $(abspath $(BIN)):$(PATH)
export VIRTUAL_ENV := $(abspath $(VENV))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
export BEACON_COMM_DATA ?= $(DATA)
# The checkout's beacon_comm/ has no compiled messages: never import it from the current folder.
export PYTHONSAFEPATH := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

MESSAGES := $(wildcard msg/*.msg)
BUILD_FILES := CMakeLists.txt setup.py setup.cfg pyproject.toml package.xml $(wildcard cmake/*)
INTERFACE := interfaces/event_camera_msgs
INTERFACE_FILES := $(INTERFACE)/package.xml $(INTERFACE)/CMakeLists.txt $(wildcard $(INTERFACE)/msg/*.msg)
BENCH_INTERFACE := interfaces/dvs_msgs
BENCH_INTERFACE_FILES := $(BENCH_INTERFACE)/package.xml $(BENCH_INTERFACE)/CMakeLists.txt $(wildcard $(BENCH_INTERFACE)/msg/*.msg)

# Build a message package (1: its folder) and install it (2: where).
define build_interface
export AMENT_PREFIX_PATH=$(abspath $(VENV)) && \
( cmake -S $(1) -B $(VENV)/build/$(notdir $(1)) -G Ninja -DCMAKE_BUILD_TYPE=Release \
    -DBUILD_TESTING=OFF -DCMAKE_INSTALL_PREFIX=$(abspath $(2)) -DCMAKE_PREFIX_PATH=$(abspath $(VENV)) \
    -DPython3_EXECUTABLE=$(abspath $(BIN))/python -DCMAKE_PROJECT_INCLUDE=$(ROOT)/cmake/ros_wheels.cmake && \
  cmake --build $(VENV)/build/$(notdir $(1)) && cmake --install $(VENV)/build/$(notdir $(1)) \
) > $(VENV)/$(notdir $(1)).log 2>&1 || { cat $(VENV)/$(notdir $(1)).log >&2; exit 1; }
endef

.PHONY: help setup demo test bench lint clean
.DELETE_ON_ERROR:

help:
	@echo 'make setup   make .venv: Python, ROS 2 from PyPI, this package with its messages, test tools'
	@echo 'make demo    setup, then replay a short recording into the live node and print what it reads'
	@echo 'make test    setup, then lint and all tests'
	@echo 'make bench   setup, then measure the speed, by stages and live: tables, and bench.json'
	@echo 'make lint    setup, then ruff and mypy'
	@echo 'make clean   remove .venv and everything built'

setup: $(STAMPS)/package $(STAMPS)/event_camera_msgs
	@$(BIN)/python scripts/link_sources.py

demo: setup
	@$(BIN)/python -m beacon_comm.cli.demo

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/mypy

test: lint
	@$(BIN)/pytest test

# PyPI's evt3 is only compared with; the bench says so where it is missing.
bench: setup $(STAMPS)/dvs_msgs
	@$(BIN)/python -c 'import evt3' 2>/dev/null || $(BIN)/python -m pip install --quiet evt3 || true
	@$(BIN)/python bench/bench.py

# The bench's second message type; in a folder of its own, since the environment is to be as a robot's without it.
$(STAMPS)/dvs_msgs: $(BENCH_INTERFACE_FILES) cmake/ros_wheels.cmake | $(STAMPS)/requirements
	@echo 'bench: building dvs_msgs from $(BENCH_INTERFACE)'
	@$(call build_interface,$(BENCH_INTERFACE),$(VENV)/bench)
	@touch $@

clean:
	rm -rf $(VENV) build install log *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find beacon_comm test launch scripts -name __pycache__ -type d -prune -exec rm -rf {} +

# An environment does not survive its folder being moved or its Python being taken away: make it anew.
$(shell grep -qsxF '$(CURDIR)' $(STAMPS)/python && [ -x $(BIN)/python ] || rm -rf $(STAMPS))

$(STAMPS)/python:
	@scripts/check_compiler
	@python=$$(scripts/find_python) && echo "setup: making $(VENV) with $$python" && "$$python" -m venv --clear $(VENV)
	@mkdir -p $(STAMPS) && echo '$(CURDIR)' > $@

$(STAMPS)/requirements: setup.cfg pyproject.toml scripts/requirements.py | $(STAMPS)/python
	@echo 'setup: installing ROS 2, libraries and tools from PyPI (some minutes the first time)'
	@$(BIN)/python scripts/requirements.py > $(VENV)/requirements.txt
	@$(BIN)/python -m pip install --quiet --requirement $(VENV)/requirements.txt
	@touch $@

$(STAMPS)/package: $(BUILD_FILES) $(MESSAGES) msg | $(STAMPS)/requirements
	@echo 'setup: building and installing beacon_comm with its messages'
	@$(BIN)/python scripts/link_sources.py --remove
	@$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --force-reinstall .
	@touch $@

# event_camera_msgs is on apt only, so the message is built from our definition of it, once it is missing.
$(STAMPS)/event_camera_msgs: $(INTERFACE_FILES) cmake/ros_wheels.cmake | $(STAMPS)/requirements
	@if [ -e $@ ] || ! $(BIN)/python -c 'import event_camera_msgs' 2>/dev/null; then \
	  echo 'setup: building event_camera_msgs from $(INTERFACE)' && $(call build_interface,$(INTERFACE),$(VENV)); \
	fi
	@touch $@
