.PHONY: help demo dashboard soak test test-all lint bench serve api system venv clean mcp bridge real-arm real-arm-test real-arm-next foreign lerobot lerobot-next dds-security models conform
.DEFAULT_GOAL := help
VENV := .venv
BIN := $(VENV)/bin
REAL_ARM := .venv-lerobot/bin
MODELS := .venv-models/bin
POLICIES := .venv-policies/bin
DDS_SECURITY := .venv-dds-security/bin
DDS_TESTS := tests/integration/ros/test_dds.py tests/integration/ros/test_dds_security.py \
  tests/integration/ros/test_rtps_bridge.py tests/ros/test_dds_types.py tests/ros/test_dds_security.py
# Most tests wait for another process; a file stays on one worker, so that its own tests never meet. The files begin in
# the order of tests/conftest.py: xdist's own begins with many that wait, and leaves those that compute for the end.
WORKERS := --numprocesses 4 --dist loadfile --no-loadscope-reorder
# These start more of them, or a browser. Reachy Mini's daemons take one fixed port, so theirs run one after another.
PAIR := --numprocesses 2 --dist loadfile
GL_PACKAGES := libegl1 libgl1 libgl1-mesa-dri libosmesa6

help:  ## Show these targets
	@grep -E '^[a-z-]+:.*##' Makefile | sed 's/:.*##/\t/' | expand -t 16

venv:  ## What tests, examples and every extra but bridge and lerobot need, in .venv
	@./scripts/venv.sh $(VENV) requirements/dev.lock

demo:  ## An agent in another process has a simulated arm put a cube on a plate, and is stopped
	@[ -f $(VENV)/.installed-dev.lock ] || ./scripts/venv.sh $(VENV) requirements/demo.lock
	@$(BIN)/strands-robots demo $(ARGS)

serve: venv  ## Serve a simulated SO-100 on this machine (ROBOT=..., ARGS=...)
	@$(BIN)/strands-robots serve $(or $(ROBOT),so100) $(ARGS)

dashboard: venv  ## The operator's page in a browser, on four simulated robots
	@$(BIN)/strands-robots dashboard --demo $(ARGS)

test: venv  ## Everything that needs nothing but wheels
	@./scripts/tests.sh $(BIN)/python -m "not system" $(WORKERS) $(ARGS)

system:
	@./scripts/system-packages.sh $(GL_PACKAGES) mosquitto iproute2 chromium fonts-dejavu-core
	@./scripts/reachy-daemon.sh 1.13.0
	@./scripts/reachy-daemon.sh 1.4.1
	@./scripts/real-arm.sh
	@./scripts/models.sh
	@./scripts/mcp.sh
	@./scripts/mcp-conformance.sh
	@./scripts/venv.sh .venv-bridge requirements/bridge.lock
	@./scripts/rosbridge.sh
	@./scripts/registry.sh
	@./scripts/strands-05.sh
	@./scripts/axe.sh
	@./scripts/dds-peers.sh
	@./scripts/dds-security.sh

test-all: venv system  ## What needs Debian or npm packages besides
	@./scripts/tests.sh $(BIN)/python -m system --ignore tests/integration/reachy $(PAIR) $(ARGS)
	@./scripts/tests.sh $(BIN)/python -m system tests/integration/reachy $(ARGS)
	@./scripts/tests.sh $(REAL_ARM)/python tests/integration/hardware $(ARGS)
	@./scripts/tests.sh $(MODELS)/python tests/integration/simulation $(ARGS)
	@./scripts/tests.sh .venv-mcp/bin/python tests/integration/mcp $(ARGS)
	@./scripts/tests.sh .venv-bridge/bin/python tests/integration/device_connect/test_agents.py $(ARGS)
	@./scripts/tests.sh $(DDS_SECURITY)/python $(DDS_TESTS) $(ARGS)

mcp:  ## The MCP server on the newest MCP SDK, in .venv-mcp, and its tests
	@./scripts/mcp.sh
	@./scripts/tests.sh .venv-mcp/bin/python tests/integration/mcp $(ARGS)

bridge:  ## The framework's own MCP bridge, in .venv-bridge, and its test
	@./scripts/venv.sh .venv-bridge requirements/bridge.lock
	@./scripts/tests.sh .venv-bridge/bin/python tests/integration/device_connect/test_agents.py $(ARGS)

dds-security:  ## DDS Security on a Cyclone DDS that has it, in .venv-dds-security, and its tests
	@./scripts/dds-security.sh
	@./scripts/tests.sh $(DDS_SECURITY)/python $(DDS_TESTS) $(ARGS)

real-arm:  ## LeRobot's own SO-100/SO-101 driver without torch, in .venv-lerobot
	@./scripts/real-arm.sh

real-arm-test: real-arm  ## The tests of a real arm, on emulated servos
	@./scripts/tests.sh $(REAL_ARM)/python tests/integration/hardware $(ARGS)

conform: venv real-arm  ## Check every built-in robot and driver, and write the README's table of their tiers
	@$(BIN)/python scripts/conform.py $(ARGS)

models:  ## The models of eight other projects in a world of ours, in .venv-models, and their test
	@./scripts/models.sh
	@./scripts/tests.sh $(MODELS)/python tests/integration/simulation $(ARGS)

lerobot:  ## LeRobot 0.4.4 with torch, in .venv-policies, and the tests of policies that are computed here
	@./scripts/lerobot.sh
	@./scripts/tests.sh $(POLICIES)/python tests/integration/policies $(ARGS)

lerobot-next:  ## The same on LeRobot 0.6.1, which needs Python 3.12 (PYTHON=python3.12), in .venv-policies-0.6.1
	@./scripts/lerobot.sh 0.6.1
	@./scripts/tests.sh .venv-policies-0.6.1/bin/python tests/integration/policies $(ARGS)

real-arm-next:  ## The arm driver of LeRobot 0.6.1, which needs Python 3.12 (PYTHON=python3.12), in .venv-lerobot-0.6.1
	@./scripts/real-arm.sh 0.6.1
	@./scripts/tests.sh .venv-lerobot-0.6.1/bin/python tests/integration/hardware $(ARGS)

foreign:  ## Robots of other people's packages from the index, graded on emulated buses (ARGS=PACKAGE)
	@./scripts/foreign.sh $(ARGS)

soak: venv  ## A hundred robots at 10 Hz on the page for ten minutes (SECONDS=600)
	@$(BIN)/python -m benchmarks.soak $(or $(SECONDS),600)

lint: venv  ## ruff and mypy --strict
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

bench: venv  ## The tables of docs/benchmarks.md, measured here and now
	@$(BIN)/python -m benchmarks $(ARGS)

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis dist
