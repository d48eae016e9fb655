#!/usr/bin/env bash
# Makes .venv-strands-05 with strands-robots 0.5.3 itself, for the tests of a fleet of both. Does nothing when it is
# there. 0.5.3 needs Python 3.12: PYTHON312 names one, or one is found on the path, in pyenv or by uv, which fetches one.
# Without any it says so and succeeds: the tests are skipped then, and fail in CI. The package comes without what it asks
# for, beside what its mesh and its Device Connect use: no torch, no OpenCV.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-strands-05
pins=(eclipse-zenoh==1.10.2 device-connect-edge==0.2.5 device-connect-agent-tools==0.2.5 strands-agents==1.62.0
  cryptography==50.0.2 json5==0.17.3 numpy==2.5.5)
stamp=$dir/.installed
want=$(sha256sum <"$0")
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0

# A pyenv shim is on the path for versions that it does not run, so each candidate is asked.
runs() { "$1" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; }
python=
for candidate in ${PYTHON312:+"$PYTHON312"} python3.12 python3 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12.*/bin/python; do
  if runs "$candidate"; then
    python=$candidate
    break
  fi
done
if [ -z "$python" ]; then
  tool=$(mktemp -d)
  trap 'rm -rf "$tool"' EXIT
  python3 -c 'import ensurepip, venv' 2>/dev/null || ./scripts/system-packages.sh python3-venv
  python3 -m venv "$tool"
  "$tool/bin/pip" install --quiet --disable-pip-version-check "uv>=0.8" && "$tool/bin/uv" python install --quiet 3.12 &&
    python=$("$tool/bin/uv" python find 3.12) || python=
fi
if [ -z "$python" ]; then
  echo "No Python 3.12 for strands-robots 0.5.3: the tests of a fleet of both are not run. Set PYTHON312 to one." >&2
  exit 0
fi
echo "Installing strands-robots 0.5.3 into $dir (once)..."
rm -rf "$dir"
"$python" -m venv "$dir"
"$dir/bin/pip" install --quiet --disable-pip-version-check "${pins[@]}"
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps strands-robots==0.5.3
echo "$want" >"$stamp"
