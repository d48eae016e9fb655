#!/usr/bin/env bash
# What the tests build DDS participants of other vendors with: Fast DDS for C++ and Cyclone DDS for C, from Debian.
set -euo pipefail
cd "$(dirname "$0")/.."
./scripts/system-packages.sh g++ libfastrtps-dev libfastcdr-dev fastddsgen cyclonedds-dev cyclonedds-tools
