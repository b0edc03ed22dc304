# Two commands do all set-up on a machine with python3, pip, make and git:
#   make demo   the main job end to end, without hardware
#   make test   the tests
PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin

.PHONY: demo test test-slow test-lerobot test-ros lint format clean

$(VENV)/.installed: pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/tiptrace demo

test: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2 -m slow

# Opt-in: the readers of LeRobot themselves, in two heavy environments of their own (v3.0 and v2.1 of the format).
test-lerobot: $(VENV)/.installed
	test -d .lerobot30 || ($(PYTHON) -m venv .lerobot30 && .lerobot30/bin/pip install --quiet lerobot==0.4.4)
	test -d .lerobot21 || ($(PYTHON) -m venv .lerobot21 && .lerobot21/bin/pip install --quiet lerobot==0.3.3)
	TIPTRACE_LEROBOT_V30=$(CURDIR)/.lerobot30/bin/python TIPTRACE_LEROBOT_V21=$(CURDIR)/.lerobot21/bin/python \
		$(BIN)/python -m pytest -m slow tests/export/test_lerobot.py

# Opt-in: ROS_PYTHON is an interpreter that has rclpy and tiptrace (docs/ros2.md).
test-ros: $(VENV)/.installed
	TIPTRACE_ROS_PYTHON=$(ROS_PYTHON) $(BIN)/python -m pytest -m slow tests/ros

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo .pytest_cache .mypy_cache .ruff_cache
