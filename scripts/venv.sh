#!/usr/bin/env bash
# Usage: venv.sh DIR LOCK. Makes the virtual environment DIR with what LOCK names and this project in it.
# Does nothing when DIR already holds exactly that.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=$1 lock=$2
stamp="$dir/.installed-$(basename "$lock")"
want=$(cat "$lock" pyproject.toml | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
  echo "strands-robots-edge needs Python 3.11 or newer; $python is $("$python" -V). Set PYTHON to a newer one." >&2
  exit 1
}
if [ ! -x "$dir/bin/pip" ]; then
  "$python" -c 'import ensurepip, venv' 2>/dev/null || ./scripts/system-packages.sh python3-venv
  "$python" -m venv "$dir"
fi
echo "Installing into $dir (once; about a minute)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps --require-hashes -r "$lock"
# Before it had a name of its own, this project was installed as strands-robots, which is another project's name.
"$dir/bin/pip" uninstall --quiet --quiet --yes strands-robots
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps --editable .
rm -f "$dir"/.installed-*
echo "$want" >"$stamp"
