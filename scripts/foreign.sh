#!/usr/bin/env bash
# Usage: foreign.sh [PACKAGE...]. Grades packages of other people with robots for LeRobot, on emulated buses, and writes
# the table of docs/foreign-robots.md. Some need LeRobot 0.6.1, which needs Python 3.12: PYTHON312 names one, or one is
# found on the path or in pyenv. Without any those packages are left as they are.
set -euo pipefail
cd "$(dirname "$0")/.."
./scripts/real-arm.sh
# A pyenv shim is on the path for versions that it does not run, so each candidate is asked.
runs() { "$1" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; }
for python in ${PYTHON312:+"$PYTHON312"} python3.12 python3 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12.*/bin/python; do
  if runs "$python"; then
    PYTHON=$python ./scripts/real-arm.sh 0.6.1
    break
  fi
done
exec .venv-lerobot/bin/python scripts/foreign.py "$@"
