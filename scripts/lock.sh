#!/usr/bin/env bash
# Rewrites the lock files from pyproject.toml; all hold hashes and are valid on Python 3.11 to 3.13.
set -euo pipefail
cd "$(dirname "$0")/.."
tool=$(mktemp -d)
trap 'rm -rf "$tool"' EXIT
python3 -m venv "$tool"
"$tool/bin/pip" install --quiet "uv>=0.8"
compile=("$tool/bin/uv" pip compile --universal --python-version 3.11 --generate-hashes --no-header --quiet pyproject.toml)
"${compile[@]}" --extra all --group dev --output-file requirements/dev.lock "$@"
"${compile[@]}" --extra device-connect --extra sim --extra dashboard --extra mcp --constraint requirements/dev.lock --output-file requirements/demo.lock
"${compile[@]}" --extra bridge --extra agent --group dev --output-file requirements/bridge.lock
"${compile[@]}" --group dds-security --output-file requirements/dds-security.lock
